"""The keyed carrier and its joint detector, against dense linear algebra."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.observation import Observation, observe
from jaxmark.geometry.mesh import vertex_normals
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, centre
from jaxmark.watermark.bits import detect_bits, embed_bits
from jaxmark.watermark.carriers import Carrier, KeyedCarrier, KeyedReader, ModulatedCarrier, host_bands, make_chips
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.reading import detectors
from jaxmark.watermark.reading.detectors import joint
from jaxmark.watermark.reading.reception import Reception, make_host, make_receiver, receive
from tests.dense import chebyshev_matrices
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

GEOMETRY = b"g" * 32
FAMILY = scaling(16, damping="jackson")[:6]
BITS = 5


class Case(NamedTuple):
    operator: Laplacian
    x: np.ndarray  # centred
    normals: np.ndarray
    moving: np.ndarray
    terms: np.ndarray  # T_k(Δ - I)
    filters: np.ndarray  # f_j(Δ)


def make_case(level: int) -> Case:
    mesh = bumpy_sphere(level)
    operator = from_mesh(mesh, "inverse-length")
    moving = np.arange(len(mesh.vertices)) % 7 != 3
    terms = chebyshev_matrices(operator, FAMILY.shape[1] - 1)
    filters = np.einsum("jk,kuv->juv", FAMILY, terms)
    return Case(operator, centre(operator, mesh.vertices), vertex_normals(mesh), moving, terms, filters)


@pytest.fixture(scope="module")
def small() -> Case:
    """42 vertices."""
    return make_case(1)


@pytest.fixture(scope="module")
def medium() -> Case:
    """162 vertices."""
    return make_case(2)


def places(moving: np.ndarray) -> np.ndarray:
    """Number of each vertex among those that move, or -1."""
    return np.where(moving, np.cumsum(moving) - 1, -1)


def make_carrier(case: Case, key: bytes, dtype, direction="coordinates", bits=BITS, moving=None) -> KeyedCarrier:
    x = jnp.asarray(case.x, dtype)
    host = make_host(case.operator, x, x, FAMILY, scales=2, degree=1)
    chips = make_chips(
        Choices(jm.Key(key), GEOMETRY),
        places(case.moving if moving is None else moving),
        bits,
        channels=3 if direction == "coordinates" else 1,
    )
    return KeyedCarrier(host, chips, None if direction == "coordinates" else jnp.asarray(case.normals, dtype))


def shaping(case: Case, strength: np.ndarray, direction: str) -> np.ndarray:
    """From chips `[N · channels]` to the displacement `[3N]`, dense; strength is `[bands, 3]`, or `[bands, 1]`."""
    count = len(case.x)
    if direction == "normals":
        filter = np.einsum("j,juv->uv", strength[:, 0], case.filters)
        return (case.normals[:, :, None] * filter[:, None, :]).reshape(3 * count, count)
    return np.einsum("jc,juv,cd->ucvd", strength, case.filters, np.eye(3)).reshape(3 * count, 3 * count)


def spreading(carrier: KeyedCarrier) -> np.ndarray:
    """From bits to chips, dense."""
    slots, signs = np.ravel(carrier.chips.slots), np.ravel(carrier.chips.signs)
    matrix = np.zeros((len(slots), len(carrier.chips.population)))
    matrix[np.arange(len(slots)), slots] = signs
    return matrix


def close(actual, expected, dtype, factor=1.0):
    """Relative to the whole."""
    expected = np.asarray(expected)
    error = np.linalg.norm((np.asarray(actual, np.float64) - expected).ravel()) / np.linalg.norm(expected.ravel())
    assert error < factor * (1e-11 if dtype == np.float64 else 1e-5)


@pytest.mark.parametrize(
    ("direction", "beta"),
    [
        ("coordinates", "scalar"),
        ("coordinates", "per band"),
        ("coordinates", "per band and coordinate"),
        ("normals", "scalar"),
        ("normals", "per band"),
    ],
)
def test_against_dense_algebra(direction, beta, small: Case, key: jm.Key, dtype):
    random = np.random.default_rng(0)
    bands, channels = len(FAMILY), 3 if direction == "coordinates" else 1
    strength = {"scalar": 0.7, "per band": random.uniform(size=bands)}.get(beta, random.uniform(size=(bands, 3)))
    full = np.broadcast_to(np.atleast_2d(np.asarray(strength).T).T, (bands, channels))
    carrier = make_carrier(small, key, dtype, direction)
    assert isinstance(carrier, Carrier)
    shaped, spread = shaping(small, full, direction), spreading(carrier)
    columns = shaped @ spread
    mass = np.repeat(small.operator.degree, 3)
    amplitudes, residual = random.normal(size=BITS), random.normal(size=small.x.shape)
    chips = random.normal(size=carrier.chips.signs.shape)
    given = jnp.asarray(strength, dtype)
    observation, bits = jnp.asarray(residual, dtype), jnp.asarray(amplitudes, dtype)
    shape = carrier.coefficients(given)

    displacement = carrier.displacement(bits, given)
    assert displacement.dtype == dtype
    close(displacement, (columns @ amplitudes).reshape(-1, 3), dtype)
    close(carrier.adjoint(observation, given), columns.T @ (mass * residual.ravel()), dtype)
    close(carrier.gram(given), columns.T @ (mass[:, None] * columns), dtype)
    close(carrier.modulate(bits, shape), (columns @ amplitudes).reshape(-1, 3), dtype)
    close(carrier.correlate(observation, shape), columns.T @ residual.ravel(), dtype)
    close(carrier.filter_chips(jnp.asarray(chips, dtype), shape), (shaped @ chips.ravel()).reshape(-1, 3), dtype)
    close(carrier.match_chips(observation, shape), (shaped.T @ residual.ravel()).reshape(-1, channels), dtype)
    if beta != "scalar":
        weight = random.uniform(size=bands)
        weighed = shaping(small, weight[:, None] * full, direction)
        shape = carrier.coefficients(given, jnp.asarray(weight, dtype))
        close(carrier.match_chips(observation, shape), (weighed.T @ residual.ravel()).reshape(-1, channels), dtype)


@pytest.mark.parametrize("direction", ["coordinates", "normals"])
def test_linear_and_its_adjoint_the_transpose(direction, small: Case, key: jm.Key, x64):
    """By JAX's own transposition, in the D inner product."""
    carrier = make_carrier(small, key, np.float64, direction)
    random = np.random.default_rng(1)
    a, b = (jnp.asarray(random.normal(size=BITS)) for _ in range(2))
    beta, other = (jnp.asarray(random.uniform(size=len(FAMILY))) for _ in range(2))
    np.testing.assert_allclose(
        carrier.displacement(2 * a - b, beta),
        2 * carrier.displacement(a, beta) - carrier.displacement(b, beta),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        carrier.displacement(a, 2 * beta - other),
        2 * carrier.displacement(a, beta) - carrier.displacement(a, other),
        atol=1e-12,
    )
    residual = jnp.asarray(random.normal(size=small.x.shape))
    mass = jnp.asarray(small.operator.degree)[:, None]
    (cotangent,) = jax.vjp(lambda bits: carrier.displacement(bits, beta), jnp.zeros(BITS))[1](mass * residual)
    np.testing.assert_allclose(carrier.adjoint(residual, beta), cotangent, atol=1e-10)


