"""Visible change of shading: the turn of normals over the turn that the original masks, face by face.

A mean over edges misses a wave on a plane, because most edges lie where the surface is curved or rough and masks more.
Here each point is judged separately, and the result is a percentile of the area, in just noticeable differences.

1. *Contrast.* Where a normal turns by δ, Lambertian shading changes by up to tan(i)·δ of itself, i being the incidence
   of the light. Lights come at 60°, from any side, so that no rotation changes the result: 0.33° is a contrast of 1 %.
2. *Frequency.* Normals of faces are split into six bands by diffusion from face to face, from waves as long as 1.5
   edges to waves of 48. Diffusion stops at creases of the original, on whose two sides light differs anyway.
3. *Sensitivity.* How contrast sensitivity falls towards short waves is the formula of Barten, "Evaluation of subjective
   image quality with the square-root integral method", Journal of the Optical Society of America A 7(10), 1990, at
   100 cd/m² and with the diagonal as large as 40° of the field of view.
4. *Masking.* The original's contrast in a band around a point raises the threshold there by (1 + (k c)^b)^(1/b), c
   being that contrast over its own threshold. The formula is that of Daly, "The visible differences predictor" (Digital
   Images and Human Vision, 1993). Nader, Wang, Hétroy-Wheeler and Dupont fitted it to what people saw on meshes ("Just
   noticeable distortion profile for flat-shaded 3D mesh surfaces", IEEE TVCG 22(11), 2016); k = 0.0078 · 88.29 and
   b = 4.207, with a slope of 1, are those of their model in the program MEPP2.
5. *Pooling.* Bands are summed with the exponent 4, near those of probability summation over channels (Watson, Ahumada,
   "A standard model for foveal detection of spatial contrast", Journal of Vision 5(9), 2005).

Chosen by us: the lights' incidence; the angle at which a crease begins; that sensitivity does not fall towards long
waves, which gratings do but glossy planes do not; and the least contrast, 0.6 %, which makes 0.2° on a plane just
noticeable. It lies between what Barten's formula gives for practised people and plain gratings, 0.17 %, and the 2 % of
Nader et al. at their best frequency for one moved vertex. `benchmarks/robustness/visibility.py` prints the results.

The metric does not see waves much longer than 48 edges, which on a mesh of a million points are short; sides between
creases that turn as a whole; silhouettes; and displacements along the surface, which only textures show.
"""

import math
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.distortion.dihedral import MIN_HEIGHT
from jaxmark.distortion.norms import Positions, Scalar, check_alike, percentile, ratio, root
from jaxmark.geometry.mesh import cross_product, face_pairs
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import band_components, filter
from jaxmark.spectral.laplacian import MIN_LARGE_VALUES, Laplacian, graph_laplacian, take_rows
from jaxmark.spectral.padding import common_size, pad_edges, pad_rows

SHARE = 0.99  # fraction of the area on which the turn is less visible than the value of the metric
_INCIDENCE = math.radians(60)  # angle between the light and the surroundings' mean normal
_CREASE = math.radians(45)  # angle between faces of the original at which the weight of their link is 1/e
_SCALES = (0, 2, 4, 6, 8, 10)  # binary logarithms of the steps of diffusion that divide the bands
BANDS = len(_SCALES)
_WAVELENGTHS = 3 * 2.0 ** np.arange(-1, len(_SCALES) - 1)  # of the waves that each band passes best, in edge lengths
_GAINS = np.array([1, *[2] * (len(_SCALES) - 1)])  # inverse of the bands' responses to their best waves
_SIZE = 40.0  # degrees of the field of view that the diagonal takes when people look closely
_BEST_FREQUENCY = 3.0  # cycles per degree
_LUMINANCE = 100.0  # cd/m²
_LEAST_CONTRAST = 0.006  # just noticeable contrast at the best frequency
_MIN_SENSITIVITY = 1e-3  # sensitivity to the shortest waves, over the largest sensitivity
_MASKING_SLOPE, _MASKING_BEND = 0.0078 * 88.29, 4.207
_FEW_TERMS = 25  # number of terms of a series that the first four bands need
_POOLING = 4  # exponent by which bands are summed
_MIN_AREA = 1e-3  # least area of a face in its links, over the mean area


