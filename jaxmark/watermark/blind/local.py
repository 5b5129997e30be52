"""The scheme `local`: values at vertices that are found by the connectivity around them, wherever parts are cut off.

Each vertex has a colour by the five rings around it. Where the key's hash of it is the least far around, the vertex is
an anchor: a cut changes colours and values near to it, and nothing else. An anchor's value is the difference of two
averages over the graph, (I - Δ/2)^k - (I - Δ/2)^2k, along the averaged normal, over how large such differences are
around it. Smoothing by m steps of a tenth is about (I - Δ/2)^(m/5), so that averages shorter by that much read what was
smoothed. Another meshing has other colours, and shows nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Int64

from jaxmark.alignment.original import Original
from jaxmark.geometry.connectivity import Rings
from jaxmark.geometry.mesh import Mesh, diagonal, open_sides
from jaxmark.geometry.pose import Pose
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.padding import common_laplacian, common_size, pad_rows
from jaxmark.watermark.blind.dither import make_words
from jaxmark.watermark.blind.scheme import AnchoredHost, BlindScheme, Look, measure
from jaxmark.watermark.coding.keys import Choices

_RINGS = 5  # of neighbours that a colour depends on
_APART = 3  # rings within which there is one anchor at most
_BORDER = 8  # rings along borders where nothing is read
_SHORTER = (0, 1, 3, 6, 10)  # powers by which averages are shorter, as smoothing did as much already
_STEPS_EACH = 5  # of smoothing, for each of these
_NORMAL = 16  # power of the average that normals are of
_AROUND = 4  # power of the average that sizes are of, over the narrow one's
_LARGEST, _LEAST = 4.0, 0.1  # over the usual size: what larger and smaller differences count as
_MEDIAN = 0.6745  # median of the size of what is normally distributed, over its deviation
_FIRST_STEP = 0.25  # of the lattice of values that is tried first
_SPREAD = (0.15,)  # of the usual size, as it is that of another part of the shape


@dataclass(frozen=True)
class LocalScheme(BlindScheme):
    """Writes values at vertices that connectivity tells; read without the original, and from any part of it.

    Widths and steps are public ladders, see `FieldScheme`.
    """

    name: ClassVar[str] = "local"
    in_parts: ClassVar[bool] = True
    looks: ClassVar[int] = len(_SHORTER)
    widths: tuple[float, ...] = (32.0,)  # power k of the narrow average (I - Δ/2)^k
    steps: tuple[float, ...] = tuple(0.0625 * 2 ** (rung / 2) for rung in range(11))  # of the lattice, over local sizes
    hiding: bool = False  # whether points move where and as it is hidden; see `jaxmark.watermark.perception.masking`

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """See `BlindScheme`."""
        anchors, rows = _anchors(original.points, choices), original.to_traced(original.positions)
        good = (anchors.vertices >= 0).astype(np.float64)
        free = original.to_traced(original.used.astype(np.float64))
        found = {}
        for width in self.widths:
            shape = _shape(original.points, original.operator, anchors, int(width), 0)
            values, held = measure(shape, rows)
            found[width] = AnchoredHost(
                shape, anchors.names, np.asarray(values, np.float64), held, good, free, np.ones(1), _FIRST_STEP
            )
        return found

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[Look]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: if the suspect is a point cloud, or has no extent.
        """
        size = diagonal(suspect)
        points, dtype = np.asarray(suspect.vertices, np.float64), jnp.result_type(float)
        operator, anchors = common_laplacian(suspect), _anchors(suspect, choices)
        at = jnp.asarray(pad_rows((points - points.mean(axis=0)) / size, len(operator.degree)), dtype)
        for shorter in _SHORTER:
            for width in self.widths:
                values, _ = measure(_shape(suspect, operator, anchors, int(width), shorter), at)
                yield Look(
                    anchors.names[None],
                    values,
                    anchors.vertices >= 0,
                    -values[:, None],
                    _SPREAD,
                    width,
                    Pose(np.eye(3), np.zeros(3)),
                    _STEPS_EACH * shorter,
                    np.zeros(1, bool),
                )


class _Anchors(NamedTuple):
    """Vertices that connectivity and key tell; padded to a common size."""

    vertices: Int64[np.ndarray, " anchors"]  # -1 for padding
    names: Int64[np.ndarray, "anchors 1"]  # their colours


