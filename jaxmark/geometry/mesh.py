"""Triangle meshes and point clouds as arrays, checked once on the host.

A `Mesh` is plain data: it goes through `jit`, `vmap` and `grad`. The functions run on the host with NumPy, in float64,
and refuse unusable input before anything is traced.
"""

# `help` then shows the names of type aliases, such as ArrayLike, and not all that they stand for.
from __future__ import annotations

import hashlib
import math
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Float64, Int, Int64
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError, require

# Diagonal to which meshes are scaled for fast-simplification. Its thresholds are absolute: in smaller meshes it
# collapses many edges in arbitrary order, in much larger ones too few.
_INPUT_DIAGONAL = 100
_ALWAYS_FINITE = 1e75  # coordinates up to this have finite areas
_FACES_AT_ONCE = 2**14


Faces = Int[Array | np.ndarray, "faces 3"]


class Mesh(NamedTuple):
    """A triangle mesh; without faces, a point cloud, all of whose points count as used.

    Build one with `make_mesh` or `load_mesh`, which validate; the type itself checks nothing, because transformed
    code rebuilds it with tracers.
    """

    vertices: Float[Array | np.ndarray, "vertices 3"]  # in the file's own units and order
    faces: Faces  # zero-based indices into `vertices`


class Weld(NamedTuple):
    """The vertices that are copies of one point (UV seams, triangle soup), and so must move together."""

    point: Int64[np.ndarray, " vertices"]  # the point of each vertex; points are numbered by first occurrence
    first: Int64[np.ndarray, " points"]  # the first vertex of each point


def make_mesh(vertices: ArrayLike, faces: ArrayLike) -> Mesh:
    """Validate arrays on the host and make a `Mesh` of NumPy arrays of them: float64 vertices, int64 faces.

    Args:
        vertices: `[N, 3]` finite numbers.
        faces: `[F, 3]` integers, zero-based, each in `[0, N)`. Degenerate faces, duplicate vertices, isolated
            vertices, boundaries and non-manifold edges are all accepted. Without any, the mesh is a point cloud.

    Raises:
        JaxmarkError: if a shape is wrong, there is no vertex, a coordinate is not finite, or an index is not an
            integer or out of range.
    """
    points = np.asarray(vertices)
    triangles = np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3:
        raise JaxmarkError(f"vertices must be an array [N, 3], got shape {points.shape}.")
    if not len(points):
        raise JaxmarkError("The mesh has no vertices; there is nothing to mark, measure or read.")
    if triangles.size == 0:
        triangles = np.zeros((0, 3), np.int64)
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise JaxmarkError(f"faces must be an array [F, 3], got shape {triangles.shape}; split polygons first.")
    if not np.issubdtype(triangles.dtype, np.integer):
        raise JaxmarkError(f"faces must be integers, got {triangles.dtype}.")
    if np.iscomplexobj(points) or not np.issubdtype(points.dtype, np.number):
        raise JaxmarkError(f"vertices must be real numbers, got {points.dtype}.")
    points = np.ascontiguousarray(points, dtype=np.float64)
    # Rows are looked at one by one only where something is wrong, which takes ten times as long.
    if not np.isfinite(points).all():
        bad = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise JaxmarkError(
            f"Vertex {bad} (zero-based) has a coordinate that is not a finite number: {points[bad].tolist()};"
            " mend or remove it."
        )
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(points)):
        bad = int(np.argmax(((triangles < 0) | (triangles >= len(points))).any(axis=1)))
        raise JaxmarkError(
            f"Face {bad} (zero-based) refers to vertices {triangles[bad].tolist()}, but the mesh has"
            f" {len(points)} vertices, numbered from 0."
        )
    return Mesh(points, np.ascontiguousarray(triangles, dtype=np.int64))


def host_mesh(mesh: Mesh) -> Mesh:
    """Convert a mesh of any arrays to validated NumPy arrays; raises as `make_mesh` does, and for traced arrays."""
    check_mesh(mesh)
    check_concrete("This", mesh.vertices, mesh.faces)
    return make_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def check_mesh(mesh: Mesh) -> None:
    """Raise `JaxmarkError` for an object without vertices and faces, such as the name of a file."""
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise JaxmarkError(f"A mesh is needed, got {type(mesh).__name__}; jaxmark.load_mesh reads one from a file.")


