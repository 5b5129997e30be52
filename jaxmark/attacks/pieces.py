"""Mosaics: pieces of a mesh between three perpendicular planes through the centre of its bounding box; host side."""

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, diagonal, used_vertices
from jaxmark.seeds import Randomness, generator

_OCTANT_COUNT = 8


@on_host
def mosaic(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Shift the pieces of the mesh apart, each in a random direction.

    Three perpendicular planes of random orientation through the centre of the bounding box separate up to eight pieces.
    A face belongs to the piece that contains its centroid, and none is cut; vertices that pieces share are duplicated.

    Args:
        mesh: any mesh, concrete.
        strength: length of each shift, relative to the diagonal of the bounding box.
        key: a JAX random key or a NumPy generator.

    Returns:
        The mesh with its faces in the same order; vertices are sorted by piece, and keep their order within a piece.

    Raises:
        JaxmarkError: if all vertices of the mesh are at one point.
    """
    random, faces = generator(key), np.asarray(mesh.faces, np.int64)
    piece = _octants(mesh, random)
    shift = random.normal(size=(_OCTANT_COUNT, 3))
    shift *= strength * diagonal(mesh) / np.linalg.norm(shift, axis=1, keepdims=True)
    size = len(mesh.vertices)
    copies, place = np.unique(piece[:, None] * size + faces, return_inverse=True)
    owner, vertex = np.divmod(copies, size)
    return Mesh(np.asarray(mesh.vertices)[vertex] + shift[owner], place.reshape(-1, 3))


@on_host
def missing_pieces(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Remove pieces of the mesh, separated as by `mosaic`.

    Args:
        mesh: any mesh, concrete.
        strength: share of the pieces to remove, in [0, 1), rounded to whole pieces. Only pieces with a face count,
            mostly eight.
        key: a JAX random key or a NumPy generator.

    Returns:
        The faces of the other pieces, and the vertices that they use, exactly where they were.

    Raises:
        JaxmarkError: if the share is outside [0, 1), or no piece would be left.
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of pieces to lose is at least 0 and below 1, got {strength:g}.")
    random = generator(key)
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


def _octants(mesh: Mesh, random: np.random.Generator) -> Int64[np.ndarray, " faces"]:
    """The octant, 0 to 7, that contains each face's centroid."""
    vertices = np.asarray(mesh.vertices, np.float64)
    surface = vertices[used_vertices(mesh)]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    planes: Float64[np.ndarray, "3 3"] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    side = (vertices[np.asarray(mesh.faces)].mean(axis=1) - middle) @ planes > 0
    return side @ np.array([1, 2, 4])
