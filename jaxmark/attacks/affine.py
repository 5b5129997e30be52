"""Affine maps, about the mean of the vertices that faces use: what Sohn et al. do by scale, rotation, translation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, surface
from jaxmark.mesh import Mesh, used_vertices
from jaxmark.precision import matmul


def similarity(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Turn, scale and shift.

    Args:
        mesh: any mesh, its faces concrete.
        strength: length of the shift in any direction, relative to the diagonal of the bounding box; scales are from
            1/(1 + strength) to 1 + strength, uniform in their logarithm. Whatever it is, all rotations are as likely.
        key: a JAX random key.

    Returns:
        The mesh in its new pose. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    most = jnp.asarray(strength).astype(vertices.dtype)
    turn, stretch, direct = jax.random.split(key, 3)
    scale = jnp.exp(jax.random.uniform(stretch, (), vertices.dtype, -1, 1) * jnp.log1p(most))
    direction = jax.random.normal(direct, (3,), vertices.dtype)
    shift = most * diagonal(surface(mesh)) * direction / jnp.linalg.norm(direction)
    return _mapped(mesh, scale * _rotation(jax.random.normal(turn, (4,), vertices.dtype)), shift)


def affine(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Map by I + strength · G, where G is random and its Frobenius norm 1.

    Args:
        mesh: any mesh, its faces concrete.
        strength: Frobenius norm of the map less the identity. **Below 1** the map can be inverted and keeps the mesh
            outside out.
        key: a JAX random key.

    Returns:
        The sheared and scaled mesh. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    change = jax.random.normal(key, (3, 3), vertices.dtype)
    matrix = jnp.eye(3, dtype=vertices.dtype)
    matrix += jnp.asarray(strength).astype(vertices.dtype) * change / jnp.linalg.norm(change)
    return _mapped(mesh, matrix, jnp.zeros(3, vertices.dtype))


def _rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Of a quaternion of any length; a normal one gives all rotations the same chance (Shoemake, 1992)."""
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _mapped(mesh: Mesh, matrix: Float[Array, "3 3"], shift: Float[Array, "3"]) -> Mesh:
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    middle = surface(mesh).mean(axis=0)
    moved = middle + matmul(vertices - middle, matrix.T) + shift
    return Mesh(jnp.where(used[:, None], moved, vertices), mesh.faces)