@pytest.mark.parametrize("direction", ["coordinates", "normals"])
def test_claim_is_a_sum_over_keyed_signs(direction, small: Case, key: jm.Key, dtype):
    """S = Σ s·a: turning one keyed sign turns its term in S and leaves ‖a‖ alone, and the terms are a."""
    carrier = make_carrier(small, key, dtype, direction)
    random = np.random.default_rng(2)
    residual = jnp.asarray(1e-3 * random.normal(size=small.x.shape), dtype)
    weights = jnp.asarray(random.uniform(size=len(small.x)) * (random.uniform(size=len(small.x)) < 0.7), dtype)
    observation = observe(residual, weights)
    bits = jnp.asarray(random.choice([-1.0, 1.0], BITS), dtype)
    score, norm = carrier.claim(observation, bits)
    assert score.dtype == norm.dtype == dtype
    terms = np.zeros(carrier.chips.signs.shape)
    for place in np.argwhere(carrier.chips.signs):
        turned = carrier.chips.signs.copy()
        turned[tuple(place)] *= -1
        other, same = carrier._replace(chips=carrier.chips._replace(signs=turned)).claim(observation, bits)
        terms[tuple(place)] = (float(score) - float(other)) / 2
        assert float(same) == float(norm)
    tolerance = 1e-9 if dtype == np.float64 else 1e-3
    assert terms.sum() == pytest.approx(float(score), rel=tolerance, abs=tolerance * float(norm))
    assert np.linalg.norm(terms) == pytest.approx(float(norm), rel=tolerance)
    reader = carrier.reader()
    matched = np.asarray(reader.matched_residual(reader.receive(observation)), np.float64)
    expected = matched * carrier.chips.signs * np.asarray(bits)[carrier.chips.slots]
    np.testing.assert_allclose(terms, expected, atol=tolerance * float(norm))
    assert np.abs(matched[~small.moving]).max() > 0  # and yet it takes no part


