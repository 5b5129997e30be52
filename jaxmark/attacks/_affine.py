"""Random similarities and affine maps: the scalings, rotations and translations of Sohn et al.

Their centre is the mean of the vertices that faces use.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, surface
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.spectral.precision import matmul


def similarity(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Rotate, scale and translate the mesh at random.

    Args:
        mesh: any mesh, its faces concrete.
        strength: length of the translation, in a random direction, relative to the diagonal of the bounding box. Scales
            lie between 1/(1 + strength) and 1 + strength and are uniform in their logarithm. Rotations are uniformly
            distributed whatever the strength is.
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
    return _transform(mesh, scale * _rotation(jax.random.normal(turn, (4,), vertices.dtype)), shift)


def affine(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Apply the linear map I + strength · G, where G is random with Frobenius norm 1.

    Args:
        mesh: any mesh, its faces concrete.
        strength: Frobenius norm of the map minus the identity. **Below 1** the map is invertible and preserves
            orientation.
        key: a JAX random key.

    Returns:
        The sheared and scaled mesh. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    change = jax.random.normal(key, (3, 3), vertices.dtype)
    matrix = jnp.eye(3, dtype=vertices.dtype)
    matrix += jnp.asarray(strength).astype(vertices.dtype) * change / jnp.linalg.norm(change)
    return _transform(mesh, matrix, jnp.zeros(3, vertices.dtype))


def _rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a quaternion of any length; normal entries give uniform rotations (Shoemake, 1992)."""
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _transform(mesh: Mesh, matrix: Float[Array, "3 3"], shift: Float[Array, "3"]) -> Mesh:
    """Apply a linear map about the mean of the vertices that faces use, then a translation."""
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    middle = surface(mesh).mean(axis=0)
    moved = middle + matmul(vertices - middle, matrix.T) + shift
    return Mesh(jnp.where(used[:, None], moved, vertices), mesh.faces)
