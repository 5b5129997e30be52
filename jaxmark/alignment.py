"""From a suspect mesh to the displacement of each point of the original; host side, free of the key.

Vertices are recognised by their order, else by the connectivity around them, else the suspect's surface is brought onto
the original's. An affine attack moves the mark with the host: the map is inverted by least squares before anything
else, on the points that agree with it. What lies far off was cut away, replaced or lost, and is masked.
"""

import time
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.connectivity import matching_vertices
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import (
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
    welded_mesh,
)
from jaxmark.observation import Observation
from jaxmark.original import Original, residual
from jaxmark.pose import Points, Pose, affine, similarity
from jaxmark.registration import refine, register_part, register_whole
from jaxmark.replay import replayed, replayed_points
from jaxmark.surfaces import Surface, on_rim

Align = Literal["auto", "same", "similarity", "affine"]

# A point is masked if it is off by more than this, and by more than so many times what 40 % of the points are off.
_FAR = 0.005
_OFF = 10.0
_TRIMS = 30
_FEW = 100  # points that a map of their own needs at least
_ROUNDS = 10
_ENOUGH = 50_000  # points, to find a map
_ROUNDING = 1e-12  # of sums over all points; a smaller residual is none
_PARTS = 4  # largest components that are tried one by one
_SEEN, _ALL = 0.05, 0.95  # shares of the original: must be seen, and so nearly all that nothing else is looked for
_PIECE = 0.01  # share of the original that a piece must show


class Alignment(NamedTuple):
    """A suspect seen from an original."""

    displacement: Float64[np.ndarray, "points 3"]  # of the original's points, in diagonals
    weights: Float64[np.ndarray, " points"]  # 1, or 0 where a point is masked or no face uses it
    normals: Float64[np.ndarray, "points 3"] | None  # given, only the displacement along them is known; unit length
    nuisance: Float[np.ndarray, "points columns"] | None  # what smoothing explains, where that is much
    method: Literal["same", "connectivity", "surface"]  # vertices by their order, by their surroundings, or none
    pose: Pose  # from the suspect's coordinates to the original's, as in their files
    residual: float  # root mean square of the displacement, where it counts
    seconds: float  # that it took


def observation(original: Original, found: Alignment) -> Observation:
    """What an aligned suspect shows of each point's displacement, in diagonals, in the original's dtype; key-free."""

    def array(value: np.ndarray | None) -> Array | None:
        return None if value is None else original.traced(value)

    return Observation(
        original.traced(found.displacement),
        original.traced(found.weights),
        array(found.normals),
        array(found.nuisance),
    )


def align(original: Original, suspect: Mesh, how: Align = "auto") -> Alignment:
    """Bring a suspect back to the original, and see how far each point is still off.

    Args:
        original: from `prepare`.
        suspect: any mesh.
        how: `"same"` demands the original's vertices and faces in the same order; `"similarity"` and `"affine"` compare
            surfaces, up to such a map; `"auto"` takes the first that will do: order, surroundings, surfaces up to a
            similarity.

    Raises:
        JaxmarkError: if the suspect does not share the original's connectivity and it must, cannot be aligned (what is
            left of the displacement is over 0.5 % of the diagonal, or less than 5 % of the original is seen), or
            libigl is missing, which surfaces need.
    """
    if how not in get_args(Align):
        raise JaxmarkError(f"A suspect is aligned by {', '.join(get_args(Align))}, not {how!r}.")
    start = time.perf_counter()
    found = _align(original, host_mesh(suspect), how)
    return found._replace(seconds=time.perf_counter() - start)


def _align(original: Original, suspect: Mesh, how: Align) -> Alignment:
    mesh = _points(original)
    if how == "same" or (how == "auto" and same_connectivity(suspect, original.mesh)):
        x = np.asarray(original.positions, np.float64)
        y, back = x + residual(original, suspect), _file(original).inverse()
        return _by_points(original, mesh, y, original.used, np.asarray(mesh.faces), "same", back)
    welded = welded_mesh(suspect, weld(suspect.vertices))
    if how == "auto":
        # Of a suspect without copies, the welded mesh is the suspect itself.
        copies = len(welded.vertices) < len(suspect.vertices)
        for points in (welded, suspect) if copies else (welded,):
            match = matching_vertices(mesh, points)
            found = original.used & (match >= 0)
            there = np.asarray(points.vertices)[match]
            size = np.ptp(there[found], axis=0).max() if found.any() else 0.0
            if found.sum() >= max(4, _SEEN * original.used.sum()) and size > 0:
                scale = Pose(np.eye(3) / size, np.zeros(3))
                # The suspect's faces, as far as they are between points that were found.
                point = np.full(len(points.vertices), -1)
                point[match[found]] = np.flatnonzero(found)
                faces = point[np.asarray(points.faces)]
                faces = faces[(faces >= 0).all(axis=1)]
                return _by_points(original, mesh, scale(there), found, faces, "connectivity", scale)
    return _by_surfaces(original, Surface(mesh), welded, how == "affine")


