"""What the receiver projects off, and what it measures, against dense linear algebra and least squares."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from jaxmark.alignment.observation import Observation, observe
from jaxmark.geometry.mesh import vertex_normals
from jaxmark.spectral.bands import diffusion, scaling
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, centre
from jaxmark.watermark.reading import reception
from jaxmark.watermark.reading.reception import Receiver, clean, extend, make_host, make_receiver, receive
from tests.dense import laplacian_matrix
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

BANDS = 32
PASSING = 10
FAMILY = scaling(BANDS, damping="jackson")[:PASSING]
SCALES, DEGREE = 5, 2
CONDITIONS = ["everything", "half", "weights", "normals"]


class Case(NamedTuple):
    operator: Laplacian
    x: np.ndarray  # centred
    normals: np.ndarray
    values: np.ndarray  # λ of Δ
    vectors: np.ndarray  # as columns, orthonormal in D


@pytest.fixture(scope="module")
def case() -> Case:
    """162 vertices."""
    mesh = bumpy_sphere(2)
    operator = from_mesh(mesh)
    root = np.sqrt(operator.degree)
    values, vectors = np.linalg.eigh(root[:, None] * laplacian_matrix(operator) / root)
    return Case(operator, centre(operator, mesh.vertices), vertex_normals(mesh), values, vectors / root[:, None])


def make(case: Case, dtype) -> Receiver:
    x = jnp.asarray(case.x, dtype)
    return make_receiver(make_host(case.operator, x, x + 3, FAMILY, scales=SCALES, degree=DEGREE))


def apply(case: Case, function: np.ndarray, x: np.ndarray) -> np.ndarray:
    """f(Δ)x by the eigenvectors, for the values of f at the eigenvalues."""
    return case.vectors @ (function[:, None] * (case.vectors.T @ (case.operator.degree[:, None] * x)))


def responses(case: Case) -> np.ndarray:
    """f_j(λ) at the eigenvalues, `[bands, N]`."""
    return np.polynomial.chebyshev.chebval(case.values - 1, FAMILY.T)


def bands(case: Case) -> np.ndarray:
    """f_j(Δ), dense."""
    return np.einsum("uk,jk,vk,v->juv", case.vectors, responses(case), case.vectors, case.operator.degree)


def looking(case: Case, condition: str, residual: np.ndarray, dtype) -> Observation:
    random = np.random.default_rng(1)
    weights = {
        "half": (random.uniform(size=len(residual)) < 0.5).astype(float),
        "weights": random.uniform(0.1, 1, len(residual)),
    }.get(condition, np.ones(len(residual)))
    normals = jnp.asarray(case.normals, dtype) if condition == "normals" else None
    return observe(jnp.asarray(residual, dtype), jnp.asarray(weights, dtype), normals)


def dense_nuisance(case: Case) -> np.ndarray:
    """Monomials of the position up to the degree, and the host smoothed by 1, 2, 4 … steps."""
    i, j, k = np.indices((DEGREE + 1,) * 3).reshape(3, -1)
    keep = i + j + k <= DEGREE
    columns = [np.prod(case.x**powers, axis=1) for powers in np.stack([i, j, k], axis=1)[keep]]
    smooth = np.eye(len(case.x)) - laplacian_matrix(case.operator) / 2
    for scale in range(SCALES):
        columns.extend((np.linalg.matrix_power(smooth, 2**scale) @ case.x).T)
    columns = np.stack(columns, axis=1)
    return columns / np.linalg.norm(columns, axis=0)


def dense_clean(case: Case, observation: Observation, x: np.ndarray) -> np.ndarray:
    """Ω(x - what fits best), by weighted least squares on what is seen."""
    columns, root = dense_nuisance(case), np.sqrt(np.asarray(observation.weights, np.float64))[:, None]
    if observation.normals is None:
        return root**2 * (x - columns @ np.linalg.lstsq(root * columns, root * x, rcond=1e-11)[0])
    normals = case.normals
    design = (columns[:, :, None] * normals[:, None, :]).reshape(len(x), -1)
    along = np.sum(normals * x, axis=1)
    fit = np.linalg.lstsq(root * design, root[:, 0] * along, rcond=1e-11)[0]
    return root**2 * normals * (along - design @ fit)[:, None]


def test_diffusion_is_a_power():
    values = np.linspace(0, 2, 101)
    for row, terms in ((0, 2), (2, 9), (4, 17), (6, 80)):
        found = np.polynomial.chebyshev.chebval(values - 1, diffusion(row + 1, terms)[row])
        np.testing.assert_allclose(found, (1 - values / 2) ** 2**row, atol=1e-12)
    # Cut off at 4√s, as documented.
    family = diffusion(9, 64)
    assert family.shape == (9, 64)
    for row, coefficients in enumerate(family):
        found = np.polynomial.chebyshev.chebval(values - 1, coefficients)
        np.testing.assert_allclose(found, (1 - values / 2) ** 2**row, atol=1e-6)


def test_diffusion_smooths_a_signal(case: Case, dtype):
    smooth = np.eye(len(case.x)) - laplacian_matrix(case.operator) / 2
    family = diffusion(4, BANDS)
    for row, coefficients in enumerate(family):
        expected = np.linalg.matrix_power(smooth, 2**row) @ case.x
        found = filter(case.operator, coefficients, jnp.asarray(case.x, dtype))
        np.testing.assert_allclose(found, expected, atol=1e-12 if dtype == np.float64 else 1e-5)


def test_nuisance_is_nearly_orthonormal(case: Case, dtype):
    nuisance = np.asarray(make(case, dtype).nuisance, np.float64)
    assert nuisance.shape[1] == 10 + 3 * SCALES
    products = nuisance.T @ nuisance
    kept = np.diagonal(products) > 0.5
    assert kept.sum() >= 10 + 3
    np.testing.assert_allclose(products, np.diag(kept.astype(float)), atol=1e-9 if dtype == np.float64 else 0.2)


@pytest.mark.slow
def test_nuisance_by_blocks_is_the_same(case: Case, x64, monkeypatch):
    """With a last block that is not full, and a sample that tells the basis."""
    whole = make(case, np.float64)
    observation = looking(case, "weights", np.random.default_rng(3).normal(size=case.x.shape), np.float64)
    expected = receive(whole, observation)
    jax.clear_caches()
    monkeypatch.setattr(reception, "_BLOCK_VERTICES", 50)
    monkeypatch.setattr(reception, "_SAMPLE_VERTICES", 100)
    assert len(case.x) % 50 > 0
    parts = make(case, np.float64)
    found = receive(parts, observation)
    jax.clear_caches()
    # The same span: each explains the other.
    left = parts.nuisance - whole.nuisance @ jnp.linalg.lstsq(whole.nuisance, parts.nuisance)[0]
    assert np.linalg.matrix_rank(np.asarray(parts.nuisance)) == np.linalg.matrix_rank(np.asarray(whole.nuisance))
    np.testing.assert_allclose(left, 0, atol=1e-7)
    np.testing.assert_allclose(found.residual, expected.residual, atol=1e-7 * np.abs(expected.residual).max())
    np.testing.assert_allclose(found.power, expected.power, rtol=1e-5)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_nuisance_is_projected_off(condition, case: Case, dtype):
    """Affine maps, polynomials and smoothings of the host, and what is mixed of them."""
    random = np.random.default_rng(2)
    host, columns = make(case, dtype), dense_nuisance(case)
    affine = np.hstack([case.x, np.ones((len(case.x), 1))])
    smoothed = apply(case, (1 - case.values / 2) ** 8, case.x)
    tolerance = 1e-10 if dtype == np.float64 else 2e-4
    for nuisance in (
        affine @ random.normal(size=(4, 3)),
        columns[:, :10] @ random.normal(size=(10, 3)),
        smoothed - case.x,
        1.1 * smoothed @ random.normal(size=(3, 3)) - case.x + 0.1,
        columns @ random.normal(size=(columns.shape[1], 3)),
    ):
        observation = looking(case, condition, nuisance, dtype)
        received = receive(host, observation)
        once = clean(host, received.observation, received.factor, observation.residual)
        for left in (once, received.residual):
            assert left.dtype == dtype
            assert np.linalg.norm(left) < tolerance * np.linalg.norm(nuisance)
    other = looking(case, condition, random.normal(size=case.x.shape), dtype)
    left = clean(host, other, receive(host, other).factor, other.residual)
    assert np.linalg.norm(left) > 0.2 * np.linalg.norm(other.residual)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_clean_is_a_weighted_projection(condition, case: Case, x64):
    random = np.random.default_rng(3)
    host = make(case, np.float64)
    a, b = random.normal(size=(2, *case.x.shape))
    received = receive(host, looking(case, condition, a, np.float64))
    observation = received.observation

    def project(x):
        return np.asarray(clean(host, observation, received.factor, jnp.asarray(x)))

    scale = np.abs(project(a)).max()
    np.testing.assert_allclose(project(a), dense_clean(case, observation, a), atol=1e-7 * scale)
    np.testing.assert_allclose(received.residual, dense_clean(case, observation, a) @ received.axes, atol=1e-7 * scale)
    assert np.vdot(project(a), b) == pytest.approx(np.vdot(a, project(b)), rel=1e-9, abs=1e-9 * scale)
    # Without the weights it changes nothing when it is done again.
    weights = np.asarray(observation.weights)[:, None]
    bare = np.divide(project(a), weights, out=np.zeros_like(a), where=weights > 0)
    np.testing.assert_allclose(project(bare), project(a), atol=1e-7 * scale)


@pytest.mark.parametrize("condition", ["everything", "half", "normals"])
@pytest.mark.parametrize("kind", ["natural", "rough"])
def test_gain_is_the_response_of_a_smoothing(kind, condition, case: Case, dtype):
    """On bands where the host has energy: the mean response, and on a rough host nearly that at the band's centre."""
    x = case.x
    if kind == "rough":
        x = centre(case.operator, x + 0.3 * np.random.default_rng(6).normal(size=x.shape))
    signal = jnp.asarray(x, dtype)
    host = make_receiver(make_host(case.operator, signal, signal, FAMILY, scales=SCALES, degree=DEGREE))
    family = responses(case)
    spectrum = np.sum((case.vectors.T @ (case.operator.degree[:, None] * x)) ** 2, axis=1)
    energy = family**2 @ spectrum
    strong = energy > 1e-4 * energy.max()
    assert strong.sum() >= 6
    centres = 1 - np.cos((2 * np.arange(PASSING) + 1) * np.pi / (2 * BANDS))
    for steps in (2, 8):
        response = (1 - case.values / 2) ** steps
        residual = apply(case, response - 1, x)
        gain = np.asarray(receive(host, looking(case, condition, residual, dtype)).gain)
        assert gain.dtype == dtype
        mean = family**2 @ (response * spectrum) / energy
        np.testing.assert_allclose(gain[strong], mean[strong], atol=1e-6 if dtype == np.float64 else 2e-2)
        if kind == "rough":
            # Below its lowest eigenvalues a mesh has nothing: those bands see only what leaks in.
            own = centres > case.values[4]
            np.testing.assert_allclose(gain[own], ((1 - centres / 2) ** steps)[own], atol=0.06)