def check_faces(name: str, mesh: Mesh) -> None:
    """Raise `JaxmarkError` for a point cloud; `name` is the subject of the sentence, the function that needs faces."""
    if len(mesh.faces) == 0:
        raise JaxmarkError(f"{name} needs faces, and a point cloud of {len(mesh.vertices)} points has none; mesh it.")


def check_concrete(name: str, *values: Any) -> None:
    """Raise `JaxmarkError` if JAX traces one of the values, for functions of the host."""
    if any(isinstance(value, Tracer) for value in values):
        raise JaxmarkError(
            f"{name} runs on the host, where nothing can be traced: call it outside of jit, vmap and grad, or hold its"
            " result fixed."
        )


def weld(vertices: Float[Array | np.ndarray, "vertices 3"]) -> Weld:
    """Find the vertices at exactly the same finite position (-0.0 equals 0.0).

    The result maps vertices to points and back; `vertices[weld.first]` are the distinct points.
    """
    canonical = np.asarray(vertices, np.float64) + 0.0  # turns -0.0 into 0.0
    # The sort is stable: the copies of a point stand together, its first vertex first.
    order = np.lexsort(canonical.T)
    rows = canonical[order]
    fresh = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
    owner = np.empty_like(order)
    owner[order] = order[fresh][np.cumsum(fresh) - 1]
    first = owner == np.arange(len(owner))
    return Weld((np.cumsum(first) - 1)[owner], np.flatnonzero(first))


def weld_mesh(mesh: Mesh, welded: Weld) -> Mesh:
    """Weld a mesh: return its distinct points, and its faces as indices of points instead of vertices."""
    return Mesh(np.asarray(mesh.vertices)[welded.first], welded.point[np.asarray(mesh.faces)])


def edges(faces: Faces) -> Int64[np.ndarray, "edges 2"]:
    """Return the undirected edges of the faces, sorted, as `[E, 2]` with the smaller index first.

    An edge counts once, whether one face has it, two, or more. A side of a degenerate face that joins a vertex to
    itself is no edge.
    """
    return _count_sides(faces)[0]


def sides(faces: Faces) -> tuple[Int64[np.ndarray, "sides 2"], Int64[np.ndarray, " sides"]]:
    """Return the directed sides of the faces, and the corner opposite to each.

    The first sides of all faces come first, then all second sides, then all third.
    """
    faces = np.asarray(faces, np.int64)
    turned = [faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]]
    return np.concatenate([face[:, :2] for face in turned]), np.concatenate([face[:, 2] for face in turned])


def face_pairs(faces: Faces) -> tuple[Int64[np.ndarray, "pairs 2"], Bool[np.ndarray, " pairs"]]:
    """Return the pairs of faces that share an edge with no other face, and whether they run along it alike."""
    faces = np.asarray(faces, np.int64)
    count, start, code = len(faces), faces.T.ravel(), _side_codes(faces)[0].T.ravel()
    order = np.argsort(code, kind="stable")
    code = code[order]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    first = starts[np.diff(starts, append=len(code)) == 2]
    one, other = order[first], order[first + 1]
    against = start[one] == start[other]
    one, other = one % count, other % count  # the faces of these sides
    # Sides of lower number come first, but not all of them belong to faces of lower number.
    pair = np.minimum(one, other) * count + np.maximum(one, other)
    ranked = np.argsort(pair, kind="stable")
    pair, against = pair[ranked], against[ranked]
    low, high = np.divmod(pair, count)
    kept = (np.diff(pair, prepend=-1) != 0) & (low != high)
    return np.stack([low[kept], high[kept]], axis=1), against[kept]


def diagonal(mesh: Mesh) -> float:
    """Compute the length of the bounding-box diagonal, in the mesh's units; all distortions are relative to it.

    The box is axis-aligned, and contains the vertices that faces use.

    Raises:
        JaxmarkError: if it is zero, because all these vertices coincide, or not finite.
    """
    used = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
    length = math.hypot(*map(np.ptp, used.T))  # by columns, which is ten times as fast as by axis
    if not 0.0 < length < np.inf:
        raise JaxmarkError(
            f"The bounding box of the mesh has a diagonal of {length:g}; it must be positive and finite."
        )
    return length


