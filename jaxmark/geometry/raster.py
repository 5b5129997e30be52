"""Orthographic pictures of meshes: the face that each pixel shows, by casting rays with libigl, on the host."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.errors import require
from jaxmark.geometry.mesh import Mesh, diagonal, face_normals, unit, used_vertices, vertex_normals

#: Cameras by the side that they show: the axes right, up and towards the viewer, as rows. +y is up, the front is +z.
SIDES: Mapping[str, Float64[np.ndarray, "3 3"]] = {
    "front": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "back": np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "left": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "top": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "bottom": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


class Frame(NamedTuple):
    """The square that pictures of an object show; several meshes may share one."""

    centre: Float64[np.ndarray, "3"]
    width: float  # of the square that a picture shows, in the units of the positions

    @classmethod
    def of(cls, mesh: Mesh) -> "Frame":
        """Make the frame that shows a whole mesh from every side; raises as `diagonal` does."""
        points = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
        return cls((points.min(axis=0) + points.max(axis=0)) / 2, diagonal(mesh))


class Raster(NamedTuple):
    """The faces that the pixels of a square picture show, from the upper left one on."""

    mesh: Mesh
    camera: Float64[np.ndarray, "3 3"]  # right, up and towards the eye, as rows
    face: Int64[np.ndarray, "rows columns"]  # the nearest one, -1 beside the object
    weights: Float64[np.ndarray, "rows columns 3"]  # of the face's corners

    @property
    def shown(self) -> Bool[np.ndarray, "rows columns"]:
        """Mask of the pixels that show the object."""
        return self.face >= 0

    def normals(self, *, smooth: bool) -> Float64[np.ndarray, "rows columns 3"]:
        """Compute unit normals in the camera's axes, turned towards the viewer; 0 for pixels without the object.

        Args:
            smooth: whether to interpolate normals of vertices rather than to take those of faces.
        """
        if smooth:
            corners = vertex_normals(self.mesh)[np.asarray(self.mesh.faces)[self.face]]
            found = unit(np.einsum("rck,rckd->rcd", self.weights, corners))
        else:
            found = unit(face_normals(self.mesh))[self.face]
        seen = np.where(self.shown[:, :, None], found @ self.camera.T, 0)
        # Soups and open surfaces have no outside.
        return np.where(seen[:, :, 2:] < 0, -seen, seen)


def cast(mesh: Mesh, camera: Float64[np.ndarray, "3 3"], frame: Frame, size: int) -> Raster:
    """Find what each pixel shows.

    Args:
        mesh: any mesh with faces.
        camera: right, up and towards the eye, as orthonormal rows; see `SIDES`.
        frame: see `Frame.of`.
        size: pixels on each side.

    Raises:
        JaxmarkError: if libigl is missing.
    """
    embree = require("igl.embree", "align")
    placed = (np.asarray(mesh.vertices, np.float64) - frame.centre) / frame.width @ camera.T
    steps = (np.arange(size) + 0.5) / size - 0.5
    up, right = np.meshgrid(-steps, steps, indexing="ij")
    points = np.stack([right, up, np.full_like(up, 1.0)], axis=2).reshape(-1, 3)  # in front of everything
    ahead = np.tile([0.0, 0, -1], (len(points), 1))
    hits = embree.line_mesh_intersection(points, ahead, placed, np.asarray(mesh.faces, np.int64))
    u, v = hits[:, 1], hits[:, 2]
    weights = np.stack([1 - u - v, u, v], axis=1).reshape(size, size, 3)
    return Raster(mesh, camera, hits[:, 0].astype(np.int64).reshape(size, size), weights)