class Masking(NamedTuple):
    """The turns of normals that an original masks, face by face; make it with `make_masking`."""

    faces: Int[Array | np.ndarray, "faces 3"]
    area: Float[Array | np.ndarray, " faces"]  # share of the whole; 0 for faces without a normal
    turned: Float[Array | np.ndarray, " faces"]  # -1 for faces that run against their neighbours, otherwise 1
    links: Laplacian  # of the graph of faces that share an edge that is no crease; padded, see `spectral.padding`
    threshold: Float[Array | np.ndarray, "bands faces"]  # normals' just noticeable turn in each band, in radians

    def padded(self) -> "Masking":
        """Pad all arrays with faces of area 0 to the size of `links`, so that many meshes have the same shapes."""
        count = len(self.links.degree)
        if len(self.area) == count:
            return self
        faces, area = (pad_rows(np.asarray(rows), count) for rows in (self.faces, self.area))
        turned, threshold = (pad_rows(np.asarray(rows), count, 1) for rows in (self.turned, self.threshold.T))
        return Masking(faces, area, turned, self.links, threshold.T)


class Relief(NamedTuple):
    """How the faces of an original meet, from `make_relief`."""

    masking: Masking
    area: float  # of all faces that have a normal
    bare: Float[np.ndarray, "bands faces"]  # the threshold without masking
    pairs: Int[np.ndarray, "pairs 2"]  # faces that share an edge with no other face
    angle: Float[np.ndarray, " pairs"]  # between their normals

    def bend(self) -> Float[np.ndarray, " faces"]:
        """Find the second largest angle of each face to a neighbour: 0 on planes and along their edges."""
        return _second_largest(self.pairs, self.angle, len(self.masking.faces))


def make_masking(
    vertices: Float[Array | np.ndarray, "vertices 3"], faces: Int[Array | np.ndarray, "faces 3"], bands: int = BANDS
) -> Masking:
    """Compute the masking of an original in `bands` bands, starting with the shortest waves, on the host.

    Edges of one face, or of three or more faces, are no links.
    """
    return make_relief(vertices, faces, bands).masking


def make_relief(
    vertices: Float[Array | np.ndarray, "vertices 3"], faces: Int[Array | np.ndarray, "faces 3"], bands: int
) -> Relief:
    """Compute the masking as `make_masking` does, and more on how faces meet."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    pairs, against = face_pairs(faces)
    area, normals = _areas_and_normals(vertices, faces)
    turned = _orient(pairs, against, len(faces))
    normals *= turned[:, None]
    angle = np.arccos(np.clip(np.einsum("pi,pi->p", normals[pairs[:, 0]], normals[pairs[:, 1]]), -1, 1))
    mean = area.sum() / max(np.count_nonzero(area), 1) or 1.0
    size = np.where(area > 0, np.maximum(area / mean, _MIN_AREA), 0)
    weights = np.exp(-((angle / _CREASE) ** 4)) * size[pairs].prod(axis=1)
    count = common_size(len(faces))
    # A closed surface of triangles has three edges for two faces.
    links = pad_edges(graph_laplacian(pairs, count, weights), 1.5)

    used = vertices[np.bincount(faces[area > 0].ravel(), minlength=len(vertices)) > 0]
    diagonal = float(np.linalg.norm(np.ptp(used, axis=0))) if len(used) else 1.0
    lengths = np.sqrt(4 / math.sqrt(3) * size * mean) / diagonal  # of equilateral triangles' sides
    padded = jax.device_put(pad_rows(normals, count)), jax.device_put(pad_rows(lengths, count))
    # On small meshes, all bands take less time than compiling a program for fewer.
    computed = BANDS if padded[0].size < MIN_LARGE_VALUES else bands
    threshold, bare = (np.asarray(values)[:bands, : len(faces)] for values in _hidden(links, *padded, computed))
    whole = float(area.sum())
    masking = Masking(faces.astype(np.int32), area / (whole or 1.0), turned, links, threshold)
    return Relief(masking, whole, bare, pairs, angle)


@jax.jit
def visible_turn(original: Positions, distorted: Positions, masking: Masking) -> Float[Array, " faces"]:
    """Compute how visible the turn of each face's normal is, in just noticeable differences; see `shading`."""
    check_alike("shading", original, distorted)
    change = _normals(distorted, masking) - _normals(original, masking)
    # Compiled code may round equal positions to different normals. Only the value is mended: the derivative is sound.
    unmoved = jnp.all((original == distorted)[masking.faces], axis=(1, 2))[:, None]
    change -= jax.lax.stop_gradient(jnp.where(unmoved, change, 0))
    padded = jnp.pad(change, ((0, len(masking.links.degree) - len(change)), (0, 0)))
    energy = _energies(masking.links, padded, len(masking.threshold))[:, : len(change)]
    turn = root(energy) / jnp.asarray(masking.threshold).astype(change.dtype)
    largest = jax.lax.stop_gradient(jnp.max(turn, axis=0))
    largest = jnp.where(largest > 0, largest, 1)
    # Powers are computed of ratios, because those of the values themselves may overflow or underflow.
    total = jnp.sum((turn / largest) ** _POOLING, axis=0)
    return largest * jnp.where(total > 0, jnp.where(total > 0, total, 1) ** (1 / _POOLING), 0)


