"""Local roughness, and the metric FMPD.

Reference: Wang, Torkhani, Montanvert, "A fast roughness-based approach to the assessment of 3D mesh visual quality",
Computers & Graphics 36(7), 2012, with the constants of the authors' program.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxmark.distortion.norms import PerVertex, Positions, Scalar, lengths, ratio
from jaxmark.geometry.mesh import boundary_vertices

POWER = 0.15  # exponent by which roughness is modulated
_SLOPE_ABOVE_MEAN = 0.5  # factor on the part of a modulated roughness that exceeds the mean
MIN_ROUGHNESS, MAX_ROUGHNESS = 5e-4, 0.2  # roughness is clipped to these, in radians
_MAX_OVER_MEAN = 5.0  # the upper bound is at least this many times the mean
_HALF_COTANGENTS = (1e-3, 1e3)  # range to which half cotangents are clipped
_SCALE = 8.0  # brings the distance into [0, 1]


class Rough(NamedTuple):
    """Roughness of a surface at its vertices."""

    roughness: PerVertex  # in radians; see `local_roughness`
    area: PerVertex  # a third of the area of the faces around


def local_roughness(x: Positions, faces: Int[Array | np.ndarray, "faces 3"]) -> Rough:
    """Difference of each vertex's absolute angle defect from the cotangent-weighted mean of its neighbours'.

    Flat angles sum to π at the vertices of the boundary. A face that names a vertex twice has no part in the surface.
    """
    faces = np.asarray(faces)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    boundary = np.isin(np.arange(len(x)), boundary_vertices(faces))
    return _local_roughness(x, jnp.asarray(faces), jnp.asarray(boundary))


@jax.jit
def _local_roughness(x: Positions, faces: Int[Array, "faces 3"], boundary: Bool[Array, " vertices"]) -> Rough:
    corners = x[faces]
    u, v = jnp.roll(corners, -1, axis=1) - corners, jnp.roll(corners, -2, axis=1) - corners
    cosine, cross = jnp.sum(u * v, axis=2), jnp.cross(u[:, 0], v[:, 0])
    sine = lengths(cross)[:, None]  # each corner's sine, up to the same factor as its cosine
    sound = (sine > 0) | (cosine != 0)
    angle = jnp.arctan2(jnp.where(sound, sine, 0), jnp.where(sound, cosine, 1))
    half = jnp.clip(cosine / jnp.where(sine > 0, sine, 1) / 2, *_HALF_COTANGENTS)
    half = jnp.where(sine > 0, half, jnp.where(cosine > 0, _HALF_COTANGENTS[1], _HALF_COTANGENTS[0]))

    zeros = jnp.zeros(len(x), x.dtype)
    defect = jnp.abs(jnp.where(boundary, np.pi, 2 * np.pi).astype(x.dtype) - zeros.at[faces].add(angle))
    start, end = jnp.roll(faces, -1, axis=1), jnp.roll(faces, -2, axis=1)
    total = zeros.at[start].add(half).at[end].add(half)
    around = zeros.at[start].add(half * defect[end]).at[end].add(half * defect[start])
    rough = jnp.abs(jnp.where(total > 0, defect - ratio(around, total), 0))
    return Rough(rough, zeros.at[faces].add(jnp.broadcast_to(sine / 6, angle.shape)))


@jax.jit
def fmpd(first: Rough, second: Rough) -> Scalar:
    """Compute the fast mesh perceptual distance, 0 to 1: the difference of the global roughness of two surfaces.

    Connectivities may differ. The metric is nearly blind to slow waves, so do not rely on it alone for a mark of low
    frequencies.
    """
    means = jnp.minimum(*(_mean(rough.roughness, rough.area) for rough in (first, second)))
    floor = MIN_ROUGHNESS**POWER
    turn = jnp.maximum(means, MIN_ROUGHNESS) ** POWER - floor

    most = jnp.maximum(MAX_ROUGHNESS, _MAX_OVER_MEAN * means)

    def overall(rough: Rough) -> Array:
        value = jnp.clip(rough.roughness, MIN_ROUGHNESS, most) ** POWER - floor
        return _mean(jnp.where(value > turn, turn + _SLOPE_ABOVE_MEAN * (value - turn), value), rough.area)

    return jnp.minimum(_SCALE * jnp.abs(overall(first) - overall(second)), 1)


def _mean(values: Array, weights: Array) -> Array:
    return ratio(jnp.sum(values * weights), weights.sum())
