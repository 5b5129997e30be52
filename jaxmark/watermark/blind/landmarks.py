"""Landmarks of a surface: points that are found again in its parts, after remeshing and in any pose.

A landmark is a point where the value of an anchor (`jaxmark.watermark.blind.anchors`) is larger, or smaller, than
everywhere around it on the surface. It has a frame: the averaged normal, and the direction along the surface in which
the value changes most. Landmarks depend on the surface only, not on a key. All computations run on the host.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, cross_product, open_sides, unit
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.blind.anchors import REACH, Anchors, Patches, alike, anchors_at, cut, look, patches, slopes

_COARSER = 2.5  # the surface is cut into pieces for a Gaussian so much wider; more pieces would change little
_AROUND = 1.6  # distance, in widths, within which a value is the largest
_RIM = 1.0  # least distance from a border, in widths
_RIM_POINTS = 5  # points on each edge of the border
_TURNS, _STEPS = 2, 2  # curvatures are measured so many times, and Newton steps taken with each
_LONGEST_STEP, _LONGEST_WAY = 0.5, 1.0  # the longest step, and the longest way of all steps, in widths
_ASIDE = 0.4  # distance, in widths, over which curvatures are measured
_ARRIVED = 0.15  # length of the last step, in widths, up to which a landmark counts as found
_LEAST_CURVATURE = 0.15  # curvatures are taken as at least this share of the largest
_CROWDED = 1000  # pieces around a point that are too many; a plane has about 170
_MOST_POINTS, _MOST_EXTREMES = 2**15, 256  # points of a surface that are compared, and extremes that are refined
_APART = 0.3  # least distance of landmarks of one kind, in widths
_TINY = 1e-9

_Vectors = Float64[np.ndarray, "points 3"]


class Landmarks(NamedTuple):
    """The landmarks of a surface."""

    places: _Vectors
    normals: _Vectors
    tangents: _Vectors  # unit vectors along the surface, of arbitrary sign
    kinds: Int64[np.ndarray, " points"]  # twice the index of the width, plus 1 for maxima
    clarity: Float64[np.ndarray, " points"]  # curvature of the value in the direction in which it changes least

    def pick(self, chosen: Int64[np.ndarray, " chosen"] | Bool[np.ndarray, " points"]) -> "Landmarks":
        """Return some of the landmarks."""
        return Landmarks(*(column[chosen] for column in self))

    def seen(self, pose: Pose, *, inside_out: bool = False) -> "Landmarks":
        """Return the landmarks of the surface in another pose, and with its faces reversed if it was inside out."""
        return self._replace(
            places=pose(self.places),
            normals=(-1 if inside_out else 1) * unit(self.normals @ pose.matrix.T),
            tangents=unit(self.tangents @ pose.matrix.T),
            kinds=self.kinds ^ 1 if inside_out else self.kinds,
        )

    def clearest(self, count: int) -> "Landmarks":
        """Return so many of the landmarks, or all if there are fewer, the clearest first."""
        return self.pick(np.argsort(-self.clarity, kind="stable")[:count])

    @property
    def frames(self) -> Float64[np.ndarray, "points 3 3"]:
        """The axes of each landmark as columns: tangent, the cross product of normal and tangent, and normal."""
        return np.stack([self.tangents, cross_product(self.normals, self.tangents), self.normals], axis=-1)


class Border:
    """The border of a surface, beside which averages miss a part of it."""

    def __init__(self, mesh: Mesh) -> None:
        faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices, np.float64)
        is_open = open_sides(faces)
        start, end = vertices[faces[is_open]], vertices[np.roll(faces, -1, axis=1)[is_open]]
        share = np.linspace(0, 1, _RIM_POINTS)[:, None, None]
        points = ((1 - share) * start + share * end).reshape(-1, 3)
        self._tree = KDTree(points) if len(points) else None

    def distances(self, places: _Vectors, farthest: float = np.inf) -> Float64[np.ndarray, " points"]:
        """Compute the distances of places from the border; infinite beyond `farthest`, or if there is no border."""
        if self._tree is None:
            return np.full(len(places), np.inf)
        return np.asarray(self._tree.query(places, distance_upper_bound=farthest)[0])

    def spares(self, places: _Vectors, distance: float) -> Bool[np.ndarray, " points"]:
        """Return a mask of the places that are at least so far away from the border."""
        return np.isinf(self.distances(places, distance))


def find_landmarks(mesh: Mesh, widths: Sequence[float]) -> Landmarks:
    """Find the landmarks of a surface, for narrow Gaussians of some widths.

    Args:
        mesh: the surface, in any unit.
        widths: in units of the mesh.

    Raises:
        JaxmarkError: if the surface is too large for these widths.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    # Around the centre, where coordinates have most digits.
    centre = vertices.mean(axis=0)
    mesh, vertices = mesh._replace(vertices=vertices - centre), vertices - centre
    border = Border(mesh)
    # In units of the width, so that neither numbers nor compiled programs depend on the unit.
    scaled = [Mesh(vertices / width, mesh.faces) for width in widths]
    pieces, dtype = alike([cut(one, _COARSER) for one in scaled]), jnp.result_type(float)
    surfaces = list(map(patches, pieces, [jnp.asarray(one.vertices, dtype) for one in scaled]))
    points = list(map(_uncrowded, surfaces))
    if max(map(len, points)) > _MOST_POINTS:
        raise JaxmarkError("This surface is too large in comparison with its extent to find landmarks on it.")
    inside = [border.spares(width * point, _RIM * width) for width, point in zip(widths, points, strict=True)]
    extremes = list(map(_extremes, surfaces, alike(list(map(_anchors, surfaces, points))), inside))
    starts = alike([_anchors(one, top.places, _LONGEST_WAY) for one, top in zip(surfaces, extremes, strict=True)])
    columns = []
    for index, (width, found) in enumerate(zip(widths, map(_climb, surfaces, starts, extremes), strict=True)):
        found = found._replace(places=width * found.places, kinds=found.kinds + 2 * index)
        found = _distinct(found.pick(border.spares(found.places, _RIM * width)), _APART * width)
        columns.append(found._replace(places=found.places + centre))
    return Landmarks(*map(np.concatenate, zip(*columns, strict=True)))


