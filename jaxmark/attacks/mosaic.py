"""Mosaics: the mesh in pieces, by three perpendicular planes through the middle of its bounding box; on the host."""

import numpy as np
from jaxtyping import Float64, Int64, PRNGKeyArray

from jaxmark.attacks.random import generator
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, compacted, diagonal, used_vertices

_PIECES = 8


def mosaic(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
    """Shift the pieces of the mesh apart, each in a random direction.

    Three perpendicular planes in random orientation through the middle of the bounding box make up to eight pieces. A
    face belongs to the piece that its centroid is in, and none is cut; vertices of several pieces are copied.

    Args:
        mesh: any mesh, concrete.
        strength: length of each shift, over the diagonal of the bounding box.
        key: a JAX random key.

    Returns:
        The faces in their order; the vertices piece by piece, in each in their order.

    Raises:
        JaxmarkError: if all vertices of the mesh are at one point.
    """
    random, faces = generator(key), np.asarray(mesh.faces, np.int64)
    piece = _pieces(mesh, random)
    shift = random.normal(size=(_PIECES, 3))
    shift *= strength * diagonal(mesh) / np.linalg.norm(shift, axis=1, keepdims=True)
    size = len(mesh.vertices)
    copies, place = np.unique(piece[:, None] * size + faces, return_inverse=True)
    owner, vertex = np.divmod(copies, size)
    return Mesh(np.asarray(mesh.vertices)[vertex] + shift[owner], place.reshape(-1, 3))


def missing_pieces(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
    """Lose pieces of the mesh, as `mosaic` makes them.

    Args:
        mesh: any mesh, concrete.
        strength: share of the pieces that go, in [0, 1), to the nearest piece; of those that have a face, mostly eight.
        key: a JAX random key.

    Returns:
        The faces of the other pieces and the vertices that they use, exactly where they were.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no piece would be left.
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of pieces to lose is at least 0 and below 1, got {strength:g}.")
    random = generator(key)
    piece = _pieces(mesh, random)
    there = random.permutation(np.unique(piece))
    lost = there[: round(strength * len(there))]
    if len(lost) == len(there):
        raise JaxmarkError(
            f"No piece of the mesh would be left of {len(there)}; lose a smaller share than {strength:g}."
        )
    if len(lost) == 0:
        return mesh
    return compacted(Mesh(mesh.vertices, np.asarray(mesh.faces)[~np.isin(piece, lost)]))


def _pieces(mesh: Mesh, random: np.random.Generator) -> Int64[np.ndarray, " faces"]:
    """The octant, 0 to 7, that each face's centroid is in."""
    vertices = np.asarray(mesh.vertices, np.float64)
    surface = vertices[used_vertices(mesh)]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    planes: Float64[np.ndarray, "3 3"] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    side = (vertices[np.asarray(mesh.faces)].mean(axis=1) - middle) @ planes > 0
    return side @ np.array([1, 2, 4])
