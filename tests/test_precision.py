"""Sums against exact ones, and matrix products that no accelerator rounds."""

import math
from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.observation import observe
from jaxmark.alignment.original import Original, make_original
from jaxmark.distortion import msdm, msdm_views
from jaxmark.evaluation import allocation, channels
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import band_energies, gram
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.precision import compensated_sum, sum_and_norm
from jaxmark.watermark.bits import detect_bits, embed_bits
from jaxmark.watermark.carriers import Chips, KeyedCarrier, KeyedReader, chips
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.evidence import bounds
from jaxmark.watermark.reading.detectors import decorrelate
from jaxmark.watermark.reading.reception import Reception, make_host, make_receiver
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

COUNT = 2**21
SUM, SUM_AND_NORM = jax.jit(compensated_sum), jax.jit(sum_and_norm)


def rising(count: int, dtype) -> np.ndarray:
    """Terms of a score of ten standard deviations, in an order whose partial sums are far larger than the sum."""
    return np.sort(np.random.default_rng(0).normal(size=count) + 10 / math.sqrt(count)).astype(dtype)


def allowed(terms: np.ndarray) -> float:
    """The error that `compensated_sum` documents."""
    exact = terms.astype(np.float64)
    return float(np.finfo(terms.dtype).eps) * (abs(math.fsum(exact)) + np.linalg.norm(exact))


@pytest.mark.slow
@pytest.mark.parametrize("order", ["rising", "woven", "random"])
def test_millions_of_terms_against_the_exact_sum(order, dtype):
    terms = rising(COUNT, dtype)
    match order:
        case "woven":  # neighbours in size are added first, so that what cancels at last is large
            terms = terms.reshape(8, 64, 64, 64).T.ravel()
        case "random":
            terms = np.random.default_rng(1).permutation(terms)
    plain = []
    for scaled in (terms, (1.1 * terms).astype(dtype), (1.2 * terms).astype(dtype)):
        exact = math.fsum(scaled.astype(np.float64))
        found = SUM(jnp.asarray(scaled))
        assert found.dtype == dtype
        assert abs(float(found) - exact) < allowed(scaled)
        plain.append(abs(float(jnp.sum(scaled)) - exact) / allowed(scaled))
    if order == "rising" and dtype == np.float32:
        assert max(plain) > 1  # else this proves nothing


def test_no_probability_is_too_small_through_rounding():
    for scale in (1, 1.3, 1.7):
        terms = (scale * rising(COUNT, np.float32)).astype(np.float32)
        exact = terms.astype(np.float64)
        ratio = math.fsum(exact) / math.sqrt(math.fsum(exact**2))
        score, norm = SUM_AND_NORM(jnp.asarray(terms))
        assert score.dtype == norm.dtype == np.float32
        assert float(score) / float(norm) == pytest.approx(ratio, rel=4 * 1.2e-7 * (1 + 1 / ratio))
        bound = -(ratio**2) / 2 / math.log(10)
        assert bound <= bounds.log10_p_score(score, norm) < bound * (1 - 3e-6)
        # What is taken off is what was documented, and may have been needed.
        worst = np.float32(ratio * (1 + 3 * 1.2e-7))
        assert bound <= bounds.log10_p_score(worst, np.float32(1)) < bound * (1 - 3e-6)


def test_sums_work_under_transformations(dtype):
    terms = jnp.asarray(rising(80, dtype).reshape(2, 20, 2))
    plain = np.asarray(terms, np.float64)
    accuracy = 8 * np.finfo(dtype).eps
    sums, norms = jax.jit(jax.vmap(sum_and_norm))(terms)
    np.testing.assert_allclose(sums, plain.sum(axis=(1, 2)), rtol=accuracy)
    np.testing.assert_allclose(norms, np.sqrt((plain**2).sum(axis=(1, 2))), rtol=accuracy)
    for derivative in (jax.jacfwd, jax.jacrev):
        ones, unit = jax.jit(derivative(sum_and_norm))(terms)
        np.testing.assert_array_equal(ones, 1)
        np.testing.assert_allclose(unit, plain / np.linalg.norm(plain), rtol=10 * accuracy)
    np.testing.assert_array_equal(jax.jit(jax.grad(lambda x: sum_and_norm(x)[1]))(jnp.zeros(4, dtype)), 0)
    for size in (0, 1):
        assert sum_and_norm(jnp.ones(size, dtype)) == (size, size)


def test_the_norm_of_terms_whose_squares_underflow():
    terms = rising(1000, np.float32)
    score, norm = SUM_AND_NORM(jnp.asarray(1e-25 * terms, jnp.float32))
    assert float(score / norm) == pytest.approx(terms.sum() / np.linalg.norm(terms), rel=1e-5)


