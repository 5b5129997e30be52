"""Quadratic forms, traces and the lowest eigenpairs in traced form, against dense decompositions of (S, M)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from jaxmark import spectral
from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Laplacian
from tests.dense import tolerance
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module", params=["valence", "areas"])
def operator(request: pytest.FixtureRequest) -> Laplacian:
    if request.param == "valence":
        return spectral.from_mesh(bumpy_sphere(2), "inverse-length")
    return spectral.from_mesh(bumpy_sphere(2), "cotangent", mass="areas")


@pytest.fixture(scope="module")
def dense(operator: Laplacian) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    stiffness, mass = spectral.sparse_matrices(operator)
    return *linalg.eigh(stiffness.toarray(), mass.toarray()), mass.diagonal()


def changed(operator: Laplacian, weights: jax.Array, mass: jax.Array) -> Laplacian:
    return operator.with_weights(weights, None if operator.lumped_mass is None else mass)


def bump(values: jax.Array) -> jax.Array:
    return jnp.exp(-((values - 0.5) ** 2) * 8)


def test_traces_are_those_of_the_eigenvalues(operator, dense, x64):
    """With one probe for each direction they are exact, up to the null space, which probes leave out."""
    values, vectors, mass = dense
    every = jnp.asarray(vectors[:, 1:])
    for function in (jnp.log, bump):
        # Also with more steps than the signal has parts.
        assert jnp.isfinite(spectral.trace(operator, function, every, steps=12))
        found = spectral.quadratic_form(operator, function, every, steps=3)
        np.testing.assert_allclose(found, function(values[1:]), atol=1e-9)
    probes = spectral.white_probes(operator, 0, 5)
    parts = vectors.T @ (mass[:, None] * probes)
    expected = np.sum(np.log(values[1:, None]) * parts[1:] ** 2)
    np.testing.assert_allclose(spectral.trace(operator, jnp.log, probes, steps=60), expected, rtol=1e-6)


def test_derivatives_of_traces(operator, dense, x64):
    """With one probe for each direction they are those of all eigenvalues, also where weights change the mass."""
    weights, mass = jnp.asarray(operator.weights), np.asarray(operator.mass)
    way = weights * jnp.asarray(np.random.default_rng(0).normal(size=weights.shape))

    def whole(weights):
        stiffness, mass = spectral.sparse_matrices(jax.tree.map(np.asarray, changed(operator, weights, operator.mass)))
        return np.sum(np.asarray(bump(linalg.eigh(stiffness.toarray(), mass.toarray())[0])))

    every = jnp.asarray(dense[1])
    estimate = jax.jit(lambda weights: spectral.trace(changed(operator, weights, mass), bump, every, steps=4))
    difference = (whole(weights + 1e-5 * way) - whole(weights - 1e-5 * way)) / 2e-5
    np.testing.assert_allclose(jax.jvp(estimate, (weights,), (way,))[1], difference, rtol=1e-5)
    np.testing.assert_allclose(jnp.vdot(jax.grad(estimate)(weights), way), difference, rtol=1e-5)


def test_derivatives_of_quadratic_forms(operator, x64):
    """Along one direction of weights, mass and signals, in both modes, against differences."""
    weights, mass = jnp.asarray(operator.weights), jnp.asarray(operator.mass)
    probes = jnp.asarray(spectral.white_probes(operator, 0, 2))
    given = (weights, mass, probes)
    rng = np.random.default_rng(0)
    along = tuple(part * jnp.asarray(rng.normal(size=part.shape)) for part in given)

    @jax.jit
    def estimate(weights, mass, probes):
        return jnp.sum(spectral.quadratic_form(changed(operator, weights, mass), bump, probes, steps=60))

    step = 1e-5
    ahead, behind = (
        estimate(*(part + sign * step * way for part, way in zip(given, along, strict=True))) for sign in (1, -1)
    )
    by_forward = jax.jvp(estimate, given, along)[1]
    by_reverse = sum(map(jnp.vdot, jax.grad(estimate, (0, 1, 2))(*given), along))
    np.testing.assert_allclose(by_forward, (ahead - behind) / (2 * step), rtol=1e-5)
    np.testing.assert_allclose(by_reverse, by_forward, rtol=1e-9)


def test_a_signal_in_a_small_invariant_subspace(x64):
    """A ring's highest frequency: one step finds all, and further steps and derivatives stay finite."""
    ring, x = spectral.from_edges([[0, 1], [1, 2], [2, 3], [3, 0]], np.ones(4)), jnp.array([1.0, -1, 1, -1])
    np.testing.assert_allclose(spectral.quadratic_form(ring, jnp.exp, x, steps=4), 8 * np.exp(2))
    slope = jax.grad(lambda x: spectral.quadratic_form(ring, jnp.exp, x, steps=4))(x)
    np.testing.assert_allclose(slope, 4 * np.exp(2) * x)
    assert jnp.isfinite(spectral.quadratic_form(ring, jnp.log, jnp.zeros(4), steps=3))