def _points(original: Original) -> Mesh:
    """The original's points, as they are positioned for filtering."""
    return Mesh(original.positions, original.weld.point[np.asarray(original.mesh.faces)])


def _file(original: Original) -> Pose:
    """From positions in diagonals to the original's file."""
    vertices = np.asarray(original.mesh.vertices)[original.weld.first]
    return Pose(original.diagonal * np.eye(3), vertices[original.used].mean(axis=0))


def _by_points(
    original: Original,
    mesh: Mesh,
    y: Points,
    known: Bool[np.ndarray, " points"],
    faces: Int64[np.ndarray, "faces 3"],
    method: Literal["same", "connectivity"],
    before: Pose,
) -> Alignment:
    """Each known point has been found at y, where `before` brought the suspect, joined by the suspect's faces."""
    x = np.asarray(mesh.vertices, np.float64)
    moved = y - x
    # A coordinate of 1e200 would spoil every sum; such a point is lost in any case.
    spread = np.abs(moved - np.median(moved[known], axis=0)).max(axis=1)
    sound = known & (spread <= 1e6 * max(np.quantile(spread[known], 0.6), 1e-6))
    pose, agreeing = _whole(x, y, sound, spread)
    error = np.where(agreeing[:, None], pose(y) - x, 0)
    # What does not agree may be in pieces that went elsewhere; so may be everything.
    far = _rms(error[agreeing]) > _FAR
    some = far or np.sum(sound & ~agreeing) >= _least_piece(x)
    piece = np.where(sound, component_of(Mesh(y, faces)), -1) if some else np.full(len(x), -1)
    apart = _pieces(x, y, piece) if far else []
    if 2 * sum(len(points) for points, _ in apart) > known.sum():
        agreeing, pose = np.zeros(len(x), bool), apart[0][1]
    else:
        apart = _pieces(x, y, np.where(agreeing, -1, piece))
    for points, back in apart:
        agreeing[points] = True
        error[points] = back(y[points]) - x[points]
    error = np.where(agreeing[:, None], error, 0)
    if np.abs(error).max() < _ROUNDING:
        error = np.zeros_like(error)
    pose = before.then(pose).then(_file(original))
    nuisance = replayed_points(original.operator, mesh, error, agreeing)
    return Alignment(error, agreeing.astype(float), None, nuisance, method, pose, _rms(error[agreeing]), 0.0)


def _pieces(x: Points, y: Points, piece: Int64[np.ndarray, " points"]) -> list[tuple[Int64[np.ndarray, " some"], Pose]]:
    """Which points of each piece, numbered from 0, agree on a map of their own, and the map; the largest first."""
    found = []
    size = np.bincount(piece[piece >= 0], minlength=1)
    for one in np.argsort(-size, kind="stable")[: np.sum(size >= _least_piece(x))]:
        points = np.flatnonzero(piece == one)
        back, near = _fit(x[points], y[points], np.ones(len(points), bool))
        if 2 * near.sum() >= len(points) and _rms((back(y[points]) - x[points])[near]) <= _FAR:
            found.append((points[near], back))
    return found


def _least_piece(x: Points) -> float:
    return max(_FEW, _PIECE * len(x))


def _rms(x: Points) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) if len(x) else np.inf