@pytest.mark.parametrize("steps", [0, 4])
@pytest.mark.parametrize("condition", ["everything", "half"])
def test_power_is_the_spectrum_of_noise(steps, condition, case: Case, x64):
    """White noise is flat, and noise that was filtered shows its filter, within the sampling error."""
    # With little nuisance, or the low bands would be nothing else.
    x, family = jnp.asarray(case.x), responses(case)
    host = make_receiver(make_host(case.operator, x, x, FAMILY, scales=0, degree=1))
    response = (1 - case.values / 2) ** steps
    dimensions = 3 * (family**2).sum(axis=1) ** 2 / (family**4).sum(axis=1)
    expected = family**2 @ response**2 / (family**2).sum(axis=1)
    logarithms = []
    for seed in range(20):
        noise = apply(case, response, np.random.default_rng(seed).normal(size=case.x.shape))
        power = np.asarray(receive(host, looking(case, condition, noise, np.float64)).power)
        assert power.max() == pytest.approx(1)
        logarithms.append(np.log(power / expected))
    # Up to a common factor. The lowest bands are mostly nuisance.
    ratio = np.mean(logarithms, axis=0)[3:]
    error = 6 * np.sqrt(2 / dimensions[3:] * (1 / 20 + 1))
    assert (np.abs(ratio - ratio.mean()) < error).all()


