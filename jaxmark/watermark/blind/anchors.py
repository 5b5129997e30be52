"""What a surface shows at the points of a fixed lattice: how it is curved there, as a difference of two averages.

A mesh is first brought to a pose of its own, which any meshing of the same shape has. At each point of a cubic lattice
that lies near the surface, an anchor, two Gaussian averages of the surface's points are taken, one twice as wide as the
other; their difference along the averaged normal is the anchor's value. Values hardly depend on the meshing.
"""

from collections.abc import Sequence
from typing import NamedTuple

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

SPACING = 3.4  # of the lattice, in widths of the narrow Gaussian
_WIDER = 2.0  # width of the wide Gaussian over the narrow one
_CUT = 3.2  # widths of the wide Gaussian at which it is cut off
_PIECE_AREA, _PIECE_SIDE = 0.2, 0.35  # of pieces at most, in squared widths and widths of the narrow Gaussian
_GROUP = 256  # pieces in a group
_NO_PIECE = _NO_ANCHOR = 2**31 - 1  # what padding belongs to
_TINY = 1e-12  # area that is nothing
_SIZE_BY_VOLUME, _SIZE_BY_AREA = 0.25, 0.29  # root of the trace of the covariance: the diagonal is then about 1
_MAX_OPEN = 0.01  # share of open sides up to which a surface encloses a volume
# Parts that are inside out count against the others, and could make any shape as large as one likes in its own pose.
_MAX_SAMPLES, _MAX_ANCHORS, _MAX_AROUND = 2**20, 2**15, 2**25  # besides one for each face; pieces around all anchors
_NEAREST = 0.5  # distance from the surface, over the lattice's spacing, up to which a lattice point is an anchor
_MIN_COHERENCE = 0.5  # length of the mean normal: where it is less, sheets mix
_MIN_MASS = 0.2  # area under the narrow Gaussian, over a plane's, from which an anchor counts


def encloses(mesh: Mesh) -> bool:
    """Whether a surface encloses a volume: whether nearly all sides have another one along them, that runs back."""
    return bool(open_sides(mesh.faces).mean() <= _MAX_OPEN)


def moments_of(mesh: Mesh) -> Moments:
    """Moments of what a mesh encloses, or of its surface if it is open, in units of the mesh."""
    middle = np.asarray(mesh.vertices).mean(axis=0)
    corners = (np.asarray(mesh.vertices) - middle)[np.asarray(mesh.faces)]
    found = volume_moments(corners) if encloses(mesh) else surface_moments(corners)
    return found._replace(centre=found.centre + middle)


class Placed(NamedTuple):
    """A mesh in the pose of its own: lengths are about its diagonal, axes along its main axes."""

    mesh: Mesh  # with faces that look outwards, if it encloses a volume
    pose: Pose  # from the units of the file to it
    moments: Moments  # in it
    inside_out: bool  # whether its faces looked inwards, and were turned


def place(mesh: Mesh) -> Placed:
    """Bring a mesh to its own pose: to its centre and main axes, the longest first, and to a size of about 1.

    Along each axis it may look either way: whoever compares two shapes tries all.

    Raises:
        JaxmarkError: if it is a point cloud, has no extent or encloses no volume.
    """
    check_faces("A mark without an original", mesh)
    mesh = compact(weld_mesh(mesh, weld(mesh.vertices)))
    diagonal(mesh)  # refuses what has no extent
    found = moments_of(mesh)
    variances, axes = np.linalg.eigh(found.covariance)
    size = _SIZE_BY_VOLUME if encloses(mesh) else _SIZE_BY_AREA
    if not variances[0] > 0:
        raise JaxmarkError("This shape encloses no volume, by which its pose could be told; mend its faces.")
    turn = axes[:, ::-1].T
    turn *= np.linalg.det(turn)
    scale = size / np.sqrt(variances.sum())
    pose = Pose(scale * turn, -scale * turn @ found.centre)
    moved = Moments(abs(found.mass) * scale**3, np.zeros(3), scale**2 * turn @ found.covariance @ turn.T)
    inside_out = encloses(mesh) and found.mass < 0
    faces = np.asarray(mesh.faces)
    return Placed(
        Mesh(pose(np.asarray(mesh.vertices)), turned(faces) if inside_out else faces), pose, moved, inside_out
    )


