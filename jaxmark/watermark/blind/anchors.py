"""Anchors at the points of a lattice near a surface, and their values, which measure curvature by two averages.

A mesh is first moved to its own pose, which is the same after remeshing. The anchors are the points of a cubic lattice
that lie near the surface. At each anchor, two Gaussian averages of the surface's points are taken, one twice as wide as
the other. Their difference along the averaged normal is the anchor's value. Remeshing hardly changes values.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Int64
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, compact, diagonal, open_sides, weld, weld_mesh
from jaxmark.geometry.pose import Pose
from jaxmark.geometry.surfaces import Moments, surface_moments, volume_moments
from jaxmark.spectral.padding import common_size

SPACING = 3.4  # spacing of the lattice, in widths of the narrow Gaussian
WIDER = 2.0  # width of the wide Gaussian over the narrow one
_CUT = 3.2  # widths of the wide Gaussian at which it is cut off
REACH = _CUT * WIDER  # distance, in widths of the narrow Gaussian, beyond which nothing changes a value
# Largest size of pieces: in squared widths, and widths, of the narrow Gaussian. If they may be longer, subdividing the
# faces of a CAD model can change its values by a quarter of a step.
_PIECE_AREA, _PIECE_LENGTH, _PIECE_SIDE = 0.15, 0.7, 0.35
_GROUP = 256  # pieces in a group
_NO_PIECE = _NO_ANCHOR = 2**31 - 1  # the index that padding belongs to
_TINY = 1e-12  # area below which there is no surface
_SIZE_BY_VOLUME, _SIZE_BY_AREA = 0.25, 0.29  # root of the trace of the covariance: the diagonal is then about 1
_MAX_OPEN = 0.01  # largest share of open sides with which a surface encloses a volume
# Parts that are inside out have negative volume, so that the surface of a shape could be arbitrarily large in its pose.
_MAX_SAMPLES, _MAX_ANCHORS, _MAX_AROUND = 2**20, 2**15, 2**25  # apart from one per face; pieces around all anchors
_NEAREST = 0.5  # largest distance of an anchor from the surface, over the lattice's spacing
_MIN_COHERENCE = 0.5  # least length of the mean normal; where it is shorter, sheets of the surface mix
_MIN_MASS = 0.2  # least area under the narrow Gaussian, over that of a plane, with which an anchor counts


def encloses(mesh: Mesh) -> bool:
    """Whether a surface encloses a volume: whether nearly every side of a face is shared with another face."""
    return bool(open_sides(mesh.faces).mean() <= _MAX_OPEN)


def moments_of(mesh: Mesh) -> Moments:
    """Compute the moments of the volume that a mesh encloses, or of its surface if it is open, in units of the mesh."""
    centre = np.asarray(mesh.vertices).mean(axis=0)
    corners = (np.asarray(mesh.vertices) - centre)[np.asarray(mesh.faces)]
    moments = volume_moments(corners) if encloses(mesh) else surface_moments(corners)
    return moments._replace(centre=moments.centre + centre)


class Placed(NamedTuple):
    """A mesh in its own pose: the unit is about the diagonal, and the axes are the main axes."""

    mesh: Mesh  # with outward faces, if it encloses a volume
    pose: Pose  # the map from the units of the file to the mesh's own pose
    moments: Moments  # the moments in this pose
    inside_out: bool  # whether its faces were inward, and were reversed


def place(mesh: Mesh) -> Placed:
    """Move a mesh to its own pose: to its centre and main axes, the longest first, and to a size of about 1.

    The directions of the axes are arbitrary: to compare two shapes, try all directions.

    Raises:
        JaxmarkError: if it is a point cloud, has no extent or encloses no volume.
    """
    check_faces("A mark without an original", mesh)
    mesh = compact(weld_mesh(mesh, weld(mesh.vertices)))
    diagonal(mesh)  # raises an error if there is no extent
    with np.errstate(divide="ignore", invalid="ignore"):  # a double-sided surface has a volume of 0
        moments = moments_of(mesh)
    has_volume = bool(np.isfinite(moments.covariance).all())
    variances, axes = np.linalg.eigh(moments.covariance if has_volume else np.zeros((3, 3)))
    size = _SIZE_BY_VOLUME if encloses(mesh) else _SIZE_BY_AREA
    if not variances[0] > 0:
        raise JaxmarkError("This shape encloses no volume, so that it has no pose of its own; mend its faces.")
    rotation = axes[:, ::-1].T
    rotation *= np.linalg.det(rotation)
    scale = size / np.sqrt(variances.sum())
    pose = Pose(scale * rotation, -scale * rotation @ moments.centre)
    placed_moments = Moments(
        abs(moments.mass) * scale**3, np.zeros(3), scale**2 * rotation @ moments.covariance @ rotation.T
    )
    inside_out = encloses(mesh) and moments.mass < 0
    faces = np.asarray(mesh.faces)
    return Placed(
        Mesh(pose(np.asarray(mesh.vertices)), turned(faces) if inside_out else faces), pose, placed_moments, inside_out
    )


def turned(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces 3"]:
    """Reverse faces."""
    return faces[:, ::-1]


class Patches(NamedTuple):
    """Small pieces of a surface, whose size hardly depends on that of its faces; traced."""

    points: Float[Array, "pieces 3"]  # centre of each piece
    normals: Float[Array, "pieces 3"]  # normal of each piece, as long as its area if it is planar
    area: Float[Array, " pieces"]


class Pieces(NamedTuple):
    """A partition of a surface into pieces: large faces are cut, and small ones are joined."""

    corners: Int[np.ndarray, "samples 3"]  # vertices of the face of each sample
    shares: Float64[np.ndarray, "samples 3"]  # barycentric coordinates of the sample's position
    part: Float64[np.ndarray, " samples"]  # share of the face's area that the sample represents
    piece: Int[np.ndarray, " samples"]  # index of the sample's piece, ascending
    padding: Bool[np.ndarray, " pieces"]  # used only for its length, the number of pieces

    PADDING = (0, 0, 0, _NO_PIECE, False)  # the value of each array in rows of padding

    def of(self, vertices: Float[Array, "vertices 3"]) -> Patches:
        """Compute the pieces for given vertices."""
        a, b, c = (vertices[self.corners[:, corner]] for corner in range(3))
        shares = jnp.asarray(self.shares, vertices.dtype)
        points = shares[:, :1] * a + shares[:, 1:2] * b + shares[:, 2:] * c
        normals = jnp.cross(b - a, c - a) * (jnp.asarray(self.part, vertices.dtype) / 2)[:, None]
        # The small number keeps roots and divisions, and their derivatives, finite for empty pieces.
        area = jnp.sqrt(jnp.sum(normals**2, axis=1) + _TINY**2)
        columns = jnp.concatenate([area[:, None] * points, normals, area[:, None]], axis=1)
        sums = jax.ops.segment_sum(columns, self.piece, len(self.padding), indices_are_sorted=True)
        total = jnp.maximum(sums[:, 6], _TINY)
        return Patches(sums[:, :3] / total[:, None], sums[:, 3:6], total)


def cut(mesh: Mesh, width: float) -> Pieces:
    """Cut a surface into pieces much smaller than a Gaussian of this width; deterministic.

    Values at anchors must not depend on the order of vertices and faces, nor on the directions of the axes: on coarse
    meshes, whose faces are about as wide as the Gaussian, such differences would be as large as a mark.

    Raises:
        JaxmarkError: if there are too many pieces.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1) / 2
    nonempty = areas > 0
    faces, normals, areas = faces[nonempty], normals[nonempty], areas[nonempty]
    corners = vertices[faces]
    sides = np.maximum(np.ceil(np.sqrt(areas / (_PIECE_AREA * width**2))), 1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    slices = np.maximum(np.ceil(longest / (_PIECE_LENGTH * width * sides)), 1)
    _check(float(np.sum(sides**2)) - len(sides), _MAX_SAMPLES)
    # A hundred thousand long needles would have too many slices; their total area is small, so fewer will do.
    slices = np.maximum(np.floor(slices * min(1, _MAX_SAMPLES / max(np.sum(sides**2 * slices), 1))), 1)
    face, shares, part = _samples(corners, sides.astype(np.int64), slices.astype(np.int64))
    points = np.einsum("sk,skc->sc", shares, corners[face])
    # Pieces do not mix sheets: the normals of each have the same signs in all coordinates.
    cube = np.floor(points / (_PIECE_SIDE * width)).astype(np.int64)
    keys = np.concatenate([cube, normals[face] > 0], axis=1)
    _, piece = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(piece.ravel(), kind="stable")
    padding = np.zeros(int(piece.max(initial=0)) + 1, bool)
    return Pieces(faces[face][order], shares[order], part[order], piece.ravel()[order], padding)


def _samples(
    corners: Float64[np.ndarray, "faces 3 3"], sides: Int64[np.ndarray, " faces"], slices: Int64[np.ndarray, " faces"]
) -> tuple[Int64[np.ndarray, " samples"], Float64[np.ndarray, "samples 3"], Float64[np.ndarray, " samples"]]:
    """Cut faces into sides² equal triangles, and each of these across its length into slices of equal width.

    Slices do not depend on the order of the corners: they are perpendicular to the triangle's main axis.

    Returns:
        For each slice the index of its face, the barycentric coordinates of its centre, and its share of the face.
    """
    first = np.cumsum(slices) - slices  # index of the first slice of each face's triangles
    centre, share = np.full((int(slices.sum()), 3), 1 / 3), np.ones(int(slices.sum()))
    is_cut = slices > 1
    rows = np.repeat(is_cut, slices)
    centre[rows], share[rows] = _slices(corners[is_cut], slices[is_cut])
    count = sides**2 * slices
    face = np.repeat(np.arange(len(sides)), count)
    triangle, index = np.divmod(np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count), slices[face])
    middle, turned = _centres(triangle, sides[face])
    slice_ = first[face] + index
    away = np.where(turned, -1, 1)[:, None] * (centre[slice_] - 1 / 3) / sides[face][:, None]
    return face, middle + away, share[slice_] / sides[face] ** 2