@pytest.mark.parametrize("condition", CONDITIONS)
def test_what_a_suspect_explains_is_projected_off_too(condition, case: Case, x64):
    random = np.random.default_rng(8)
    host, columns = make(case, np.float64), random.normal(size=(len(case.x), 2))
    both = np.concatenate([columns, columns[:, :1] + np.asarray(host.nuisance)[:, :1]], axis=1)  # one depends on others
    observation = looking(case, condition, columns @ random.normal(size=(2, 3)), np.float64)
    assert extend(host, observation) is host
    assert np.abs(receive(host, observation).residual).max() > 0.1
    wide = extend(host, observation._replace(nuisance=jnp.asarray(1e-3 * both)))
    assert np.linalg.matrix_rank(np.asarray(wide.nuisance)) == np.linalg.matrix_rank(np.asarray(host.nuisance)) + 2
    assert np.abs(receive(wide, observation).residual).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("condition", ["everything", "half", "weights"])
def test_axes_make_directions_alike(condition, case: Case, x64):
    """The inverse root of the covariance of noise, by SciPy, whatever its colour."""
    x, random = jnp.asarray(case.x), np.random.default_rng(6)
    host = make_receiver(make_host(case.operator, x, x, FAMILY, scales=0, degree=1))
    stretch = random.normal(size=(3, 3)) + np.diag([4.0, 1.0, 1.0])
    root = np.linalg.inv(linalg.sqrtm(stretch.T @ stretch))
    found = []
    for _ in range(20):
        noise = apply(case, (1 - case.values / 2) ** 2, random.normal(size=x.shape)) @ stretch
        received = receive(host, looking(case, condition, noise, np.float64))
        equal = np.einsum("j,juv->uv", 1 / np.sqrt(received.power), bands(case)) @ received.residual
        products = equal.T @ equal
        # Up to what keeps a direction without noise from counting for everything.
        np.testing.assert_allclose(products / np.trace(products), np.eye(3) / 3, atol=2e-2)
        found.append(received.axes)
    np.testing.assert_allclose(np.mean(found, axis=0), 3 * root / np.trace(root), atol=0.1)
    along = receive(host, looking(case, "normals", noise, np.float64))
    np.testing.assert_array_equal(along.axes, np.eye(3))