def turned(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces 3"]:
    """Faces that look the other way."""
    return faces[:, ::-1]


class Patches(NamedTuple):
    """Pieces of a surface, all about as small, however large its faces are; traced."""

    points: Float[Array, "pieces 3"]  # the centre of each
    normals: Float[Array, "pieces 3"]  # as long as its area, if it is plane
    area: Float[Array, " pieces"]


class Pieces(NamedTuple):
    """How a surface is cut into pieces: faces are cut where they are large, and put together where they are small."""

    corners: Int[np.ndarray, "samples 3"]  # vertices of the face that each sample is of
    shares: Float64[np.ndarray, "samples 3"]  # of each corner in the sample's position
    part: Float64[np.ndarray, " samples"]  # of the face's area that the sample stands for
    piece: Int[np.ndarray, " samples"]  # number of the piece that it belongs to, ascending
    padding: Bool[np.ndarray, " pieces"]  # of no other use than its length

    def of(self, vertices: Float[Array, "vertices 3"]) -> Patches:
        """The pieces for vertices anywhere."""
        a, b, c = (vertices[self.corners[:, corner]] for corner in range(3))
        shares = jnp.asarray(self.shares, vertices.dtype)
        points = shares[:, :1] * a + shares[:, 1:2] * b + shares[:, 2:] * c
        normals = jnp.cross(b - a, c - a) * (jnp.asarray(self.part, vertices.dtype) / 2)[:, None]
        # The small number keeps roots and divisions, and their derivatives, finite where there is nothing.
        area = jnp.sqrt(jnp.sum(normals**2, axis=1) + _TINY**2)
        columns = jnp.concatenate([area[:, None] * points, normals, area[:, None]], axis=1)
        sums = jax.ops.segment_sum(columns, self.piece, len(self.padding), indices_are_sorted=True)
        total = jnp.maximum(sums[:, 6], _TINY)
        return Patches(sums[:, :3] / total[:, None], sums[:, 3:6], total)


def cut(mesh: Mesh, width: float) -> Pieces:
    """Cut a surface into pieces much smaller than a Gaussian of this width; the same at every call.

    Raises:
        JaxmarkError: if there are too many of them.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    sizes = np.linalg.norm(normals, axis=1) / 2
    sound = sizes > 0
    faces, normals, sizes = faces[sound], normals[sound], sizes[sound]
    _check(float(sizes.sum()) / (_PIECE_AREA * width**2), _MAX_SAMPLES)
    count = np.maximum(np.ceil(sizes / (_PIECE_AREA * width**2)), 1).astype(np.int64)
    face = np.repeat(np.arange(len(faces)), count)
    number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    # Multiples of the plastic number's powers cover a triangle evenly (Roberts, "The unreasonable effectiveness of
    # quasirandom sequences", 2018).
    u, v = (number * 0.7548776662466927 + 0.5) % 1, (number * 0.5698402909980532 + 0.5) % 1
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    single = count[face] == 1
    u[single] = v[single] = 1 / 3
    shares = np.stack([1 - u - v, u, v], axis=1)
    points = np.einsum("sk,skc->sc", shares, vertices[faces[face]])
    # Pieces do not mix sheets: the faces of each look the same way in all coordinates.
    cube = np.floor(points / (_PIECE_SIDE * width)).astype(np.int64)
    keys = np.concatenate([cube, normals[face] > 0], axis=1)
    _, piece = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(piece.ravel(), kind="stable")
    padding = np.zeros(int(piece.max(initial=0)) + 1, bool)
    return Pieces(faces[face][order], shares[order], 1 / count[face][order], piece.ravel()[order], padding)


@jax.jit
def patches(pieces: Pieces, vertices: Float[Array, "vertices 3"]) -> Patches:
    """See `Pieces.of`."""
    return pieces.of(vertices)


class Anchors(NamedTuple):
    """The lattice points near a surface, and the pieces around each, in groups of one size."""

    cells: Int64[np.ndarray, "anchors 3"]  # the lattice point's indices
    places: Float64[np.ndarray, "anchors 3"]  # its position
    around: Int[np.ndarray, "groups group"]  # numbers of pieces around one anchor; -1 for none
    anchor: Int[np.ndarray, " groups"]  # number of this anchor, ascending; for padding, past the last


def make_anchors(surface: Patches, width: float) -> Anchors:
    """Find the lattice points near a surface, and the pieces around each.

    Args:
        surface: its pieces.
        width: of the narrow Gaussian.

    Raises:
        JaxmarkError: if there are too many of them.
    """
    spacing = SPACING * width
    points = np.asarray(surface.points, np.float64)
    there = np.flatnonzero(np.asarray(surface.area) > _TINY)
    cells = np.unique(np.round(points[there] / spacing).astype(np.int64), axis=0)
    _check(len(cells), _MAX_ANCHORS)
    tree = KDTree(points[there])
    near, _ = tree.query(cells * spacing, distance_upper_bound=0.75 * spacing)
    cells = cells[np.isfinite(np.asarray(near))]
    found = np.asarray(tree.query_ball_point(cells * spacing, _CUT * _WIDER * width, workers=-1, return_length=True))
    _check(int(found.sum()), _MAX_AROUND)
    lists = tree.query_ball_point(cells * spacing, _CUT * _WIDER * width, workers=-1)
    groups = -(-found // _GROUP)
    anchor = np.repeat(np.arange(len(cells)), groups)
    first = _GROUP * (np.cumsum(groups) - groups) - (np.cumsum(found) - found)
    around = np.full(_GROUP * len(anchor), -1, np.int32)
    around[np.arange(found.sum()) + np.repeat(first, found)] = there[np.concatenate([*lists, []]).astype(np.int64)]
    return Anchors(cells, cells * spacing, around.reshape(-1, _GROUP), anchor)


def _check(size: float, most: int) -> None:
    """Refuse shapes that are too large in their own pose to be looked at."""
    if not size <= most:
        raise JaxmarkError(
            "This shape's surface is too large beside the volume that it encloses for marks by its own pose; mend its"
            " faces, or use another scheme."
        )


class Seen(NamedTuple):
    """A surface as anchors of one width see it."""

    pieces: Pieces
    surface: Patches
    anchors: Anchors


def see(mesh: Mesh, widths: Sequence[float], dtype: np.dtype) -> dict[float, Seen]:
    """Cut a surface, and find the anchors near to it, for each width.

    All are padded to the same common shapes, so that one compiled program serves them.

    Raises:
        JaxmarkError: if the surface is too large.
    """
    vertices = jnp.asarray(mesh.vertices, dtype)
    pieces = [Pieces(*one) for one in _alike([cut(mesh, width) for width in widths], (0, 0, 0, _NO_PIECE, False))]
    surfaces = [patches(one, vertices) for one in pieces]
    anchors = [Anchors(*one) for one in _alike(list(map(make_anchors, surfaces, widths)), (0, 0, -1, _NO_ANCHOR))]
    return dict(zip(widths, map(Seen, pieces, surfaces, anchors), strict=True))


def _alike(several: Sequence[Pieces | Anchors], padding: tuple[float, ...]) -> list[tuple[np.ndarray, ...]]:
    """Pad the arrays of one name to the largest, and that to a common size."""
    named = []
    for arrays, value in zip(zip(*several, strict=True), padding, strict=True):
        rows, *columns = np.max([one.shape for one in arrays], axis=0)
        shape = (common_size(int(rows)), *columns)
        widths = [[(0, most - own) for most, own in zip(shape, one.shape, strict=True)] for one in arrays]
        named.append([np.pad(one, wide, constant_values=value) for one, wide in zip(arrays, widths, strict=True)])
    return list(zip(*named, strict=True))


class Shown(NamedTuple):
    """What a surface shows at anchors."""

    values: Float[Array, " anchors"]  # difference of the averages along the normal
    good: Bool[Array, " anchors"]  # whether the lattice point is near a surface of one sheet


@jax.jit
def look(
    surface: Patches,
    anchors: Anchors,
    shift: Float[Array, "anchors 3"],
    width: Float[Array, ""],
    undone: Float[Array, ""],
) -> Shown:
    """Take the averages around each anchor, moved by `shift`.

    Args:
        surface: its pieces.
        anchors: from `make_anchors`.
        shift: how far each anchor is moved.
        width: of the narrow Gaussian.
        undone: blur that the surface had already, as a share of the narrow Gaussian's variance: that much less is
            blurred.
    """
    narrow, wide = width**2 * (1 - undone), width**2 * (_WIDER**2 - undone)
    dtype, there = surface.points.dtype, anchors.around >= 0
    at = jnp.asarray(anchors.places, dtype) + shift
    offset = surface.points[anchors.around] - at[jnp.minimum(anchors.anchor, len(at) - 1)][:, None]
    square = jnp.sum(offset**2, axis=-1)
    cut_off = jnp.exp(-((_CUT * _WIDER * width) ** 2) / 2 / wide)
    share = jnp.where(there, jnp.maximum(jnp.exp(-square / 2 / wide) - cut_off, 0), 0)
    area = surface.area[anchors.around]
    inner, outer = jnp.where(there, area * jnp.exp(-square / 2 / narrow), 0), area * share

    def total(weights: Float[Array, "groups group"], of: Float[Array, "groups group 3"]) -> Float[Array, "groups 3"]:
        return jnp.einsum("gp,gpc->gc", weights, of)

    sums = (total(share, surface.normals[anchors.around]), total(inner, offset), total(outer, offset))
    columns = jnp.concatenate([*sums, inner.sum(axis=1)[:, None], outer.sum(axis=1)[:, None]], axis=1)
    found = jax.ops.segment_sum(columns, anchors.anchor, len(at), indices_are_sorted=True)
    normal, close, far, inside, outside = jnp.split(found, (3, 6, 9, 10), axis=1)
    length = jnp.sqrt(jnp.sum(normal**2, axis=1, keepdims=True) + _TINY**2)
    normal, close, far = normal / length, close / (inside + _TINY), far / (outside + _TINY)
    away = jnp.abs(jnp.sum(close * normal, axis=1))
    coherent, solid = length > _MIN_COHERENCE * outside, inside > _MIN_MASS * 2 * jnp.pi * narrow
    good = (away < _NEAREST * SPACING * width) & coherent[:, 0] & solid[:, 0]
    return Shown(jnp.sum((close - far) * normal, axis=1), good)


class Changes(NamedTuple):
    """What a surface shows, and how that changes as it is moved and scaled by a little."""

    shown: Shown
    slope: Float[Array, "anchors 3"]  # of the values, as anchors move
    growth: Float[Array, " anchors"]  # of the values, as anchors spread by a factor and the surface keeps its size


@jax.jit
def changes(surface: Patches, anchors: Anchors, width: Float[Array, ""], undone: Float[Array, ""]) -> Changes:
    """Look at a surface, and see how that changes as it is moved and scaled by a little.

    Anchors that spread by a factor are the same as a surface that shrinks: averages widen, too, and the values are in
    the larger unit.
    """
    nowhere = jnp.zeros(anchors.places.shape, surface.points.dtype)

    def total(shift: Float[Array, "anchors 3"]) -> tuple[Float[Array, ""], Shown]:
        shown = look(surface, anchors, shift, width, undone)
        return shown.values.sum(), shown

    slope, shown = jax.grad(total, has_aux=True)(nowhere)
    _, widened = jax.jvp(lambda size: look(surface, anchors, nowhere, size, undone).values, (width,), (width,))
    spread = jnp.sum(slope * jnp.asarray(anchors.places, slope.dtype), axis=1)
    return Changes(shown, slope, spread + widened - shown.values)
