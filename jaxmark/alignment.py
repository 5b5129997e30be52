"""From a suspect mesh to the displacement of each point of the original; host side, free of the key.

Vertices are recognised by their order, else by the connectivity around them, else the suspect's surface is brought onto
the original's. An affine attack moves the mark with the host: the map is inverted by least squares before anything
else, on the points that agree with it. What lies far off was cut away, replaced or lost, and is masked.
"""

import time
from typing import Literal, NamedTuple, get_args

import numpy as np
import trimesh
from jaxtyping import Bool, Float64, Int64

from jaxmark.connectivity import matching_vertices
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import (
    Mesh,
    boundary_vertices,
    face_normals,
    host_mesh,
    same_connectivity,
    vertex_normals,
    weld,
    welded_mesh,
)
from jaxmark.original import Original, residual
from jaxmark.pose import Pose, affine, similarity
from jaxmark.registration import refine, register

Align = Literal["auto", "same", "similarity", "affine"]

# A point is masked if it is off by more than this, and by more than so many times what 40 % of the points are off.
_FAR = 0.005
_OFF = 10.0
_TRIMS = 30
_ROUNDS = 10
_ROUNDING = 1e-12  # of sums over all points; a smaller residual is none
_SEEN = 0.05  # share of the original that must be seen


class Alignment(NamedTuple):
    """A suspect seen from an original."""

    displacement: Float64[np.ndarray, "points 3"]  # of the original's points, in diagonals
    weights: Float64[np.ndarray, " points"]  # 1, or 0 where a point is masked or no face uses it
    normals: Float64[np.ndarray, "points 3"] | None  # given, only the displacement along them is known; unit length
    method: Literal["same", "connectivity", "surface"]  # vertices by their order, by their surroundings, or none
    pose: Pose  # from the suspect's coordinates to the original's, as in their files
    residual: float  # root mean square of the displacement, where it counts
    seconds: float  # that it took

    @property
    def coverage(self) -> float:
        """Share of the points that count."""
        return float(np.mean(self.weights > 0))


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
    if how == "same" or (how == "auto" and same_connectivity(suspect, original.mesh)):
        x = np.asarray(original.positions, np.float64)
        return _by_points(original, x + residual(original, suspect), original.used, "same", _file(original).inverse())
    welded = welded_mesh(suspect, weld(suspect.vertices))
    if how == "auto":
        for points in (welded, suspect):
            match = matching_vertices(_points(original), points)
            found = original.used & (match >= 0)
            if found.sum() >= max(4, _SEEN * original.used.sum()):
                there = np.asarray(points.vertices)[match]
                scale = Pose(np.eye(3) / np.ptp(there[found], axis=0).max(), np.zeros(3))
                return _by_points(original, scale(there), found, "connectivity", scale)
    return _by_surface(original, welded, how == "affine")


def _points(original: Original) -> Mesh:
    """The original's points, as they are positioned for filtering."""
    return Mesh(original.positions, original.weld.point[np.asarray(original.mesh.faces)])


def _file(original: Original) -> Pose:
    """From positions in diagonals to the original's file."""
    vertices = np.asarray(original.mesh.vertices)[original.weld.first]
    return Pose(original.diagonal * np.eye(3), vertices[original.used].mean(axis=0))