def test_strange_points_count_for_less(case: Case, x64):
    """Huber's weights by their definition, on the residual without its nuisance."""
    random = np.random.default_rng(4)
    host = make(case, np.float64)
    residual = random.normal(size=case.x.shape)
    residual[[3, 50, 120]] *= 30
    plain = looking(case, "everything", residual, np.float64)
    received = receive(host, plain)
    square = np.sum(dense_clean(case, plain, residual) ** 2, axis=1)
    expected = np.minimum(1, 4 * np.median(square) / square)
    np.testing.assert_allclose(received.observation.weights, expected, rtol=1e-6)
    assert np.asarray(received.observation.weights)[[3, 50, 120]].max() < 0.05
    assert np.mean(np.asarray(received.observation.weights) == 1) > 0.8
    # Those that are masked neither count nor set the limit.
    masked = looking(case, "half", residual, np.float64)
    received = receive(host, masked)
    visible = np.asarray(masked.weights) > 0
    square = np.sum(dense_clean(case, masked, residual) ** 2, axis=1)
    expected = np.where(visible, np.minimum(1, 4 * np.median(square[visible]) / np.where(visible, square, 1)), 0)
    np.testing.assert_allclose(received.observation.weights, expected, rtol=1e-6)


def test_what_was_meshed_anew_is_weighed_by_the_energy_around_each_point(case: Case, x64):
    """Three rounds of dense projections and averages; what is rough on a third of the surface counts for little."""
    random = np.random.default_rng(6)
    rough = case.x[:, 2] > np.quantile(case.x[:, 2], 0.7)
    noise = random.normal(size=(len(case.x), 1)) * case.normals * np.where(rough, 30, 1)[:, None]
    observation = looking(case, "normals", noise, np.float64)
    weights = np.asarray(receive(make(case, np.float64), observation).observation.weights)
    average = np.linalg.matrix_power(np.eye(len(case.x)) - laplacian_matrix(case.operator) / 2, 16)
    expected = np.ones(len(case.x))
    for _ in range(3):
        rest = dense_clean(case, observation._replace(weights=jnp.asarray(expected)), noise) / expected[:, None]
        energy = average @ np.sum(rest**2, axis=1)
        expected = 1 / (energy / np.median(energy) + 0.25)
    np.testing.assert_allclose(weights, expected, rtol=1e-6)
    assert np.median(weights[rough]) < 0.3 * np.median(weights[~rough])


