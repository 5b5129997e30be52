"""Reading with the original: which alternatives are read."""

import numpy as np
import pytest

from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh, vertex_normals
from jaxmark.watermark.nonblind import _registrations
from tests.alignment.test_registration import face, finer
from tests.samples import bumpy_sphere


@pytest.mark.slow
@pytest.mark.parametrize(("mesh", "count"), [(face(3, 0.0), 2), (bumpy_sphere(3), 1)])
def test_the_worse_reflection_is_read_only_if_it_fits_nearly_as_well(mesh: Mesh, count: int):
    """Only of a shape that is its own mirror image, up to the mark."""
    mark = 2e-4 * np.random.default_rng(0).normal(size=(len(mesh.vertices), 1)) * vertex_normals(mesh)
    marked = mesh._replace(vertices=np.asarray(mesh.vertices) + mark)
    aligned = [aligned for _, aligned in _registrations(make_original(mesh), finer(marked), "auto")]
    assert len(aligned) == count
    assert len({one.pose.mirrors for one in aligned}) == count
    assert np.all([one.method == "surface" for one in aligned])
