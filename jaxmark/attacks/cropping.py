"""Cropping: vertices are lost, and the faces that use them; what is left stays exactly where it was. On the host."""

import numpy as np
from jaxtyping import Bool, Float64, Int64, PRNGKeyArray
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.attacks.random import generator
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, compacted, edges, used_vertices

_HOLES = 10


def cropping(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
    """Cut off what lies on one side of a plane in a random direction.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices that the plane cuts off, in [0, 1).
        key: a JAX random key, of the direction.

    Returns:
        The faces that have all of their vertices, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _lost(mesh, strength)
    along = np.asarray(mesh.vertices)[used] @ generator(key).normal(size=3)
    return _without(mesh, used[np.argsort(-along, kind="stable")[:count]])


def region_cropping(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
    """Cut a region out: the vertices nearest to a random one along edges.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices in the region, in [0, 1). It goes beyond a connected part only when that is used
            up, to what is nearest in space.
        key: a JAX random key, of the vertex.

    Returns:
        The faces that have all of their vertices, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _lost(mesh, strength)
    return _without(mesh, _nearest(mesh, used, int(generator(key).choice(used)), count))


def holes(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
    """Cut ten regions out, each as `region_cropping` does, of equally many vertices as near as can be.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices in all regions together, in [0, 1).
        key: a JAX random key, of the vertices that regions grow from; each is one that is still there.

    Returns:
        The faces that have all of their vertices, and the vertices that they use.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no face would be left.
    """
    used, count = _lost(mesh, strength)
    random, gone = generator(key), np.zeros(len(mesh.vertices), bool)
    for size in np.diff(np.arange(_HOLES + 1) * count // _HOLES).tolist():
        there = used[~gone[used]]
        gone[_nearest(mesh, there, int(random.choice(there)), size)] = True
    return _without(mesh, np.flatnonzero(gone))


def _lost(mesh: Mesh, share: float) -> tuple[Int64[np.ndarray, " used"], int]:
    """The vertices that count, and how many of them go."""
    if not 0 <= share < 1:
        raise JaxmarkError(f"A share of vertices to cut out is at least 0 and below 1, got {share:g}.")
    used = np.flatnonzero(used_vertices(mesh))
    return used, round(share * len(used))


def _nearest(mesh: Mesh, among: Int64[np.ndarray, " among"], centre: int, count: int) -> Int64[np.ndarray, " nearest"]:
    """The vertices nearest to one along edges (Dijkstra, 1959); then, those that no path leads to, in space."""
    vertices, size = np.asarray(mesh.vertices), len(mesh.vertices)
    i, j = edges(mesh.faces).T
    graph = sparse.csr_array((np.linalg.norm(vertices[i] - vertices[j], axis=1), (i, j)), (size, size))
    along: Float64[np.ndarray, " vertices"] = csgraph.dijkstra(graph, directed=False, indices=centre)
    straight = np.linalg.norm(vertices - vertices[centre], axis=1)
    return among[np.lexsort([straight[among], along[among]])[:count]]


def _without(mesh: Mesh, lost: Int64[np.ndarray, " lost"]) -> Mesh:
    kept: Bool[np.ndarray, " vertices"] = np.ones(len(mesh.vertices), bool)
    kept[lost] = False
    faces = np.asarray(mesh.faces)
    left = faces[kept[faces].all(axis=1)]
    if len(left) == 0:
        raise JaxmarkError(f"Without {len(lost)} of the vertices no face of the mesh would be left; cut out fewer.")
    return mesh if len(left) == len(faces) else compacted(Mesh(mesh.vertices, left))
