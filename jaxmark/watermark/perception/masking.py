"""Where a displacement is hidden, and in which direction: along planes, cylinders and edges more than across them.

Points of a cloud have no faces that shade: they hide by how far they are apart.
"""

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int
from scipy import sparse

from jaxmark.alignment.original import Original
from jaxmark.distortion import Masking, make_masking
from jaxmark.geometry.clouds import spacings
from jaxmark.geometry.mesh import Mesh, area, edges, face_normals, open_sides, unit
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.padding import pad_rows
from jaxmark.spectral.precision import matmul

Found = TypeVar("Found")
_BAND = 2  # of `Masking`: waves six edges long, of which marks mostly consist
_SLOPE = 0.9  # largest slope of such a wave, times an edge, over its height
_ALONG = 0.04  # displacement along the surface, in edges, that counts as much as a just noticeable one across it
_BENT = np.radians(2)  # angle between faces from which on a surface may hide as much as that angle
_MIN_HIDDEN = 0.12  # of what a plane hides
_LEAST_BEND = 1e-4  # radians that the flattest faces hide in the mean of those around
_AVERAGING_SCALE = 2  # bends are averaged over 2^2 steps of diffusion
_SPACING_POINTS = 8  # nearest points whose mean distance says how dense a cloud is
_LEAST_SPACING, _MOST_SPACING = 0.25, 2.0  # over the median: what denser and looser parts count as
_ROWS_AT_ONCE = 2**20
_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of symmetric matrices
_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # of a matrix's entries among them
_SPACING_SCALE = 5  # spacings are averaged over 2^5 steps of diffusion


