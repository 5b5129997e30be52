"""Subdivision: each step is a linear map of the vertices that depends on the faces alone.

Faces that name a vertex twice are dropped. An edge is a crease unless exactly two faces share it: boundaries are
creases. The result has the old vertices first, and is differentiable with respect to vertices. Strengths are numbers of
steps: whole, from 1 to 5, and static.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.attacks.support import whole_number
from jaxmark.geometry.mesh import Mesh, sides
from jaxmark.seeds import Seed

Faces = Int64[np.ndarray, "faces 3"]
# Entries of a sparse matrix that maps old vertices to new ones: row, column and weight; entries at one place add up.
Entries = tuple[Int64[np.ndarray, " _"], Int64[np.ndarray, " _"], Float64[np.ndarray, " _"]]


class _Edges(NamedTuple):
    """The edges of a mesh, and which sides of faces lie on them, in the order of `jaxmark.geometry.mesh.sides`."""

    ends: Int64[np.ndarray, "edges 2"]
    of_side: Int64[np.ndarray, " sides"]  # the edge that each side lies on
    first: Int64[np.ndarray, " edges"]  # the first side on each edge
    last: Int64[np.ndarray, " edges"]  # the last side on each edge
    crease: Bool[np.ndarray, " edges"]  # not shared by exactly two faces


# Function of the faces, their edges and the number of vertices, to the entries of the map and the new faces.
Step = Callable[[Faces, _Edges, int], tuple[list[Entries], Int64[np.ndarray, "new_faces 3"]]]


def midpoint(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Split each face into four at the midpoints of its sides; the surface stays as it was."""

    def step(faces: Faces, edges: _Edges, size: int) -> tuple[list[Entries], np.ndarray]:
        itself, half = np.arange(size), np.full(len(edges.ends), 0.5)
        entries = [(itself, itself, np.ones(size)), *_on_edges(edges, size, half)]
        return entries, _split_in_four(faces, edges, size)

    return _repeat(step, mesh, strength)


def loop(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Subdivide by Loop's scheme with its original weights: each face becomes four faces of a smoother surface.

    C. Loop, "Smooth subdivision surfaces based on triangles", 1987: a new vertex is 3/8 of each end of its edge plus
    1/8 of each opposite corner; an old one with n neighbours moves 5/8 - (3/8 + cos(2π/n)/4)² of the way to their mean.
    On creases, Hoppe et al., "Piecewise smooth surface reconstruction", SIGGRAPH 1994: a new vertex is the midpoint of
    its edge; an old one with two crease edges takes 1/8 of either neighbour along them; with any other number it stays.
    """

    def step(faces: Faces, edges: _Edges, size: int) -> tuple[list[Entries], np.ndarray]:
        apex, smooth = sides(faces)[1], np.flatnonzero(~edges.crease)
        entries = _move_old(edges, size, lambda n: 5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2, 1 / 8)
        entries += _on_edges(edges, size, np.where(edges.crease, 1 / 2, 3 / 8))
        eighth = np.full(len(smooth), 1 / 8)
        entries += [(size + smooth, apex[side[smooth]], eighth) for side in (edges.first, edges.last)]
        return entries, _split_in_four(faces, edges, size)

    return _repeat(step, mesh, strength)


def sqrt3(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Subdivide by √3: each face gets a new vertex at its centroid, joined to those of the adjacent faces.

    L. Kobbelt, "√3-subdivision", SIGGRAPH 2000: old edges are flipped, and an old vertex with n neighbours moves
    (4 - 2 cos(2π/n))/9 of the way to their mean. Creases are not flipped, and their vertices stay.
    """

    def step(faces: Faces, edges: _Edges, size: int) -> tuple[list[Entries], np.ndarray]:
        place, third = size + np.arange(len(faces)), np.full(len(faces), 1 / 3)
        entries = _move_old(edges, size, lambda n: (4 - 2 * np.cos(2 * np.pi / n)) / 9, 0.0)
        entries += [(place, corner, third) for corner in faces.T]
        (tail, head), centre = sides(faces)[0].T, np.tile(place, 3)
        side, other, crease = edges.first[~edges.crease], edges.last[~edges.crease], edges.crease[edges.of_side]
        pieces = [
            (tail[side], centre[other], centre[side]),
            (head[side], centre[side], centre[other]),
            (tail[crease], head[crease], centre[crease]),
        ]
        return entries, np.concatenate([np.stack(corners, axis=1) for corners in pieces])

    return _repeat(step, mesh, strength)


def _repeat(step: Step, mesh: Mesh, strength: float) -> Mesh:
    """Apply the sparse matrix of each step to the vertices."""
    count = whole_number(strength, 1, 5, "Subdivision takes a whole number of steps from 1 to 5")
    vertices, faces = jnp.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    for _ in range(count):
        entries, faces = step(faces, _edges(faces), len(vertices))
        new, old, weight = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        order = np.argsort(new, kind="stable")
        parts = weight[order, None].astype(vertices.dtype) * vertices[old[order]]
        vertices = jax.ops.segment_sum(parts, new[order], new.max() + 1, indices_are_sorted=True)
    return Mesh(vertices, faces)


def _edges(faces: Faces) -> _Edges:
    pairs, size = np.sort(sides(faces)[0], axis=1), int(faces.max(initial=0)) + 1
    code, of_side, count = np.unique(pairs[:, 0] * size + pairs[:, 1], return_inverse=True, return_counts=True)
    order, end = np.argsort(of_side, kind="stable"), np.cumsum(count)
    ends = np.stack(np.divmod(code, size), axis=1)
    return _Edges(ends, of_side, order[end - count], order[end - 1], count != 2)


def _move_old(edges: _Edges, size: int, pull: Callable[[np.ndarray], np.ndarray], along: float) -> list[Entries]:
    """Return the entries for old vertices.

    A vertex with n neighbours moves `pull(n)` of the way to their mean; one on just two crease edges takes `along` of
    either neighbour along them.
    """
    place, neighbour = np.concatenate([edges.ends, edges.ends[:, ::-1]]).T
    crease = np.tile(edges.crease, 2)
    count, creases = np.bincount(place, minlength=size), np.bincount(place[crease], minlength=size)
    share = np.where(creases == 0, pull(np.maximum(count, 1)) / np.maximum(count, 1), 0)[place]
    share[crease & (creases[place] == 2)] = along
    itself = np.arange(size)
    rest = 1 - np.bincount(place, share, size)
    return [(itself, itself, rest), (place, neighbour, share)]


def _on_edges(edges: _Edges, size: int, weight: Float64[np.ndarray, " edges"]) -> list[Entries]:
    """Return the entries for new vertices on edges, with the same weight for both ends of an edge."""
    return [(size + np.arange(len(weight)), end, weight) for end in edges.ends.T]


def _split_in_four(faces: Faces, edges: _Edges, size: int) -> Int64[np.ndarray, "new_faces 3"]:
    """Split each face into four, by its corners and the new vertices on its sides."""
    (a, b, c), (ab, bc, ca) = faces.T, size + edges.of_side.reshape(3, -1)
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(corners, axis=1) for corners in quarters])
