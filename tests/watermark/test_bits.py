import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxmark as jm
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import centre
from jaxmark.watermark.bits import detect_bits, embed_bits, log_evidence
from jaxmark.watermark.carriers import ModulatedCarrier, host_bands
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.sequences import orthogonal_sequences
from jaxmark.watermark.evidence.bounds import correlation_bound
from jaxmark.watermark.reading.detectors import correlate, decorrelate, joint
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

BITS = 8


@pytest.fixture(scope="module")
def prepared():
    mesh = bumpy_sphere(2)
    operator = from_mesh(mesh)
    return operator, centre(operator, mesh.vertices)


def carrier_of(operator, signal, key, bands=16, **options):
    sequences = orthogonal_sequences(Choices(key, b""), BITS, 3 * bands).reshape(BITS, bands, 3)
    family = scaling(bands, damping=options.pop("damping", "jackson"), kernel=options.pop("kernel", "halved"))
    return ModulatedCarrier(host_bands(operator, signal, family, **options), sequences)


def test_least_squares_recovers_the_amplitudes(prepared, key: jm.Key, dtype):
    operator, signal = prepared
    x = jnp.asarray(signal, dtype)
    carrier = carrier_of(operator, x, key)
    bits = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], BITS), dtype)
    beta = jnp.asarray(np.random.default_rng(1).uniform(0.5, 1.5, 16), dtype)
    scores = detect_bits(embed_bits(x, bits, carrier, beta), x, carrier, decorrelate, beta)
    assert scores.dtype == dtype
    np.testing.assert_allclose(scores, bits, atol=1e-2 if dtype == np.float32 else 1e-6)


def test_detectors_by_their_definitions(prepared, key: jm.Key, x64):
    operator, signal = prepared
    x = jnp.asarray(signal)
    carrier = carrier_of(operator, x, key)
    residual = np.random.default_rng(2).normal(size=signal.shape)
    columns = np.stack([carrier.displacement(jnp.asarray(unit)).ravel() for unit in np.eye(BITS)], axis=1)
    mass = np.repeat(operator.degree, 3)
    np.testing.assert_allclose(
        detect_bits(x + residual, x, carrier, correlate), columns.T @ (mass * residual.ravel()), rtol=1e-8
    )
    root = np.sqrt(mass)
    least_squares = np.linalg.lstsq(root[:, None] * columns, root * residual.ravel(), rcond=None)[0]
    np.testing.assert_allclose(detect_bits(x + residual, x, carrier, decorrelate), least_squares, rtol=1e-6)


def test_the_printed_form_confuses_bits_that_decorrelation_separates(prepared, key: jm.Key, x64):
    """As printed, components of a mesh are nearly collinear: correlation mixes the bits even without an attack."""
    operator, signal = prepared
    x = jnp.asarray(signal)
    printed = carrier_of(operator, x, key, bands=32, kernel="printed", damping="none", unit_norm=False)
    damped = carrier_of(operator, x, key, bands=32)
    random = np.random.default_rng(3)
    errors = {"printed": 0, "damped": 0}
    for _ in range(50):
        bits = jnp.asarray(random.choice([-1.0, 1.0], BITS))
        for name, carrier, detector in (("printed", printed, correlate), ("damped", damped, decorrelate)):
            scores = detect_bits(embed_bits(x, bits, carrier, 1e-3), x, carrier, detector)
            errors[name] += int(np.sum(np.sign(scores) != bits))
    assert errors["printed"] > 0.1 * 50 * BITS
    assert errors["damped"] == 0


@pytest.mark.slow
def test_pure_functions_by_transformation(prepared, key: jm.Key, x64):
    operator, signal = prepared
    x = jnp.asarray(signal)
    carrier = carrier_of(operator, x, key)
    messages = jnp.asarray(np.random.default_rng(4).choice([-1.0, 1.0], (3, BITS)))
    marked = jax.jit(jax.vmap(embed_bits, (None, 0, None, None)))(x, messages, carrier, 0.01)
    scores = jax.jit(jax.vmap(lambda s: detect_bits(s, x, carrier)))(marked)
    np.testing.assert_allclose(scores, 0.01 * messages, atol=1e-7)

    def margin(suspect, original, beta):
        used = carrier_of(operator, original, key)
        return jnp.sum(messages[0] * detect_bits(suspect, original, used, decorrelate, beta))

    check_grads(jax.jit(margin), (marked[0], x, jnp.full(16, 0.1)), order=1, modes=["rev"], eps=1e-7, rtol=1e-4)
    gradients = jax.vmap(jax.grad(lambda s: jnp.sum(detect_bits(s, x, carrier) ** 2)))(marked)
    for one, suspect in zip(gradients, marked, strict=True):
        np.testing.assert_allclose(
            one, jax.grad(lambda s: jnp.sum(detect_bits(s, x, carrier) ** 2))(suspect), atol=1e-12
        )


