"""From a suspect mesh to the displacement of each point of the original; host side, free of the key.

Vertices are recognised by their order, else by the connectivity around them, else the suspect's surface is brought onto
the original's. An affine attack moves the mark with the host: the map is inverted by least squares before anything
else, on the points that agree with it. What lies far off was cut away, replaced or lost, and is masked.
"""

import time
from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float64, Int64

from jaxmark.bands import diffusion
from jaxmark.chebyshev import band_components
from jaxmark.connectivity import matching_vertices
from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import make_laplacian
from jaxmark.mesh import (
    Mesh,
    boundary_vertices,
    components,
    face_normals,
    host_mesh,
    same_connectivity,
    vertex_normals,
    weld,
    welded_mesh,
)
from jaxmark.original import Original, residual
from jaxmark.pose import Pose, affine, similarity
from jaxmark.registration import Surface, refine, register

Align = Literal["auto", "same", "similarity", "affine"]

# A point is masked if it is off by more than this, and by more than so many times what 40 % of the points are off.
_FAR = 0.005
_OFF = 10.0
_TRIMS = 30
_ROUNDS = 10
_ROUNDING = 1e-12  # of sums over all points; a smaller residual is none
_SCALES = 6  # smoothing of the suspect's meshing, by 1 to 32 steps of half the way
_MOST_LEFT, _ENOUGH = 0.1, 20_000
_PARTS = 4  # largest components that are tried one by one
_SEEN = 0.05  # share of the original that must be seen


class Alignment(NamedTuple):
    """A suspect seen from an original."""

    displacement: Float64[np.ndarray, "points 3"]  # of the original's points, in diagonals
    weights: Float64[np.ndarray, " points"]  # 1, or 0 where a point is masked or no face uses it
    normals: Float64[np.ndarray, "points 3"] | None  # given, only the displacement along them is known; unit length
    nuisance: Float64[np.ndarray, "points columns"] | None  # what the suspect's meshing explains, where that is much
    method: Literal["same", "connectivity", "surface"]  # vertices by their order, by their surroundings, or none
    pose: Pose  # from the suspect's coordinates to the original's, as in their files
    residual: float  # root mean square of the displacement, where it counts
    seconds: float  # that it took


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
    mesh, welded = _points(original), welded_mesh(suspect, weld(suspect.vertices))
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
                return _by_points(original, scale(there), found, "connectivity", scale)
    return _by_surfaces(original, mesh, welded, how == "affine")


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
    return Alignment(displacement, weights, None, None, method, before.then(pose).then(_file(original)), size, 0.0)


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


def _by_surfaces(original: Original, mesh: Mesh, suspect: Mesh, by_affine: bool) -> Alignment:
    """By the whole surface, or if that will not do by a part of it: there may be other objects beside."""
    failed, parts = [], components(suspect)
    for part in (suspect, *(parts[:_PARTS] if len(parts) > 1 else ())):
        found = _by_surface(original, mesh, part, by_affine)
        coverage = np.sum(found.weights > 0) / original.used.sum()
        if found.residual <= _FAR and coverage >= _SEEN:
            return found
        failed.append((found.residual, coverage))
    size, coverage = min(failed)
    raise JaxmarkError(
        f"The suspect could not be aligned: its surface lies {100 * size:.2g} % of the diagonal from the original's"
        f" where {100 * coverage:.0f} % of the original are seen. Bring it into the original's pose and cut off what"
        " does not belong to it."
    )


def _by_surface(original: Original, mesh: Mesh, suspect: Mesh, by_affine: bool) -> Alignment:
    """Only how far the surface lies along its normal is known of each point."""
    used, x = original.used, np.asarray(mesh.vertices)
    pose, surface = register(mesh, suspect)
    if by_affine:
        pose = refine(surface, x[used], vertex_normals(mesh)[used], pose, by_affine=True)
    closest, face = surface.closest(x, pose)
    posed = suspect._replace(vertices=pose(np.asarray(suspect.vertices)))
    error = np.where(used[:, None], closest - x, 0)
    length = np.linalg.norm(error, axis=1)
    known = used & ~_on_boundary(posed, face, closest)
    weights = known & _agreeing(length, known) if known.any() else known
    size = float(np.sqrt(np.mean(length[weights] ** 2))) if weights.any() else np.inf
    displacement = np.where(weights[:, None], error, 0)
    # Closest points lie along the suspect's normals; that they are not the original's matters on coarse suspects.
    normals = face_normals(posed)[face]
    smoothed = _smoothed(mesh, posed, face, closest)
    explains = weights.any() and _explains(smoothed, x, displacement, normals, weights)
    return Alignment(
        displacement,
        weights.astype(float),
        normals,
        smoothed if explains else None,
        "surface",
        pose.then(_file(original)),
        size,
        0.0,
    )


def _smoothed(
    original: Mesh, suspect: Mesh, face: Int64[np.ndarray, " points"], closest: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points columns"]:
    """The original put through smoothing as the suspect's meshing does it, by several amounts, as seen from its points.

    A suspect that was simplified and then smoothed has shrunk by another operator than the original's.
    """
    there = Surface(original).closest(np.asarray(suspect.vertices))[0]
    family = diffusion(_SCALES, 4 * 2 ** (_SCALES // 2) + 1)
    amounts = band_components(make_laplacian(suspect), family, jnp.asarray(there, jnp.float32))
    share = _barycentric(suspect, face, closest)
    seen = np.einsum("spkc,pk->psc", np.asarray(amounts, np.float64)[:, np.asarray(suspect.faces)[face]], share)
    return seen.reshape(len(face), -1)


def _explains(
    columns: Float64[np.ndarray, "points columns"],
    x: Float64[np.ndarray, "points 3"],
    displacement: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"],
    weights: Bool[np.ndarray, " points"],
) -> bool:
    """Whether columns explain nine tenths of what an affine map does not: each takes some of the mark away, too."""
    some = np.flatnonzero(weights)
    some = some[np.random.default_rng(0).permutation(len(some))[:_ENOUGH]]
    along = np.sum(normals[some] * displacement[some], axis=1)

    def left(columns: Float64[np.ndarray, "points columns"]) -> float:
        design = (columns[some][:, :, None] * normals[some][:, None, :]).reshape(len(some), -1)
        return float(np.sum((along - design @ np.linalg.lstsq(design, along, rcond=1e-9)[0]) ** 2))

    plain = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    return left(np.concatenate([plain, columns], axis=1)) < _MOST_LEFT * left(plain)


def _on_boundary(
    mesh: Mesh, face: Int64[np.ndarray, " points"], closest: Float64[np.ndarray, "points 3"]
) -> Bool[np.ndarray, " points"]:
    """Which closest points lie on the rim of a hole: what they are closest to is beyond it."""
    rim = np.zeros(len(mesh.vertices), bool)
    rim[boundary_vertices(mesh.faces)] = True
    if not rim.any():
        return np.zeros(len(face), bool)
    inside = _barycentric(mesh, face, closest) > 1e-6
    return np.all(~inside | rim[np.asarray(mesh.faces)[face]], axis=1) & ~np.all(inside, axis=1)


def _barycentric(
    mesh: Mesh, face: Int64[np.ndarray, " points"], points: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Shares of a face's corners in points on it; zeros on a face without area."""
    with np.errstate(all="ignore"):
        share = trimesh.triangles.points_to_barycentric(np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]], points)
    return np.nan_to_num(share, nan=0.0, posinf=0.0, neginf=0.0)
