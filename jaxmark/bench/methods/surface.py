"""The surface that methods mark: the distinct points that faces use, and how they are put back into a mesh."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmark.geometry.mesh import Mesh, Weld, compact, host_mesh, used_vertices, weld, weld_mesh
from jaxmark.geometry.pose import Points


class Skin(NamedTuple):
    """A mesh whose copies of points are one, and whose unused points are left out."""

    mesh: Mesh  # points and faces
    given: Mesh  # as it came
    welded: Weld  # of the mesh as it came

    def moved(self, points: Points) -> Mesh:
        """The mesh as it came, with the points that faces use at other places."""
        used = used_vertices(weld_mesh(self.given, self.welded))
        everywhere = np.array(self.given.vertices, np.float64)[self.welded.first]
        everywhere[used] = points
        return Mesh(everywhere[self.welded.point], self.given.faces)


def skin(mesh: Mesh) -> Skin:
    """Weld a mesh and leave out what no face uses; of a point cloud, every point is used.

    Raises:
        JaxmarkError: if it is no mesh, see `jaxmark.geometry.mesh.make_mesh`.
    """
    given = host_mesh(mesh)
    welded = weld(given.vertices)
    return Skin(compact(weld_mesh(given, welded)), given, welded)


def per_point(mesh: Mesh, values: Float64[np.ndarray, " faces"]) -> Float64[np.ndarray, " points"]:
    """Values of faces dealt out to their corners, a third to each."""
    return np.bincount(np.ravel(mesh.faces), np.repeat(values / 3, 3), len(mesh.vertices))
