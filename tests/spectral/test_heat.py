"""Heat flow, against matrix exponentials and eigenvectors of dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.polynomial import chebyshev
from scipy import linalg

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import band_components, bands, filter, from_edges, from_mesh, heat
from jaxmark.spectral.laplacian import Laplacian
from tests.dense import laplacian_matrix
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

TIMES = [0, 0.1, 10, 1e3, 1e5]


@pytest.fixture(scope="module")
def operator() -> Laplacian:
    """A path, with the slowest flow of all graphs of its size, and beside it a weighted mesh."""
    mesh = from_mesh(bumpy_sphere(2), "cotangent")
    path = np.stack([np.arange(149), np.arange(1, 150)], axis=1)
    return from_edges(np.concatenate([path, mesh.edges + 150]), np.append(np.ones(149), mesh.weights))


def signals(operator: Laplacian) -> np.ndarray:
    """Noise, a slope and a constant."""
    size = len(operator.degree)
    return np.stack([np.random.default_rng(0).normal(size=size), np.linspace(-1, 1, size), np.ones(size)], axis=1)


def flow(operator: Laplacian, x: np.ndarray, t: float) -> np.ndarray:
    """By the eigenvectors of the symmetric matrix D^½ΔD^-½."""
    root = np.sqrt(operator.degree)[:, None]
    values, vectors = np.linalg.eigh(root * laplacian_matrix(operator) / root.T)
    return vectors * np.exp(-t * values.clip(min=0)) @ vectors.T @ (root * x) / root


def norms(operator: Laplacian, x: np.ndarray) -> np.ndarray:
    return np.sqrt(operator.degree @ np.asarray(x) ** 2)


@pytest.mark.parametrize("t", TIMES)
def test_flow_is_that_of_the_dense_matrix(operator, t, dtype):
    x = signals(operator)
    found = heat(operator, jnp.asarray(x, dtype), t)
    assert found.dtype == dtype
    error = norms(operator, found - flow(operator, x, t)) / norms(operator, x)
    # The dense eigenvalues, too, are off by a rounding or two, which t multiplies.
    assert (error < {"float32": 3e-7 + 2e-8 * t, "float64": 1e-14 + 7e-16 * t}[dtype.name]).all()


def test_flow_is_the_matrix_exponential(operator, x64):
    x = signals(operator)
    for t in (0, 0.1, 10):
        expected = linalg.expm(-t * laplacian_matrix(operator)) @ x
        np.testing.assert_allclose(heat(operator, jnp.asarray(x), t), expected, atol=1e-13)


def test_the_family_has_the_kernels(x64):
    """From the smallest time to one of which only the lowest frequencies are left, as values and as parts."""
    values = np.concatenate([[0], np.geomspace(1e-8, 2, 200)])
    expected = np.exp(-np.outer(TIMES, values))
    np.testing.assert_allclose(chebyshev.chebval(values - 1, bands.heat(TIMES).T), expected, atol=1e-11)
    operator = from_mesh(bumpy_sphere(2))
    x = jnp.asarray(np.random.default_rng(0).normal(size=(162, 3)))
    for part, t in zip(band_components(operator, bands.heat(TIMES[:4]), x), TIMES[:4], strict=True):
        np.testing.assert_allclose(part, heat(operator, x, t), atol=1e-11)


@pytest.mark.parametrize("t", TIMES)
def test_the_degree_is_enough_and_not_much_more(t):
    """Terms beyond it are below rounding, and at a sixth less they are not, once the flow is long."""
    degree = bands.heat([t]).shape[1] - 1
    size = np.abs(bands.heat([t], 2 * degree + 2)[0])
    assert size[degree + 1 :].sum() < 1e-15
    if t >= 1e3:
        assert size[round(degree * 5 / 6) :].sum() > 1e-15


def test_times_of_columns_and_derivatives(x64):
    operator = from_mesh(bumpy_sphere(1))
    x = jnp.asarray(np.random.default_rng(0).normal(size=(42, 2)))
    t = jnp.asarray([0.3, 4.0])
    apart = [heat(operator, x[:, i], float(t[i])) for i in range(2)]
    np.testing.assert_allclose(heat(operator, x, t), np.stack(apart, axis=1), atol=1e-13)
    many = jax.jit(jax.vmap(lambda t: heat(operator, x, t, degree=60)))(t)
    np.testing.assert_allclose(jnp.diagonal(many, axis1=0, axis2=2), np.stack(apart, axis=1), atol=1e-13)
    check_grads(lambda x, t: heat(operator, x, t, degree=60), (x, t), order=1, modes=["rev"])
    # ∂/∂t e^{-tΔ}x = -Δe^{-tΔ}x, at 0 too.
    for time in (0.0, 2.0):
        slope = jax.grad(lambda t: jnp.sum(jnp.sin(heat(operator, x, t, degree=60))))(time)
        y = heat(operator, x, time)
        np.testing.assert_allclose(slope, -jnp.sum(jnp.cos(y) * operator.apply(y)), rtol=1e-11)


def test_refusals(unchecked):
    operator, x = from_mesh(bumpy_sphere(1)), jnp.ones((42, 3))
    for call in (
        lambda: heat(operator, x, -1),
        lambda: heat(operator, x, np.inf),
        lambda: heat(operator, x, np.ones(2)),
        lambda: heat(operator, x[1:], 1),
        lambda: heat(operator, jnp.ones((42, 3), int), 1),
        lambda: jax.grad(lambda t: heat(operator, x, t).sum())(1.0),
        lambda: bands.heat([]),
        lambda: bands.heat([1, -1]),
        lambda: bands.heat(1.0),
    ):
        with pytest.raises(JaxmarkError):
            call()


def test_filter_of_the_family_is_the_flow(sphere: Mesh, dtype):
    operator, x = from_mesh(sphere), jnp.asarray(sphere.vertices, dtype)
    found = filter(operator, bands.heat([7.0])[0], x)
    np.testing.assert_allclose(found, heat(operator, x, 7.0), atol=20 * float(np.finfo(dtype).eps))
