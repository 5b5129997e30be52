import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.padding import common_laplacian, common_size, pad_rows
from tests.dense import tolerance
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


def cut(mesh: Mesh, corners: int) -> Mesh:
    """Without the first vertices and their faces."""
    return make_mesh(mesh.vertices[corners:], mesh.faces[(mesh.faces >= corners).all(axis=1)] - corners)


def test_common_sizes_are_few_and_not_much_larger():
    counts = np.arange(1, 2**17 + 2)
    sizes = np.array([common_size(int(count)) for count in counts])
    assert (sizes >= counts).all()
    assert len(np.unique(sizes[counts <= 2**13])) == 6
    assert (sizes <= 1.25 * counts)[counts > 2**13].all()
    assert sizes[-1] == counts[-1]
    octave = sizes[(counts > 2**13) & (counts <= 2**14)]
    assert len(np.unique(octave)) == 4


@pytest.mark.parametrize("weights", ["valence", "cotangent"])
@pytest.mark.parametrize("lowering", ["gather", "segments"])
def test_what_is_filled_in_changes_nothing(hard_graph: Mesh, weights, lowering, dtype):
    plain = from_mesh(hard_graph, weights, lowering=lowering)
    filled = common_laplacian(hard_graph, weights, lowering)
    x = np.random.default_rng(0).normal(size=(len(hard_graph.vertices), 3)).astype(dtype)
    c = np.random.default_rng(1).normal(size=9).astype(dtype)
    got = filter(filled, c, jnp.asarray(pad_rows(x, len(filled.degree))))
    assert len(got) == 256 == len(filled.degree)
    np.testing.assert_allclose(got[: len(x)], filter(plain, c, jnp.asarray(x)), atol=tolerance(dtype, 10))
    np.testing.assert_array_equal(got[len(x) :], 0)


@pytest.mark.slow
def test_programs_serve_meshes_of_other_sizes(key: jm.Key):
    """Where meshes have about as many vertices, and the scheme lays out their bands alike."""
    whole, compiled = bumpy_sphere(4), []

    def hear(event: str, seconds: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and seconds > 0.1:
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        for index, mesh in enumerate((cut(whole, 7), cut(whole, 40), cut(whole, 90))):
            before = len(compiled)
            marked, _ = jm.embed(mesh, b"s", key)
            assert jm.detect(marked, original=mesh, key=key, bits=8).message == b"s"
            assert len(make_original(mesh).signal) == common_size(len(mesh.vertices)) == 4096
            assert index == 0 or len(compiled) == before
    finally:
        jax.monitoring.unregister_event_duration_listener(hear)
