"""The bound on what vertices of simplified suspects carry: against dense matrices, and where its model is exact."""

import importlib
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark.geometry.mesh import Mesh, vertex_normals
from jaxmark.watermark.carriers.chips import KeyedCarrier
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.reading.coarse import expected_errors
from tests import ROOT
from tests.samples import bumpy_sphere

BUDGET, NOISE = 1e-3, 3e-4  # of the diagonal


@pytest.fixture
def bounds(monkeypatch) -> ModuleType:
    pytest.importorskip("igl")
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("common.bounds")


def scattered(mesh: Mesh, count: int, seed: int) -> Mesh:
    """A suspect of random points on a mesh's faces, a little above them or below; its own faces only use them."""
    rng = np.random.default_rng(seed)
    face, parts = rng.integers(len(mesh.faces), size=count), rng.dirichlet(np.ones(3), size=count)
    points, normals = (
        np.einsum("mk,mkc->mc", parts, np.asarray(values)[np.asarray(mesh.faces)[face]])
        for values in (mesh.vertices, vertex_normals(mesh))
    )
    noise = NOISE * np.linalg.norm(np.ptp(mesh.vertices, axis=0)) * rng.normal(size=(count, 1))
    return Mesh(points + noise * normals, np.arange(count).reshape(-1, 3))


@pytest.mark.slow
def test_covariance_and_eigenvalues_are_those_of_dense_matrices(bounds, key, x64):
    marker = make_marker(bumpy_sphere(2), key, bits=0)
    carrier, original = marker.carrier, marker.original
    assert isinstance(carrier, KeyedCarrier)
    there = bounds.measurer(original)(scattered(original.mesh, 60, 0))
    shape = carrier.chips.signs.shape
    chips = np.eye(shape[0] * shape[1])[np.abs(carrier.chips.signs).ravel() > 0].reshape(-1, *shape)
    spread = jax.vmap(lambda one: carrier.filter_chips(one, carrier.coefficients(1.0)))(jnp.asarray(chips))
    seen = np.stack([there.along(original.to_host(one)) for one in spread], axis=1)  # A T
    covariance = bounds.carried(carrier, there)
    np.testing.assert_allclose(covariance, seen @ seen.T, atol=1e-9 * covariance.max())
    rng = np.random.default_rng(1)
    deviation, nuisance = rng.uniform(1, 2, 60) * np.sqrt(covariance.max()), rng.normal(size=(60, 5))
    channel = bounds.make_channel(covariance, deviation, nuisance)
    free = np.linalg.svd((nuisance / deviation[:, None]).T)[2][5:]  # a basis of what B leaves
    dense = np.linalg.svd(free @ (seen / deviation[:, None]), compute_uv=False) ** 2
    np.testing.assert_allclose(channel.signal_to_noise()[5:][::-1], dense[:55], atol=1e-9 * dense.max())


def test_the_matched_receiver_reaches_the_bound_and_another_does_not(bounds):
    rng = np.random.default_rng(0)
    mix, deviation = rng.normal(size=(300, 300)) * 0.9 ** np.arange(300), rng.uniform(0.5, 2, 300)
    nuisance, covariance = rng.normal(size=(300, 12)), mix @ mix.T
    channel = bounds.make_channel(covariance, deviation, nuisance)
    s, found, plain = channel.signal_to_noise(), [], []
    for _ in range(100):
        mark = mix @ rng.choice([-1.0, 1.0], 300)
        height = mark + nuisance @ (100 * rng.normal(size=12)) + deviation * rng.normal(size=300)
        found.append(np.sqrt(channel.matched(height, mark)))
        white = channel.white(height)
        plain.append(channel.white(mark) @ white / np.sqrt(white @ channel.covariance @ white))
    assert np.mean(found) ** 2 == pytest.approx(np.sum(s / (1 + s)), rel=0.03)
    assert np.mean(plain) ** 2 < 0.8 * np.mean(found) ** 2


def test_errors_are_found_where_others_have_them(bounds):
    rng = np.random.default_rng(0)
    nothing = np.zeros((600, 1))

    def suspect() -> tuple[Any, np.ndarray, np.ndarray]:
        places = rng.uniform(-1, 1, (600, 3)) * [1, 1, 0]
        deviation = 2.0 + places[:, 0]
        there = bounds.VertexHeights(places, 0 * deviation, places, None)
        return there, deviation, 5 * places[:, 1] + deviation * rng.normal(size=600)

    (there, deviation, _), *others = [suspect() for _ in range(9)]
    found = expected_errors(there, [one[0] for one in others], [one[2] for one in others], [nothing] * 8)
    assert np.corrcoef(found[0], 5 * there.places[:, 1])[0, 1] > 0.95
    assert np.median(found[1] / deviation) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_a_whole_bound_where_its_model_is_exact(bounds, key):
    mesh = bumpy_sphere(4)
    marker = make_marker(mesh, key, bits=0)
    marked, _ = marker.embed(b"", BUDGET)
    found = bounds.make_bound(marker, marked, scattered(marked, 600, 1), lambda other: scattered(other, 600, 1), seed=0)
    assert found.vertices == 600
    assert 0 < found.square < 600
    assert found.bits > found.square / 2 / np.log(2)  # as log(1 + s) > s / (1 + s)
    assert np.sqrt(found.matched) == pytest.approx(np.sqrt(found.square), abs=2.5)
