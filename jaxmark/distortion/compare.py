"""All metrics of a pair of meshes at once, on the host."""

from typing import NamedTuple

from jaxmark.distortion.displacement import maximum, rms
from jaxmark.mesh import Mesh
from jaxmark.original import prepare, residual


class Comparison(NamedTuple):
    """Distortions of a mesh, each over the original's bounding-box diagonal."""

    rms: float  # displacement of the welded vertices
    max: float


def compare(original: Mesh, distorted: Mesh) -> Comparison:
    """Measure how far a mesh was moved from its original.

    Raises:
        JaxmarkError: if the meshes do not share their connectivity.
    """
    displacement = residual(prepare(original), distorted)
    return Comparison(float(rms(displacement)), float(maximum(displacement)))