def vertex_normals(mesh: Mesh) -> Float64[np.ndarray, "vertices 3"]:
    """Compute unit normals of vertices, as area-weighted means of the face normals; zero if these cancel."""
    corner, normals, size = np.ravel(mesh.faces), _area_vectors(mesh), len(mesh.vertices)
    return unit(np.stack([np.bincount(corner, np.repeat(column, 3), size) for column in normals.T], axis=1))


def face_normals(mesh: Mesh) -> Float64[np.ndarray, "faces 3"]:
    """Compute unit normals of faces; zero for faces of area 0."""
    return unit(_area_vectors(mesh))


def boundary_vertices(faces: Faces) -> Int64[np.ndarray, " boundary"]:
    """Return the indices of the vertices on edges that only one face has, ascending."""
    pairs, count = _count_sides(faces)
    return np.unique(pairs[count == 1])


def open_sides(faces: Faces) -> Bool[np.ndarray, "faces 3"]:
    """Return a mask of the sides of faces without a second face; side k goes from corner k to corner k + 1."""
    codes, proper, _ = _side_codes(faces)
    _, which, count = np.unique(codes, return_inverse=True, return_counts=True)
    return (count == 1)[which.reshape(codes.shape)] & proper


def face_areas(mesh: Mesh) -> Float64[np.ndarray, " faces"]:
    """Compute the area of each face."""
    return np.linalg.norm(_area_vectors(mesh), axis=1) / 2


def area(mesh: Mesh) -> float:
    """Compute the total surface area, in squared units of the mesh."""
    return float(face_areas(mesh).sum())


def has_area(mesh: Mesh) -> bool:
    """Whether the total area is positive and finite; faces are measured block by block until one has an area."""
    if np.abs(np.asarray(mesh.vertices)).max(initial=0) > _ALWAYS_FINITE:
        return 0 < area(mesh) < np.inf
    starts = range(0, len(mesh.faces), _FACES_AT_ONCE)
    return any(area(mesh._replace(faces=mesh.faces[start : start + _FACES_AT_ONCE])) > 0 for start in starts)


def component_of(mesh: Mesh) -> Int64[np.ndarray, " vertices"]:
    """Label each vertex with the number of its connected component."""
    pairs, size = edges(mesh.faces), len(mesh.vertices)
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (size, size))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def components(mesh: Mesh, most: int) -> list[Mesh]:
    """Split a mesh into its connected components, the one of most faces first; each keeps all vertices.

    Args:
        mesh: any mesh.
        most: number of components from which on the others are left out.
    """
    faces = np.asarray(mesh.faces)
    label = component_of(mesh)[faces[:, 0]]
    count = np.bincount(label)
    largest = np.argsort(-count, kind="stable")[:most]
    return [mesh._replace(faces=faces[label == number]) for number in largest if count[number]]


def used_vertices(mesh: Mesh) -> Bool[np.ndarray, " vertices"]:
    """Return a mask of the vertices that faces use, which form the surface; a cloud uses all its points."""
    if len(mesh.faces) == 0:
        return np.ones(len(mesh.vertices), bool)
    used = np.zeros(len(mesh.vertices), bool)
    used[np.asarray(mesh.faces)] = True
    return used


def compact(mesh: Mesh) -> Mesh:
    """Remove the vertices that no face uses; the others keep their order, and a cloud keeps all of its points."""
    used = used_vertices(mesh)
    return Mesh(np.asarray(mesh.vertices)[used], (np.cumsum(used) - 1)[np.asarray(mesh.faces)])


def simplify(mesh: Mesh, faces: int) -> Mesh:
    """Collapse edges, those of least quadric error first, until about a number of faces is left.

    The program is fast-simplification, which uses the quadrics of Garland and Heckbert, "Surface simplification using
    quadric error metrics", SIGGRAPH 1997.

    Args:
        mesh: any mesh, concrete.
        faces: the number of faces, positive.

    Raises:
        JaxmarkError: if no face is left, all vertices are at one point, or fast-simplification is missing.
    """
    if faces >= len(mesh.faces):
        return mesh
    simplifier = require("fast_simplification", "attacks").simplify
    vertices, indices = map(np.asarray, compact(mesh))
    centre, length = vertices.mean(axis=0), diagonal(mesh) / _INPUT_DIAGONAL
    points, indices = simplifier((vertices - centre) / length, indices, target_count=faces)
    if len(indices) == 0:
        raise JaxmarkError("fast-simplification left no face of this mesh; ask for a smaller share.")
    return Mesh(centre + length * points, indices.astype(np.int64))