def _by_points(
    original: Original,
    y: Float64[np.ndarray, "points 3"],
    known: Bool[np.ndarray, " points"],
    method: Literal["same", "connectivity"],
    before: Pose,
) -> Alignment:
    """Each known point has been found at y, where `before` brought the suspect."""
    x = np.asarray(original.positions, np.float64)
    moved = y - x
    # A coordinate of 1e200 would spoil every sum; such a point is lost in any case.
    spread = np.abs(moved - np.median(moved[known], axis=0)).max(axis=1)
    sound = known & (spread <= 1e6 * max(np.quantile(spread[known], 0.6), 1e-6))
    x, y = x[sound], y[sound]
    fits = [_fit(x, y, agreeing) for agreeing in (np.ones(len(x), bool), _agreeing(spread[sound]))]
    pose, agreeing = min(fits, key=lambda fit: np.quantile(np.linalg.norm(fit[0](y) - x, axis=1), 0.4))
    error = pose(y) - x
    if np.abs(error[agreeing]).max() < _ROUNDING:
        error = np.zeros_like(error)
    displacement, weights = np.zeros(moved.shape), np.zeros(len(moved))
    displacement[sound] = np.where(agreeing[:, None], error, 0)
    weights[sound] = agreeing
    size = float(np.sqrt(np.mean(np.sum(error[agreeing] ** 2, axis=1))))
    return Alignment(displacement, weights, None, method, before.then(pose).then(_file(original)), size, 0.0)


def _fit(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> tuple[Pose, Bool[np.ndarray, " points"]]:
    """The affine map that brings y onto x, fitted to the points that agree with it, found anew in each round."""
    # Least trimmed squares first: what is far off must not draw the fit towards itself.
    for _ in range(_TRIMS):
        error = np.linalg.norm(_map(x, y, agreeing)(y) - x, axis=1)
        before, agreeing = agreeing, error <= np.quantile(error, 0.5)
        if np.array_equal(agreeing, before):
            break
    rounds = 0
    while True:
        pose = _map(x, y, agreeing)
        before, agreeing = agreeing, _agreeing(np.linalg.norm(pose(y) - x, axis=1))
        rounds += 1
        if rounds == _ROUNDS or np.array_equal(agreeing, before):
            return pose, agreeing


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


def _by_surface(original: Original, suspect: Mesh, by_affine: bool) -> Alignment:
    """Only how far the surface lies along its normal is known of each point."""
    mesh, used = _points(original), original.used
    pose, surface = register(mesh, suspect)
    x, normals = np.asarray(original.positions, np.float64), vertex_normals(mesh)
    if by_affine:
        pose = refine(surface, x[used], normals[used], pose, by_affine=True)
    closest, face = surface.closest(pose.inverse()(x))
    error = np.where(used[:, None], pose(closest) - x, 0)
    length = np.linalg.norm(error, axis=1)
    known = used & ~_on_boundary(suspect, face, closest)
    weights = known & _agreeing(length, known) if known.any() else known
    size = float(np.sqrt(np.mean(length[weights] ** 2))) if weights.any() else np.inf
    coverage = weights.sum() / used.sum()
    if size > _FAR or coverage < _SEEN:
        raise JaxmarkError(
            f"The suspect could not be aligned: its surface lies {100 * size:.2g} % of the diagonal from the original's"
            f" where {100 * coverage:.0f} % of the original are seen. Bring it into the original's pose and cut off"
            " what does not belong to it."
        )
    displacement = np.where(weights[:, None], error, 0)
    # Closest points lie along the suspect's normals; that they are not the original's matters on coarse suspects.
    normals = face_normals(Mesh(pose(np.asarray(suspect.vertices)), suspect.faces))[face]
    return Alignment(displacement, weights.astype(float), normals, "surface", pose.then(_file(original)), size, 0.0)


def _on_boundary(
    mesh: Mesh, face: Int64[np.ndarray, " points"], closest: Float64[np.ndarray, "points 3"]
) -> Bool[np.ndarray, " points"]:
    """Which closest points lie on the rim of a hole: what they are closest to is beyond it."""
    rim = np.zeros(len(mesh.vertices), bool)
    rim[boundary_vertices(mesh.faces)] = True
    if not rim.any():
        return np.zeros(len(face), bool)
    corners = np.asarray(mesh.faces)[face]
    share = trimesh.triangles.points_to_barycentric(np.asarray(mesh.vertices)[corners], closest)
    # A degenerate face has no such coordinates, and no inside.
    inside = np.nan_to_num(share, nan=0.0) > 1e-6
    return np.all(~inside | rim[corners], axis=1) & ~np.all(inside, axis=1)