def test_a_claim_of_millions_of_chips():
    """Against the exact sum, in an order of the vertices that a plain sum does not bear."""
    random, count, code = np.random.default_rng(2), COUNT // 3, 8
    operator = Laplacian(np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(count))
    zeros = jnp.zeros((count, 3), jnp.float32)
    signs, slots = random.choice([-1, 1], zeros.shape).astype(np.int8), random.integers(0, code, zeros.shape)
    bits = random.choice([-1.0, 1.0], code)
    terms = rising(zeros.size, np.float32).reshape(zeros.shape)
    host = make_host(operator, zeros, zeros, np.ones((1, 1)), scales=0, degree=1)
    chips = Chips(signs, slots.astype(np.int32), np.bincount(slots.ravel(), minlength=code))
    reader = KeyedReader(KeyedCarrier(host, chips), zeros[:, :1])
    one, seen = jnp.ones(1, jnp.float32), observe(zeros)
    received = Reception(
        *(reader.receiver, seen, jnp.asarray(terms * signs * bits[slots], jnp.float32), one, one),
        *(jnp.eye(3, dtype=jnp.float32), seen, jnp.ones((1, 1), jnp.float32)),
    )
    score, norm = reader.claim(received, jnp.asarray(bits, jnp.float32))
    assert abs(float(score) - math.fsum(terms.astype(np.float64).ravel())) < allowed(terms.ravel())
    assert float(norm) == pytest.approx(np.linalg.norm(terms.astype(np.float64)), rel=3e-7)


def products(jaxpr) -> Iterator:
    """All matrix products in a program, those of its parts included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(leaf, "jaxpr", leaf)
            if hasattr(inner, "eqns"):
                yield from products(inner)


def check_products(function, *arguments) -> int:
    """How many matrix products a traced function has, all of them at full precision."""
    found = list(products(jax.make_jaxpr(function)(*arguments).jaxpr))
    highest = jax.lax.Precision.HIGHEST
    for equation in found:
        assert equation.params["precision"] == (highest, highest), f"{equation}\n{equation.source_info.traceback}"
    return len(found)


def test_the_check_of_products_finds_those_that_are_not_exact():
    def hidden(x):
        return jax.lax.map(jax.jit(jax.checkpoint(lambda row: row @ row)), x)

    with pytest.raises(AssertionError, match="dot_general"):
        check_products(hidden, jnp.ones((3, 2)))
    with jax.default_matmul_precision("highest"):
        assert check_products(hidden, jnp.ones((3, 2))) == 1


@pytest.fixture(scope="module")
def original() -> Original:
    return make_original(bumpy_sphere(2))


SCHEMES = [KeyedScheme(), KeyedScheme(direction="normals"), HostScheme(bands=32), EigenScheme(pairs=32)]


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: f"{scheme.name}-{getattr(scheme, 'direction', '')}")
def test_products_of_preparing_embedding_and_reading(scheme, original, key: jm.Key):
    one = jnp.ones(1, jnp.float32)[0]

    def written(x, bits, beta):
        carrier = scheme.carrier(replace(original, signal=x), Choices(key, b""), 8, 64)
        return carrier, embed_bits(x, bits, carrier, beta)

    def read(x, bits, beta, normals):
        carrier, marked = written(x, bits, beta)
        soft = detect_bits(jax.lax.stop_gradient(marked), x, carrier, beta=beta, normals=normals)
        return jnp.sum(soft * bits)

    def others(x, bits, beta):
        carrier, marked = written(x, bits, beta)
        seen, reader = observe(marked - x)._replace(nuisance=x), carrier.reader()
        received = reader.receive(seen)
        signs = jnp.ones(carrier.chips.signs.shape, x.dtype) if scheme.name == "keyed" else None
        probe = None if signs is None else chips._probe(reader.receiver, carrier.normals, jnp.ones_like(x[:, 0]), signs)
        more = probe, reader.linear_score(received, x, bits), reader.read_quickly(seen)
        return (
            carrier.claim(seen, bits),
            carrier.adjoint(x, beta),
            carrier.gram(beta),
            decorrelate(reader, received),
            more,
        )

    inputs = original.signal, jnp.ones(64, jnp.float32), one
    assert check_products(others, *inputs)
    for normals in (None, jnp.ones_like(original.signal) / 3**0.5):
        assert check_products(jax.value_and_grad(read, argnums=(0, 1, 2)), *inputs, normals)


def test_products_of_tuning(original, key: jm.Key):
    x, family = original.signal, jnp.asarray(scaling(16, damping="jackson"), jnp.float32)
    host = make_receiver(make_host(original.operator, x, x, family, scales=2, degree=3))
    seen = observe(0.01 * x)
    assert check_products(channels.measure, host, seen, x)
    assert check_products(jax.grad(lambda x: band_energies(original.operator, family, x, x).sum()), x)
    for method in ("bands", "moments"):
        assert check_products(jax.grad(lambda x, m=method: gram(original.operator, family, x, method=m).sum()), x)
    measured = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), jax.eval_shape(channels.measure, host, seen, x))

    def best(measured, cost):
        return jnp.sum(allocation.allocate(measured, cost, steps=5))

    check_products(jax.value_and_grad(best, argnums=(0, 1)), measured, jnp.ones(len(family)))


def test_products_of_what_limits_and_proves(original):
    mesh = original.mesh
    x = jnp.asarray(mesh.vertices, jnp.float32)
    views = msdm_views(mesh, mesh)
    assert check_products(lambda y: msdm(x, y, views), x)
    assert check_products(bounds.correlation_bound, jnp.ones((2, 4)), jnp.ones(4), 0.5, 0.1)
