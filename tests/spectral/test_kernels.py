"""Compiled kernels beside the scans that they replace, and beside SciPy; skipped where they are not installed."""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark.spectral import kernels, recurrence
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.laplacian import Laplacian, graph_laplacian, sparse_matrices
from jaxmark.spectral.padding import common_laplacian, pad_edges
from tests.dense import tolerance
from tests.samples import bumpy_sphere

pytestmark = [pytest.mark.core, pytest.mark.processor]

needed = pytest.mark.skipif(not kernels.installed(), reason="jaxmark-kernels is not installed")
TERMS = 24


def grid(side: int) -> tuple[np.ndarray, int]:
    """Edges of a square grid of triangles."""
    places = np.arange(side * side).reshape(side, side)
    steps = [(places[:, :-1], places[:, 1:]), (places[:-1], places[1:]), (places[:-1, :-1], places[1:, 1:])]
    return np.concatenate([np.stack([one.ravel(), other.ravel()], axis=1) for one, other in steps]), side * side


def shuffled(pairs: np.ndarray, size: int) -> tuple[np.ndarray, int]:
    return np.random.default_rng(3).permutation(size)[pairs], size


def hubs() -> tuple[np.ndarray, int]:
    """A grid of which some vertices have hundreds of neighbours, past any number of slots, and some have none."""
    pairs, size = grid(140)
    random = np.random.default_rng(4)
    rays = [
        np.stack([np.full(300, hub), hub + 1 + random.choice(3000, 300, replace=False)], axis=1) for hub in (5, 9000)
    ]
    return np.unique(np.sort(np.concatenate([pairs, *rays]), axis=1), axis=0), size + 100


def scattered() -> tuple[np.ndarray, int]:
    """Edges between any two vertices, so that no order brings them near."""
    pairs = np.random.default_rng(5).integers(0, 20000, (50000, 2))
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0), 20000


def weighted(pairs: np.ndarray, size: int) -> tuple[np.ndarray, int, np.ndarray]:
    return pairs, size, np.random.default_rng(6).uniform(0.1, 2, len(pairs))


def with_mass(operator: Laplacian) -> Laplacian:
    """A lumped mass, and a bound of the spectrum with it."""
    mass = np.random.default_rng(7).uniform(1, 2, len(operator.degree))
    return operator._replace(lumped_mass=mass, scale=np.array(float(np.max(operator.degree / mass))))


OPERATORS = {
    "small": lambda: graph_laplacian(*grid(9)),
    "ordered": lambda: graph_laplacian(*grid(200)),
    "shuffled": lambda: graph_laplacian(*shuffled(*grid(200))),
    "hubs": lambda: graph_laplacian(*hubs()),
    "weighted hubs": lambda: graph_laplacian(*weighted(*hubs())),
    "scattered": lambda: graph_laplacian(*scattered()),
    "massive": lambda: with_mass(graph_laplacian(*weighted(*shuffled(*grid(150))))),
    "padded": lambda: pad_edges(graph_laplacian(*hubs()), 3),
    "mesh": lambda: common_laplacian(bumpy_sphere(3)),
    "edgeless": lambda: graph_laplacian(np.zeros((0, 2), int), 5, lowering="gather"),
}


def signal(operator: Laplacian, *columns: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(len(operator.degree), *columns))


@needed
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("name", OPERATORS)
def test_results_are_those_of_the_scans(name, double):
    with jax.enable_x64(double):
        operator = OPERATORS[name]()
        dtype = np.float64 if double else np.float32
        random = np.random.default_rng(1)
        for columns in ((), (1,), (3,), (6,)):
            x, u = (jnp.asarray(signal(operator, *columns, seed=seed).astype(dtype)) for seed in (0, 1))
            c = jnp.asarray(random.normal(size=(TERMS, *columns)).astype(dtype))
            bank = jnp.asarray(random.normal(size=(3, TERMS)).astype(dtype))
            pairs = {
                "filter": (recurrence.filtered(operator, c, x), recurrence.filter_scan(operator, c, x)),
                "bank": (recurrence.components(operator, bank, x), recurrence._components_scan(operator, bank, x)),
                "constant": (recurrence.filtered(operator, c[:1], x), c[0] * x),
                "projection": (
                    recurrence.projection(TERMS)(operator, x, u),
                    recurrence._projection_scan(recurrence.COLUMNS, TERMS, operator, x, u),
                ),
            }
            for what, (found, expected) in pairs.items():
                assert found.dtype == dtype
                size = float(jnp.abs(expected).max())
                np.testing.assert_allclose(
                    found, expected, atol=tolerance(dtype, 30) * size, err_msg=f"{what} {columns}"
                )


@needed
def test_results_are_those_of_scipy(x64):
    operator = OPERATORS["shuffled"]()
    stiffness, mass = sparse_matrices(operator)
    c, x = np.random.default_rng(1).normal(size=TERMS), signal(operator, 3)
    before, now = x, (stiffness @ x) / mass.diagonal()[:, None] - x
    total = c[0] * before + c[1] * now
    for c_k in c[2:]:
        before, now = now, 2 * ((stiffness @ now) / mass.diagonal()[:, None] - now) - before
        total += c_k * now
    np.testing.assert_allclose(filter(operator, c, jnp.asarray(x)), total, atol=1e-11)


@needed
def test_derivatives_and_batches_are_those_of_the_scan(x64):
    operator = jax.tree.map(jnp.asarray, OPERATORS["weighted hubs"]())
    c, x = jnp.asarray(np.random.default_rng(1).normal(size=TERMS)), jnp.asarray(signal(operator, 2))

    def gradients(function):
        return jax.grad(lambda c, x, w: jnp.sum(function(operator._replace(weights=w), c, x) ** 3), (0, 1, 2))

    for found, expected in zip(
        gradients(filter)(c, x, operator.weights),
        gradients(recurrence.filter_scan)(c, x, operator.weights),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * float(jnp.abs(expected).max()))
    change = jax.jvp(partial(filter, operator, c), (x,), (x,))[1]
    np.testing.assert_allclose(change, filter(operator, c, x), atol=1e-12)
    some = jnp.stack([c, 2 * c])
    together = jax.jit(jax.vmap(filter, (None, 0, None)))(operator, some, x)
    np.testing.assert_allclose(together, jnp.stack([filter(operator, c, x) for c in some]), atol=1e-12)


def test_without_kernels_the_scan_computes(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxmark_kernels", None)
    kernels.installed.cache_clear()
    try:
        assert not kernels.installed()
        found = kernels.where_installed(lambda *_: pytest.fail("the kernel ran"), lambda operator, x: 2 * x)(
            None, jnp.ones(2)
        )
        np.testing.assert_array_equal(found, 2)
    finally:
        kernels.installed.cache_clear()
