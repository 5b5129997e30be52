from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import sparse

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import rational
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, sparse_matrices
from jaxmark.spectral.rational import butterworth, response
from tests.dense import laplacian_matrix, tolerance
from tests.samples import ordered_laplacian

pytestmark = pytest.mark.core

# Poles on the real axis and off it, zeros within the spectrum, and a section that is a polynomial.
SECTIONS = np.array([[1.0, 0.0, 0.0, 1.0, 5.0, 0.0], [0.3, -1.0, 0.5, 1.3, -1.5, 1.0], [0.1, 2.0, -1.0, 1.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def operator(hard_graph: Mesh) -> Laplacian:
    return ordered_laplacian(hard_graph, "inverse-length")


def dense(operator: Laplacian, sections: np.ndarray) -> np.ndarray:
    """f(Δ) by the eigenvectors of the dense matrix."""
    values, vectors = np.linalg.eig(laplacian_matrix(operator))
    top = np.prod([np.polyval(row[2::-1], values) for row in sections], axis=0)
    bottom = np.prod([np.polyval(row[:2:-1], values) for row in sections], axis=0)
    return ((vectors * (top / bottom)) @ np.linalg.inv(vectors)).real


@pytest.mark.parametrize("columns", [(), (3,)])
def test_filter_is_the_function_of_the_dense_matrix(operator, columns, dtype):
    x = np.random.default_rng(0).normal(size=(11, *columns)).astype(dtype)
    found = jax.jit(rational.filter_rational)(operator, SECTIONS, jnp.asarray(x))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, dense(operator, SECTIONS) @ x, atol=tolerance(dtype, 10))


def test_response_is_what_an_eigenvector_sees():
    values = np.linspace(0, 2, 7)
    expected = np.prod([np.polyval(row[2::-1], values) / np.polyval(row[:2:-1], values) for row in SECTIONS], axis=0)
    np.testing.assert_allclose(response(SECTIONS, values), expected, rtol=1e-13)


def test_implicit_smoothing_against_a_direct_solver(sphere: Mesh, x64):
    operator = from_mesh(sphere)
    stiffness, mass = sparse_matrices(operator)
    x = np.asarray(sphere.vertices)
    system = sparse.csc_array(mass + 30 * stiffness)
    expected = sparse.linalg.spsolve(system, mass @ sparse.linalg.spsolve(system, mass @ x))
    found = rational.filter_rational(operator, np.array([[1.0, 0, 0, 1, 30, 0]] * 2), jnp.asarray(x))
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_butterworth_bands_by_their_closed_form(order):
    edges = np.array([0, 0.05, 0.2, 0.7, 1.2, 2])
    values = np.linspace(0, 2, 1001)
    low = [0 * values, *(1 / (1 + (values / edge) ** (2 * order)) for edge in edges[1:-1]), 1 + 0 * values]
    found = response(butterworth(edges, order), values)
    np.testing.assert_allclose(found, np.diff(low, axis=0), atol=1e-13)
    np.testing.assert_allclose(found.sum(axis=0), 1, atol=1e-13)
    # Where a difference of low-passes would have no digits left.
    np.testing.assert_allclose(
        response(butterworth(edges, order), np.array([1e-6]))[1:4, 0],
        [1e-6 ** (2 * order) * (a ** (-2 * order) - b ** (-2 * order)) for a, b in pairwise(edges[1:-1])],
        rtol=1e-5,
    )


def test_bands_of_a_bank(sphere: Mesh, dtype):
    """Against the dense eigenbasis; they sum to the signal, and are self-adjoint in the D inner product."""
    operator = from_mesh(sphere)
    bank = butterworth(1 - np.cos(np.linspace(0, np.pi, 7)), 2)
    x, u = np.random.default_rng(0).normal(size=(2, 642)).astype(dtype)
    apply = jax.jit(jax.vmap(rational.filter_rational, (None, 0, None)))
    found = apply(operator, bank, jnp.asarray(x))
    assert found.dtype == dtype
    np.testing.assert_allclose(found.sum(axis=0), x, atol=tolerance(dtype, 10))
    root = np.sqrt(operator.degree)
    values, vectors = np.linalg.eigh(root[:, None] * laplacian_matrix(operator) / root)
    expected = (response(bank, values) * (vectors.T @ (root * x))) @ vectors.T / root
    np.testing.assert_allclose(found, expected, atol=tolerance(dtype, 10))
    other = apply(operator, bank, jnp.asarray(u))
    np.testing.assert_allclose(
        found @ (operator.degree * u), other @ (operator.degree * x), atol=tolerance(dtype, 1000)
    )


def test_derivatives_against_finite_differences(operator, x64):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 11, 3)))

    def loss(sections, x, weights):
        apply = jax.vmap(lambda one: rational.filter_rational(operator._replace(weights=weights), sections, one))
        return jnp.sum(jnp.sin(apply(x)))

    inputs = (jnp.asarray(SECTIONS[:2]), x, jnp.asarray(operator.weights))
    check_grads(jax.jit(loss), inputs, order=1, modes=["fwd", "rev"])


def test_refusals(operator, unchecked):
    x = jnp.ones(11)
    for call in (
        lambda: rational.filter_rational(operator, SECTIONS, x[1:]),
        lambda: rational.filter_rational(operator, SECTIONS[0], x),
        lambda: rational.filter_rational(operator, SECTIONS[:, :5], x),
        lambda: butterworth(np.array([0.0, 2]), 1),
        lambda: butterworth(np.array([0.0, 1, 0.5]), 1),
        lambda: butterworth(np.array([0.0, 1, 2]), 0),
    ):
        with pytest.raises(JaxmarkError):
            call()
