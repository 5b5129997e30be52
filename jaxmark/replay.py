"""The original put through the smoothing that a suspect has evidently gone through; free of the key.

By the suspect's own meshing or, where its vertices are known, by the original's cotangents. What that explains of a
suspect's displacement is nuisance, as is what the original's own operator explains.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from jaxmark.bands import diffusion
from jaxmark.chebyshev import band_components
from jaxmark.laplacian import Laplacian, Weighting
from jaxmark.mesh import Mesh, area
from jaxmark.pose import Points
from jaxmark.shapes import common_laplacian, fill
from jaxmark.surfaces import Surface, barycentric

_SCALES = 9  # of smoothing, by 1 to 256 steps of half the way
_WEIGHTINGS: tuple[Weighting, ...] = ("valence", "cotangent")
# Along normals only, columns take a good part of the mark away with what they explain; of known points, next to none.
_MOST_LEFT, _MOST_LEFT_OF_POINTS = 0.1, 0.5
# What a first glance may leave of smoothing: of marks and noise it leaves over 99.5 % on real meshes, of smoothing less
# than 87 %.
_SIGNS_LEFT = 0.98
_ENOUGH = 20_000

Columns = Float[np.ndarray, "points columns"]


def replayed(
    original: Surface,
    suspect: Mesh,
    face: Int64[np.ndarray, " points"],
    closest: Points,
    normals: Points,
    weights: Bool[np.ndarray, " points"],
) -> Columns | None:
    """What smoothing by the suspect's meshing would have done to the original, if it explains nearly all that is seen.

    A suspect that was simplified and then smoothed has shrunk by another operator than the original's.

    Args:
        original: about one in size.
        suspect: in the original's pose, with an area.
        face: on which the suspect comes closest to each of the original's points.
        closest: where.
        normals: along which the suspect's displacement is known.
        weights: where it counts.
    """
    x = np.asarray(original.mesh.vertices)
    there = original.closest(np.asarray(suspect.vertices))[0]
    share, corners = barycentric(suspect, face, closest), np.asarray(suspect.faces)[face]
    smoothed = [
        np.concatenate(
            [np.einsum("pkc,pk->pc", one[corners], share) for one in _smoothed(suspect, weighting, there)], 1
        )
        for weighting in _WEIGHTINGS
    ]
    displacement = np.where(weights[:, None], closest - x, 0)
    return _likeliest(smoothed, x, displacement, normals, weights, _MOST_LEFT)


def replayed_points(
    operator: Laplacian, original: Mesh, displacement: Points, weights: Bool[np.ndarray, " points"]
) -> Columns | None:
    """The same of points that are known, by the original's cotangents; what its valences explain is nuisance anyway.

    Args:
        operator: of the original.
        original: about one in size.
        displacement: of its points.
        weights: where it counts.
    """
    x = np.asarray(original.vertices)
    # Smoothing of any kind and amount shows in these already; marks and noise do not, and end here.
    once = operator.apply(jnp.asarray(fill(x, len(operator.degree)), jnp.float32))
    signs = np.concatenate([once, operator.apply(once)], axis=1)[: len(x)]
    if _likeliest([signs], x, displacement, None, weights, _SIGNS_LEFT) is None or area(original) == 0:
        return None
    columns = np.concatenate(_smoothed(original, "cotangent", x), axis=1)
    return _likeliest([columns], x, displacement, None, weights, _MOST_LEFT_OF_POINTS)


def _smoothed(mesh: Mesh, weighting: Weighting, signal: Points) -> list[Float32[np.ndarray, "points 3"]]:
    """A signal after smoothing by a mesh's Laplacian, by several amounts."""
    family = diffusion(_SCALES, 4 * 2 ** (_SCALES // 2) + 1)
    operator = common_laplacian(mesh, weighting)
    amounts = band_components(operator, family, jnp.asarray(fill(signal, len(operator.degree)), jnp.float32))
    return list(np.asarray(amounts)[:, : len(signal)])


def _likeliest(
    candidates: list[Columns],
    x: Points,
    displacement: Points,
    normals: Points | None,
    weights: Bool[np.ndarray, " points"],
    most_left: float,
) -> Columns | None:
    """The columns that explain most of what an affine map does not, if that is enough."""
    some = np.flatnonzero(weights)
    some = some[np.random.default_rng(0).permutation(len(some))[:_ENOUGH]]
    if not len(some):
        return None
    plain, shown = np.concatenate([np.ones((len(some), 1)), x[some]], axis=1), displacement[some]

    def left(columns: Columns) -> float:
        if normals is None:
            design, along = columns, shown
        else:
            design = (columns[:, :, None] * normals[some][:, None, :]).reshape(len(some), -1)
            along = np.sum(normals[some] * shown, axis=1)
        return float(np.sum((along - design @ np.linalg.lstsq(design, along, rcond=1e-9)[0]) ** 2))

    rest = [left(np.concatenate([plain, columns[some].astype(np.float64)], axis=1)) for columns in candidates]
    return candidates[int(np.argmin(rest))] if min(rest) < most_left * left(plain) else None