def _centres(
    index: Int64[np.ndarray, " triangles"], sides: Int64[np.ndarray, " triangles"]
) -> tuple[Float64[np.ndarray, "triangles 3"], Bool[np.ndarray, " triangles"]]:
    """Compute the barycentric coordinates of the centres of the sides² equal triangles that a triangle is cut into.

    They do not depend on the order of the triangle's corners, and their mean of any linear function is exact. Row k
    below the first corner has 2k + 1 triangles, every other one upside down.

    Returns:
        The centres, and which of the triangles are upside down.
    """
    row = np.floor(np.sqrt(index))
    pair, upside_down = np.divmod(index - row**2, 2)
    second, third = pair + (1 + upside_down) / 3, row - pair + (1 - 2 * upside_down) / 3
    return np.stack([sides - second - third, second, third], axis=1) / sides[:, None], upside_down == 1


def _slices(
    corners: Float64[np.ndarray, "faces 3 3"], count: Int64[np.ndarray, " faces"]
) -> tuple[Float64[np.ndarray, "slices 3"], Float64[np.ndarray, " slices"]]:
    """Cut triangles across their length into slices of equal width.

    Returns:
        For each slice the barycentric coordinates of its centre, and its share of the triangle's area.
    """
    middle = corners - corners.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("fki,fkj->fij", middle, middle))
    along = np.einsum("fkc,fc->fk", middle, axes[:, :, 2])
    order = np.argsort(along, axis=1)
    face = np.repeat(np.arange(len(count)), count)
    low, peak, high = np.take_along_axis(along, order, axis=1)[face].T
    step = (high - low) / count[face]
    index = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)

    def below(place: Float64[np.ndarray, " slices"]) -> Float64[np.ndarray, "slices 4"]:
        """Moment in barycentric coordinates, and area, of the part of a triangle below a place along its axis."""
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = (place - low) / (peak - low), (place - low) / (high - low)
            lower = near * far * np.stack([1 - (near + far) / 3, near / 3, far / 3, np.ones_like(far)])
            near, far = np.where(high > peak, (high - place) / (high - peak), 0), (high - place) / (high - low)
            upper = near * far * np.stack([far / 3, near / 3, 1 - (near + far) / 3, np.ones_like(far)])
        whole = np.array([1 / 3, 1 / 3, 1 / 3, 1.0])
        return np.where(place[:, None] < peak[:, None], lower.T, whole - upper.T)

    between = below(np.minimum(low + step * (index + 1), high)) - below(low + step * index)
    centre = between[:, :3] / between[:, 3:]
    return np.take_along_axis(centre, np.argsort(order, axis=1)[face], axis=1), between[:, 3]