def _anchors(points: Mesh, choices: Choices) -> _Anchors:
    """Find the vertices whose keyed hash is the least within some rings, and no other's, away from borders."""
    rings = Rings(points)
    names = [rings.grow() for _ in range(_RINGS)][-1].view(np.int64)
    known, place = np.unique(names, return_inverse=True)
    hashes = make_words(choices, "local/anchor", known[:, None])[place] >> 31

    def least(numbers: Int64[np.ndarray, " vertices"], count: int) -> Int64[np.ndarray, " vertices"]:
        """The least number within so many rings."""
        for _ in range(count):
            numbers = rings.least(numbers)
        return numbers

    # Where equal hashes are near, the first and the last of them differ, and neither is an anchor.
    number = np.arange(len(names))
    first, last = (hashes << 32) + number, (hashes << 32) + number[::-1]
    alone = (least(first, _APART) == first) & (least(last, _APART) == last)
    border = np.zeros(len(names), np.int64)
    faces, alone_there = np.asarray(points.faces), open_sides(points.faces)
    border[faces[alone_there]] = border[np.roll(faces, -1, axis=1)[alone_there]] = -1
    inside = least(border, _BORDER) == 0
    found = np.flatnonzero(alone & inside & (rings.valence > 0))
    count = common_size(max(len(found), 1))
    return _Anchors(pad_rows(found, count, -1), pad_rows(names[found][:, None], count))


class Surroundings(NamedTuple):
    """What the values of a mesh are computed from, but its vertices; a pytree."""

    operator: Laplacian
    faces: Int[np.ndarray, "faces 3"]
    anchors: Int[np.ndarray, " anchors"]
    used: Bool[np.ndarray, " rows"]  # whether a row is a vertex of a face
    band: Float64[np.ndarray, " terms"]  # series of the difference of two averages
    normal: Float64[np.ndarray, " terms"]  # of the average that normals are of
    around: Float64[np.ndarray, " terms"]  # of the average that sizes are of

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " none"]]:
        """Values of the anchors; nothing is held. Normals and sizes count as constants in derivatives."""
        smooth = filter(self.operator, self.normal, vertices)
        a, b, c = (smooth[self.faces[:, corner]] for corner in range(3))
        across = jnp.cross(b - a, c - a)
        normals = sum(jax.ops.segment_sum(across, self.faces[:, corner], len(vertices)) for corner in range(3))
        tiny = jnp.finfo(vertices.dtype).tiny
        normals = normals / jnp.sqrt(jnp.maximum(jnp.sum(normals**2, axis=1, keepdims=True), tiny))
        values = jnp.sum(filter(self.operator, self.band, vertices) * jax.lax.stop_gradient(normals), axis=1)
        usual = jnp.nanmedian(jnp.where(self.used, jnp.abs(values), jnp.nan)) / _MEDIAN
        square = jnp.where(self.used, jnp.minimum(values**2, (_LARGEST * usual) ** 2), 0)
        around = jnp.maximum(filter(self.operator, self.around, square), 0) + (_LEAST * usual) ** 2
        size = jax.lax.stop_gradient(jnp.sqrt(usual * jnp.sqrt(around)))
        return (values / jnp.maximum(size, tiny))[self.anchors], jnp.zeros(0, vertices.dtype)


def _shape(points: Mesh, operator: Laplacian, anchors: _Anchors, power: int, shorter: int) -> Surroundings:
    """Prepare a mesh for averages of a power, shorter by some."""
    faces, rows = np.asarray(points.faces), len(operator.degree)
    used = np.zeros(rows, bool)
    used[faces.ravel()] = True
    return Surroundings(
        operator,
        pad_rows(faces, common_size(len(faces))),
        np.maximum(anchors.vertices, 0),
        used,
        _series(power - shorter, 2 * power) - _series(2 * power - shorter, 2 * power),
        _series(_NORMAL, _NORMAL),
        _series(_AROUND * power, 2 * power),
    )


def _series(power: int, degree: int) -> Float64[np.ndarray, " terms"]:
    """The Chebyshev series of (1 - λ/2)^power, up to a degree."""
    places = np.cos(np.pi * (np.arange(2 * degree + 1) + 0.5) / (2 * degree + 1))
    return np.polynomial.chebyshev.chebfit(places, ((1 - places) / 2) ** power, degree)
