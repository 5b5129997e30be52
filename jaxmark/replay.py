"""The original put through what a suspect has evidently gone through, by the suspect's own meshing; free of the key.

What that explains of a suspect's displacement is nuisance, as is what the original's own operator explains.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.bands import diffusion
from jaxmark.chebyshev import band_components
from jaxmark.laplacian import make_laplacian
from jaxmark.mesh import Mesh
from jaxmark.surfaces import Surface, barycentric

_SCALES = 6  # smoothing of the suspect's meshing, by 1 to 32 steps of half the way
_MOST_LEFT, _ENOUGH = 0.1, 20_000


def replayed(
    original: Surface,
    suspect: Mesh,
    face: Int64[np.ndarray, " points"],
    closest: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"],
    weights: Bool[np.ndarray, " points"],
) -> Float64[np.ndarray, "points columns"] | None:
    """What smoothing would have done to the original, if it explains nearly all that a suspect shows.

    Args:
        original: about one in size.
        suspect: in the original's pose.
        face: on which the suspect comes closest to each of the original's points.
        closest: where.
        normals: along which the suspect's displacement is known.
        weights: where it counts.
    """
    x = np.asarray(original.mesh.vertices)
    columns = _smoothed(original, suspect, face, closest)
    displacement = np.where(weights[:, None], closest - x, 0)
    return columns if weights.any() and _explains(columns, x, displacement, normals, weights) else None


def _smoothed(
    original: Surface, suspect: Mesh, face: Int64[np.ndarray, " points"], closest: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points columns"]:
    """The original put through smoothing as the suspect's meshing does it, by several amounts, as seen from its points.

    A suspect that was simplified and then smoothed has shrunk by another operator than the original's.
    """
    there = original.closest(np.asarray(suspect.vertices))[0]
    family = diffusion(_SCALES, 4 * 2 ** (_SCALES // 2) + 1)
    amounts = band_components(make_laplacian(suspect), family, jnp.asarray(there, jnp.float32))
    share = barycentric(suspect, face, closest)
    seen = np.einsum("spkc,pk->psc", np.asarray(amounts, np.float64)[:, np.asarray(suspect.faces)[face]], share)
    return seen.reshape(len(face), -1)


def _explains(
    columns: Float64[np.ndarray, "points columns"],
    x: Float64[np.ndarray, "points 3"],
    displacement: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"],
    weights: Bool[np.ndarray, " points"],
) -> bool:
    """Whether columns explain nine tenths of what an affine map does not: each takes some of the mark away, too."""
    some = np.flatnonzero(weights)
    some = some[np.random.default_rng(0).permutation(len(some))[:_ENOUGH]]
    along = np.sum(normals[some] * displacement[some], axis=1)

    def left(columns: Float64[np.ndarray, "points columns"]) -> float:
        design = (columns[some][:, :, None] * normals[some][:, None, :]).reshape(len(some), -1)
        return float(np.sum((along - design @ np.linalg.lstsq(design, along, rcond=1e-9)[0]) ** 2))

    plain = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    return left(np.concatenate([plain, columns], axis=1)) < _MOST_LEFT * left(plain)
