"""The heights of a suspect's own vertices above the original's surface.

A simplified surface is accurate at its vertices, but cuts corners between them. Therefore its vertices are compared
with the original, instead of the original's points with the suspect.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy import sparse

from jaxmark.geometry.mesh import Mesh, unit, used_vertices, vertex_normals
from jaxmark.geometry.surfaces import Surface, barycentric

_FAR = 0.005  # largest distance of a vertex from the original, in diagonals; other vertices do not belong to it

Numbers = Float64[np.ndarray, " vertices"]
Unknowns = Float64[np.ndarray, "vertices unknowns"]


class VertexHeights(NamedTuple):
    """The heights of a suspect's vertices above the original's surface, along its normals.

    The foot of a vertex is the closest point of the original's surface.
    """

    places: Float64[np.ndarray, "vertices 3"]  # of the vertices, in diagonals, centred as `Original.positions`
    height: Numbers  # in diagonals
    normals: Float64[np.ndarray, "vertices 3"]  # unit normals of the original at the feet
    share: sparse.csr_array  # barycentric coordinates of the feet, [vertices, points]
    faces: int = 0  # number of faces that a mesh of the whole original would have at the suspect's density

    def along(self, displacement: Float64[np.ndarray, "points 3"]) -> Numbers:
        """Compute the heights that a displacement of the original's points causes."""
        return np.sum(self.normals * (self.share @ displacement), axis=1)

    def adjoint(self, height: Numbers) -> Float64[np.ndarray, "points 3"]:
        """Apply the adjoint of `along`."""
        return self.share.T @ (self.normals * height[:, None])

    def columns(self, basis: Float64[np.ndarray, "points columns"]) -> Unknowns:
        """Compute the heights that each column of a basis causes, as a displacement along each coordinate axis."""
        at_feet = self.share @ basis
        return np.concatenate([self.normals[:, axis, None] * at_feet for axis in range(3)], axis=1)


def measure_heights(original: Surface, suspect: Mesh, faces: int = 0) -> VertexHeights:
    """Measure the heights of a suspect's vertices: of all that a face uses and that are near the original.

    Args:
        original: the original's points and faces, in diagonals.
        suspect: the suspect, in the original's pose.
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