def _uncrowded(surface: Patches) -> _Vectors:
    """Return the pieces around which the surface is no thicker than some sheets; elsewhere, averages mean nothing."""
    points = np.asarray(surface.points, np.float64)[np.asarray(surface.area) > _TINY]
    return points[np.asarray(KDTree(points).query_ball_point(points, REACH, workers=-1, return_length=True)) < _CROWDED]


def _anchors(surface: Patches, places: _Vectors, room: float = 0.0) -> Anchors:
    return anchors_at(surface, places, 1.0, room)


class _Seen(NamedTuple):
    """The measurements at places beside a surface, in units of the width."""

    slopes: _Vectors
    normals: _Vectors
    away: Float64[np.ndarray, " points"]
    good: Bool[np.ndarray, " points"]


def _measure(surface: Patches, anchors: Anchors, places: _Vectors) -> _Seen:
    """Measure values and their derivatives at places near some anchors."""
    moved = anchors.places.copy()
    moved[: len(places)] = places
    dtype = surface.points.dtype
    shown, slope = slopes(surface, anchors._replace(places=moved), jnp.ones((), dtype), jnp.zeros((), dtype))
    columns = (slope, shown.normals, shown.away)
    slope, normals, away = (np.asarray(column, np.float64)[: len(places)] for column in columns)
    return _Seen(slope, normals, away, np.asarray(shown.good)[: len(places)])


class _Extremes(NamedTuple):
    """Points whose values are the largest or the smallest around."""

    places: _Vectors
    signs: Float64[np.ndarray, " points"]  # 1 for the largest, -1 for the smallest


