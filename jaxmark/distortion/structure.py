"""Statistics of curvature in windows, which MSDM and MSDM2 compare as SSIM compares images."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.distortion.neighbourhoods import Neighbourhoods, share_inside
from jaxmark.distortion.roots import root


class Statistics(NamedTuple):
    """Statistics of curvature in the window around each vertex."""

    mean: tuple[Float[Array, " vertices"], Float[Array, " vertices"]]  # on the original, on the distorted mesh
    deviation: tuple[Float[Array, " vertices"], Float[Array, " vertices"]]  # standard deviations, likewise
    covariance: Float[Array, " vertices"]  # covariance of the two meshes' curvatures


def window_statistics(
    curvatures: tuple[Float[Array, " vertices"], Float[Array, " vertices"]],
    positions: tuple[Float[Array, "vertices 3"], Float[Array, "vertices 3"]],
    windows: Neighbourhoods,
    sigma: float | np.ndarray | Float[Array, ""],
) -> Statistics:
    """Compute statistics in windows, weighted by a Gaussian of the distance from the window's centre.

    Args:
        curvatures: of the original and of the distorted mesh, both at the distorted mesh's vertices.
        positions: of both meshes, likewise.
        windows: points of the distorted mesh, from `make_neighbourhoods`.
        sigma: width of the Gaussian, in the units of the positions.
    """
    count = len(curvatures[0])
    share = share_inside(positions[1], windows)

    def at_points(values: Array) -> Array:
        part = share if values.ndim == 1 else share[:, None]
        return (1 - part) * values[windows.tail] + part * values[windows.head]

    def total(values: Array) -> Array:
        return jax.ops.segment_sum(values, windows.centre, count, indices_are_sorted=True)

    values = [at_points(curvature) for curvature in curvatures]
    weights = [jnp.exp(-jnp.sum((at_points(x) - x[windows.centre]) ** 2, axis=1) / (2 * sigma**2)) for x in positions]
    sums = [jnp.where(whole > 0, whole, 1) for whole in map(total, weights)]
    means = [total(w * v) / s for w, v, s in zip(weights, values, sums, strict=True)]
    off = [v - m[windows.centre] for v, m in zip(values, means, strict=True)]
    deviations = [root(total(w * d**2) / s) for w, d, s in zip(weights, off, sums, strict=True)]
    # As in MEPP, weights are those of the original, but their sum is that of the distorted mesh.
    covariance = total(weights[0] * off[0] * off[1]) / sums[1]
    return Statistics((means[0], means[1]), (deviations[0], deviations[1]), covariance)


def contributions(found: Statistics, offset: float) -> tuple[Array, Array, Array]:
    """Differences of curvature, contrast and structure, each relative to its size plus an offset; 0/0 counts as 0."""

    def relative(difference: Array, size: Array) -> Array:
        whole = size + offset
        return jnp.where(whole > 0, jnp.abs(difference) / jnp.where(whole > 0, whole, 1), 0)

    (m1, m2), (s1, s2) = found.mean, found.deviation
    return (
        relative(m1 - m2, jnp.maximum(m1, m2)),
        relative(s1 - s2, jnp.maximum(s1, s2)),
        relative(s1 * s2 - found.covariance, s1 * s2),
    )


def cubic_mean(values: Float[Array, " vertices"]) -> Float[Array, ""]:
    """Cubic mean, the cube root of the mean of cubes; the gradient at 0 is 0."""
    mean = jnp.mean(values**3)
    return jnp.where(mean > 0, jnp.cbrt(jnp.where(mean > 0, mean, 1)), 0)
