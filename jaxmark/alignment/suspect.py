"""Preparation of a suspect for alignment: scale it to a usual size, and restore the corner order of its faces."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh, host_mesh, same_connectivity, weld, weld_mesh
from jaxmark.geometry.pose import IDENTITY, Pose

_SMALLEST = 1e-50  # least size of a suspect, in its file's units, whose powers do not underflow
_COPIES_APART = 0.1  # largest median distance of vertices that share a point, over the suspect's size, if order is kept


@dataclass(frozen=True, eq=False)
class PreparedSuspect:
    """A suspect, prepared for alignment with an original by `make_suspect`."""

    mesh: Mesh  # the suspect, scaled so that powers of its coordinates neither overflow nor underflow
    pose: Pose  # from the file's coordinates to those of `mesh`

    @property
    def is_cloud(self) -> bool:
        """Whether the suspect has no faces."""
        return len(self.mesh.faces) == 0

    @cached_property
    def welded(self) -> Mesh:
        """The mesh with one vertex for each position."""
        return weld_mesh(self.mesh, weld(self.mesh.vertices))

    def has_order_of(self, original: Original) -> bool:
        """Whether the suspect's vertices seem to have the order in which the original was marked."""
        alike = original.in_order and same_connectivity(self.mesh, original.mesh)
        return alike and self._has_copies_together(original)

    def _has_copies_together(self, original: Original) -> bool:
        """Whether vertices that share a point of the original are near each other in the suspect.

        In a shuffled triangle soup they are not. Connectivity does not show this, because all triangle soups with the
        same number of triangles have the same faces.
        """
        first = original.weld.first[original.weld.point]
        copies = np.flatnonzero(first != np.arange(len(first)))
        vertices = np.asarray(self.mesh.vertices, np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # coordinates of a suspect may be huge
            apart = np.abs(vertices[copies] - vertices[first[copies]]).max(axis=1)
            size = np.abs(vertices - np.median(vertices, axis=0)).max(axis=1)
        return len(copies) == 0 or bool(np.median(apart) <= _COPIES_APART * np.median(size))


def make_suspect(original: Original, mesh: Mesh) -> PreparedSuspect:
    """Check a mesh and scale it to a usual size; if its faces differ only in the order of corners, restore that order.

    Programs that reflect a mesh also reverse its faces, so that normals point outwards again.

    Raises:
        JaxmarkError: see `make_mesh`.
    """
    mesh = host_mesh(mesh)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    marked = original.marked_order
    own = np.asarray(marked.faces)
    alike = len(vertices) == len(marked.vertices) and len(faces) == len(own)
    if alike and np.array_equal(np.sort(faces, axis=1), np.sort(own, axis=1)):
        mesh = mesh._replace(faces=own)
    size = float(np.quantile(np.abs(vertices - np.median(vertices, axis=0)).max(axis=1), 0.6))  # of most points
    if not 0 < size < np.inf or _SMALLEST < size < 1 / _SMALLEST:
        return PreparedSuspect(mesh, IDENTITY)
    # Scale in two steps, because the factor itself may be out of range.
    exponent = -int(np.floor(np.log2(size)))
    half = np.ldexp(1.0, exponent // 2)
    scaled = vertices * half * np.ldexp(1.0, exponent - exponent // 2)
    pose = Pose(np.ldexp(1.0, min(exponent, 1000)) * np.eye(3), np.zeros(3))
    return PreparedSuspect(mesh._replace(vertices=scaled), pose)