def same_connectivity(first: Mesh, second: Mesh) -> bool:
    """Whether two meshes have the same number of vertices and the same faces, index by index."""
    return len(first.vertices) == len(second.vertices) and np.array_equal(first.faces, second.faces)


def digest(mesh: Mesh) -> bytes:
    """Hash the arrays of a mesh, so that meshes of equal vertices and faces, in the same order, have equal hashes."""
    check_mesh(mesh)
    check_concrete("This", mesh.vertices, mesh.faces)
    hashed = hashlib.sha256()
    for array in map(np.asarray, mesh):
        hashed.update(f"{array.dtype} {array.shape} ".encode())
        hashed.update(array.tobytes())
    return hashed.digest()


def displacement(mesh: Mesh, suspect: Mesh, welded: Weld, length: float) -> Float64[np.ndarray, "points 3"]:
    """Compute the displacement of each welded point from a mesh to a suspect, divided by `length`.

    Displacements of vertices that share a point are averaged.

    Points are welded by the mesh, not by the suspect's positions, because quantisation makes other vertices coincide. A
    point that no face uses is no part of the surface: wherever it went, it counts as unmoved.

    Args:
        mesh: the original.
        suspect: a mesh of the same connectivity.
        welded: from `weld`, of the original's vertices.
        length: the unit of the result, such as the original's `diagonal`.

    Raises:
        JaxmarkError: if the suspect does not share the mesh's connectivity, index by index.
    """
    suspect = host_mesh(suspect)
    if not same_connectivity(suspect, mesh):
        raise JaxmarkError(
            f"The suspect ({len(suspect.vertices)} vertices, {len(suspect.faces)} triangles) does not share the"
            f" connectivity of the original ({len(mesh.vertices)} vertices, {len(mesh.faces)} triangles), in the same"
            " vertex and face order, as this comparison needs it."
        )
    difference = (np.asarray(suspect.vertices) - np.asarray(mesh.vertices)) / length
    used = used_vertices(mesh)
    difference[~used] = 0
    count = len(welded.first)
    copies = np.bincount(welded.point[used], minlength=count)
    sums = [np.bincount(welded.point, column, count) for column in difference.T]
    return np.stack(sums, axis=1) / np.maximum(copies, 1)[:, None]


def _area_vectors(mesh: Mesh) -> Float64[np.ndarray, "faces 3"]:
    """Compute the normals of faces, as long as twice the face's area."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return cross_product(b - a, c - a)


def cross_product(x: Float64[np.ndarray, "rows 3"], y: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "rows 3"]:
    """Compute the cross product row by row, four times as fast as NumPy's, which supports any axes."""
    return np.stack([x[:, i] * y[:, j] - x[:, j] * y[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)


def unit(x: Float64[np.ndarray, "*rows 3"]) -> Float64[np.ndarray, "*rows 3"]:
    """Normalise vectors to length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", x, x))[..., None]
    return np.divide(x, length, out=np.zeros_like(x), where=length > 0)


def _count_sides(faces: Faces) -> tuple[Int64[np.ndarray, "edges 2"], Int64[np.ndarray, " edges"]]:
    """Return the undirected edges, sorted, and the number of sides of faces on each edge."""
    codes, proper, bits = _side_codes(faces)
    codes, count = np.unique(codes[proper], return_counts=True)
    return np.stack([codes >> bits, codes & ((1 << bits) - 1)], axis=1), count


def _side_codes(faces: Faces) -> tuple[Int64[np.ndarray, "faces 3"], Bool[np.ndarray, "faces 3"], int]:
    """Return a code for each undirected side, whether its ends differ, and the bits of the larger end in the code.

    One integer per pair sorts many times faster than rows do.
    """
    faces = np.asarray(faces, np.int64)
    ends, bits = np.roll(faces, -1, axis=1), int(faces.max(initial=0)).bit_length()
    return np.minimum(faces, ends) << bits | np.maximum(faces, ends), faces != ends, bits
