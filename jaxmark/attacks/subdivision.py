"""Subdivision: each step is a linear map of the vertices that depends on the faces alone.

Faces that name a vertex twice are dropped. An edge is a crease unless exactly two faces share it: boundaries are
creases.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, sides

_MAX_STEPS = 5
Points = Float[Array, "vertices 3"]
Faces = Int64[np.ndarray, "faces 3"]
Finer = tuple[Float[Array, "new_vertices 3"], Int64[np.ndarray, "new_faces 3"]]


class _Entries(NamedTuple):
    """Entries of a sparse matrix that maps old vertices to new ones; entries at one place add up."""

    new: Int64[np.ndarray, " entries"]  # row
    old: Int64[np.ndarray, " entries"]  # column
    weight: Float64[np.ndarray, " entries"]


class _Edges(NamedTuple):
    """The edges of a mesh, and which sides of faces lie on them, in the order of `jaxmark.geometry.mesh.sides`."""

    ends: Int64[np.ndarray, "edges 2"]
    of_side: Int64[np.ndarray, " sides"]  # the edge that each side lies on
    first: Int64[np.ndarray, " edges"]  # the first side on each edge
    last: Int64[np.ndarray, " edges"]  # the last side on each edge
    crease: Bool[np.ndarray, " edges"]  # not shared by exactly two faces


def midpoint(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Split each face into four at the midpoints of its sides; the surface stays as it was.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not a whole number from 1 to 5.
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        itself, half = np.arange(size), np.full(len(found.ends), 0.5)
        entries = [_Entries(itself, itself, np.ones(size)), *_on_edges(found, size, half)]
        return _combine(vertices, size + len(half), entries), _split_in_four(faces, found, size)

    return _repeat(step, mesh, strength)


def loop(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Subdivide by Loop's scheme with its original weights: each face becomes four faces of a smoother surface.

    C. Loop, "Smooth subdivision surfaces based on triangles", 1987: a new vertex is 3/8 of each end of its edge plus
    1/8 of each opposite corner; an old one with n neighbours moves 5/8 - (3/8 + cos(2π/n)/4)² of the way to their mean.
    On creases, Hoppe et al., "Piecewise smooth surface reconstruction", SIGGRAPH 1994: a new vertex is the midpoint of
    its edge; an old one with two crease edges takes 1/8 of either neighbour along them; with any other number it stays.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not a whole number from 1 to 5.
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        apex, smooth = sides(faces)[1], np.flatnonzero(~found.crease)
        entries = _move_old(found, size, lambda n: 5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2, 1 / 8)
        entries += _on_edges(found, size, np.where(found.crease, 1 / 2, 3 / 8))
        eighth = np.full(len(smooth), 1 / 8)
        entries += [_Entries(size + smooth, apex[side[smooth]], eighth) for side in (found.first, found.last)]
        return _combine(vertices, size + len(found.ends), entries), _split_in_four(faces, found, size)

    return _repeat(step, mesh, strength)


def sqrt3(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Subdivide by √3: each face gets a new vertex at its centroid, joined to those of the adjacent faces.

    L. Kobbelt, "√3-subdivision", SIGGRAPH 2000: old edges are flipped, and an old vertex with n neighbours moves
    (4 - 2 cos(2π/n))/9 of the way to their mean. Creases are not flipped, and their vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first, then one for each face. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not a whole number from 1 to 5.
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        place, third = size + np.arange(len(faces)), np.full(len(faces), 1 / 3)
        entries = _move_old(found, size, lambda n: (4 - 2 * np.cos(2 * np.pi / n)) / 9, 0.0)
        entries += [_Entries(place, corner, third) for corner in faces.T]
        (tail, head), centre = sides(faces)[0].T, np.tile(place, 3)
        side, other = found.first[~found.crease], found.last[~found.crease]
        pieces = [
            (tail[side], centre[other], centre[side]),
            (head[side], centre[side], centre[other]),
            (column[found.crease[found.of_side]] for column in (tail, head, centre)),
        ]
        finer = np.concatenate([np.stack(list(corners), axis=1) for corners in pieces])
        return _combine(vertices, size + len(faces), entries), finer

    return _repeat(step, mesh, strength)


def _repeat(step: Callable[[Points, Faces], Finer], mesh: Mesh, strength: float) -> Mesh:
    if not 1 <= strength <= _MAX_STEPS or strength != int(strength):
        raise JaxmarkError(f"Subdivision takes a whole number of steps from 1 to {_MAX_STEPS}, got {strength:g}.")
    vertices, faces = jnp.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    for _ in range(int(strength)):
        vertices, faces = step(vertices, faces)
    return Mesh(vertices, faces)


def _edges(faces: Faces) -> _Edges:
    pairs, size = np.sort(sides(faces)[0], axis=1), int(faces.max(initial=0)) + 1
    code, of_side, count = np.unique(pairs[:, 0] * size + pairs[:, 1], return_inverse=True, return_counts=True)
    order, end = np.argsort(of_side, kind="stable"), np.cumsum(count)
    ends = np.stack(np.divmod(code, size), axis=1)
    return _Edges(ends, of_side, order[end - count], order[end - 1], count != 2)


def _move_old(edges: _Edges, size: int, pull: Callable[[np.ndarray], np.ndarray], along: float) -> list[_Entries]:
    """Entries for old vertices.

    Args:
        edges: the edges of the mesh.
        size: number of old vertices.
        pull: from the number of a vertex's neighbours to the share of the way that it moves to their mean.
        along: share of either neighbour along the crease, for a vertex on just two crease edges.
    """
    place, neighbour = np.concatenate([edges.ends, edges.ends[:, ::-1]]).T
    crease = np.tile(edges.crease, 2)
    count, creases = np.bincount(place, minlength=size), np.bincount(place[crease], minlength=size)
    share = np.where(creases == 0, pull(np.maximum(count, 1)) / np.maximum(count, 1), 0)[place]
    share[crease & (creases[place] == 2)] = along
    itself = np.arange(size)
    rest = 1 - np.bincount(place, share, size)
    return [_Entries(itself, itself, rest), _Entries(place, neighbour, share)]


def _on_edges(edges: _Edges, size: int, weight: Float64[np.ndarray, " edges"]) -> list[_Entries]:
    """Entries for new vertices on edges, with the same weight for both ends of an edge."""
    return [_Entries(size + np.arange(len(weight)), end, weight) for end in edges.ends.T]


def _split_in_four(faces: Faces, edges: _Edges, size: int) -> Int64[np.ndarray, "new_faces 3"]:
    """Split each face into four, by its corners and the new vertices on its sides."""
    (a, b, c), (ab, bc, ca) = faces.T, size + edges.of_side.reshape(3, -1)
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(corners, axis=1) for corners in quarters])


def _combine(vertices: Float[Array, "old 3"], size: int, entries: Sequence[_Entries]) -> Float[Array, "new 3"]:
    """Apply the sparse matrix to the old vertices; `size` is the number of new ones."""
    new, old, weight = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    order = np.argsort(new, kind="stable")
    parts = weight[order, None].astype(vertices.dtype) * vertices[old[order]]
    return jax.ops.segment_sum(parts, new[order], size, indices_are_sorted=True)
