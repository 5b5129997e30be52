"""Align a suspect with the original, to find the displacement of each point; on the host, without the key.

Points of clouds are recognised by their order, else by being mutually nearest in a pose. Of meshes, vertices are
recognised by their order, else by the connectivity around them. Else the suspect's surface is brought onto the
original's. An affine attack moves the mark with the host, so that its map is inverted first, by least squares on the
points that agree with it. Points that lie far off were cut away, replaced or lost, and are masked. A suspect that
was mirrored is read as it was before: any of these maps mirrors where that fits better.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.alignment.heights import VertexHeights, measure_heights
from jaxmark.alignment.nearest import find_heights, settle
from jaxmark.alignment.nonrigid import Bent, straighten
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original, residual
from jaxmark.alignment.registration import BOTH_HANDS, SETTINGS, refine, register_part, register_whole
from jaxmark.alignment.replay import replay_smoothing, replay_smoothing_of_points
from jaxmark.errors import JaxmarkError
from jaxmark.extras import available
from jaxmark.geometry.clouds import Cloud
from jaxmark.geometry.connectivity import matching_vertices
from jaxmark.geometry.mesh import (
    Mesh,
    area,
    component_of,
    components,
    face_normals,
    host_mesh,
    same_connectivity,
    used_vertices,
    vertex_normals,
    weld,
    weld_mesh,
)
from jaxmark.geometry.pose import IDENTITY, Points, Pose, affine, similarity
from jaxmark.geometry.surfaces import Surface, on_rim

Align = Literal["auto", "same", "similarity", "affine"]
Method = Literal["same", "connectivity", "points", "surface"]

# A point is masked if it is off by more than the distance (in diagonals), and by more than the multiple of the 40 %
# quantile of all points' distances. A suspect whose residual exceeds the distance is aligned if nothing fits better.
_FAR_DISTANCE, _FAR_MULTIPLE = 0.005, 10.0
# Little more than the shape may be left of a surface. Where no pose leaves less, it is read up to this residual if so
# much of the original is seen.
_ROUGH_DISTANCE, _ROUGH_COVERAGE = 0.01, 0.5
_MAX_TRIMMING_ROUNDS = 30  # rounds of fitting a map to the better half of the points
_MAX_AGREEING_ROUNDS = 10  # rounds of fitting a map to the points that agree with it
_MAX_FIT_POINTS = 50_000  # random points by which a map is found before all points refine it
_COPIES_APART = 0.1  # distance of copies of a point, over the size of the suspect, above which its order is another
_ROUNDING = 1e-12  # error of sums over all points, in diagonals; if no coordinate is off by more, the displacement is 0
_SMALLEST = 1e-50  # size of a suspect, in its file's units, whose powers do not vanish
_MAX_COMPONENTS = 4  # largest components of a suspect that are tried one by one
_MIN_COVERAGE = 0.05  # share of the original that an alignment must show
_FULL_COVERAGE = 0.95  # share of the original from which on no further pieces are looked for
_MIN_IN_PLACE = 0.5  # share of a cloud's points that must be in order, or near their place in the file
_SAMPLES_PER_POINT = 2  # points sampled from a surface for each of an original cloud, which they are compared with
_FEW_VERTICES = 0.5  # of the original's: with so many or less, a surface is right at its vertices, and chords between
_MIN_PIECE_POINTS, _MIN_PIECE_SHARE = 100, 0.01  # a piece with a map of its own shows this much of the original


class Alignment(NamedTuple):
    """A suspect aligned with an original."""

    displacement: Float64[np.ndarray, "points 3"]  # displacement of the original's points, in diagonals
    weights: Float64[np.ndarray, " points"]  # 1; 0 where a point is masked or no face uses it
    normals: Float64[np.ndarray, "points 3"] | None  # if given, only displacements along these unit vectors are known
    nuisance: Float[np.ndarray, "points columns"] | None  # displacements by smoothing, if that explains much
    method: Method  # recognition of vertices: by order, by connectivity, as nearest points of clouds, or none
    pose: Pose  # from the suspect's coordinates to the original's, as in their files
    residual: float  # root mean square displacement of the points with weight 1, in diagonals
    seconds: float  # duration of the alignment
    how: Align = "auto"  # how it was asked for
    heights: VertexHeights | None = None  # of the vertices of a surface that has few, above the original
    bent: Bent | None = None  # recognised points that no single map brings back

    def facts(self) -> dict[str, Any]:
        """What a report says of the registration, as values for JSON."""
        return {
            "method": self.method,
            "pose": self.pose.facts(),
            "residual": self.residual,
            "seconds": self.seconds,
        }


def observation(original: Original, found: Alignment) -> Observation:
    """Convert an alignment to what detectors read: displacements in diagonals, padded, in the original's dtype."""

    def array(value: np.ndarray | None) -> Array | None:
        return None if value is None else original.to_traced(value)

    return Observation(
        original.to_traced(found.displacement),
        original.to_traced(found.weights),
        array(found.normals),
        array(found.nuisance),
    )


