"""Masking tensors: matrices that direct and scale the displacement of each point so that it is hardly visible.

Displacements along planes, cylinders and edges are less visible than across them. Points of a cloud have no faces that
shade, so that their displacements are scaled by their spacing.
"""

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int
from scipy import sparse

from jaxmark.alignment.original import Original
from jaxmark.distortion import Relief, make_relief
from jaxmark.geometry.clouds import spacings
from jaxmark.geometry.mesh import Mesh, cross_product, open_sides, unit
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.padding import pad_rows
from jaxmark.spectral.precision import matmul
from jaxmark.spectral.threads import in_thread

_BAND = 2  # band of `Masking`: waves six edges long, of which marks mostly consist
_SLOPE = 0.9  # largest slope of such a wave, times an edge, over its height
_ALONG = 0.04  # displacement along the surface, in edges, that counts as much as a just noticeable one across it
_BENT = np.radians(2)  # angle between faces that masks a rotation by the same angle; others mask angle²/_BENT
_MIN_HIDDEN = 0.12  # least masked rotation, relative to the just noticeable rotation on a plane
_LEAST_BEND = 1e-4  # lower limit in radians on the masked rotation, for the geometric mean over neighbouring faces
_AVERAGING_SCALE = 2  # these angles are averaged over 2^2 steps of diffusion
_SPACING_POINTS = 8  # number of nearest points whose mean distance is the spacing of a cloud
_LEAST_SPACING, _MOST_SPACING = 0.25, 2.0  # limits on the spacing, over the median
_ROWS_AT_ONCE = 2**20
_ROWS_IN_THREAD = 2**14  # least number of matrices for which a thread is started
_ENTRIES = np.triu_indices(3)  # rows and columns of the entries of symmetric matrices that are stored
_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # index of each entry of a matrix among them
_SPACING_SCALE = 5  # spacings are averaged over 2^5 steps of diffusion


def masking_tensors(original: Original) -> Float[Array, "rows 3 3"]:
    """Return the tensors of `masking_directions` for traced code; they are computed once for each original."""
    return original.derived(_traced_tensors)


def _traced_tensors(original: Original) -> Float[Array, "rows 3 3"]:
    tensors = masking_directions(original)
    with jax.ensure_compile_time_eval():  # what is kept must not belong to a trace
        return original.to_traced(tensors)


def masking_directions(original: Original) -> Float64[np.ndarray, "points 3 3"]:
    """Compute the masking tensor of each point, which rotates and scales displacements so that they are hardly visible.

    Each face around a point limits displacements along its normal to the height of a wave that the face masks in
    shading (see `jaxmark.distortion.shading`). Displacements along each edge, and in any direction, are limited to 4 %
    of an edge. A border has the limits of the edge of a solid sheet. The limits of all faces around a point form an
    ellipsoid, and the masking tensor maps the unit sphere to it. It is flat on a plane, a needle along an edge, and
    round where the surface is rough or curved.

    A plane next to a rough region masks nothing: the masking of a face is limited by the second largest angle to its
    neighbours, which is 0 on planes and cylinders up to their rims.

    The displacements of a cloud's point are scaled alike in all directions, by its distance from the nearest points.

    Args:
        original: the mesh to mark. The tensors depend on it alone, not on key or message.

    Returns:
        Symmetric positive definite matrices; 0 for points that no face uses. They preserve the root mean square of a
        displacement whose coordinates are independent.
    """
    points, faces = original.positions, np.asarray(original.points.faces)
    if len(faces) == 0:
        return _by_spacing(original)
    mesh, size = Mesh(points, faces), len(points)
    # Carriers may be made in traced code; in another thread, nothing is traced. The rest, in NumPy, takes as long.
    heights = in_thread(lambda: _heights(mesh))
    (normals, angles), opened = _normals_and_angles(points, faces), open_sides(faces)
    along, free = _along_edges(original)
    shares, height, least = heights.result()
    proper = np.flatnonzero(shares)
    form, weight = _sums(faces[proper], angles[proper], normals[proper] / height[proper, None], size)

    # A border is treated as the edge of a solid sheet: as if a wall stood on it.
    face, side = np.nonzero(opened & (shares > 0)[:, None])
    ends = np.stack([faces[face, side], faces[face, (side + 1) % 3]], axis=1)
    outward = unit(np.cross(points[ends[:, 1]] - points[ends[:, 0]], normals[face]))
    border_form, border_weight = _sums(ends, np.full(ends.shape, np.pi / 2), outward / least[face, None], size)
    weight += border_weight
    form += border_form
    form /= np.where(weight > 0, weight, 1)[:, None]
    form[free] += along

    # The displacements whose form is at most 1 are the ellipsoid.
    matrices = np.zeros((size, 3, 3))
    matrices[free] = _inverse_roots(form[free])
    return matrices / np.sqrt(np.sum(matrices**2) / np.count_nonzero(original.used) / 3)


def _along_edges(original: Original) -> tuple[Float64[np.ndarray, "free 6"], Bool[np.ndarray, " points"]]:
    """Compute quadratic forms that limit displacements along each edge, and in all directions, by edge lengths.

    Edges count as at most twice as long as the median, because a mark that is mostly in a few points gives little
    evidence.

    Returns:
        The form of each point that has an edge, and a mask of these points.
    """
    points, size = original.positions, len(original.positions)
    pairs = np.asarray(original.operator.edges)
    pairs = pairs[pairs[:, 0] < size]  # without padding
    ends = points[pairs[:, 1]] - points[pairs[:, 0]]
    lengths = np.linalg.norm(ends, axis=1)
    along, count = _sums(pairs, np.ones(pairs.shape), ends / (_ALONG * lengths**2)[:, None], size)
    mean = np.bincount(pairs.ravel(), np.repeat(lengths, 2), size) / np.maximum(count, 1)
    free = original.used & (count > 0)
    limit = _ALONG * np.minimum(mean, 2 * np.median(mean[free])) if free.any() else mean
    return along[free] / count[free, None] + np.eye(3)[_ENTRIES] / limit[free, None] ** 2, free


