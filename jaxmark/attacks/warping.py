"""Smooth maps of space: none moves parts of the surface against each other, all move it where it was not."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, displaced, displaced_by, surface
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, used_vertices
from jaxmark.precision import matmul

_WAVES = 4
_LENGTHS = (0.5, 2.0)  # of the waves, in diagonals
_FULL_TURN = 360.0


def warp(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Move each vertex by a smooth random function of its position that has no affine part.

    It is the sum of four sinusoids in random directions, of wavelengths from 0.5 to 2 diagonals, each with a random
    vector as its amplitude; what an affine map of the vertices does best is taken off.

    Args:
        mesh: any mesh, its faces concrete.
        strength: root mean square of the vertices' displacements, relative to the diagonal of the bounding box; met
            exactly.
        key: a JAX random key.

    Returns:
        The warped mesh. Differentiable with respect to vertices and strength.
    """
    points = surface(mesh)
    x = (jnp.asarray(mesh.vertices) - points.mean(axis=0)) / diagonal(points)
    direct, length, turn, size = jax.random.split(key, 4)
    waves = jax.random.normal(direct, (_WAVES, 3), x.dtype)
    lengths = jax.random.uniform(length, (_WAVES, 1), x.dtype, *_LENGTHS)
    waves *= 2 * np.pi / (lengths * jnp.linalg.norm(waves, axis=1, keepdims=True))
    phases = jax.random.uniform(turn, (_WAVES,), x.dtype, 0, 2 * np.pi)
    amplitudes = jax.random.normal(size, (_WAVES, 3), x.dtype)
    shift = matmul(jnp.sin(matmul(x, waves.T) + phases), amplitudes)
    return displaced_by(mesh, _without_affine_part(x, shift, used_vertices(mesh)), strength)


def bending(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Bend the longest axis of the bounding box into an arc of a circle, of the same length.

    The axis through the centre of the box, which stays, is bent towards its shorter other side. Planes across the axis
    stay planes, and keep what is in them. Where they meet within the mesh it is folded.

    Args:
        mesh: any mesh, its faces concrete.
        strength: angle of the arc in degrees, in [0, 360].
        key: not used; attacks share one signature.

    Returns:
        The bent mesh. Differentiable with respect to vertices and strength.

    Raises:
        JaxmarkError: if the angle is a number above a full turn or negative.
    """
    if isinstance(strength, float | int) and not 0 <= strength <= _FULL_TURN:
        raise JaxmarkError(f"A mesh is bent by 0 to {_FULL_TURN:g} degrees, got {strength:g}.")

    def bent(x: Array, size: Array, angle: Array) -> Array:
        towards = jnp.where(size[1] <= size[2], jnp.array([0, 1, 0]), jnp.array([0, 0, 1])).astype(x.dtype)
        along, across = x[:, :1], jnp.sum(x * towards, axis=1, keepdims=True)
        turned = angle * along / size[0]
        # sin(t)/t and (1 - cos t)/t = t/2 · (sin(t/2)/(t/2))², also where t is 0.
        forth = along * (jnp.sinc(turned / np.pi) - 1) - across * jnp.sin(turned)
        side = along * turned / 2 * jnp.sinc(turned / (2 * np.pi)) ** 2 + across * (jnp.cos(turned) - 1)
        return forth * jnp.array([1, 0, 0], x.dtype) + side * towards

    return _deformed(mesh, strength, bent)


def twisting(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Turn planes across the longest axis of the bounding box about it, by an angle that grows along it.

    The axis is that through the centre of the box, where nothing turns; the screw is right-handed.

    Args:
        mesh: any mesh, its faces concrete.
        strength: degrees by which one end is turned against the other.
        key: not used; attacks share one signature.

    Returns:
        The twisted mesh. Differentiable with respect to vertices and strength.
    """

    def twisted(x: Array, size: Array, angle: Array) -> Array:
        turned = angle * x[:, 0] / size[0]
        sine, less = jnp.sin(turned), -2 * jnp.sin(turned / 2) ** 2  # cos - 1
        y, z = x[:, 1], x[:, 2]
        return jnp.stack([jnp.zeros_like(y), less * y - sine * z, sine * y + less * z], axis=1)

    return _deformed(mesh, strength, twisted)


def _deformed(mesh: Mesh, degrees: float | Float[Array, ""], shift: Callable[[Array, Array, Array], Array]) -> Mesh:
    """Vertices moved by a function of their places in the box, of its sizes and of an angle; the longest axis first."""
    vertices, points = jnp.asarray(mesh.vertices), surface(mesh)
    low, size = points.min(axis=0), jnp.ptp(points, axis=0)
    longest = jnp.argmax(size)
    x = jnp.roll(vertices - (low + size / 2), -longest, axis=1)
    angle = jnp.asarray(degrees).astype(vertices.dtype) * (np.pi / 180)
    return displaced(mesh, jnp.roll(shift(x, jnp.roll(size, -longest), angle), longest, axis=1))


def _without_affine_part(
    x: Float[Array, "vertices 3"], shift: Float[Array, "vertices 3"], used: Bool[np.ndarray, " vertices"]
) -> Float[Array, "vertices 3"]:
    """A field less the affine function of the position that comes nearest to it at the vertices that count."""
    maps, places = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1), np.flatnonzero(used)
    fitted = maps[places]
    inverse = jnp.linalg.pinv(matmul(fitted.T, fitted))  # flat meshes have no inverse
    # The second pass takes off what rounding left.
    for _ in range(2):
        shift = shift - matmul(maps, matmul(inverse, matmul(fitted.T, shift[places])))
    return shift