def straightened(original: Original, found: Alignment, bent: Bent) -> Alignment:
    """The same suspect, brought back by a map of its own around each point; see `bending.straighten`."""
    displacement, weights = straighten(original.operator, np.asarray(original.positions, np.float64), bent)
    residual = _rms(displacement[weights > 0])
    return found._replace(displacement=displacement, weights=weights, nuisance=None, residual=residual, bent=None)


def align(original: Original, suspect: Mesh, how: Align = "auto", *, hands: Sequence[bool] = BOTH_HANDS) -> Alignment:
    """Bring a suspect back to the original, and find the displacement of each point that remains.

    Args:
        original: from `make_original`.
        suspect: any mesh.
        how: `"same"` demands the original's vertices and faces in the same order; `"similarity"` and `"affine"` align
            surfaces, up to such a map; `"auto"` takes the first way that works: vertices by their order, vertices by
            connectivity, surfaces up to a similarity; for point clouds, points by their order, else the nearest ones
            where they are or up to a similarity. Each map may mirror, and faces may be turned round.
        hands: whether the pose of a surface may be one that does not mirror, one that mirrors, or either; the surface
            of a shape that is nearly its own mirror image does not tell.

    Raises:
        JaxmarkError: if the suspect does not share the original's connectivity under `"same"`, cannot be aligned (the
            residual is over 1 % of the diagonal, or over 0.5 % where less than half of the original is seen, or less
            than 5 % is seen), or libigl is missing, which surfaces need.
    """
    if how not in get_args(Align):
        raise JaxmarkError(f"A suspect is aligned by {', '.join(get_args(Align))}, not {how!r}.")
    start = time.perf_counter()
    suspect, back = _in_range(host_mesh(suspect))
    found = _align(original, suspect, how, hands)
    return found._replace(pose=back.then(found.pose), seconds=time.perf_counter() - start, how=how)