def _heights(
    mesh: Mesh,
) -> tuple[Float64[np.ndarray, " faces"], Float64[np.ndarray, " faces"], Float64[np.ndarray, " faces"]]:
    """Compute each face's share of the area, the height of a wave that it masks, and the least such height."""
    found = make_relief(mesh.vertices, mesh.faces, _BAND + 1)
    bends = _bends(found)
    shares = np.asarray(found.masking.area)
    unmasked, threshold = found.bare[_BAND], np.asarray(found.masking.threshold[_BAND])
    edge = np.sqrt(4 / np.sqrt(3) * shares * found.area)  # edge of an equilateral triangle of the same area
    lowest = _MIN_HIDDEN * unmasked
    return shares, edge * np.maximum(np.minimum(threshold - unmasked, bends), lowest) / _SLOPE, edge * lowest / _SLOPE


def _normals_and_angles(
    points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float64[np.ndarray, "faces 3"], Float64[np.ndarray, "faces 3"]]:
    """Compute the unit normals of faces, and the angles at their corners."""
    sides = [points[faces[:, (k + 1) % 3]] - points[faces[:, k]] for k in range(3)]
    normals = cross_product(sides[0], sides[1])
    double = np.sqrt(np.einsum("fi,fi->f", normals, normals))
    angles = np.stack([np.arctan2(double, -np.einsum("fi,fi->f", sides[k], sides[k - 1])) for k in range(3)], axis=1)
    return normals / np.where(double > 0, double, 1)[:, None], angles


def _by_spacing(original: Original) -> Float64[np.ndarray, "points 3 3"]:
    """Compute the relative spacing of a cloud's points, without variations that would mix low and high frequencies."""
    spacing = spacings(original.positions, _SPACING_POINTS)
    spacing = np.clip(spacing / (np.median(spacing) or 1.0), _LEAST_SPACING, _MOST_SPACING)
    average = diffusion(_SPACING_SCALE + 1, 2**_SPACING_SCALE + 1)[_SPACING_SCALE]
    smooth = in_thread(lambda: original.to_host(filter(original.operator, average, original.to_traced(spacing))))
    factor = smooth.result()
    return (factor / np.sqrt(np.mean(factor**2)))[:, None, None] * np.eye(3)


def _bends(found: Relief) -> Float64[np.ndarray, " faces"]:
    """Compute the largest rotation that each face masks by its angle to neighbours, as a geometric mean around it."""
    links, bend = found.masking.links, found.bend()
    logs = pad_rows(np.log(np.maximum(bend**2 / _BENT, _LEAST_BEND)), len(links.degree))
    average = diffusion(_AVERAGING_SCALE + 1, 2**_AVERAGING_SCALE + 1)[_AVERAGING_SCALE]
    return np.exp(np.asarray(filter(links, average, logs), np.float64)[: len(bend)])


def _sums(
    points: Int[np.ndarray, "rows corners"],
    weights: Float64[np.ndarray, "rows corners"],
    vectors: Float64[np.ndarray, "rows 3"],
    size: int,
) -> tuple[Float64[np.ndarray, "points 6"], Float64[np.ndarray, " points"]]:
    """Sum up the forms x ↦ (vector · x)² of the rows at the points of each row, with weights, and the weights.

    Forms are symmetric matrices, by their entries `_ENTRIES`.
    """
    sums, total = np.zeros((size, 6)), np.zeros(size)
    for start in range(0, len(points), _ROWS_AT_ONCE):  # in parts, to limit the memory for large meshes
        corners, corner_weights, some = (rows[start : start + _ROWS_AT_ONCE] for rows in (points, weights, vectors))
        # The rows of a CSC matrix's columns need not be sorted.
        starts = np.arange(0, corners.size + 1, corners.shape[1])
        incidence = sparse.csc_array((corner_weights.ravel(), corners.ravel(), starts), shape=(size, len(corners)))
        sums += incidence @ np.stack([some[:, i] * some[:, j] for i, j in zip(*_ENTRIES, strict=True)], axis=1)
        total += np.bincount(corners.ravel(), corner_weights.ravel(), size)
    return sums, total


def _inverse_roots(forms: Float64[np.ndarray, "rows 6"]) -> Float64[np.ndarray, "rows 3 3"]:
    """Compute A^-1/2 of symmetric positive matrices, which are given by their entries `_ENTRIES`."""

    def roots(some: Float64[np.ndarray, "some 6"]) -> Float64[np.ndarray, "some 3 3"]:
        values, vectors = np.linalg.eigh(some[:, _PLACES])
        return (vectors / np.sqrt(values)[:, None, :]) @ vectors.transpose(0, 2, 1)

    # NumPy finds eigenvectors on one processor.
    count = min(os.cpu_count() or 1, 1 + len(forms) // _ROWS_IN_THREAD)
    found = [in_thread(partial(roots, some)) for some in np.array_split(forms, count)]
    return np.concatenate([part.result() for part in found])


def apply_mask(
    mask: Float[Array | np.ndarray, " rows *axes"] | None, x: Float[Array, "rows 3"]
) -> Float[Array, "rows 3"]:
    """Mask displacements by a factor or a symmetric matrix `[3, 3]` for each vertex; this is its own adjoint."""
    if mask is None:
        return x
    factor = jnp.asarray(mask)
    if factor.ndim == 1:
        return factor[:, None] * x
    return matmul(factor, x[:, :, None])[:, :, 0]