@jax.jit
def shading(original: Positions, distorted: Positions, masking: Masking, share: float | Scalar = SHARE) -> Scalar:
    """Compute the visible turn of normals that 1 % of the area (1 - `share`) exceeds, in just noticeable differences.

    Normals are split into bands of spatial frequency. In each band, the turn is divided by the just noticeable turn,
    which increases with the original's own contrast in the band (masking by Daly, with the constants of Nader, Wang,
    Hétroy-Wheeler, Dupont, "Just noticeable distortion profile for flat-shaded 3D mesh surfaces", IEEE TVCG 22(11),
    2016; sensitivity by Barten, JOSA A 7(10), 1990). On a plane, a turn of 0.2° is just noticeable, by our calibration.
    The gradient is that of the face at the percentile.

    Raises:
        JaxmarkError: if the positions differ in shape.
    """
    return percentile(visible_turn(original, distorted, masking), jnp.asarray(masking.area), share)


def vertex_means(values: Float[Array, " faces"], masking: Masking, count: int) -> Float[Array, " vertices"]:
    """Average the values of the faces around each of `count` vertices by area, for heat maps; 0 without faces."""
    area = jnp.asarray(masking.area).astype(values.dtype)[:, None]
    zeros, corners = jnp.zeros(count, values.dtype), masking.faces
    return ratio(zeros.at[corners].add(area * values[:, None]), zeros.at[corners].add(area))


def _areas_and_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the areas of faces and their unit normals, 0 for those that are too flat to have one."""
    sides = [vertices[faces[:, k]] - vertices[faces[:, k - 1]] for k in range(3)]
    longest, normals = np.max([_squared(side) for side in sides], axis=0), cross_product(sides[1], sides[2])
    double = np.sqrt(_squared(normals))
    area = np.where(double > MIN_HEIGHT * longest, double / 2, 0)
    return area, normals / np.where(area > 0, double, 1)[:, None]


def _squared(x: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, " rows"]:
    """Compute the squared lengths of vectors."""
    return np.einsum("ri,ri->r", x, x)


def _second_largest(pairs: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Find the second largest value of the pairs that contain each index below a count; 0 if fewer than two do."""
    which, left = pairs.T.ravel(), np.tile(values, 2)
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, which, left)
    first = np.full(count, -1)
    reaching = np.flatnonzero(left == largest[which])
    first[which[reaching]] = reaching
    left[first[first >= 0]] = -np.inf
    second = np.full(count, -np.inf)
    np.maximum.at(second, which, left)
    return np.where(np.isfinite(second), second, 0)


def _orient(pairs: np.ndarray, against: np.ndarray, count: int) -> np.ndarray:
    """Compute signs that orient the faces of each component consistently; +1 for components that are one-sided.

    In a graph, each face has two nodes, one for each of its sides; nodes of adjoining sides are connected.
    """
    if not against.any():
        return np.ones(count)
    one, other = pairs.T
    ends = np.concatenate([one, one + count]), np.concatenate([other + count * against, other + count * ~against])
    graph = sparse.coo_array((np.ones(len(ends[0])), ends), shape=(2 * count, 2 * count))
    front, back = csgraph.connected_components(graph, directed=False)[1].reshape(2, count)
    return np.where(front <= back, 1.0, -1.0)