@pytest.mark.parametrize("direction", ["coordinates", "normals"])
def test_what_signs_multiply_depends_on_no_key(direction, small: Case, key: jm.Key, x64):
    moving = np.ones(len(small.x), bool)
    random = np.random.default_rng(3)
    residual = random.normal(size=small.x.shape)
    bits = random.choice([-1.0, 1.0], BITS)
    norms, vectors, scores = [], [], []
    for secret in (key, jm.Key(bytes(32)), jm.Key(b"z" * 32)):
        carrier = make_carrier(small, secret, np.float64, direction, moving=moving)
        observation = observe(jnp.asarray(residual))
        reader = carrier.reader()
        vectors.append(np.asarray(reader.matched_residual(reader.receive(observation))))
        score, norm = carrier.claim(observation, jnp.asarray(bits))
        norms.append(float(norm))
        scores.append(float(score))
    assert norms[0] == norms[1] == norms[2]
    for vector in vectors[1:]:
        np.testing.assert_array_equal(vector, vectors[0])
    assert norms[0] == pytest.approx(np.linalg.norm(vectors[0]))
    assert len(set(scores)) == 3


def test_golden_chips(key: jm.Key):
    """Held exactly, for ever."""
    moving = np.array([True, True, False, True, True])
    chips = make_chips(Choices(key, GEOMETRY), places(moving), 5)
    assert chips.signs.tolist() == [[1, -1, 1], [1, -1, -1], [0, 0, 0], [1, -1, 1], [1, 1, -1]]
    assert chips.slots.tolist() == [[2, 0, 0], [1, 1, 2], [0, 0, 0], [4, 1, 0], [3, 3, 4]]
    assert chips.population.tolist() == [3, 3, 2, 2, 2]
    along = make_chips(Choices(key, GEOMETRY), places(moving), 2, channels=1)
    assert along.signs.ravel().tolist() == [-1, -1, 0, -1, -1]
    assert along.slots.ravel().tolist() == [1, 0, 0, 1, 0]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("bits", [1, 7, 64])