@jax.jit
def patches(pieces: Pieces, vertices: Float[Array, "vertices 3"]) -> Patches:
    """See `Pieces.of`."""
    return pieces.of(vertices)


class Anchors(NamedTuple):
    """The lattice points near a surface, and the pieces around each, in groups of equal size."""

    cells: Int64[np.ndarray, "anchors 3"]  # indices of the lattice point
    places: Float64[np.ndarray, "anchors 3"]  # position of the lattice point
    around: Int[np.ndarray, "groups group"]  # indices of pieces around an anchor; -1 for none
    anchor: Int[np.ndarray, " groups"]  # index of this anchor, ascending; for padding, beyond the last

    PADDING = (0, 0, -1, _NO_ANCHOR)  # the value of each array in rows of padding


def make_anchors(surface: Patches, width: float) -> Anchors:
    """Find the lattice points near a surface, and the pieces around each.

    Args:
        surface: the pieces of the surface.
        width: width of the narrow Gaussian.

    Raises:
        JaxmarkError: if there are too many anchors or pieces.
    """
    spacing = SPACING * width
    points = np.asarray(surface.points, np.float64)
    nonempty = np.flatnonzero(np.asarray(surface.area) > _TINY)
    cells = np.unique(np.round(points[nonempty] / spacing).astype(np.int64), axis=0)
    _check(len(cells), _MAX_ANCHORS)
    tree = KDTree(points[nonempty])
    distance, _ = tree.query(cells * spacing, distance_upper_bound=0.75 * spacing)
    cells = cells[np.isfinite(np.asarray(distance))]
    return Anchors(cells, cells * spacing, *_around(tree, nonempty, cells * spacing, REACH * width))