def _normals(x: Array, masking: Masking) -> Array:
    """Compute the unit normals of the faces that have one."""
    corners = take_rows(x, masking.faces)
    cross = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    square = jnp.sum(cross**2, axis=1, keepdims=True)
    sound = (square > 0) & (jnp.asarray(masking.area) > 0)[:, None]
    sign = jnp.asarray(masking.turned).astype(x.dtype)[:, None]
    return jnp.where(sound, sign * cross / jnp.sqrt(jnp.where(sound, square, 1)), 0)


@cache
def _diffusions(count: int) -> Float[np.ndarray, "scales terms"]:
    """Compute the Chebyshev coefficients of the diffusions that separate a number of bands."""
    terms = [round(3 * 2 ** (scale / 2)) + 1 for scale in _SCALES[:count]]
    series = diffusion(_SCALES[count - 1] + 1, terms[-1])[list(_SCALES[:count])]
    # The rest of each series is below 3e-5.
    return np.where(np.arange(terms[-1]) < np.array(terms)[:, None], series, 0)


def _energies(links: Laplacian, x: Array, count: int) -> Array:
    """Compute the energy of signals of faces in bands, from the shortest waves on; the longest waves are in no band."""
    passed = _diffusions(count)
    bands = _GAINS[:count, None] * (np.vstack([np.eye(1, passed.shape[1]), passed[:-1]]) - passed)
    parts = (band_components(links, jnp.asarray(some, x.dtype), x) for some in _by_length(bands, x.size))
    return jnp.concatenate([jnp.sum(part**2, axis=2) for part in parts])


def _by_length(series: Float[np.ndarray, "series terms"], values: int) -> list[Float[np.ndarray, "some fewer"]]:
    """Split series, sorted by length, into those of at most `_FEW_TERMS` terms, without the zeros, and the others.

    If a signal has few values, the series stay together: running them takes less time than compiling two programs.
    """
    if values < MIN_LARGE_VALUES:
        return [series]
    short = int((~series[:, _FEW_TERMS:].any(axis=1)).sum())
    return [some for some in (series[:short, :_FEW_TERMS], series[short:]) if len(some)]


@partial(jax.jit, static_argnames="count")
def _hidden(links: Laplacian, normals: Array, length: Array, count: int) -> tuple[Array, Array]:
    """Compute the just noticeable turns in each band, with and without masking, from the means around each face."""
    energy, dtype = _energies(links, normals, count), normals.dtype
    means, start = [], 0
    for some in _by_length(_diffusions(count), normals.size):
        # Each band's energy and the lengths are averaged by the same series: columns of one signal.
        columns = jnp.concatenate([energy[start : start + len(some)], jnp.tile(length, (len(some), 1))]).T
        means.append(filter(links, jnp.tile(jnp.asarray(some, dtype), (2, 1)), columns).T.reshape(2, len(some), -1))
        start += len(some)
    around, local = jnp.concatenate(means, axis=1)
    contrast = math.tan(_INCIDENCE) * root(around)
    wavelengths = jnp.asarray(_WAVELENGTHS[:count, None], dtype) * local
    sensitivity = _sensitivity(jnp.maximum(wavelengths, 1e-9))
    masked = (1 + (_MASKING_SLOPE * contrast * sensitivity) ** _MASKING_BEND) ** (1 / _MASKING_BEND)
    bare = 1 / sensitivity / math.tan(_INCIDENCE)
    return masked * bare, bare


def _sensitivity(wavelength: Array) -> Array:
    """Compute the contrast sensitivity to waves, whose lengths are given in diagonals."""
    cycles = jnp.maximum(1 / (wavelength * _SIZE), _BEST_FREQUENCY)
    values = _barten(cycles) / float(_barten(np.array(_BEST_FREQUENCY), np))
    return jnp.maximum(values, _MIN_SENSITIVITY) / _LEAST_CONTRAST


def _barten(cycles: Any, xp: Any = jnp) -> Any:
    """Compute Barten's contrast sensitivity at frequencies in cycles per degree, by JAX or by NumPy."""
    peak = 540 * (1 + 0.7 / _LUMINANCE) ** -0.2 / (1 + 12 / (_SIZE * (1 + cycles / 3) ** 2))
    kept = xp.exp(-0.3 * (1 + 100 / _LUMINANCE) ** 0.15 * cycles)
    return peak * cycles * xp.sqrt(kept**2 + 0.06 * kept)
