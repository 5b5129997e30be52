import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import product
from jaxmark.spectral.bands import nodes, scaling
from jaxmark.spectral.chebyshev import band_components
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.product import Factors, lagrange_factors, leja
from tests.dense import laplacian_matrix, tolerance
from tests.samples import ordered_laplacian

pytestmark = pytest.mark.core

all_bands = jax.jit(jax.vmap(product.filter_by_factors, (None, 0, None)))


@pytest.mark.parametrize("columns", [(), (3,)])
def test_factors_are_applied_as_the_paper_has_them(hard_graph: Mesh, columns, dtype):
    """Π scale (Δ - zero) with dense matrices, isolated vertices included."""
    operator = ordered_laplacian(hard_graph, "inverse-length")
    random = np.random.default_rng(0)
    factors = Factors(*random.uniform(0.5, 2, (2, 6)))
    x = random.normal(size=(11, *columns)).astype(dtype)
    expected = x
    for zero, scale in zip(*factors, strict=True):
        expected = scale * (laplacian_matrix(operator) @ expected - zero * expected)
    found = product.filter_by_factors(operator, factors, jnp.asarray(x))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=tolerance(dtype) * np.abs(expected).max())


@pytest.mark.parametrize("order", ["leja", "printed"])
def test_lagrange_factors_are_1_at_their_node_and_0_at_the_others(order):
    eigenvalues = np.array([0.0, 0.3, 0.35, 1.1, 1.9, 1.2])
    zeros, scales = lagrange_factors(eigenvalues, order=order)
    values = (scales * (eigenvalues[:, None, None] - zeros)).prod(axis=-1)
    np.testing.assert_allclose(values, np.eye(6), atol=1e-12)
    if order == "printed":
        np.testing.assert_array_equal(zeros[2], np.delete(eigenvalues, 2))


@pytest.mark.parametrize(("order", "bands"), [("printed", 8), ("leja", 8), ("leja", 32), ("leja", 128)])
def test_both_methods_agree(sphere: Mesh, order, bands, dtype):
    operator = from_mesh(sphere)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(642, 3)).astype(dtype))
    second = band_components(operator, scaling(bands), x)
    first = all_bands(operator, lagrange_factors(nodes(bands), order=order), x)
    np.testing.assert_allclose(first, second, atol=tolerance(dtype) * np.abs(second).max())


def test_the_printed_order_loses_all_digits(sphere: Mesh, x64):
    """Why the order is not a matter of taste: 64 bands have errors of 10⁸ in float64, and overflow in float32."""
    operator = from_mesh(sphere)
    x = np.random.default_rng(0).normal(size=642)
    second = band_components(operator, scaling(64), jnp.asarray(x))
    first = all_bands(operator, lagrange_factors(nodes(64), order="printed"), jnp.asarray(x))
    assert np.abs(first - second).max() > 1
    single = lagrange_factors(nodes(192), order="printed")
    assert not np.isfinite(all_bands(operator, single, jnp.asarray(x, jnp.float32))).all()


def test_leja_order_by_its_definition():
    points = np.random.default_rng(0).uniform(0, 2, 12)
    order = leja(points)
    assert points[order[0]] == points.max()
    for k in range(1, 12):
        products = [np.prod(np.abs(point - points[order[:k]])) for point in points]
        assert np.argmax(products) == order[k]


def test_derivatives(hard_graph: Mesh, x64):
    operator = ordered_laplacian(hard_graph, "inverse-length")
    random = np.random.default_rng(0)
    factors = Factors(*(jnp.asarray(part) for part in random.uniform(0.5, 1.5, (2, 5))))
    x = jnp.asarray(random.normal(size=(2, 11)))

    def loss(factors, x, weights):
        return jnp.sum(jnp.sin(product.filter_by_factors(operator._replace(weights=weights), factors, x)))

    weights = jnp.asarray(operator.weights)
    check_grads(jax.jit(loss), (factors, x[0], weights), order=1, modes=["fwd", "rev"])
    mapped = jax.vmap(jax.grad(loss, 1), (None, 0, None))(factors, x, weights)
    np.testing.assert_allclose(mapped[1], jax.grad(loss, 1)(factors, x[1], weights), atol=1e-12)


def test_refusals(sphere: Mesh, unchecked):
    operator, x = from_mesh(sphere), jnp.ones(642)
    factors = lagrange_factors(nodes(4))
    for call in (
        lambda: product.filter_by_factors(operator, factors, x),
        lambda: product.filter_by_factors(operator, Factors(*(part[0] for part in factors)), x[1:]),
        lambda: product.filter_by_factors(operator, Factors(factors.zeros[0], factors.scales[0, :2]), x),
        lambda: lagrange_factors(np.array([1.0, 1.0])),
        lambda: lagrange_factors(np.array([1.0])),
        lambda: lagrange_factors(nodes(4), order="x"),
    ):
        with pytest.raises(JaxmarkError):
            call()
