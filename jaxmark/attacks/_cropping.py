"""Cropping: vertices or points are lost, with their faces, and the others stay exactly where they were; host side."""

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, edges, used_vertices
from jaxmark.seeds import Randomness, generator

_HOLE_COUNT = 10


@on_host
def cropping(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Cut off the part of the mesh beyond a plane of random direction.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices that the plane cuts off, in [0, 1).
        key: a JAX random key or a NumPy generator, which determines the direction.

    Returns:
        The faces whose vertices are all left, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _resolve_share(mesh, strength)
    along = np.asarray(mesh.vertices)[used] @ generator(key).normal(size=3)
    return _remove(mesh, used[np.argsort(-along, kind="stable")[:count]])


@on_host
def region_cropping(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Cut out a region: the vertices nearest to a random one, by distance along edges.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices in the region, in [0, 1). Once a connected part is used up, the region goes on
            with the vertices nearest in space.
        key: a JAX random key or a NumPy generator, which determines the centre of the region.

    Returns:
        The faces whose vertices are all left, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _resolve_share(mesh, strength)
    return _remove(mesh, _nearest(mesh, used, int(generator(key).choice(used)), count))


@on_host
def holes(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Cut out ten regions, each as `region_cropping` does; their numbers of vertices differ by at most one.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices in all regions together, in [0, 1).
        key: a JAX random key or a NumPy generator, which draws the centre of each region from the vertices that are
            still there.

    Returns:
        The faces whose vertices are all left, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _resolve_share(mesh, strength)
    random, gone = generator(key), np.zeros(len(mesh.vertices), bool)
    for size in np.diff(np.arange(_HOLE_COUNT + 1) * count // _HOLE_COUNT).tolist():
        there = used[~gone[used]]
        gone[_nearest(mesh, there, int(random.choice(there)), size)] = True
    return _remove(mesh, np.flatnonzero(gone))


def _resolve_share(mesh: Mesh, share: float) -> tuple[Int64[np.ndarray, " used"], int]:
    """Check a share; return the vertices that faces use, and how many of them are to be lost."""
    if not 0 <= share < 1:
        raise JaxmarkError(f"A share of vertices to cut out is at least 0 and below 1, got {share:g}.")
    used = np.flatnonzero(used_vertices(mesh))
    return used, round(share * len(used))


def _nearest(mesh: Mesh, among: Int64[np.ndarray, " among"], centre: int, count: int) -> Int64[np.ndarray, " nearest"]:
    """The vertices nearest to a centre along edges (Dijkstra, 1959), then the unreachable ones, nearest in space."""
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
