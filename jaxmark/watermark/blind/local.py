"""The blind scheme `local`: values at vertices that are identified by the connectivity around them; survives cropping.

Each vertex has a colour, which is a hash of the connectivity of the five rings around it. A vertex is an anchor if the
key's hash of its colour is the least in its neighbourhood. A cut therefore changes colours and values only nearby. An
anchor's value is the difference of two averages over the graph, (I - Δ/2)^k - (I - Δ/2)^2k, along the averaged normal,
divided by the usual size of such differences around it. Smoothing by m steps of a tenth is approximately
(I - Δ/2)^(m/5), so that a smoothed suspect is read with averages whose powers are smaller by this number. After
remeshing, the colours are different, and nothing can be read.
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

_RINGS = 5  # number of rings of neighbours that a colour depends on
_APART = 3  # number of rings in which there is at most one anchor
_BORDER = 8  # number of rings along borders that are not used
_SHORTER = (0, 1, 3, 6, 10)  # numbers that are subtracted from the powers of averages, for smoothed suspects
_STEPS_EACH = 5  # number of smoothing steps that correspond to 1 of them
_NORMAL = 16  # power of the average from which normals are computed
_AROUND = 4  # power of the average of sizes, over that of the narrow average
_LARGEST, _LEAST = 4.0, 0.1  # limits on the size of differences, over the usual size
_MEDIAN = 0.6745  # median of the absolute value of a normal distribution, over its standard deviation
_FIRST_STEP = 0.25  # quantisation step that is tried first
_SPREAD = (0.15,)  # standard deviation of the usual size in a part, relative to that of the whole shape


@dataclass(frozen=True)
class LocalScheme(BlindScheme):
    """A blind scheme that writes values at vertices identified by connectivity; read from any part of the mesh.

    Widths and steps are public lists, see `FieldScheme`.
    """

    name: ClassVar[str] = "local"
    in_parts: ClassVar[bool] = True
    written_last: ClassVar[bool] = True
    widths: tuple[float, ...] = (32.0,)  # power k of the narrow average (I - Δ/2)^k
    steps: tuple[float, ...] = tuple(0.0625 * 2 ** (rung / 2) for rung in range(11))  # quantisation steps
    hiding: bool = False  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`

    @property
    def looks(self) -> int:
        """See `BlindScheme`."""
        return len(_SHORTER)

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """See `BlindScheme`."""
        anchors, rows = _anchors(original.points, choices), original.to_traced(original.positions)
        good = (anchors.vertices >= 0).astype(np.float64)
        free = original.to_traced(original.used.astype(np.float64))
        hosts = {}
        for width in self.widths:
            shape = _shape(original.points, original.operator, anchors, int(width), 0)
            values, held = measure(shape, rows)
            hosts[width] = AnchoredHost(
                shape, anchors.names, np.asarray(values, np.float64), held, good, free, np.ones(1), _FIRST_STEP
            )
        return hosts

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[list[Look]]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: if the suspect is a point cloud, or has no extent.
        """
        size = diagonal(suspect)
        points, dtype = np.asarray(suspect.vertices, np.float64), jnp.result_type(float)
        operator, anchors = common_laplacian(suspect), _anchors(suspect, choices)
        positions = jnp.asarray(pad_rows((points - points.mean(axis=0)) / size, len(operator.degree)), dtype)
        for shorter in _SHORTER:
            looks = []
            for width in self.widths:
                values, _ = measure(_shape(suspect, operator, anchors, int(width), shorter), positions)
                looks.append(
                    Look(
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
                )
            yield looks


class _Anchors(NamedTuple):
    """Vertices that are selected by connectivity and key; padded to a common size."""

    vertices: Int64[np.ndarray, " anchors"]  # -1 for padding
    names: Int64[np.ndarray, "anchors 1"]  # their colours


def _anchors(points: Mesh, choices: Choices) -> _Anchors:
    """Find the vertices away from borders whose keyed hash is less than all others within some rings."""
    rings = Rings(points)
    names = [rings.grow() for _ in range(_RINGS)][-1].view(np.int64)
    distinct, place = np.unique(names, return_inverse=True)
    hashes = make_words(choices, "local/anchor", distinct[:, None])[place] >> 31

    def least(numbers: Int64[np.ndarray, " vertices"], count: int) -> Int64[np.ndarray, " vertices"]:
        """Find the least number within a number of rings of each vertex."""
        for _ in range(count):
            numbers = rings.least(numbers)
        return numbers

    # Ties between equal hashes are broken by both orders of the vertices, so that no vertex with a tie is an anchor.
    number = np.arange(len(names))
    first, last = (hashes << 32) + number, (hashes << 32) + number[::-1]
    is_least = (least(first, _APART) == first) & (least(last, _APART) == last)
    border = np.zeros(len(names), np.int64)
    faces, is_open = np.asarray(points.faces), open_sides(points.faces)
    border[faces[is_open]] = border[np.roll(faces, -1, axis=1)[is_open]] = -1
    inside = least(border, _BORDER) == 0
    selected = np.flatnonzero(is_least & inside & (rings.valence > 0))
    count = common_size(max(len(selected), 1))
    return _Anchors(pad_rows(selected, count, -1), pad_rows(names[selected][:, None], count))


class Surroundings(NamedTuple):
    """A mesh prepared for measuring the values of its anchors as a function of its vertices; a pytree."""

    operator: Laplacian
    faces: Int[np.ndarray, "faces 3"]
    anchors: Int[np.ndarray, " anchors"]
    used: Bool[np.ndarray, " rows"]  # whether a row is a vertex of a face
    band: Float64[np.ndarray, " terms"]  # series of the difference of the two averages
    normal: Float64[np.ndarray, " terms"]  # series of the average from which normals are computed
    around: Float64[np.ndarray, " terms"]  # series of the average of sizes

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " none"]]:
        """Measure the anchors' values; nothing is held. Normals and sizes are constants in derivatives."""
        smooth = filter(self.operator, self.normal, vertices)
        a, b, c = (smooth[self.faces[:, corner]] for corner in range(3))
        face_normals = jnp.cross(b - a, c - a)
        normals = sum(jax.ops.segment_sum(face_normals, self.faces[:, corner], len(vertices)) for corner in range(3))
        tiny = jnp.finfo(vertices.dtype).tiny
        normals = normals / jnp.sqrt(jnp.maximum(jnp.sum(normals**2, axis=1, keepdims=True), tiny))
        values = jnp.sum(filter(self.operator, self.band, vertices) * jax.lax.stop_gradient(normals), axis=1)
        usual = jnp.nanmedian(jnp.where(self.used, jnp.abs(values), jnp.nan)) / _MEDIAN
        square = jnp.where(self.used, jnp.minimum(values**2, (_LARGEST * usual) ** 2), 0)
        around = jnp.maximum(filter(self.operator, self.around, square), 0) + (_LEAST * usual) ** 2
        size = jax.lax.stop_gradient(jnp.sqrt(usual * jnp.sqrt(around)))
        return (values / jnp.maximum(size, tiny))[self.anchors], jnp.zeros(0, vertices.dtype)


def _shape(points: Mesh, operator: Laplacian, anchors: _Anchors, power: int, shorter: int) -> Surroundings:
    """Prepare a mesh for averages of a power, minus a number for smoothed suspects."""
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
    """Compute the Chebyshev series of (1 - λ/2)^power, up to a degree."""
    places = np.cos(np.pi * (np.arange(2 * degree + 1) + 0.5) / (2 * degree + 1))
    return np.polynomial.chebyshev.chebfit(places, ((1 - places) / 2) ** power, degree)