def _extremes(surface: Patches, anchors: Anchors, inside: Bool[np.ndarray, " points"]) -> _Extremes:
    """Find the points whose values are the largest or the smallest around; `inside` are those that count."""
    places = anchors.places[: len(inside)]
    dtype = surface.points.dtype
    shown = look(surface, anchors, jnp.zeros(anchors.places.shape, dtype), jnp.ones((), dtype), jnp.zeros((), dtype))
    values, good, normals = (np.asarray(column)[: len(inside)] for column in shown[:3])
    first, second = KDTree(places).query_pairs(_AROUND, output_type="ndarray").T
    on_one_sheet = (normals[first] * normals[second]).sum(axis=1) > 0
    first, second, inside = first[on_one_sheet], second[on_one_sheet], inside & good
    found = []
    for sign in (-1.0, 1.0):
        height = np.where(inside, sign * values, -np.inf)
        highest = height.copy()
        np.maximum.at(highest, first, height[second])
        np.maximum.at(highest, second, height[first])
        top = np.flatnonzero((height >= highest) & inside)
        top = top[np.argsort(-height[top], kind="stable")[:_MOST_EXTREMES]]
        found.append(_Extremes(places[top], np.full(len(top), sign)))
    return _Extremes(*map(np.concatenate, zip(*found, strict=True)))


def _climb(surface: Patches, anchors: Anchors, extremes: _Extremes) -> Landmarks:
    """Move extremes along the surface to where the value is extreme, by Newton steps; in units of the width."""
    start, signs = extremes
    places, seen = start, _measure(surface, anchors, start)
    axes, curvature, length = np.zeros((len(start), 2, 3)), np.zeros((len(start), 2)), np.full(len(start), np.inf)
    for _ in range(_TURNS):
        axes, curvature = _curvatures(surface, anchors, places, seen.normals, signs)
        least = np.maximum(_LEAST_CURVATURE * curvature[:, 1:], _TINY)
        for _ in range(_STEPS):
            slope = signs[:, None] * np.einsum("akx,ax->ak", axes, seen.slopes)
            step = slope / np.maximum(curvature, least)
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1, _LONGEST_STEP / np.maximum(length, _TINY))[:, None]
            places = places + np.einsum("ak,akx->ax", step, axes) + seen.away[:, None] * seen.normals
            seen = _measure(surface, anchors, places)
    is_found = (length < _ARRIVED) & (curvature[:, 0] > 0) & seen.good
    is_found &= np.linalg.norm(places - start, axis=1) < _LONGEST_WAY
    tangents = unit(axes[:, 1] - (axes[:, 1] * seen.normals).sum(axis=1, keepdims=True) * seen.normals)
    return Landmarks(places, seen.normals, tangents, (signs > 0).astype(np.int64), curvature[:, 0]).pick(is_found)


def _curvatures(
    surface: Patches, anchors: Anchors, places: _Vectors, normals: _Vectors, signs: Float64[np.ndarray, " points"]
) -> tuple[Float64[np.ndarray, "points 2 3"], Float64[np.ndarray, "points 2"]]:
    """Compute the main axes and curvatures, ascending, of values times -1 for maxima, along the surface."""
    axis = np.where(np.abs(normals[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    across = unit(cross_product(axis, normals))
    basis = np.stack([across, cross_product(normals, across)], axis=1)
    bends = []
    for direction in np.swapaxes(basis, 0, 1):
        ahead, behind = (_measure(surface, anchors, places + way * direction) for way in (_ASIDE, -_ASIDE))
        bends.append(signs[:, None] * (behind.slopes - ahead.slopes) / (2 * _ASIDE))
    hessian = np.einsum("kax,alx->akl", np.stack(bends), basis)
    curvature, turn = np.linalg.eigh((hessian + np.swapaxes(hessian, 1, 2)) / 2)
    return np.einsum("alk,alx->akx", turn, basis), curvature


def _distinct(landmarks: Landmarks, apart: float) -> Landmarks:
    """Drop landmarks that lie beside another one of their kind."""
    keep = np.ones(len(landmarks.places), bool)
    for one, other in sorted(KDTree(landmarks.places).query_pairs(apart)):
        if keep[one] and landmarks.kinds[one] == landmarks.kinds[other]:
            keep[other] = False
    return landmarks.pick(keep)