def _in_range(suspect: Mesh) -> tuple[Mesh, Pose]:
    """A suspect of a size whose powers do not overflow or vanish, and the map to it, mostly none."""
    vertices = np.asarray(suspect.vertices)
    size = float(np.quantile(np.abs(vertices - np.median(vertices, axis=0)).max(axis=1), 0.6))  # of most points
    if not 0 < size < np.inf or _SMALLEST < size < 1 / _SMALLEST:
        return suspect, IDENTITY
    # In two steps, as a factor may be out of range itself.
    exponent = -int(np.floor(np.log2(size)))
    half = np.ldexp(1.0, exponent // 2)
    scaled = np.asarray(suspect.vertices) * half * np.ldexp(1.0, exponent - exponent // 2)
    return suspect._replace(vertices=scaled), Pose(np.ldexp(1.0, min(exponent, 1000)) * np.eye(3), np.zeros(3))


def _align(original: Original, suspect: Mesh, how: Align, hands: Sequence[bool]) -> Alignment:
    mesh, suspect = _points(original), _with_faces_of(original.mesh, suspect)
    if how == "same" and not original.in_order:
        raise JaxmarkError(
            "The original's file has another order than the one that was marked, so that vertices cannot be compared in"
            " order; align by 'auto'."
        )
    if len(suspect.faces) == 0 or len(mesh.faces) == 0:
        return _align_points(original, mesh, suspect, how, hands)
    alike = how == "auto" and original.in_order and same_connectivity(suspect, original.mesh)
    alike = alike and _has_copies_together(original, suspect)
    if how == "same" or alike:
        return _in_order(original, mesh, suspect)
    welded = weld_mesh(suspect, weld(suspect.vertices))
    if how == "auto":
        # If a suspect has no copies of points, the welded mesh is the suspect itself.
        copies = len(welded.vertices) < len(suspect.vertices)
        for points in (welded, suspect) if copies else (welded,):
            match = matching_vertices(mesh, points)
            found = original.used & (match >= 0)
            y = np.asarray(points.vertices)[match]
            size = np.ptp(y[found], axis=0).max() if found.any() else 0.0
            if found.sum() >= max(4, _MIN_COVERAGE * original.used.sum()) and size > 0:
                scale = Pose(np.eye(3) / size, np.zeros(3))
                # The suspect's faces between points that were found, as indices of the original's points.
                point = np.full(len(points.vertices), -1)
                point[match[found]] = np.flatnonzero(found)
                faces = point[np.asarray(points.faces)]
                faces = faces[(faces >= 0).all(axis=1)]
                return _by_points(original, mesh, scale(y), found, faces, "connectivity", scale)
    return _by_surfaces(original, Surface(mesh), welded, how == "affine", hands)


def _in_order(original: Original, mesh: Mesh, suspect: Mesh) -> Alignment:
    """Align a suspect whose vertices are the original's, one by one."""
    x = np.asarray(original.positions, np.float64)
    y, back = x + residual(original, suspect), _file(original).inverse()
    return _by_points(original, mesh, y, original.used, np.asarray(mesh.faces), "same", back)


def _align_points(original: Original, mesh: Mesh, suspect: Mesh, how: Align, hands: Sequence[bool]) -> Alignment:
    """Align a suspect where it or the original is a point cloud: the faces of the other one tell nothing."""
    if how == "same":
        return _in_order(original, mesh, suspect)
    if how == "auto" and original.in_order and len(suspect.vertices) == len(original.mesh.vertices):
        found = _in_order(original, mesh, suspect._replace(faces=original.mesh.faces))
        if found.residual <= _FAR_DISTANCE and _coverage(original, found) >= _MIN_IN_PLACE:
            return found
    points = np.asarray(suspect.vertices, np.float64)[used_vertices(suspect)]
    if len(suspect.faces):
        sampled = Surface(suspect).sample(_SAMPLES_PER_POINT * int(original.used.sum())).points
        points = np.concatenate([points, sampled])
    target, source = Cloud(np.asarray(mesh.vertices)[original.used]), Cloud(points)
    least, fitting = np.inf, []
    for pose, placed in _poses_of_points(original, target, source, how, hands):
        found = _by_nearest(original, mesh, target, source, pose, how == "affine")
        if _coverage(original, found) < (_MIN_IN_PLACE if placed and found.method == "surface" else _MIN_COVERAGE):
            continue
        least = min(least, found.residual)
        # A flat cloud lies near itself in many poses: other ones are tried unless its own points are found, or its
        # surface is nearer than points are to each other.
        if found.residual <= (target.spacing if found.method == "surface" else _FAR_DISTANCE):
            return found
        if found.residual <= _FAR_DISTANCE:
            fitting.append(found)
    if fitting:
        return min(fitting, key=lambda one: one.residual)
    raise JaxmarkError(
        "The suspect could not be aligned: in no pose are its points near the original's"
        + (f", but {100 * least:.2g} % of the diagonal away" if least < np.inf else "")
        + ". Bring it into the original's pose and cut off what does not belong to it."
    )


def _poses_of_points(
    original: Original, target: Cloud, source: Cloud, how: Align, hands: Sequence[bool]
) -> Iterator[tuple[Pose, bool]]:
    """Poses of a cloud to try, and whether they are where its file has it: most attacks leave it there."""
    if how == "auto" and False in hands:
        yield _file(original).inverse(), True
    # Clouds of few points are further apart than surfaces, wherever both lie.
    settings = replace(SETTINGS, whole_distance=max(SETTINGS.whole_distance, 2 * target.spacing))
    dense = source.without_strays()
    for register in (register_whole, register_part):
        if (pose := register(target, dense, hands, settings=settings)) is not None:
            yield pose, False


def _by_nearest(original: Original, mesh: Mesh, target: Cloud, source: Cloud, pose: Pose, by_affine: bool) -> Alignment:
    """Align a suspect in a pose, nearly, by the points that survive in it; if there are none, by planes."""
    used, size = np.flatnonzero(original.used), len(original.used)
    settled, partners = settle(target.points, source.points, pose)
    if partners.surviving and partners.known.sum() >= max(4, _MIN_COVERAGE * len(used)):
        y, known = np.zeros((size, 3)), np.zeros(size, bool)
        y[used], known[used] = settled(source.points[partners.place]), partners.known
        return _by_points(original, mesh, y, known, np.zeros((0, 3), np.int64), "points", settled)
    pose = refine(source, *target.anchors(), pose, by_affine=by_affine)
    heights = find_heights(target, pose(source.points))
    displacement, normals, seen = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros(size, bool)
    displacement[used], normals[used] = heights.height[:, None] * heights.normals, heights.normals
    seen[used] = heights.known
    if seen.any():
        seen &= _agreeing(np.linalg.norm(displacement, axis=1), seen)
    displacement[~seen] = 0
    residual = _rms(displacement[seen])
    return Alignment(
        displacement, seen.astype(float), normals, None, "surface", pose.then(_file(original)), residual, 0.0
    )


def _with_faces_of(mesh: Mesh, suspect: Mesh) -> Mesh:
    """A suspect with a mesh's own faces, if its faces are these but for the order of corners.

    Programs that mirror a mesh turn its faces round, so that normals point outwards again.
    """
    if len(mesh.vertices) != len(suspect.vertices) or len(mesh.faces) != len(suspect.faces):
        return suspect
    mine, theirs = (np.sort(faces, axis=1) for faces in (mesh.faces, suspect.faces))
    return suspect._replace(faces=mesh.faces) if np.array_equal(mine, theirs) else suspect


def _has_copies_together(original: Original, suspect: Mesh) -> bool:
    """Whether the copies of a point are still near each other in a suspect; of shuffled triangle soup they are not.

    All triangle soups of one size have the same faces, so that their connectivity alone tells nothing of their order.
    """
    first = original.weld.first[original.weld.point]
    copies = np.flatnonzero(first != np.arange(len(first)))
    vertices = np.asarray(suspect.vertices, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # a vertex may be thrown anywhere
        apart = np.abs(vertices[copies] - vertices[first[copies]]).max(axis=1)
        size = np.abs(vertices - np.median(vertices, axis=0)).max(axis=1)
    return len(copies) == 0 or bool(np.median(apart) <= _COPIES_APART * np.median(size))


def _points(original: Original) -> Mesh:
    """The mesh of the original's points, in the positions in which they are filtered."""
    return Mesh(original.positions, original.points.faces)


def _file(original: Original) -> Pose:
    """The map from positions in diagonals to coordinates of the original's file."""
    return Pose(original.diagonal * np.eye(3), np.asarray(original.points.vertices)[original.used].mean(axis=0))


def _by_points(
    original: Original,
    mesh: Mesh,
    y: Points,
    known: Bool[np.ndarray, " points"],
    faces: Int64[np.ndarray, "faces 3"],
    method: Literal["same", "connectivity", "points"],
    before: Pose,
) -> Alignment:
    """Align a suspect by its recognised points.

    Args:
        original: the original.
        mesh: the mesh of its points.
        y: position of each known point in the suspect, after the map `before`.
        known: mask of the points that were recognised.
        faces: the suspect's faces between known points.
        method: how they were recognised.
        before: a map that has been applied to the suspect's coordinates.
    """
    x = np.asarray(mesh.vertices, np.float64)
    moved = y - x
    # A coordinate of 1e200 would spoil every sum; such a point is lost in any case.
    spread = np.abs(moved - np.median(moved[known], axis=0)).max(axis=1)
    sound = known & (spread <= 1e6 * max(np.quantile(spread[known], 0.6), 1e-6))
    pose, agreeing = _fit_whole(x, y, sound, spread)
    error = np.where(agreeing[:, None], pose(y) - x, 0)
    # Points that do not agree may belong to pieces that moved apart; if the residual is large, so may all points.
    far = _rms(error[agreeing]) > _FAR_DISTANCE
    has_pieces = far or np.sum(sound & ~agreeing) >= _min_piece_points(x)
    bent = Bent(pose(y), sound) if has_pieces else None
    label = np.where(sound, component_of(Mesh(y, faces)), -1) if has_pieces else np.full(len(x), -1)
    pieces = _fit_pieces(x, y, label) if far else []
    if 2 * sum(len(points) for points, _ in pieces) > known.sum():
        agreeing, pose = np.zeros(len(x), bool), pieces[0][1]
    else:
        pieces = _fit_pieces(x, y, np.where(agreeing, -1, label))
    for points, back in pieces:
        agreeing[points] = True
        error[points] = back(y[points]) - x[points]
    error = np.where(agreeing[:, None], error, 0)
    if np.abs(error).max() < _ROUNDING:
        error = np.zeros_like(error)
    pose = before.then(pose).then(_file(original))
    nuisance = replay_smoothing_of_points(original.operator, mesh, error, agreeing)
    size = _rms(error[agreeing])
    return Alignment(error, agreeing.astype(float), None, nuisance, method, pose, size, 0.0, bent=bent)


def _fit_pieces(
    x: Points, y: Points, label: Int64[np.ndarray, " points"]
) -> list[tuple[Int64[np.ndarray, " agreeing"], Pose]]:
    """Fit a map of its own to each piece, the largest first; returns the points that agree on it, and the map.

    Points are labelled with the number of their piece, or -1.
    """
    found = []
    size = np.bincount(label[label >= 0], minlength=1)
    for piece in np.argsort(-size, kind="stable")[: np.sum(size >= _min_piece_points(x))]:
        points = np.flatnonzero(label == piece)
        back, near = _fit(x[points], y[points], np.ones(len(points), bool))
        if 2 * near.sum() >= len(points) and _rms((back(y[points]) - x[points])[near]) <= _FAR_DISTANCE:
            found.append((points[near], back))
    return found


def _min_piece_points(x: Points) -> float:
    return max(_MIN_PIECE_POINTS, _MIN_PIECE_SHARE * len(x))


def _rms(x: Points) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) if len(x) else np.inf


def _fit_whole(
    x: Points, y: Points, sound: Bool[np.ndarray, " points"], spread: Float64[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    """Fit the map on which most points agree; returns it, and a mask of these points."""
    pose, near = _fit(x[sound], y[sound], np.ones(sound.sum(), bool))
    # If all points agree, another start finds no other map.
    if not near.all():
        fits = (pose, near), _fit(x[sound], y[sound], _agreeing(spread[sound]))
        pose, near = min(fits, key=lambda fit: np.quantile(_distance(fit[0](y[sound]), x[sound]), 0.4))
    agreeing = np.zeros(len(x), bool)
    agreeing[sound] = near
    return pose, agreeing


def _fit(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    """Fit an affine map that brings y onto x to the points that agree with it, which are found anew in each round.

    Returns:
        The map, and a mask of the points that agree with it.
    """
    if len(x) <= _MAX_FIT_POINTS:
        return _fit_to_all(x, y, agreeing)
    # A sample finds the map; two rounds with all points make it exact.
    chosen = np.sort(np.random.default_rng(0).permutation(len(x))[:_MAX_FIT_POINTS])
    pose = _fit_to_all(x[chosen], y[chosen], agreeing[chosen])[0]
    agreeing = _agreeing(_distance(pose(y), x))
    for _ in range(2):
        pose = _map(x, y, agreeing)
        before, agreeing = agreeing, _agreeing(_distance(pose(y), x))
        if np.array_equal(agreeing, before):
            break
    return pose, agreeing


def _fit_to_all(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    # Least trimmed squares come first, because points that are far off must not draw the fit towards themselves.
    for _ in range(_MAX_TRIMMING_ROUNDS):
        error = _distance(_map(x, y, agreeing)(y), x)
        before, agreeing = agreeing, error <= np.quantile(error, 0.5)
        if np.array_equal(agreeing, before):
            break
    rounds = 0
    while True:
        pose = _map(x, y, agreeing)
        before, agreeing = agreeing, _agreeing(_distance(pose(y), x))
        rounds += 1
        if rounds == _MAX_AGREEING_ROUNDS or np.array_equal(agreeing, before):
            return pose, agreeing


def _distance(x: Points, y: Points) -> Float64[np.ndarray, " points"]:
    difference = x - y
    return np.sqrt(np.einsum("pc,pc->p", difference, difference))


def _map(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> Pose:
    """Fit a similarity to the points that agree, and an affine map to what the similarity leaves."""
    nearly = similarity(y[agreeing], x[agreeing], mirrored=None)
    return nearly.then(affine(nearly(y[agreeing]), x[agreeing]))


def _agreeing(
    error: Float64[np.ndarray, " points"], among: Bool[np.ndarray, " points"] | slice = slice(None)
) -> Bool[np.ndarray, " points"]:
    return error <= max(_FAR_DISTANCE, _FAR_MULTIPLE * np.quantile(error[among], 0.4))


def _by_surfaces(
    original: Original, surface: Surface, suspect: Mesh, by_affine: bool, hands: Sequence[bool]
) -> Alignment:
    """Align a suspect's surface: as the whole of the original, else as a part of it, else one component at a time."""
    whole = Surface(suspect)
    parts = [Surface(part) for part in components(suspect)[:_MAX_COMPONENTS] if area(part) > 0]
    parts = parts if len(parts) > 1 else []
    failed: list[Alignment] = []
    for part, register in ((whole, register_whole), (whole, register_part), *((p, register_whole) for p in parts)):
        if (pose := register(surface, part, hands)) is None:
            continue
        found = _by_surface(original, surface, part, pose, by_affine)
        if (coverage := _coverage(original, found)) >= _MIN_COVERAGE and found.residual <= _FAR_DISTANCE:
            return _with_pieces(original, surface, parts, found, pose) if coverage < _FULL_COVERAGE else found
        failed.append(found)
    size, coverage = np.inf, 0.0
    if failed:
        found = min(failed, key=lambda one: one.residual)
        size, coverage = found.residual, _coverage(original, found)
        if coverage >= _ROUGH_COVERAGE and size <= _ROUGH_DISTANCE:
            return found
    raise JaxmarkError(
        "The suspect could not be aligned: "
        + (
            f"its surface lies {100 * size:.2g} % of the diagonal from the original's where {100 * coverage:.0f} % of"
            " the original are seen."
            if coverage
            else "in no pose is its surface near the original's."
        )
        + " Bring it into the original's pose and cut off what does not belong to it."
    )


def _coverage(original: Original, found: Alignment) -> float:
    """Share of the original's points that an alignment shows."""
    return float(np.sum(found.weights > 0) / original.used.sum())


def _with_pieces(original: Original, surface: Surface, parts: list[Surface], found: Alignment, pose: Pose) -> Alignment:
    """Complete an alignment by other components of the suspect that moved apart, each by a map of its own."""
    for part in parts:
        posed = pose(np.asarray(part.mesh.vertices)[used_vertices(part.mesh)])
        if np.median(np.linalg.norm(surface.closest(posed)[0] - posed, axis=1)) <= _FAR_DISTANCE:
            continue  # this component is aligned by the common pose already
        if (own_pose := register_part(surface, part)) is None:
            continue
        piece = _by_surface(original, surface, part, own_pose, by_affine=True)
        new = (piece.weights > 0) & (found.weights == 0)
        if piece.residual <= _FAR_DISTANCE and new.sum() >= _MIN_PIECE_SHARE * original.used.sum():
            both = {
                name: np.where(new[:, None], getattr(piece, name), getattr(found, name))
                for name in ("displacement", "normals")
            }
            found = found._replace(weights=np.where(new, piece.weights, found.weights), **both)
    return found


def _by_surface(original: Original, surface: Surface, suspect: Surface, pose: Pose, by_affine: bool) -> Alignment:
    """Align a suspect's surface in a pose; of each point, only the displacement along the surface's normal is known."""
    x = np.asarray(surface.mesh.vertices)
    closest, face, seen = _closest(original, x, suspect, pose)
    if by_affine and seen.any():
        pose = refine(suspect, x[seen], vertex_normals(surface.mesh)[seen], pose, by_affine=True)
        closest, face, seen = _closest(original, x, suspect, pose)
    displacement = np.where(seen[:, None], closest - x, 0)
    size = _rms(displacement[seen])
    posed = suspect.mesh._replace(vertices=pose(np.asarray(suspect.mesh.vertices)))
    # Closest points lie along the suspect's normals, which on coarse suspects differ from the original's.
    normals = face_normals(posed)[face]
    nuisance = replay_smoothing(surface, posed, face, closest, normals, seen) if size <= _ROUGH_DISTANCE else None
    file = pose.then(_file(original))
    heights = None
    few = len(posed.vertices) <= _FEW_VERTICES * original.used.sum()
    if few and size <= _ROUGH_DISTANCE and available("fast_simplification"):  # which tells what errors heights have
        heights = measure_heights(surface, posed, round(len(posed.faces) * area(surface.mesh) / area(posed)))
    return Alignment(displacement, seen.astype(float), normals, nuisance, "surface", file, size, 0.0, heights=heights)


def _closest(
    original: Original, x: Points, suspect: Surface, pose: Pose
) -> tuple[Points, Int64[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Find the point and the face where a posed suspect comes closest to each point, and a mask of points it shows."""
    closest, face = suspect.closest(x, pose)
    known = original.used & ~on_rim(suspect.mesh, face, pose.inverse()(closest))
    error = np.linalg.norm(closest - x, axis=1)
    return closest, face, known & _agreeing(error, known) if known.any() else known
