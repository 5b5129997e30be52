"""Subdivision: each step is a linear map of the vertices, which the faces alone decide.

Faces that name a vertex twice go. An edge is a crease unless exactly two faces have it: boundaries are creases.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, sides

_MOST_STEPS = 5
Points = Float[Array, "vertices 3"]
Faces = Int64[np.ndarray, "faces 3"]
Finer = tuple[Float[Array, "new_vertices 3"], Int64[np.ndarray, "new_faces 3"]]


class _Entries(NamedTuple):
    """Entries of a sparse matrix that maps old vertices to new ones; those of one place add up."""

    new: Int64[np.ndarray, " entries"]
    old: Int64[np.ndarray, " entries"]
    weight: Float64[np.ndarray, " entries"]


class _Edges(NamedTuple):
    """The edges of faces, and how sides lie on them; sides in the order of `jaxmark.mesh.sides`."""

    ends: Int64[np.ndarray, "edges 2"]
    of_side: Int64[np.ndarray, " sides"]
    first: Int64[np.ndarray, " edges"]  # the first side on each
    last: Int64[np.ndarray, " edges"]
    crease: Bool[np.ndarray, " edges"]


def midpoint(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Split each face in four at the middles of its sides; the surface stays as it was.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole, or outside [1, 5].
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        itself, half = np.arange(size), np.full(len(found.ends), 0.5)
        entries = [_Entries(itself, itself, np.ones(size)), *_on_edges(found, size, half)]
        return _combined(vertices, size + len(half), entries), _in_four(faces, found, size)

    return _repeated(step, mesh, strength)


def loop(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Subdivide by Loop's scheme with his own weights: each face becomes four of a smoother surface.

    C. Loop, "Smooth subdivision surfaces based on triangles", 1987: a new vertex is 3/8 of each end of its edge and
    1/8 of each corner opposite; an old one with n neighbours goes 5/8 - (3/8 + cos(2π/n)/4)² of the way to their mean.
    On creases, Hoppe et al., "Piecewise smooth surface reconstruction", SIGGRAPH 1994: a new vertex is in the middle,
    an old one takes 1/8 of either neighbour along the crease, or stays where not just two of its edges are creases.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole, or outside [1, 5].
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        apex, smooth = sides(faces)[1], np.flatnonzero(~found.crease)
        entries = _moved(found, size, lambda n: 5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2, 1 / 8)
        entries += _on_edges(found, size, np.where(found.crease, 1 / 2, 3 / 8))
        eighth = np.full(len(smooth), 1 / 8)
        entries += [_Entries(size + smooth, apex[side[smooth]], eighth) for side in (found.first, found.last)]
        return _combined(vertices, size + len(found.ends), entries), _in_four(faces, found, size)

    return _repeated(step, mesh, strength)


def sqrt3(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Subdivide by √3: a new vertex in the middle of each face, joined to those of the faces beside it.

    L. Kobbelt, "√3-subdivision", SIGGRAPH 2000: old edges are flipped, and an old vertex with n neighbours goes
    (4 - 2 cos(2π/n))/9 of the way to their mean. Creases are not flipped, and their vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many steps, a whole number from 1 to 5; static.
        key: not used; attacks share one signature.

    Returns:
        The finer mesh, the old vertices first, then one for each face. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole, or outside [1, 5].
    """

    def step(vertices: Points, faces: Faces) -> Finer:
        size, found = len(vertices), _edges(faces)
        place, third = size + np.arange(len(faces)), np.full(len(faces), 1 / 3)
        entries = _moved(found, size, lambda n: (4 - 2 * np.cos(2 * np.pi / n)) / 9, 0.0)
        entries += [_Entries(place, corner, third) for corner in faces.T]
        (tail, head), centre = sides(faces)[0].T, np.tile(place, 3)
        side, other = found.first[~found.crease], found.last[~found.crease]
        pieces = [
            (tail[side], centre[other], centre[side]),
            (head[side], centre[side], centre[other]),
            (column[found.crease[found.of_side]] for column in (tail, head, centre)),
        ]
        finer = np.concatenate([np.stack(list(corners), axis=1) for corners in pieces])
        return _combined(vertices, size + len(faces), entries), finer

    return _repeated(step, mesh, strength)


def _repeated(step: Callable[[Points, Faces], Finer], mesh: Mesh, strength: float) -> Mesh:
    if not 1 <= strength <= _MOST_STEPS or strength != int(strength):
        raise JaxmarkError(f"Subdivision takes a whole number of steps from 1 to {_MOST_STEPS}, got {strength:g}.")
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


def _moved(edges: _Edges, size: int, pull: Callable[[np.ndarray], np.ndarray], along: float) -> list[_Entries]:
    """Old vertices, `pull` of the number of neighbours towards their mean; on creases, `along` of either neighbour."""
    place, neighbour = np.concatenate([edges.ends, edges.ends[:, ::-1]]).T
    crease = np.tile(edges.crease, 2)
    count, creases = np.bincount(place, minlength=size), np.bincount(place[crease], minlength=size)
    share = np.where(creases == 0, pull(np.maximum(count, 1)) / np.maximum(count, 1), 0)[place]
    share[crease & (creases[place] == 2)] = along
    itself = np.arange(size)
    rest = 1 - np.bincount(place, share, size)
    return [_Entries(itself, itself, rest), _Entries(place, neighbour, share)]


def _on_edges(edges: _Edges, size: int, weight: Float64[np.ndarray, " edges"]) -> list[_Entries]:
    """New vertices, of equal shares of both ends of each edge."""
    return [_Entries(size + np.arange(len(weight)), end, weight) for end in edges.ends.T]


def _in_four(faces: Faces, edges: _Edges, size: int) -> Int64[np.ndarray, "new_faces 3"]:
    """Each face by its corners and the new vertices on its sides."""
    (a, b, c), (ab, bc, ca) = faces.T, size + edges.of_side.reshape(3, -1)
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(corners, axis=1) for corners in quarters])


def _combined(vertices: Float[Array, "old 3"], size: int, entries: Sequence[_Entries]) -> Float[Array, "new 3"]:
    new, old, weight = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    order = np.argsort(new, kind="stable")
    parts = weight[order, None].astype(vertices.dtype) * vertices[old[order]]
    return jax.ops.segment_sum(parts, new[order], size, indices_are_sorted=True)