def test_no_residual_and_nothing_seen(case: Case, dtype):
    host = make(case, dtype)
    zero, one = jnp.zeros(case.x.shape, dtype), jnp.ones(case.x.shape, dtype)
    for seen in (observe(zero), observe(zero, normals=jnp.asarray(case.normals, dtype)), observe(one, zero[:, 0])):
        received = receive(host, seen)
        np.testing.assert_array_equal(received.residual, 0)
        np.testing.assert_array_equal(received.power, 1)
        assert np.isfinite(received.factor).all()
        assert np.isfinite(received.gain).all()
    np.testing.assert_array_equal(receive(host, observe(zero)).gain, 1)


def test_a_host_without_extent_is_finite(case: Case, dtype):
    """A flat host has columns that are zero, or alike: they are dropped."""
    flat = jnp.asarray(case.x * [1, 1, 0], dtype)
    for signal in (flat, 0 * flat):
        host = make_receiver(make_host(case.operator, signal, signal, FAMILY, scales=SCALES, degree=DEGREE))
        received = receive(host, observe(jnp.ones_like(signal)))
        for part in jax.tree.leaves(received):
            assert np.isfinite(part).all()
        assert np.linalg.norm(received.residual) < 1e-4


@pytest.mark.parametrize("normals", [False, True])
def test_differentiable_with_respect_to_suspect_and_original(normals: bool, case: Case, x64):
    """By finite differences along random ways, under jit."""
    random = np.random.default_rng(5)
    x, along = jnp.asarray(case.x), jnp.asarray(case.normals) if normals else None

    def loss(suspect, original):
        host = make_receiver(make_host(case.operator, original, original, FAMILY, scales=SCALES, degree=DEGREE))
        received = receive(host, observe(suspect - original, normals=along))
        return (
            jnp.sum(jnp.sin(20 * received.residual))
            + jnp.sum(received.gain)
            + jnp.sum(jnp.sin(received.power))
            + jnp.sum(jnp.sin(received.axes * jnp.arange(3.0)))
        )

    value_and_slopes = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    suspect = jnp.asarray(apply(case, (1 - case.values / 2) ** 2, case.x) + 0.02 * random.normal(size=x.shape))
    for point in ((suspect, x), (x, x)):
        value, slopes = value_and_slopes(*point)
        assert np.isfinite(value)
        for slope in slopes:
            assert np.isfinite(slope).all()
    _, slopes = value_and_slopes(suspect, x)
    for which, slope in enumerate(slopes):
        for _ in range(3):
            # The fit of the nuisance magnifies rounding, which on GPUs differs from run to run, so steps are not small.
            way = jnp.asarray(1e-5 * random.normal(size=x.shape))
            ends = [
                value_and_slopes(*((suspect + s * way, x) if which == 0 else (suspect, x + s * way)))[0]
                for s in (1, -1)
            ]
            assert float(jnp.vdot(slope, way)) == pytest.approx(float(ends[0] - ends[1]) / 2, rel=1e-3)
