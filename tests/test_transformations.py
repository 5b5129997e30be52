"""Numerical functions under every transformation, against dense matrices that JAX differentiates."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark import spectral
from jaxmark.spectral.chebyshev import band_energies, over_bands
from jaxmark.spectral.laplacian import Laplacian
from tests.dense import tolerance
from tests.samples import bumpy_sphere, ordered_laplacian

pytestmark = pytest.mark.core

BANDS = np.random.default_rng(0).normal(size=(3, 5))
WEIGHTS = np.random.default_rng(1).normal(size=(2, 3, 4))
SECTIONS = np.array([[1, 0.5, 0, 1, 0.5, 0.1]])
FRAME = np.array([[2.5, 0], [1.5, 1]])
FACTORS = spectral.Factors(np.array([0.3, 1.2]), np.array([0.5, -0.7]))


class Dense:
    """Δ and M as matrices, and what is made of them by definition."""

    def __init__(self, operator: Laplacian, dtype: Any):
        stiffness, mass = spectral.sparse_matrices(operator)
        self.mass = jnp.asarray(mass.diagonal(), dtype)
        self.delta = jnp.asarray(stiffness.toarray(), dtype) / self.mass[:, None]
        terms = [jnp.eye(len(self.delta), dtype=dtype), self.delta - jnp.eye(len(self.delta), dtype=dtype)]
        while len(terms) < 9:
            terms.append(2 * terms[1] @ terms[-1] - terms[-2])
        self.terms = jnp.stack(terms)

    def filter(self, c: np.ndarray, x: jax.Array) -> jax.Array:
        return jnp.einsum("k,kuv,vc->uc", jnp.asarray(c, x.dtype), self.terms[: len(c)], x)

    def components(self, x: jax.Array) -> jax.Array:
        return jnp.stack([self.filter(c, x) for c in BANDS])

    def moments(self, u: jax.Array, x: jax.Array, count: int) -> jax.Array:
        return jnp.einsum("vc,v,kvu,uc->kc", u, self.mass, self.terms[:count], x)

    def quadratic(self, c: np.ndarray) -> jax.Array:
        whole = c[0] * self.terms[0] + c[1] * self.delta + c[2] * self.delta @ self.delta
        return whole.astype(self.delta.dtype)

    def unmix(self, x: jax.Array) -> jax.Array:
        first, second = (FRAME[row, 0] * self.terms[0] + FRAME[row, 1] * self.terms[1] for row in (0, 1))
        first, second = first.astype(x.dtype), second.astype(x.dtype)
        return jnp.linalg.solve(first @ first + second @ second, first @ x + second @ x)

    def heat(self, x: jax.Array) -> jax.Array:
        return jax.scipy.linalg.expm(-2 * self.delta) @ x


def square(x: jax.Array) -> jax.Array:
    return jnp.sum(x**2)


# Each by the library, and by definition.
FUNCTIONS: dict[str, tuple[Callable[[Laplacian, jax.Array], Any], Callable[[Dense, jax.Array], Any]]] = {
    "apply": (lambda op, x: op.apply(x), lambda d, x: d.delta @ x),
    "inner": (lambda op, x: op.inner(x, jnp.sin(x)), lambda d, x: d.mass @ (x * jnp.sin(x))),
    "filter": (lambda op, x: spectral.filter(op, BANDS[0], x), lambda d, x: d.filter(BANDS[0], x)),
    "transpose": (
        lambda op, x: spectral.transpose(op, BANDS[0], x),
        lambda d, x: jnp.einsum("k,kvu,vc->uc", jnp.asarray(BANDS[0], x.dtype), d.terms[:5], x),
    ),
    "band_components": (lambda op, x: spectral.band_components(op, BANDS, x), lambda d, x: d.components(x)),
    "synthesise": (
        lambda op, x: spectral.synthesise(op, BANDS, jnp.stack([x, jnp.sin(x), x**2])),
        lambda d, x: d.filter(BANDS[0], x) + d.filter(BANDS[1], jnp.sin(x)) + d.filter(BANDS[2], x**2),
    ),
    "inverse": (
        lambda op, x: spectral.inverse(op, FRAME, jnp.stack([x, x])),
        lambda d, x: d.unmix(x),
    ),
    "heat": (lambda op, x: spectral.heat(op, x, 2.0), lambda d, x: d.heat(x)),
    "cross_moments": (
        lambda op, x: spectral.cross_moments(op, jnp.sin(x), x, degree=4),
        lambda d, x: d.moments(jnp.sin(x), x, 5),
    ),
    "moments": (lambda op, x: spectral.moments(op, x, degree=4), lambda d, x: d.moments(x, x, 9)),
    "gram": (
        lambda op, x: spectral.gram(op, BANDS, x),
        lambda d, x: jnp.einsum("v,ivc,jvc->cij", d.mass, d.components(x), d.components(x)),
    ),
    "gram by moments": (
        lambda op, x: spectral.gram(op, BANDS, x, method="moments"),
        lambda d, x: jnp.einsum("v,ivc,jvc->cij", d.mass, d.components(x), d.components(x)),
    ),
    "over_bands": (
        lambda op, x: over_bands(square, op, BANDS, x),
        lambda d, x: jnp.sum(d.components(x) ** 2, axis=(1, 2)),
    ),
    "band_energies": (
        lambda op, x: band_energies(op, jnp.asarray(BANDS, x.dtype), x, x),
        lambda d, x: jnp.einsum("vc,v,bvc->b", x, d.mass, d.components(x)) / d.mass.mean(),
    ),
    "filter_rational": (
        lambda op, x: spectral.filter_rational(op, SECTIONS, x),
        lambda d, x: jnp.linalg.solve(d.quadratic(SECTIONS[0, 3:]), d.quadratic(SECTIONS[0, :3]) @ x),
    ),
    "filter_by_factors": (
        lambda op, x: spectral.filter_by_factors(op, FACTORS, x),
        lambda d, x: -0.35 * (d.delta - 0.3 * d.terms[0]) @ (d.delta - 1.2 * d.terms[0]) @ x,
    ),
    "cheb_conv": (
        lambda op, x: spectral.cheb_conv(op, {"weight": WEIGHTS, "bias": np.ones(3)}, x),
        lambda d, x: jnp.einsum("kuv,vi,iok->uo", d.terms[:4], x, jnp.asarray(WEIGHTS, x.dtype)) + 1,
    ),
}


def transformed(function: Callable[[jax.Array], Any], x: jax.Array, along: jax.Array) -> dict[str, Any]:
    """What a function gives under each transformation."""

    def loss(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.sin(0.1 * function(x)))

    both = jnp.stack([x, along])
    return {
        "value": function(x),
        "vmap": jax.vmap(function)(both),
        "grad": jax.grad(loss)(x),
        "jvp": jax.jvp(function, (x,), (along,))[1],
        "jvp of grad": jax.jvp(jax.grad(loss), (x,), (along,))[1],
        "grad of grad": jax.grad(lambda x: jnp.vdot(jax.grad(loss)(x), along))(x),
        "vmap of grad": jax.vmap(jax.grad(loss))(both),
        "linearize": jax.linearize(function, x)[1](along),
        "checkpoint": jax.grad(jax.checkpoint(loss))(x),
    }


def check(operator: Laplacian, name: str, dtype: Any) -> None:
    ours, definition = FUNCTIONS[name]
    x, along = (
        jnp.asarray(np.random.default_rng(seed).normal(size=(len(operator.degree), 2)), dtype) for seed in (0, 1)
    )
    dense = Dense(operator, dtype)
    with jax.numpy_dtype_promotion("strict"):
        found = jax.jit(lambda x, along: transformed(lambda x: ours(operator, x), x, along))(x, along)
        eager = ours(operator, x)
    expected = jax.jit(lambda x, along: transformed(lambda x: definition(dense, x), x, along))(x, along)
    for way, wanted in expected.items():
        assert found[way].dtype == dtype, way
        close = {"atol": tolerance(dtype, 100) * float(1 + jnp.abs(wanted).max()), "err_msg": f"{name}: {way}"}
        np.testing.assert_allclose(found[way], wanted, **close)
    np.testing.assert_allclose(eager, found["value"], atol=tolerance(dtype, 10) * float(1 + jnp.abs(eager).max()))


@pytest.mark.parametrize("name", ["filter", "moments"])
def test_on_one_small_operator(name, x64):
    check(ordered_laplacian(bumpy_sphere(0), "inverse-length"), name, jnp.float64)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_with_a_mass(name, dtype):
    check(spectral.from_mesh(bumpy_sphere(0), "cotangent", mass="areas"), name, dtype)
