"""Attacks on parts of a mesh: crop it, move its pieces apart, or add objects next to it; on the host.

If vertices are removed, the result has the faces whose vertices all remain, and the vertices of these faces, at their
old positions. `JaxmarkError` is raised if no face would remain, or if a shift or size is relative to a mesh whose
vertices are all at one point.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.attacks.support import check_share, on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, diagonal, edges, used_vertices
from jaxmark.seeds import Randomness, generator

_HOLE_COUNT = 10
_OCTANT_COUNT = 8
_GAP_DIAGONALS = 0.1  # between the bounding spheres of the mesh and of each added object, in diagonals of the mesh


@on_host
def cropping(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Cut off the part of the mesh beyond a plane of random direction.

    The strength is the share of the vertices that the plane cuts off, in [0, 1).
    """
    used, count = _resolve_share(mesh, strength)
    along = np.asarray(mesh.vertices)[used] @ generator(seed).normal(size=3)
    return _remove(mesh, used[np.argsort(-along, kind="stable")[:count]])


@on_host
def region_cropping(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Cut out a region: the vertices nearest to a random one, by distance along edges.

    The strength is the share of the vertices in the region, in [0, 1). Once a connected part is used up, the region
    goes on with the vertices nearest in space.
    """
    used, count = _resolve_share(mesh, strength)
    return _remove(mesh, _nearest(mesh, used, int(generator(seed).choice(used)), count))


@on_host
def holes(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Cut out ten regions, each as `region_cropping` does; their numbers of vertices differ by at most one.

    The strength is the share of the vertices in all regions together, in [0, 1). The centre of each region is drawn
    from the vertices that are still there.
    """
    used, count = _resolve_share(mesh, strength)
    random, gone = generator(seed), np.zeros(len(mesh.vertices), bool)
    for size in np.diff(np.arange(_HOLE_COUNT + 1) * count // _HOLE_COUNT).tolist():
        there = used[~gone[used]]
        gone[_nearest(mesh, there, int(random.choice(there)), size)] = True
    return _remove(mesh, np.flatnonzero(gone))


@on_host
def mosaic(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Shift the pieces of the mesh apart, each in a random direction.

    Three perpendicular planes of random orientation through the centre of the bounding box separate up to eight pieces.
    A face belongs to the piece that contains its centroid, and none is cut; vertices that pieces share are duplicated.
    The strength is the length of each shift, relative to the diagonal of the bounding box. Faces keep their order;
    vertices are sorted by piece, and keep their order within a piece.
    """
    random, faces = generator(seed), np.asarray(mesh.faces, np.int64)
    piece = _octants(mesh, random)
    shift = random.normal(size=(_OCTANT_COUNT, 3))
    shift *= strength * diagonal(mesh) / np.linalg.norm(shift, axis=1, keepdims=True)
    copies, place = np.unique(piece[:, None] * len(mesh.vertices) + faces, return_inverse=True)
    owner, vertex = np.divmod(copies, len(mesh.vertices))
    return Mesh(np.asarray(mesh.vertices)[vertex] + shift[owner], place.reshape(-1, 3))


@on_host
def missing_pieces(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Remove pieces of the mesh, separated as by `mosaic`.

    The strength is the share of the pieces to remove, in [0, 1), rounded to whole pieces. Only pieces with a face
    count, mostly eight.
    """
    check_share(strength, "pieces to lose")
    random = generator(seed)
    piece = _octants(mesh, random)
    there = random.permutation(np.unique(piece))
    lost = there[: round(strength * len(there))]
    if len(lost) == len(there):
        raise JaxmarkError(
            f"No piece of the mesh would be left of {len(there)}; lose a smaller share than {strength:g}."
        )
    if len(lost) == 0:
        return mesh
    return compact(Mesh(mesh.vertices, np.asarray(mesh.faces)[~np.isin(piece, lost)]))


@on_host
def adding_geometry(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Add a ring on one side of the mesh and a box on the other, in a random direction and poses.

    The strength is the bounding-box diagonal of each object before it is rotated, relative to that of the mesh;
    positive. The result has the mesh, unchanged, then the ring of 1,024 vertices and the box of 386; none touch.
    """
    import trimesh  # takes long to import

    if not strength > 0:
        raise JaxmarkError(f"What is put beside a mesh needs a positive size, got {strength:g}.")
    random, size = generator(seed), diagonal(mesh)
    surface = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    step = random.normal(size=3)
    step *= size * ((1 + strength) / 2 + _GAP_DIAGONALS) / np.linalg.norm(step)
    box = trimesh.creation.box((6, 5, 4)).subdivide().subdivide().subdivide()
    vertices, faces = [np.asarray(mesh.vertices, np.float64)], [np.asarray(mesh.faces, np.int64)]
    count = len(vertices[0])
    for thing, place in ((trimesh.creation.torus(3, 1), middle + step), (box, middle - step)):
        turn = trimesh.transformations.random_rotation_matrix(random.random(3))[:3, :3]
        scale = strength * size / np.linalg.norm(np.ptp(thing.vertices, axis=0))
        vertices.append(place + scale * (thing.vertices @ turn.T))
        faces.append(count + np.asarray(thing.faces, np.int64))
        count += len(thing.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def _resolve_share(mesh: Mesh, share: float) -> tuple[Int64[np.ndarray, " used"], int]:
    """Check a share; return the vertices that faces use, and how many of them are to be lost."""
    check_share(share, "vertices to cut out")
    used = np.flatnonzero(used_vertices(mesh))
    return used, round(share * len(used))


def _nearest(mesh: Mesh, among: Int64[np.ndarray, " among"], centre: int, count: int) -> Int64[np.ndarray, " nearest"]:
    """Return the vertices nearest to a centre along edges (Dijkstra, 1959), then unreachable ones by distance."""
    vertices, size = np.asarray(mesh.vertices), len(mesh.vertices)
    i, j = edges(mesh.faces).T
    graph = sparse.csr_array((np.linalg.norm(vertices[i] - vertices[j], axis=1), (i, j)), (size, size))
    along: Float64[np.ndarray, " vertices"] = csgraph.dijkstra(graph, directed=False, indices=centre)
    straight = np.linalg.norm(vertices - vertices[centre], axis=1)
    return among[np.lexsort([straight[among], along[among]])[:count]]


def _remove(mesh: Mesh, lost: Int64[np.ndarray, " lost"]) -> Mesh:
    """Remove vertices and the faces that use them; refuse if no face is left, or of a cloud no point."""
    kept: Bool[np.ndarray, " vertices"] = np.ones(len(mesh.vertices), bool)
    kept[lost] = False
    faces = np.asarray(mesh.faces)
    left = faces[kept[faces].all(axis=1)]
    if len(faces) == 0 and kept.any():
        return Mesh(np.asarray(mesh.vertices)[kept], faces)
    if len(left) == 0:
        raise JaxmarkError(f"Without {len(lost)} of the vertices no face of the mesh would be left; cut out fewer.")
    return mesh if len(left) == len(faces) else compact(Mesh(mesh.vertices, left))


def _octants(mesh: Mesh, random: np.random.Generator) -> Int64[np.ndarray, " faces"]:
    """Return the octant, 0 to 7, that contains each face's centroid."""
    vertices = np.asarray(mesh.vertices, np.float64)
    surface = vertices[used_vertices(mesh)]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    planes: Float64[np.ndarray, "3 3"] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    side = (vertices[np.asarray(mesh.faces)].mean(axis=1) - middle) @ planes > 0
    return side @ np.array([1, 2, 4])
