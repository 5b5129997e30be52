"""Transformations of space: random similarities and affine maps (Sohn et al.), warping, bending and twisting.

The last three do not move neighbouring parts of the surface relative to each other, but no affine map inverts them.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmark.attacks.support import Positions, Strength, diagonal, displace, displace_by, surface
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.precision import matmul

_WAVE_COUNT = 4
_WAVELENGTH_RANGE = (0.5, 2.0)  # in diagonals


def similarity(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Rotate, scale and translate the mesh at random; differentiable.

    The strength is the length of the translation, in a random direction, relative to the diagonal of the bounding box.
    Scales lie between 1/(1 + strength) and 1 + strength and are uniform in their logarithm. Rotations are uniformly
    distributed whatever the strength is. The centre is the mean of the vertices that faces use.
    """
    vertices = jnp.asarray(mesh.vertices)
    most = jnp.asarray(strength).astype(vertices.dtype)
    turn, stretch, direct = jax.random.split(random_key(seed), 3)
    scale = jnp.exp(jax.random.uniform(stretch, (), vertices.dtype, -1, 1) * jnp.log1p(most))
    direction = jax.random.normal(direct, (3,), vertices.dtype)
    shift = most * diagonal(surface(mesh)) * direction / jnp.linalg.norm(direction)
    return _transform(mesh, scale * _rotation(jax.random.normal(turn, (4,), vertices.dtype)), shift)


def affine(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Apply the linear map I + strength · G, where G is random with Frobenius norm 1; differentiable.

    **Below a strength of 1** the map is invertible and preserves orientation. Its fixed point is the mean of the
    vertices that faces use.
    """
    vertices = jnp.asarray(mesh.vertices)
    change = jax.random.normal(random_key(seed), (3, 3), vertices.dtype)
    matrix = jnp.eye(3, dtype=vertices.dtype)
    matrix += jnp.asarray(strength).astype(vertices.dtype) * change / jnp.linalg.norm(change)
    return _transform(mesh, matrix, jnp.zeros(3, vertices.dtype))


def _rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Return the rotation of a quaternion of any length; normal entries give uniform rotations (Shoemake, 1992)."""
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
    vertices, middle = jnp.asarray(mesh.vertices), surface(mesh).mean(axis=0)
    moved = middle + matmul(vertices - middle, matrix.T) + shift
    return Mesh(jnp.where(used_vertices(mesh)[:, None], moved, vertices), mesh.faces)


def warp(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Move each vertex by a smooth random function of its position that has no affine part; differentiable.

    It is the sum of four sinusoids in random directions, of wavelengths from 0.5 to 2 diagonals, each with a random
    vector as its amplitude; the affine function of position that fits it best at the vertices is subtracted. The
    strength is the RMS displacement of the vertices, relative to the diagonal of the bounding box, and is met exactly.
    """
    points = surface(mesh)
    x = (jnp.asarray(mesh.vertices) - points.mean(axis=0)) / diagonal(points)
    direct, length, turn, size = jax.random.split(random_key(seed), 4)
    waves = jax.random.normal(direct, (_WAVE_COUNT, 3), x.dtype)
    lengths = jax.random.uniform(length, (_WAVE_COUNT, 1), x.dtype, *_WAVELENGTH_RANGE)
    waves *= 2 * np.pi / (lengths * jnp.linalg.norm(waves, axis=1, keepdims=True))
    phases = jax.random.uniform(turn, (_WAVE_COUNT,), x.dtype, 0, 2 * np.pi)
    amplitudes = jax.random.normal(size, (_WAVE_COUNT, 3), x.dtype)
    shift = matmul(jnp.sin(matmul(x, waves.T) + phases), amplitudes)
    return displace_by(mesh, _remove_affine_part(x, shift, used_vertices(mesh)), strength)


def bending(mesh: Mesh, strength: Strength, seed: Seed | None = None) -> Mesh:
    """Bend the longest axis of the bounding box into a circular arc of the same length; differentiable.

    The axis goes through the centre of the box, which stays, and turns towards the shorter of the other two sides.
    Planes perpendicular to the axis move rigidly. The mesh folds if they meet within it. The strength is the
    angle of the arc in degrees, in [0, 360]; traced angles are not checked.
    """
    if isinstance(strength, float | int) and not 0 <= strength <= 360:
        raise JaxmarkError(f"A mesh is bent by 0 to 360 degrees, got {strength:g}.")

    def bend(x: Array, size: Array, angle: Array) -> Array:
        towards = jnp.where(size[1] <= size[2], jnp.array([0, 1, 0]), jnp.array([0, 0, 1])).astype(x.dtype)
        along, across = x[:, :1], jnp.sum(x * towards, axis=1, keepdims=True)
        turned = angle * along / size[0]
        # sin(t)/t and (1 - cos t)/t = t/2 · (sin(t/2)/(t/2))², also where t is 0.
        forth = along * (jnp.sinc(turned / np.pi) - 1) - across * jnp.sin(turned)
        side = along * turned / 2 * jnp.sinc(turned / (2 * np.pi)) ** 2 + across * (jnp.cos(turned) - 1)
        return forth * jnp.array([1, 0, 0], x.dtype) + side * towards

    return _deform(mesh, strength, bend)


def twisting(mesh: Mesh, strength: Strength, seed: Seed | None = None) -> Mesh:
    """Rotate planes perpendicular to the longest axis of the bounding box, by an angle proportional to the place on it.

    The axis goes through the centre of the box, where the angle is zero; the screw is right-handed. The strength is the
    angle in degrees by which one end is turned against the other. Differentiable.
    """

    def twist(x: Array, size: Array, angle: Array) -> Array:
        turned = angle * x[:, 0] / size[0]
        sine, less = jnp.sin(turned), -2 * jnp.sin(turned / 2) ** 2  # cos - 1
        y, z = x[:, 1], x[:, 2]
        return jnp.stack([jnp.zeros_like(y), less * y - sine * z, sine * y + less * z], axis=1)

    return _deform(mesh, strength, twist)


def _deform(mesh: Mesh, degrees: Strength, shift: Callable[[Array, Array, Array], Array]) -> Mesh:
    """Move vertices by a function of their places in the box, its sizes and an angle in radians; longest axis first."""
    vertices, points = jnp.asarray(mesh.vertices), surface(mesh)
    low, size = points.min(axis=0), jnp.ptp(points, axis=0)
    longest = jnp.argmax(size)
    x = jnp.roll(vertices - (low + size / 2), -longest, axis=1)
    angle = jnp.asarray(degrees).astype(vertices.dtype) * (np.pi / 180)
    return displace(mesh, jnp.roll(shift(x, jnp.roll(size, -longest), angle), longest, axis=1))


def _remove_affine_part(x: Positions, shift: Positions, used: Bool[np.ndarray, " vertices"]) -> Positions:
    """Subtract from a field the affine function of position that is closest to it at the vertices in use."""
    maps, places = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1), np.flatnonzero(used)
    fitted = maps[places]
    inverse = jnp.linalg.pinv(matmul(fitted.T, fitted))  # flat meshes have no inverse
    for _ in range(2):  # the second pass removes what rounding left
        shift = shift - matmul(maps, matmul(inverse, matmul(fitted.T, shift[places])))
    return shift
