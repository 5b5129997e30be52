"""Smooth deformations of space: warping, bending and twisting.

None moves neighbouring parts of the surface against each other, but no affine map undoes them.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, displace, displace_by, surface
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.spectral.precision import matmul

_WAVE_COUNT = 4
_WAVELENGTH_RANGE = (0.5, 2.0)  # in diagonals
_FULL_TURN_DEGREES = 360.0


def warp(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Move each vertex by a smooth random function of its position that has no affine part.

    It is the sum of four sinusoids in random directions, of wavelengths from 0.5 to 2 diagonals, each with a random
    vector as its amplitude; the affine function of position that fits it best at the vertices is subtracted.

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
    waves = jax.random.normal(direct, (_WAVE_COUNT, 3), x.dtype)
    lengths = jax.random.uniform(length, (_WAVE_COUNT, 1), x.dtype, *_WAVELENGTH_RANGE)
    waves *= 2 * np.pi / (lengths * jnp.linalg.norm(waves, axis=1, keepdims=True))
    phases = jax.random.uniform(turn, (_WAVE_COUNT,), x.dtype, 0, 2 * np.pi)
    amplitudes = jax.random.normal(size, (_WAVE_COUNT, 3), x.dtype)
    shift = matmul(jnp.sin(matmul(x, waves.T) + phases), amplitudes)
    return displace_by(mesh, _remove_affine_part(x, shift, used_vertices(mesh)), strength)


def bending(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Bend the longest axis of the bounding box into a circular arc of the same length.

    The axis goes through the centre of the box, which stays, and bends towards the shorter of the other two sides.
    Planes perpendicular to the axis move rigidly. Where they meet within the mesh, it is folded.

    Args:
        mesh: any mesh, its faces concrete.
        strength: angle of the arc in degrees, in [0, 360].
        key: not used; attacks share one signature.

    Returns:
        The bent mesh. Differentiable with respect to vertices and strength.

    Raises:
        JaxmarkError: if the angle is a number outside [0, 360]; traced angles are not checked.
    """
    if isinstance(strength, float | int) and not 0 <= strength <= _FULL_TURN_DEGREES:
        raise JaxmarkError(f"A mesh is bent by 0 to {_FULL_TURN_DEGREES:g} degrees, got {strength:g}.")

    def bend(x: Array, size: Array, angle: Array) -> Array:
        towards = jnp.where(size[1] <= size[2], jnp.array([0, 1, 0]), jnp.array([0, 0, 1])).astype(x.dtype)
        along, across = x[:, :1], jnp.sum(x * towards, axis=1, keepdims=True)
        turned = angle * along / size[0]
        # sin(t)/t and (1 - cos t)/t = t/2 · (sin(t/2)/(t/2))², also where t is 0.
        forth = along * (jnp.sinc(turned / np.pi) - 1) - across * jnp.sin(turned)
        side = along * turned / 2 * jnp.sinc(turned / (2 * np.pi)) ** 2 + across * (jnp.cos(turned) - 1)
        return forth * jnp.array([1, 0, 0], x.dtype) + side * towards

    return _deform(mesh, strength, bend)


def twisting(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Rotate planes perpendicular to the longest axis of the bounding box, by an angle proportional to the place on it.

    The axis goes through the centre of the box, where the angle is zero; the screw is right-handed.

    Args:
        mesh: any mesh, its faces concrete.
        strength: angle in degrees by which one end is turned against the other.
        key: not used; attacks share one signature.

    Returns:
        The twisted mesh. Differentiable with respect to vertices and strength.
    """

    def twist(x: Array, size: Array, angle: Array) -> Array:
        turned = angle * x[:, 0] / size[0]
        sine, less = jnp.sin(turned), -2 * jnp.sin(turned / 2) ** 2  # cos - 1
        y, z = x[:, 1], x[:, 2]
        return jnp.stack([jnp.zeros_like(y), less * y - sine * z, sine * y + less * z], axis=1)

    return _deform(mesh, strength, twist)


def _deform(mesh: Mesh, degrees: float | Float[Array, ""], shift: Callable[[Array, Array, Array], Array]) -> Mesh:
    """Move vertices by a function of their places in the box, its sizes and an angle in radians; longest axis first."""
    vertices, points = jnp.asarray(mesh.vertices), surface(mesh)
    low, size = points.min(axis=0), jnp.ptp(points, axis=0)
    longest = jnp.argmax(size)
    x = jnp.roll(vertices - (low + size / 2), -longest, axis=1)
    angle = jnp.asarray(degrees).astype(vertices.dtype) * (np.pi / 180)
    return displace(mesh, jnp.roll(shift(x, jnp.roll(size, -longest), angle), longest, axis=1))


def _remove_affine_part(
    x: Float[Array, "vertices 3"], shift: Float[Array, "vertices 3"], used: Bool[np.ndarray, " vertices"]
) -> Float[Array, "vertices 3"]:
    """Subtract from a field the affine function of position that is closest to it at the vertices in use."""
    maps, places = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1), np.flatnonzero(used)
    fitted = maps[places]
    inverse = jnp.linalg.pinv(matmul(fitted.T, fitted))  # flat meshes have no inverse
    # The second pass removes what rounding left.
    for _ in range(2):
        shift = shift - matmul(maps, matmul(inverse, matmul(fitted.T, shift[places])))
    return shift