def test_every_bit_has_as_many_chips(bits, channels, key: jm.Key):
    moving = np.random.default_rng(4).uniform(size=201) < 0.8
    chips = make_chips(Choices(key, GEOMETRY), places(moving), bits, channels=channels)
    total = channels * moving.sum()
    assert chips.population.sum() == total
    assert set(chips.population.tolist()) <= {total // bits, -(-total // bits)}
    np.testing.assert_array_equal(np.bincount(chips.slots[moving].ravel(), minlength=bits), chips.population)
    assert (chips.signs[~moving] == 0).all()
    assert (np.abs(chips.signs[moving]) == 1).all()
    for one, again in zip(
        chips, make_chips(Choices(key, GEOMETRY), places(moving), bits, channels=channels), strict=True
    ):
        np.testing.assert_array_equal(one, again)


def test_keys_meshes_and_layouts_share_nothing(key: jm.Key):
    moving = np.ones(6000, bool)
    base = make_chips(Choices(key, GEOMETRY), places(moving), 50)
    for other in (
        make_chips(Choices(jm.Key(bytes(32)), GEOMETRY), places(moving), 50),
        make_chips(Choices(key, b"h" * 32), places(moving), 50),
        make_chips(Choices(key, GEOMETRY), places(moving), 51),
        make_chips(Choices(key, GEOMETRY), places(moving), 50, channels=1),
    ):
        count = other.signs.size
        assert abs(np.vdot(base.signs.ravel()[:count].astype(int), other.signs.ravel())) < 6 * np.sqrt(count)
        same = np.mean(base.slots.ravel()[:count] == other.slots.ravel())
        assert abs(same - 1 / 50) < 6 * np.sqrt(0.02 * 0.98 / count)
    # Neither do the signs tell the slots, nor the order of the vertices.
    deviation = 6 / np.sqrt(base.signs.size)
    assert abs(np.corrcoef(base.signs.ravel(), base.slots.ravel())[0, 1]) < deviation
    assert abs(np.corrcoef(np.arange(base.slots.size), base.slots.ravel())[0, 1]) < deviation


CONDITIONS = ["everything", "half", "weights", "normals"]


def make_seen(case: Case, condition: str, residual, dtype) -> Observation:
    """A residual of which only something is seen; what is not is nonsense."""
    random = np.random.default_rng(5)
    weights, normals = np.ones(len(residual)), None
    if condition == "half":
        weights = (random.uniform(size=len(residual)) < 0.5).astype(float)
        residual = np.where(weights[:, None] > 0, residual, 0.3)
    elif condition == "weights":
        weights = random.uniform(0.1, 1, len(residual))
    elif condition == "normals":
        normals = case.normals
        residual = normals * np.sum(normals * residual, axis=1, keepdims=True)
    return observe(
        jnp.asarray(residual, dtype),
        jnp.asarray(weights, dtype),
        None if normals is None else jnp.asarray(normals, dtype),
    )


@pytest.mark.parametrize("condition", CONDITIONS)
def test_joint_reads(condition, medium: Case):
    check_reading(condition, "coordinates", medium, np.float32)


@pytest.mark.slow
def test_joint_reads_in_double_precision(medium: Case, x64):
    check_reading("everything", "coordinates", medium, np.float64)


def test_joint_reads_chips_along_normals(medium: Case):
    for condition in ("half", "weights"):
        check_reading(condition, "normals", medium, np.float32)


def check_reading(condition, direction, case: Case, dtype):
    """Read under several keys: where little is seen, the chips of some leave a bit undecided."""
    bits, read = 8, []
    message = np.random.default_rng(6).choice([-1.0, 1.0], bits)
    beta = jnp.asarray(1e-3 * np.linspace(1, 0.5, len(FAMILY)), dtype)
    x = jnp.asarray(case.x, dtype)
    for number in range(6):
        carrier = make_carrier(case, jm.Key(bytes([number] * 32)), dtype, direction, bits)
        marked = embed_bits(x, jnp.asarray(message, dtype), carrier, beta)
        observation = make_seen(case, condition, np.asarray(marked - x), dtype)
        known = {"weights": observation.weights, "normals": observation.normals}
        soft = detect_bits(x + observation.residual, x, carrier, joint, beta, **known)
        assert soft.dtype == dtype
        read.append(np.asarray(soft) * message)
    assert np.sum(np.array(read) <= 0) <= (2 if condition == "normals" else 0)
    if condition == "everything":
        # As promised: ±1 on average.
        assert np.mean(read) == pytest.approx(1, abs=0.15)


@jax.jit
def solved(reader: KeyedReader, received: Reception, beta: jax.Array) -> jax.Array:
    """The joint detector, run to the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detectors, "_TOLERANCE", 1e-14)
        patch.setattr(detectors, "_MAX_ITERATIONS", 500)
        return joint.__wrapped__(reader, received, beta)  # pyright: ignore[reportFunctionMemberAccess]


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_joint_is_regularised_least_squares(condition, noise, small: Case, key: jm.Key, x64):
    """(AᵀA + ρ)⁻¹Aᵀy with dense matrices, A = whitening · axes · weighted projector · shaped chips · signs."""
    carrier = make_carrier(small, key, np.float64)
    random = np.random.default_rng(7)
    message = random.choice([-1.0, 1.0], BITS)
    beta = random.uniform(0.5, 1, len(FAMILY))
    residual = np.asarray(carrier.displacement(jnp.asarray(message), jnp.asarray(beta)))
    residual = residual + noise * residual.std() * random.normal(size=residual.shape) @ np.diag([1.0, 4.0, 0.5])
    observation = make_seen(small, condition, 1e-3 * residual, np.float64)
    reader = carrier.reader()
    soft = np.asarray(solved(reader, reader.receive(observation), jnp.asarray(beta)))

    products, matched = dense_equations(small, carrier, observation, beta)
    # With one ρ > 0 for all bits, whatever it is.
    ridge = soft @ (matched - products @ soft) / (soft @ soft)
    assert ridge > 0
    expected = np.linalg.solve(products + ridge * np.eye(BITS), matched)
    np.testing.assert_allclose(soft, expected, atol=1e-7 * np.abs(expected).max())


def dense_equations(case: Case, carrier: KeyedCarrier, observation: Observation, beta) -> tuple[np.ndarray, np.ndarray]:
    """AᵀA and Aᵀy, given what is received."""
    received = receive(make_receiver(carrier.host), observation)
    clean = dense_clean(carrier, received.observation)
    whitening = np.kron(np.einsum("j,juv->uv", 1 / np.sqrt(received.power), case.filters), received.axes)
    model = shaping(case, (np.asarray(received.gain) * beta)[:, None] * np.ones(3), "coordinates")
    system = whitening @ clean @ model @ spreading(carrier)
    return system.T @ system, system.T @ whitening @ clean @ np.asarray(observation.residual).ravel()


def dense_clean(carrier: KeyedCarrier, observation: Observation) -> np.ndarray:
    """x ↦ Ω(x - best nuisance), as a matrix `[3N, 3N]`, by least squares on what is seen."""
    count = len(observation.weights)
    columns = np.kron(np.asarray(make_receiver(carrier.host).nuisance), np.eye(3))
    look = np.eye(3 * count)
    if observation.normals is not None:
        look = np.zeros((count, count, 3))
        look[np.arange(count), np.arange(count)] = np.asarray(observation.normals)
        look = look.reshape(count, 3 * count)
    weights = np.repeat(np.asarray(observation.weights), len(look) // count)
    root = np.sqrt(weights)[:, None] * look
    fit = np.linalg.lstsq(root @ columns, root, rcond=None)[0]
    return look.T @ (weights[:, None] * look) @ (np.eye(3 * count) - columns @ fit)


@pytest.mark.parametrize("direction", ["coordinates", "normals"])
def test_projected_correlations_by_dense_algebra(direction, small: Case, key: jm.Key, dtype):
    carrier, random = make_carrier(small, key, dtype, direction), np.random.default_rng(11)
    normals = carrier.normals if direction == "normals" else None
    weights = jnp.asarray(random.uniform(0.1, 1, len(small.x)), dtype)
    observation = observe(jnp.asarray(random.normal(size=small.x.shape), dtype), weights, normals)
    beta = random.uniform(size=len(FAMILY))
    mark = shaping(small, beta[:, None] * np.ones(len(carrier.chips.signs[0])), direction) @ spreading(carrier)
    expected = mark.T @ dense_clean(carrier, observation) @ np.asarray(observation.residual, np.float64).ravel()
    close(carrier.reader().read_quickly(observation, jnp.asarray(beta, dtype)), expected, dtype, factor=100)


@pytest.mark.slow
def test_no_residual_gives_zero_scores_with_finite_gradients(small: Case, key: jm.Key):
    """In float32, where more underflows."""
    x = jnp.asarray(small.x, jnp.float32)
    carrier = make_carrier(small, key, np.float32)

    @jax.jit
    def soft_and_slope(suspect, weights):
        soft, pull = jax.vjp(lambda s: detect_bits(s, x, carrier, joint, weights=weights), suspect)
        return soft, pull(jnp.ones_like(soft))[0]

    for suspect, weights in ((x, jnp.ones(len(x), x.dtype)), (x + 1, jnp.zeros(len(x), x.dtype))):
        soft, slope = soft_and_slope(suspect, weights)
        np.testing.assert_array_equal(soft, 0)
        assert np.isfinite(slope).all()
        np.testing.assert_array_equal(carrier.claim(observe(suspect - x, weights), jnp.ones(BITS, x.dtype)), 0)


@pytest.mark.slow
def test_pure_functions_by_transformation(medium: Case, key: jm.Key, x64):
    carrier, x = make_carrier(medium, key, np.float64, bits=8), jnp.asarray(medium.x)
    messages = jnp.asarray(np.random.default_rng(8).choice([-1.0, 1.0], (3, 8)))
    beta = jnp.full(len(FAMILY), 1e-3)
    marked = jax.jit(jax.vmap(embed_bits, (None, 0, None, None)))(x, messages, carrier, beta)
    scores = jax.jit(jax.vmap(lambda s: detect_bits(s, x, carrier, joint, beta)))(marked)
    for suspect, message, soft in zip(marked, messages, scores, strict=True):
        np.testing.assert_allclose(suspect, embed_bits(x, message, carrier, beta), atol=1e-14)
        np.testing.assert_allclose(
            soft, detect_bits(suspect, x, carrier, joint, beta, weights=jnp.ones(len(x))), rtol=1e-6, atol=1e-6
        )
        np.testing.assert_array_equal(np.sign(soft), message)


@pytest.fixture
def fresh_traces() -> Iterator[None]:
    """What is patched for a test shows in what it traces, and in nothing that is traced after it."""
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_traces", "x64")
def test_differentiable_with_respect_to_suspect_original_and_strength(small: Case, key: jm.Key, monkeypatch):
    """By finite differences. The ridge is not differentiated on purpose; here it is, and all else has to fit."""
    stop = jax.lax.stop_gradient
    monkeypatch.setattr(jax.lax, "stop_gradient", lambda x: x if getattr(x, "ndim", 1) == 0 else stop(x))
    chips = make_chips(Choices(key, GEOMETRY), places(small.moving), BITS)
    random = np.random.default_rng(9)
    message = jnp.asarray(random.choice([-1.0, 1.0], BITS))

    untraced = solved.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]

    def margin(suspect, original, beta):
        host = make_host(small.operator, original, original, FAMILY, scales=2, degree=1)
        soft = detect_bits(suspect, original, KeyedCarrier(host, chips), untraced, beta)
        return jnp.sum(jnp.sin(soft * message))

    value_and_slopes = jax.jit(jax.value_and_grad(margin, argnums=(0, 1, 2)))
    x, beta = jnp.asarray(small.x), jnp.linspace(1, 0.5, len(FAMILY))
    mark = make_carrier(small, key, np.float64).displacement(message, beta)
    noise = jnp.asarray(0.3 * float(mark.std()) * random.normal(size=x.shape))
    point = (0.98 * x + 0.01 * (mark + noise), x, 0.01 * beta)
    value, slopes = value_and_slopes(*point)
    assert 0.1 < abs(float(value)) < BITS
    for which, (start, slope) in enumerate(zip(point, slopes, strict=True)):
        for _ in range(3):
            way = jnp.asarray(1e-6 * random.normal(size=start.shape)) * jnp.abs(start).mean()
            ahead, behind = (value_and_slopes(*point[:which], start + s * way, *point[which + 1 :])[0] for s in (1, -1))
            assert float(jnp.vdot(slope, way)) == pytest.approx(float(ahead - behind) / 2, rel=1e-4)


def test_a_carrier_without_a_host_is_refused_without_a_host(small: Case, x64):
    x = jnp.asarray(small.x)
    carrier = ModulatedCarrier(host_bands(small.operator, x, FAMILY), np.ones((2, len(FAMILY), 3), np.int8))
    with pytest.raises(jm.JaxmarkError, match="keyed carriers, not ModulatedCarrier"):
        joint(carrier.reader(), observe(x))