def _whole(
    x: Points, y: Points, sound: Bool[np.ndarray, " points"], spread: Float64[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    """The map on which most agree, and which points do."""
    pose, near = _fit(x[sound], y[sound], np.ones(sound.sum(), bool))
    # Where all agree there is no other.
    if not near.all():
        fits = (pose, near), _fit(x[sound], y[sound], _agreeing(spread[sound]))
        pose, near = min(fits, key=lambda fit: np.quantile(_distance(fit[0](y[sound]), x[sound]), 0.4))
    agreeing = np.zeros(len(x), bool)
    agreeing[sound] = near
    return pose, agreeing


def _fit(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    """The affine map that brings y onto x, fitted to the points that agree with it, found anew in each round."""
    if len(x) <= _ENOUGH:
        return _fit_to_all(x, y, agreeing)
    # A sample finds it; two rounds with all points make it exact.
    some = np.sort(np.random.default_rng(0).permutation(len(x))[:_ENOUGH])
    pose = _fit_to_all(x[some], y[some], agreeing[some])[0]
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
    # Least trimmed squares first: what is far off must not draw the fit towards itself.
    for _ in range(_TRIMS):
        error = _distance(_map(x, y, agreeing)(y), x)
        before, agreeing = agreeing, error <= np.quantile(error, 0.5)
        if np.array_equal(agreeing, before):
            break
    rounds = 0
    while True:
        pose = _map(x, y, agreeing)
        before, agreeing = agreeing, _agreeing(_distance(pose(y), x))
        rounds += 1
        if rounds == _ROUNDS or np.array_equal(agreeing, before):
            return pose, agreeing


def _distance(x: Points, y: Points) -> Float64[np.ndarray, " points"]:
    difference = x - y
    return np.sqrt(np.einsum("pc,pc->p", difference, difference))


def _map(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> Pose:
    """A similarity, and what is left to an affine map; of the points that agree."""
    nearly = similarity(y[agreeing], x[agreeing])
    return nearly.then(affine(nearly(y[agreeing]), x[agreeing]))


def _agreeing(
    error: Float64[np.ndarray, " points"], among: Bool[np.ndarray, " points"] | slice = slice(None)
) -> Bool[np.ndarray, " points"]:
    return error <= max(_FAR, _OFF * np.quantile(error[among], 0.4))


def _by_surfaces(original: Original, surface: Surface, suspect: Mesh, by_affine: bool) -> Alignment:
    """By the whole surface, or if that will not do as a part of the original, or by a part of the suspect."""
    whole, parts = Surface(suspect), [Surface(part) for part in components(suspect)[:_PARTS] if area(part) > 0]
    parts = parts if len(parts) > 1 else []
    failed = [(np.inf, 0.0)]
    for part, register in ((whole, register_whole), (whole, register_part), *((p, register_whole) for p in parts)):
        if (pose := register(surface, part)) is None:
            continue
        found = _by_surface(original, surface, part, pose, by_affine)
        if (fits := _coverage(original, found)) >= _SEEN and found.residual <= _FAR:
            return _with_pieces(original, surface, parts, found, pose) if fits < _ALL else found
        failed.append((found.residual, fits))
    size, coverage = min(failed)
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
    return float(np.sum(found.weights > 0) / original.used.sum())


def _with_pieces(original: Original, surface: Surface, parts: list[Surface], found: Alignment, pose: Pose) -> Alignment:
    """What other parts of a suspect show of the original, wherever they went, each brought back by a map of its own."""
    for part in parts:
        there = pose(np.asarray(part.mesh.vertices)[used_vertices(part.mesh)])
        if np.median(np.linalg.norm(surface.closest(there)[0] - there, axis=1)) <= _FAR:
            continue  # seen already
        if (of_its_own := register_part(surface, part)) is None:
            continue
        piece = _by_surface(original, surface, part, of_its_own, by_affine=True)
        new = (piece.weights > 0) & (found.weights == 0)
        if piece.residual <= _FAR and new.sum() >= _PIECE * original.used.sum():
            both = {
                name: np.where(new[:, None], getattr(piece, name), getattr(found, name))
                for name in ("displacement", "normals")
            }
            found = found._replace(weights=np.where(new, piece.weights, found.weights), **both)
    return found


def _by_surface(original: Original, surface: Surface, suspect: Surface, pose: Pose, by_affine: bool) -> Alignment:
    """Only how far the surface lies along its normal is known of each point."""
    x = np.asarray(surface.mesh.vertices)
    closest, face, seen = _closest(original, x, suspect, pose)
    if by_affine and seen.any():
        pose = refine(suspect, x[seen], vertex_normals(surface.mesh)[seen], pose, by_affine=True)
        closest, face, seen = _closest(original, x, suspect, pose)
    displacement = np.where(seen[:, None], closest - x, 0)
    size = _rms(displacement[seen])
    posed = suspect.mesh._replace(vertices=pose(np.asarray(suspect.mesh.vertices)))
    # Closest points lie along the suspect's normals; that they are not the original's matters on coarse suspects.
    normals = face_normals(posed)[face]
    nuisance = replayed(surface, posed, face, closest, normals, seen) if size <= _FAR else None
    file = pose.then(_file(original))
    return Alignment(displacement, seen.astype(float), normals, nuisance, "surface", file, size, 0.0)


def _closest(
    original: Original, x: Points, suspect: Surface, pose: Pose
) -> tuple[Points, Int64[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Where and on which face a suspect in a pose comes closest to each point, and whether that says anything."""
    closest, face = suspect.closest(x, pose)
    known = original.used & ~on_rim(suspect.mesh, face, pose.inverse()(closest))
    error = np.linalg.norm(closest - x, axis=1)
    return closest, face, known & _agreeing(error, known) if known.any() else known