def test_no_residual_gives_zero_scores_with_finite_gradients(prepared, key: jm.Key, x64):
    operator, signal = prepared
    x = jnp.asarray(signal)
    carrier = carrier_of(operator, x, key)
    for detector in (correlate, decorrelate):
        np.testing.assert_array_equal(detect_bits(x, x, carrier, detector), 0)
        assert np.isfinite(jax.grad(lambda s, d=detector: jnp.sum(detect_bits(s, x, carrier, d) ** 2))(x)).all()
    flat = carrier_of(operator, 0 * x, key)
    np.testing.assert_array_equal(detect_bits(x, 0 * x, flat, decorrelate), 0)


@pytest.mark.parametrize("seed", range(20))
def test_the_completed_bound_3_holds(seed, x64):
    """On random nearly orthogonal unit components, with an attack in their span."""
    random = np.random.default_rng(seed)
    n, k, beta = 16, 4, 0.5
    components = np.linalg.qr(random.normal(size=(n + 5, n)))[0] + 0.002 * random.normal(size=(n + 5, n))
    components /= np.linalg.norm(components, axis=0)
    products = components.T @ components
    coherence = np.abs(products - np.diag(np.diag(products))).max()
    sequences = orthogonal_sequences(Choices(jm.Key(bytes([seed] * 32)), b""), k, n).astype(float)
    attack = 0.1 * random.normal(size=n)
    bits = random.choice([-1.0, 1.0], k)
    scores = sequences @ (products @ (beta * sequences.T @ bits + attack))
    bound = np.asarray(correlation_bound(jnp.asarray(sequences), jnp.asarray(attack), coherence, beta))
    assert (np.abs(scores) >= bound - 1e-12).all()
    assert bound.max() > 0  # not vacuous here
    assert np.asarray(correlation_bound(jnp.asarray(sequences), jnp.asarray(attack), 0.9, beta)).max() < 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "noise"), [("keyed", 0.006), pytest.param("host", 5e-4, marks=pytest.mark.slow), ("eigen", 5e-4)]
)
def test_evidence_is_what_a_detection_says(scheme, noise, x64):
    """The pure function in nats, against the bound that is printed, which pays for other ways to align and to claim.

    The arrays are padded, from 642 points to 1,024 rows, which must not count as points that were seen.
    """
    marker = jm.make_marker(bumpy_sphere(3), jm.Key(bytes(32)), bits=16, scheme=scheme)
    marked, _ = marker.embed(b"ok", jm.Budget(rms=4e-4, noise=0), read_back="never")
    suspect = jm.attack(marked, "noise", noise, seed=0)
    original = marker.original
    moved = (np.asarray(suspect.vertices) - original.mesh.vertices)[original.weld.first] / original.diagonal
    x = jnp.asarray(original.signal)
    seen = marker.observe(marker.register(suspect))
    word = jnp.asarray(marker.codeword(b"ok"), x.dtype)

    def nats(residual):
        return log_evidence(x + residual, x, marker.reader.carrier, word)

    said = marker.detect(suspect, b"ok").log10_p
    assert -60 < said < -3
    assert nats(seen.residual) == pytest.approx(-math.log(10) * (said + 2 * math.log10(0.97)), abs=0.1)
    along = jnp.asarray(original.to_traced(moved))
    slope = jax.jvp(nats, (seen.residual,), (along,))[1]
    assert jnp.vdot(jax.grad(nats)(seen.residual), along) == pytest.approx(float(slope), rel=1e-3)


def test_soft_decisions_are_by_default_those_of_the_carriers_own_detector(prepared, key: jm.Key, x64):
    operator, signal = prepared
    marker, plain = jm.make_marker(bumpy_sphere(2), key, bits=8), carrier_of(operator, signal, key)
    for carrier, host, own in ((plain, signal, decorrelate), (marker.carrier, marker.original.signal, joint)):
        x = jnp.asarray(host)
        suspect = x + carrier.displacement(jnp.ones(carrier.code_bits), 1e-3)
        np.testing.assert_array_equal(detect_bits(suspect, x, carrier), detect_bits(suspect, x, carrier, own))