def anchors_at(surface: Patches, places: Float64[np.ndarray, "anchors 3"], width: float, room: float = 0.0) -> Anchors:
    """Make anchors at any places, which have no cells.

    Args:
        surface: the pieces of the surface.
        places: where the anchors are.
        width: width of the narrow Gaussian.
        room: length by which the anchors may be moved afterwards.

    Raises:
        JaxmarkError: if there are too many pieces around the anchors.
    """
    nonempty = np.flatnonzero(np.asarray(surface.area) > _TINY)
    tree = KDTree(np.asarray(surface.points, np.float64)[nonempty])
    cells = np.zeros(places.shape, np.int64)
    return Anchors(cells, places, *_around(tree, nonempty, places, REACH * width + room))


def _around(
    tree: KDTree, pieces: Int64[np.ndarray, " pieces"], places: Float64[np.ndarray, "anchors 3"], reach: float
) -> tuple[Int[np.ndarray, "groups group"], Int[np.ndarray, " groups"]]:
    """Find the pieces around places, in groups of equal size, and the place that each group belongs to."""
    counts = np.asarray(tree.query_ball_point(places, reach, workers=-1, return_length=True))
    _check(int(counts.sum()), _MAX_AROUND)
    lists = tree.query_ball_point(places, reach, workers=-1)
    groups = -(-counts // _GROUP)
    anchor = np.repeat(np.arange(len(places)), groups)
    first = _GROUP * (np.cumsum(groups) - groups) - (np.cumsum(counts) - counts)
    around = np.full(_GROUP * len(anchor), -1, np.int32)
    around[np.arange(counts.sum()) + np.repeat(first, counts)] = pieces[np.concatenate([*lists, []]).astype(np.int64)]
    return around.reshape(-1, _GROUP), anchor


def _check(size: float, largest: int) -> None:
    """Check that a shape is not too large in its own pose."""
    if not size <= largest:
        raise JaxmarkError(
            "This shape's surface is too large in comparison with the volume that it encloses, so that its pose cannot"
            " be used; mend its faces, or use another scheme."
        )


class Seen(NamedTuple):
    """A surface cut into pieces, with its anchors for one width."""

    pieces: Pieces
    surface: Patches
    anchors: Anchors


def see(mesh: Mesh, widths: Sequence[float], dtype: np.dtype) -> dict[float, Seen]:
    """Cut a surface into pieces, and find the anchors near it, for each width.

    The results for all widths are padded to common shapes, so that one compiled program serves them all.

    Raises:
        JaxmarkError: if the surface is too large.
    """
    vertices = jnp.asarray(mesh.vertices, dtype)
    pieces = alike([cut(mesh, width) for width in widths])
    surfaces = [patches(part, vertices) for part in pieces]
    anchors = alike(list(map(make_anchors, surfaces, widths)))
    return dict(zip(widths, map(Seen, pieces, surfaces, anchors), strict=True))


_Partition = TypeVar("_Partition", Pieces, Anchors)


def alike(partitions: Sequence[_Partition]) -> list[_Partition]:
    """Pad the arrays of the same field to the size of the largest, and then to a common size."""
    fields = []
    for arrays, value in zip(zip(*partitions, strict=True), partitions[0].PADDING, strict=True):
        rows, *columns = np.max([array.shape for array in arrays], axis=0)
        shape = (common_size(int(rows)), *columns)
        widths = [[(0, largest - size) for largest, size in zip(shape, array.shape, strict=True)] for array in arrays]
        fields.append([np.pad(array, pad, constant_values=value) for array, pad in zip(arrays, widths, strict=True)])
    return [type(partitions[0])(*arrays) for arrays in zip(*fields, strict=True)]


class Shown(NamedTuple):
    """The values of anchors."""

    values: Float[Array, " anchors"]  # difference of the averages along the normal
    good: Bool[Array, " anchors"]  # whether the lattice point is near a single sheet of the surface
    normals: Float[Array, "anchors 3"]  # averaged normals of the surface
    away: Float[Array, " anchors"]  # how far the surface lies away along the normal


@jax.jit
def look(
    surface: Patches,
    anchors: Anchors,
    shift: Float[Array, "anchors 3"],
    width: Float[Array, ""],
    undone: Float[Array, ""],
) -> Shown:
    """Measure the value of each anchor, moved by `shift`.

    Args:
        surface: the pieces of the surface.
        anchors: from `make_anchors`.
        shift: displacement of each anchor.
        width: width of the narrow Gaussian.
        undone: blur that the surface already has, as a share of the narrow Gaussian's variance; the averages are made
            narrower by it.
    """
    narrow, wide = width**2 * (1 - undone), width**2 * (WIDER**2 - undone)
    dtype, is_piece = surface.points.dtype, anchors.around >= 0
    positions = jnp.asarray(anchors.places, dtype) + shift
    offset = surface.points[anchors.around] - positions[jnp.minimum(anchors.anchor, len(positions) - 1)][:, None]
    square = jnp.sum(offset**2, axis=-1)
    cut_off = jnp.exp(-((REACH * width) ** 2) / 2 / wide)
    share = jnp.where(is_piece, jnp.maximum(jnp.exp(-square / 2 / wide) - cut_off, 0), 0)
    area = surface.area[anchors.around]
    inner, outer = jnp.where(is_piece, area * jnp.exp(-square / 2 / narrow), 0), area * share

    def total(
        weights: Float[Array, "groups group"], vectors: Float[Array, "groups group 3"]
    ) -> Float[Array, "groups 3"]:
        return jnp.einsum("gp,gpc->gc", weights, vectors)

    sums = (total(share, surface.normals[anchors.around]), total(inner, offset), total(outer, offset))
    columns = jnp.concatenate([*sums, inner.sum(axis=1)[:, None], outer.sum(axis=1)[:, None]], axis=1)
    sums_per_anchor = jax.ops.segment_sum(columns, anchors.anchor, len(positions), indices_are_sorted=True)
    normal, narrow_mean, wide_mean, inside, outside = jnp.split(sums_per_anchor, (3, 6, 9, 10), axis=1)
    length = jnp.sqrt(jnp.sum(normal**2, axis=1, keepdims=True) + _TINY**2)
    normal, narrow_mean, wide_mean = normal / length, narrow_mean / (inside + _TINY), wide_mean / (outside + _TINY)
    away = jnp.sum(narrow_mean * normal, axis=1)
    is_coherent, is_covered = length > _MIN_COHERENCE * outside, inside > _MIN_MASS * 2 * jnp.pi * narrow
    good = (jnp.abs(away) < _NEAREST * SPACING * width) & is_coherent[:, 0] & is_covered[:, 0]
    return Shown(jnp.sum((narrow_mean - wide_mean) * normal, axis=1), good, normal, away)


class Changes(NamedTuple):
    """The values of anchors, and their derivatives with respect to small motions and scalings of the surface."""

    shown: Shown
    slope: Float[Array, "anchors 3"]  # derivatives of the values as the anchors move
    growth: Float[Array, " anchors"]  # derivatives of the values as the anchors are scaled and the surface is not


@jax.jit
def slopes(
    surface: Patches, anchors: Anchors, width: Float[Array, ""], undone: Float[Array, ""]
) -> tuple[Shown, Float[Array, "anchors 3"]]:
    """Measure the values of anchors, and their derivatives as the anchors move."""

    def total(shift: Float[Array, "anchors 3"]) -> tuple[Float[Array, ""], Shown]:
        shown = look(surface, anchors, shift, width, undone)
        return shown.values.sum(), shown

    slope, shown = jax.grad(total, has_aux=True)(jnp.zeros(anchors.places.shape, surface.points.dtype))
    return shown, slope


@jax.jit
def changes(surface: Patches, anchors: Anchors, width: Float[Array, ""], undone: Float[Array, ""]) -> Changes:
    """Measure the values of anchors, and their derivatives with respect to small motions and scalings of the surface.

    Scaling the anchors is equivalent to shrinking the surface: the averages are widened too, and the values are in the
    larger unit.
    """
    no_shift = jnp.zeros(anchors.places.shape, surface.points.dtype)
    shown, slope = slopes(surface, anchors, width, undone)
    _, widened = jax.jvp(lambda size: look(surface, anchors, no_shift, size, undone).values, (width,), (width,))
    spread = jnp.sum(slope * jnp.asarray(anchors.places, slope.dtype), axis=1)
    return Changes(shown, slope, spread + widened - shown.values)