def masking_directions(original: Original) -> Float64[np.ndarray, "points 3 3"]:
    """Matrices that turn and scale displacements so that each point is moved where, and as, it is hidden.

    Each face around a point allows a displacement along its normal as far as a wave of that height is just noticeable
    in shading (see `jaxmark.distortion.shading`); along each edge, and in any direction, 4 % of an edge is allowed. A
    border allows as much as the edge of a solid sheet would. What all faces around a point allow is an ellipsoid; the
    matrix maps the unit sphere to it. On a plane it is flat, along an edge it is a needle, where the surface is rough
    or curved it is round.

    A plane beside something rough hides nothing: what a face hides is capped by the second largest angle to its
    neighbours, which is 0 on planes and cylinders up to their rims.

    A point of a cloud may move in all directions, as far as it is from the nearest others.

    Args:
        original: the mesh to mark. Nothing else decides: no key, no message.

    Returns:
        Symmetric positive definite matrices; 0 for points that no face uses. They keep the root mean square of a
        displacement whose coordinates are independent.
    """
    points, faces = original.positions, np.asarray(original.points.faces)
    if len(faces) == 0:
        return _by_spacing(original)
    mesh, size = Mesh(points, faces), len(points)
    # What faces hide takes as long as all that does not need it, and that is NumPy's: another thread computes it.
    rest = _beside(
        lambda: (face_normals(mesh), _corner_angles(points, faces), open_sides(faces), _along_edges(original))
    )
    shares, height, least = _heights(mesh)
    normals, angles, opened, (along, free) = rest.result()
    sound = np.flatnonzero(shares)
    form, weight = _sums(faces[sound], angles[sound], _squares(normals[sound], height[sound]), size)

    # A border hides what the edge of a solid sheet does: as if a wall stood on it.
    face, side = np.nonzero(opened & (shares > 0)[:, None])
    ends = np.stack([faces[face, side], faces[face, (side + 1) % 3]], axis=1)
    outward = unit(np.cross(points[ends[:, 1]] - points[ends[:, 0]], normals[face]))
    more, added = _sums(ends, np.full(ends.shape, np.pi / 2), _squares(outward, least[face]), size)
    weight += added
    form = (form + more) / np.where(weight > 0, weight, 1)[:, None, None]
    form[free] += along
    form[~free] = np.eye(3)

    # A displacement is hidden where its form is at most 1.
    values, vectors = np.linalg.eigh(form)
    matrices = (vectors / np.sqrt(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
    matrices[~free] = 0
    return matrices / np.sqrt(np.mean(np.sum(matrices[original.used] ** 2, axis=(1, 2))) / 3)


def _beside(compute: Callable[[], Found]) -> "Future[Found]":
    """What another thread computes meanwhile, or this one at once, where a program that ends starts no more threads."""
    found: Future[Found] = Future()

    def run() -> None:
        try:
            found.set_result(compute())
        except BaseException as error:
            found.set_exception(error)

    try:
        Thread(target=run).start()
    except RuntimeError:
        run()
    return found


def _along_edges(original: Original) -> tuple[Float64[np.ndarray, "free 3 3"], Bool[np.ndarray, " points"]]:
    """Along each edge, and in all directions, a displacement is bounded by lengths of edges: forms of points on edges.

    One long edge among short ones does not count more than twice: a mark that is mostly in a few points proves little.
    """
    points, size = original.positions, len(original.positions)
    pairs = edges(np.asarray(original.points.faces))
    ends = points[pairs[:, 1]] - points[pairs[:, 0]]
    lengths = np.linalg.norm(ends, axis=1)
    along, count = _sums(pairs, np.ones(pairs.shape), _squares(unit(ends), _ALONG * lengths), size)
    mean = np.bincount(pairs.ravel(), np.repeat(lengths, 2), size) / np.maximum(count, 1)
    free = original.used & (count > 0)
    most = _ALONG * np.minimum(mean, 2 * np.median(mean[free])) if free.any() else mean
    return along[free] / count[free, None, None] + np.eye(3) / most[free, None, None] ** 2, free


def _heights(
    mesh: Mesh,
) -> tuple[Float64[np.ndarray, " faces"], Float64[np.ndarray, " faces"], Float64[np.ndarray, " faces"]]:
    """Each face's share of the area, how high a wave is just noticeable on it, and how high where nothing hides it."""
    with jax.ensure_compile_time_eval():  # carriers may be made in traced code
        masking = make_masking(mesh.vertices, mesh.faces, _BAND + 1)
        bends = _bends(masking)
    shares = np.asarray(masking.area)
    bare, masked = masking.bare[_BAND], masking.threshold[_BAND]
    edge = np.sqrt(4 / np.sqrt(3) * shares * area(mesh))  # of an equilateral triangle
    least = _MIN_HIDDEN * bare
    return shares, edge * np.maximum(np.minimum(masked - bare, bends), least) / _SLOPE, edge * least / _SLOPE


def _corner_angles(
    points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "faces 3"]:
    """The angles of faces at their corners."""
    along = [unit(points[faces[:, (k + 1) % 3]] - points[faces[:, k]]) for k in range(3)]
    cosines = np.stack([-np.einsum("fi,fi->f", along[k], along[k - 1]) for k in range(3)], axis=1)
    return np.arccos(np.clip(cosines, -1, 1))


def _by_spacing(original: Original) -> Float64[np.ndarray, "points 3 3"]:
    """How far points of a cloud are apart, relative to all, without what would turn low frequencies into high ones."""
    apart = spacings(original.positions, _SPACING_POINTS)
    apart = np.clip(apart / (np.median(apart) or 1.0), _LEAST_SPACING, _MOST_SPACING)
    with jax.ensure_compile_time_eval():
        average = diffusion(_SPACING_SCALE + 1, 2**_SPACING_SCALE + 1)[_SPACING_SCALE]
        factor = original.to_host(filter(original.operator, average, original.to_traced(apart)))
    return (factor / np.sqrt(np.mean(factor**2)))[:, None, None] * np.eye(3)


def _bends(masking: Masking) -> Float64[np.ndarray, " faces"]:
    """The most that faces hide by how they bend, as geometric means around each."""
    logs = pad_rows(np.log(np.maximum(masking.bend**2 / _BENT, _LEAST_BEND)), len(masking.links.degree))
    average = diffusion(_AVERAGING_SCALE + 1, 2**_AVERAGING_SCALE + 1)[_AVERAGING_SCALE]
    return np.exp(np.asarray(filter(masking.links, average, jnp.asarray(logs)), np.float64)[: len(masking.bend)])


def _squares(x: Float64[np.ndarray, "rows 3"], size: Float64[np.ndarray, " rows"]) -> Float64[np.ndarray, "rows 6"]:
    """Forms that are 1 for a displacement of so much along each unit vector: the entries of `_ENTRIES`."""
    scaled = x / size[:, None]
    found = np.empty((len(x), 6))
    for place, (i, j) in enumerate(_ENTRIES):
        found[:, place] = scaled[:, i] * scaled[:, j]
    return found


def _sums(
    points: Int[np.ndarray, "rows corners"],
    weights: Float64[np.ndarray, "rows corners"],
    forms: Float64[np.ndarray, "rows 6"],
    size: int,
) -> tuple[Float64[np.ndarray, "points 3 3"], Float64[np.ndarray, " points"]]:
    """Weighted sums of rows' forms at the points of each row, and the sums of the weights."""
    sums, total = np.zeros((size, 6)), np.zeros(size)
    for start in range(0, len(points), _ROWS_AT_ONCE):  # of large meshes not all at once, which would take more memory
        some, heavy = (rows[start : start + _ROWS_AT_ONCE] for rows in (points, weights))
        # Columns of a matrix by columns need not be sorted.
        starts = np.arange(0, some.size + 1, some.shape[1])
        incidence = sparse.csc_array((heavy.ravel(), some.ravel(), starts), shape=(size, len(some)))
        sums += incidence @ forms[start : start + _ROWS_AT_ONCE]
        total += np.bincount(some.ravel(), heavy.ravel(), size)
    return sums[:, _PLACES], total


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