def test_the_lowest_eigenpairs(operator, dense, dtype):
    values, vectors, mass = dense
    found = spectral.lowest_eigenpairs(operator, 12, 0, dtype=dtype)
    assert found.values.dtype == found.vectors.dtype == dtype
    close = tolerance(dtype, 100)
    np.testing.assert_allclose(found.values, values[:12], atol=close)
    overlaps = abs(found.vectors.T @ (mass[:, None] * vectors[:, :12]))
    np.testing.assert_allclose(overlaps, np.eye(12), atol=1e3 * close)
    assert found.residual < close


def test_derivatives_of_the_lowest_eigenpairs(operator, x64):
    weights, mass = jnp.asarray(operator.weights), jnp.asarray(operator.mass)
    rng = np.random.default_rng(0)
    given = (weights, mass)
    along = tuple(0.3 * part * jnp.asarray(rng.normal(size=part.shape)) for part in given)
    heights = jnp.asarray(bumpy_sphere(2).vertices[:, :1])

    @jax.jit
    def loss(weights, mass):
        pairs = spectral.lowest_eigenpairs(changed(operator, weights, mass), 8, 0, dtype=jnp.float64)
        # Squares, as the signs of vectors mean nothing.
        middles = jnp.sum(mass[:, None] * pairs.vectors**2 * heights, axis=0)
        return jnp.sum(jnp.sin(20 * pairs.values)) + jnp.sum(jnp.sin(3 * middles))

    step = 1e-5
    ahead, behind = (
        loss(*(part + sign * step * way for part, way in zip(given, along, strict=True))) for sign in (1, -1)
    )
    by_forward = jax.jvp(loss, given, along)[1]
    by_reverse = sum(map(jnp.vdot, jax.grad(loss, (0, 1))(*given), along))
    np.testing.assert_allclose(by_forward, (ahead - behind) / (2 * step), rtol=1e-5)
    np.testing.assert_allclose(by_reverse, by_forward, rtol=1e-8)


def test_all_eigenpairs_of_a_small_graph_with_isolated_vertices(x64):
    two = spectral.from_edges([[0, 1], [2, 3], [3, 4]], size=7)
    found = spectral.lowest_eigenpairs(two, 7, 0, dtype=jnp.float64)
    np.testing.assert_allclose(found.values, [0, 0, 1, 2, 2, 2, 2], atol=1e-12)
    np.testing.assert_allclose(found.vectors[5:, :3], 0, atol=1e-12)
    by_key = spectral.lowest_eigenpairs(two, 7, jax.random.key(0), dtype=jnp.float64)
    np.testing.assert_array_equal(by_key.vectors, found.vectors)


def test_what_cannot_be_computed_is_refused(operator, unchecked):
    x = jnp.ones(len(operator.mass))
    for call, sentence in [
        (lambda: spectral.lowest_eigenpairs(operator, 0, 0), "has 1 to 162 eigenpairs, not 0"),
        (lambda: spectral.lowest_eigenpairs(operator, 163, 0), "not 163"),
        (lambda: spectral.lowest_eigenpairs(operator, 4, 0, dtype=jnp.float16), "not in float16"),
        (lambda: spectral.quadratic_form(operator, jnp.exp, x, steps=0), "one step or more"),
        (lambda: spectral.quadratic_form(operator, jnp.exp, x[1:], steps=2), "N = 162"),
    ]:
        with pytest.raises(JaxmarkError, match=sentence):
            call()
