"""All metrics of a pair of meshes at once, on the host."""

from typing import NamedTuple

import numpy as np

from jaxmark.distortion.displacement import maximum, rms
from jaxmark.mesh import Mesh, diagonal, host_mesh, used_vertices, weld, welded_mesh
from jaxmark.original import displacement


class Comparison(NamedTuple):
    """Distortions of a mesh, each over the original's bounding-box diagonal."""

    rms: float  # displacement of the welded vertices that faces use, unweighted
    max: float


def compare(original: Mesh, distorted: Mesh) -> Comparison:
    """Measure how far a mesh was moved from its original.

    Raises:
        JaxmarkError: if the meshes do not share their connectivity, or one is unusable (see `make_mesh`, `diagonal`).
    """
    mesh = host_mesh(original)
    welded = weld(mesh.vertices)
    moved = displacement(mesh, distorted, welded, diagonal(mesh))[used_vertices(welded_mesh(mesh, welded))]
    with np.errstate(over="ignore"):  # a vertex thrown to the end of the number range is infinitely far
        return Comparison(float(rms(moved)), float(maximum(moved)))
