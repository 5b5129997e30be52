"""How far a suspect's own vertices are above the original.

A simplified surface is right at its vertices, and a chord between them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy import sparse

from jaxmark.geometry.mesh import Mesh, unit, used_vertices, vertex_normals
from jaxmark.geometry.surfaces import Surface, barycentric

_FAR = 0.005  # distance from the original, in diagonals, beyond which a vertex is no part of it

Numbers = Float64[np.ndarray, " vertices"]
Unknowns = Float64[np.ndarray, "vertices unknowns"]


class VertexHeights(NamedTuple):
    """The heights of a suspect's vertices above the original's surface, along its normals at their feet.

    The foot of a vertex is the point of the original's surface that is closest to it.
    """

    places: Float64[np.ndarray, "vertices 3"]  # of the vertices, in diagonals, centred as `Original.positions`
    height: Numbers  # in diagonals
    normals: Float64[np.ndarray, "vertices 3"]  # of the original at the feet, unit length
    share: sparse.csr_array  # barycentric coordinates of the feet, [vertices, points]
    faces: int = 0  # number that as fine a mesh of the whole original would have

    def along(self, displacement: Float64[np.ndarray, "points 3"]) -> Numbers:
        """Heights by a displacement of the original's points."""
        return np.sum(self.normals * (self.share @ displacement), axis=1)

    def adjoint(self, height: Numbers) -> Float64[np.ndarray, "points 3"]:
        """The adjoint of `along`."""
        return self.share.T @ (self.normals * height[:, None])

    def columns(self, basis: Float64[np.ndarray, "points columns"]) -> Unknowns:
        """Heights by each column of a basis, along each coordinate."""
        there = self.share @ basis
        return np.concatenate([self.normals[:, axis, None] * there for axis in range(3)], axis=1)


def measure_heights(original: Surface, suspect: Mesh, faces: int = 0) -> VertexHeights:
    """Measure the heights of a suspect's vertices, those that faces use and that are near the original.

    Args:
        original: the original's points and faces, in diagonals.
        suspect: the suspect, where the original is.
        faces: see `VertexHeights`.

    Raises:
        JaxmarkError: if libigl is missing.
    """
    places = np.asarray(suspect.vertices, np.float64)[used_vertices(suspect)]
    feet, face = original.closest(places)
    near = np.linalg.norm(places - feet, axis=1) <= _FAR
    places, feet, face = places[near], feet[near], face[near]
    corners, parts = np.asarray(original.mesh.faces)[face], barycentric(original.mesh, face, feet)
    normals = unit(np.einsum("mk,mkc->mc", parts, vertex_normals(original.mesh)[corners]))
    entries = parts.ravel(), (np.repeat(np.arange(len(feet)), 3), corners.ravel())
    share = sparse.csr_array(entries, shape=(len(feet), len(original.mesh.vertices)))
    return VertexHeights(places, np.sum(normals * (places - feet), axis=1), normals, share, faces)
