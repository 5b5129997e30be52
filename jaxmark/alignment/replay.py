"""Replay of smoothing: smooth the original as the suspect was smoothed, to explain its displacements without the key.

The original is smoothed by the Laplacian of the suspect's mesh or, if the suspect's vertices are recognised, by the
original's cotangent Laplacian. Displacements that this smoothing explains are treated as nuisance. Displacements that
the original's valence Laplacian explains are nuisance in any case.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from jaxmark.geometry.mesh import Mesh, area
from jaxmark.geometry.pose import Points
from jaxmark.geometry.surfaces import Surface, barycentric
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import band_components
from jaxmark.spectral.laplacian import Laplacian, host_edges
from jaxmark.spectral.padding import common_laplacian, pad_rows

_SCALES = 9  # smoothing by 1, 2, 4 … 256 steps, each halfway to the neighbours' mean
# Smoothing is assumed if it leaves at most this fraction of the squared displacement unexplained. If displacements are
# known along normals only, smoothing also explains a part of the mark; at recognised points, hardly any of it. Often,
# remeshing also smoothed a surface, and smoothing explains two thirds or more of its displacement.
_MAX_UNEXPLAINED_ON_SURFACES, _MAX_UNEXPLAINED_AT_POINTS = 1 / 3, 0.5
# The same limit for the quick check by two columns. On real meshes, the two columns leave over 99.5 % of marks and
# noise unexplained, but less than 87 % of smoothing.
_MAX_UNEXPLAINED_AT_FIRST = 0.98
_MAX_FIT_POINTS = 20_000  # number of random points in the least-squares fits

Columns = Float[np.ndarray, "points columns"]


def replay_smoothing(
    original: Surface,
    suspect: Mesh,
    face: Int64[np.ndarray, " points"],
    closest: Points,
    normals: Points,
    weights: Bool[np.ndarray, " points"],
) -> Columns | None:
    """Smooth the original by the Laplacian of the suspect's mesh.

    A suspect that was first simplified and then smoothed was smoothed by the Laplacian of its own mesh, not by the
    original's.

    Args:
        original: the original's surface, about 1 in size.
        suspect: the suspect in the original's pose; its area must not be 0.
        face: for each of the original's points, the face on which the suspect comes closest to it.
        closest: the closest point on this face.
        normals: unit vectors along which the displacement of each point is known.
        weights: mask of the points whose displacement is known.

    Returns:
        Positions of the original's points after smoothing, three columns for each number of steps. None unless they
        explain most of the displacement.
    """
    x = np.asarray(original.mesh.vertices)
    signal = original.closest(np.asarray(suspect.vertices))[0]
    share, corners = barycentric(suspect, face, closest), np.asarray(suspect.faces)[face]
    cotangents = common_laplacian(suspect, "cotangent")
    # The valence Laplacian gets weights of 1, so that one compiled program serves both.
    pairs, _ = host_edges(cotangents)
    valence = cotangents._replace(
        weights=pad_rows(np.ones(len(pairs)), len(cotangents.edges)),
        degree=np.bincount(pairs.ravel(), minlength=len(cotangents.degree)).astype(np.float64),
    )
    smoothed = [
        np.concatenate([np.einsum("pkc,pk->pc", scale[corners], share) for scale in _smoothed(operator, signal)], 1)
        for operator in (valence, cotangents)
    ]
    displacement = np.where(weights[:, None], closest - x, 0)
    return _likeliest(smoothed, x, displacement, normals, weights, _MAX_UNEXPLAINED_ON_SURFACES)


def replay_smoothing_of_points(
    operator: Laplacian, original: Mesh, displacement: Points, weights: Bool[np.ndarray, " points"]
) -> Columns | None:
    """Smooth the original by its cotangent Laplacian, for a suspect whose vertices are recognised.

    Displacements that the valence Laplacian explains are nuisance in any case.

    Args:
        operator: the original's valence Laplacian.
        original: the mesh of the original's points, about 1 in size.
        displacement: displacement of these points.
        weights: mask of the points whose displacement is known.

    Returns:
        Positions of the original's points after smoothing, three columns for each number of steps. None unless they
        explain much of the displacement.
    """
    x = np.asarray(original.vertices)
    # Smoothing of any kind and amount is partly explained by Δx and Δ²x; marks and noise are not. This quick check
    # avoids the smoothing below for most suspects.
    once = operator.apply(pad_rows(x, len(operator.degree)).astype(np.float32))
    powers = np.concatenate([once, operator.apply(once)], axis=1)[: len(x)]
    if _likeliest([powers], x, displacement, None, weights, _MAX_UNEXPLAINED_AT_FIRST) is None or area(original) == 0:
        return None
    columns = np.concatenate(_smoothed(common_laplacian(original, "cotangent"), x), axis=1)
    return _likeliest([columns], x, displacement, None, weights, _MAX_UNEXPLAINED_AT_POINTS)


def _smoothed(operator: Laplacian, signal: Points) -> list[Float32[np.ndarray, "points 3"]]:
    """Smooth a signal by a Laplacian, once for each number of steps."""
    family = diffusion(_SCALES, 4 * 2 ** (_SCALES // 2) + 1)
    scales = band_components(operator, family, pad_rows(signal, len(operator.degree)).astype(np.float32))
    return list(np.asarray(scales)[:, : len(signal)])


def _likeliest(
    candidates: list[Columns],
    x: Points,
    displacement: Points,
    normals: Points | None,
    weights: Bool[np.ndarray, " points"],
    max_unexplained: float,
) -> Columns | None:
    """Choose the columns that explain most of the displacement that an affine map leaves; None if it is too little."""
    chosen = np.flatnonzero(weights)
    chosen = chosen[np.random.default_rng(0).permutation(len(chosen))[:_MAX_FIT_POINTS]]
    if not len(chosen):
        return None
    affine, moved = np.concatenate([np.ones((len(chosen), 1)), x[chosen]], axis=1), displacement[chosen]

    def unexplained(columns: Columns) -> float:
        if normals is None:
            design, along = columns, moved
        else:
            design = (columns[:, :, None] * normals[chosen][:, None, :]).reshape(len(chosen), -1)
            along = np.sum(normals[chosen] * moved, axis=1)
        return float(np.sum((along - design @ np.linalg.lstsq(design, along, rcond=1e-9)[0]) ** 2))

    rest = [unexplained(np.concatenate([affine, columns[chosen].astype(np.float64)], axis=1)) for columns in candidates]
    return candidates[int(np.argmin(rest))] if min(rest) < max_unexplained * unexplained(affine) else None
