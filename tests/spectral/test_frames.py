"""Frames: bounds against a fine grid and known cases, the way back against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.polynomial import chebyshev

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import band_components, bands, frame_bounds, frames, from_mesh, inverse, synthesise, tight
from jaxmark.spectral.laplacian import Laplacian
from tests import ROOT
from tests.dense import chebyshev_matrices
from tests.samples import ordered_laplacian

pytestmark = pytest.mark.core

BANKS = {
    "mexican hat": bands.mexican_hat(5, 60),
    "spline": bands.abspline(6, 60),
    "Meyer": bands.meyer(4),
    "itersine": bands.itersine(6, 24),
    "scaling": bands.scaling(12),
    "damped": bands.scaling(12, damping="jackson"),
    "heat": np.vstack([bands.heat([1.0, 5.0], 30), np.eye(1, 31)]),
}


@pytest.fixture(scope="module")
def operator(hard_graph: Mesh) -> Laplacian:
    return ordered_laplacian(hard_graph, "inverse-length")


def power(bank: np.ndarray, values: np.ndarray) -> np.ndarray:
    return (chebyshev.chebval(values - 1, np.asarray(bank).T) ** 2).sum(axis=0)


@pytest.mark.parametrize("name", BANKS)
def test_bounds_hold_and_are_sharp(name):
    """Against the extremes, at the ends and at the roots of the derivative."""
    series = np.zeros(1)
    for row in BANKS[name]:
        series = chebyshev.chebadd(series, chebyshev.chebmul(row, row))
    roots = chebyshev.chebroots(chebyshev.chebder(series))
    inside = roots.real[(np.abs(roots.imag) < 1e-3) & (np.abs(roots.real) < 1)]
    values = chebyshev.chebval(np.concatenate([inside, [-1, 1]]), series)
    lower, upper = frame_bounds(BANKS[name])
    assert lower <= values.min() + 1e-12
    assert upper >= values.max() - 1e-12
    np.testing.assert_allclose([lower, upper], [values.min(), values.max()], atol=2e-5 * (upper - lower) + 1e-12)


def test_bounds_of_known_banks():
    assert frame_bounds(np.array([[3.0]])) == (9, 9)
    # (1 + x/2)² + x² with x = λ - 1 is least at x = -0.4.
    np.testing.assert_allclose(frame_bounds(np.array([[1, 0.5], [0, -1]])), (0.8, 3.25), atol=1e-4)
    assert frame_bounds(np.array([[1.0, 1.0]]))[0] == 0  # λ² vanishes at 0
    low = bands.heat([50.0])
    assert frame_bounds(low)[0] == 0


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        ("mexican_hat", "0.177, 0.270"),
        ("abspline", "1.280, 2.123"),
        ("meyer", "0.998, 1.002"),
        ("itersine", "1.000, 1.000"),
    ],
)
def test_bounds_are_those_that_the_pages_show(name, bounds):
    lower, upper = frame_bounds(getattr(bands, name)(6))
    assert f"{lower:.3f}, {upper:.3f}" == bounds
    page = (ROOT / "docs" / "bands.md").read_text()
    assert any(line.startswith(f"| `{name}(bands)`") and line.endswith(f"| {bounds} |") for line in page.splitlines())


@pytest.mark.parametrize("name", BANKS)
def test_tight_frames_are_tight(name):
    found = tight(BANKS[name], tolerance=1e-5)
    values = 1 - np.cos(np.linspace(0, np.pi, 5000))
    np.testing.assert_allclose(power(found, values), 1, atol=1e-5)
    expected = chebyshev.chebval(values - 1, BANKS[name].T) / np.sqrt(power(BANKS[name], values))
    np.testing.assert_allclose(chebyshev.chebval(values - 1, found.T), expected, atol=1e-5)


@pytest.mark.parametrize("columns", [(), (2,)])
def test_synthesis_is_that_of_dense_matrices(operator, columns, dtype):
    bank = BANKS["scaling"]
    parts = np.random.default_rng(0).normal(size=(len(bank), 11, *columns)).astype(dtype)
    expected = np.einsum("jk,kvw,jw...->v...", bank, chebyshev_matrices(operator, bank.shape[1] - 1), parts)
    found = synthesise(operator, bank, jnp.asarray(parts))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=100 * float(np.finfo(dtype).eps))


@pytest.mark.parametrize("terms", [1, 2, 5])
def test_synthesis_is_the_adjoint_of_analysis(operator, terms, x64):
    """⟨parts of x, y⟩_D = ⟨x, synthesis of y⟩_D, also of constants and first-degree filters."""
    random = np.random.default_rng(0)
    bank, x, y = random.normal(size=(3, terms)), random.normal(size=11), random.normal(size=(3, 11))
    ahead = np.sum(band_components(operator, bank, jnp.asarray(x)) * y * operator.degree)
    back = np.sum(synthesise(operator, bank, jnp.asarray(y)) * x * operator.degree)
    np.testing.assert_allclose(ahead, back, rtol=1e-12)


@pytest.mark.parametrize("name", BANKS)
def test_signals_come_back_from_their_parts(name, sphere: Mesh, x64):
    operator, bank = from_mesh(sphere), BANKS[name]
    x = jnp.asarray(np.random.default_rng(0).normal(size=(642, 3)))
    found = inverse(operator, bank, band_components(operator, bank, x))
    np.testing.assert_allclose(found, x, atol=1e-10)


def test_signals_come_back_in_single_precision_and_by_a_tight_frame(sphere: Mesh):
    operator, x = from_mesh(sphere), jnp.asarray(sphere.vertices, jnp.float32)
    found = inverse(operator, BANKS["spline"], band_components(operator, BANKS["spline"], x))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, x, atol=2e-5)
    bank = tight(BANKS["spline"])
    np.testing.assert_allclose(synthesise(operator, bank, band_components(operator, bank, x)), x, atol=2e-5)


def test_changed_parts_give_the_nearest_signal(operator, x64):
    """Least squares over all parts in the D-norm, by a dense solver; isolated vertices, with no mass, on their own."""
    bank = BANKS["scaling"]
    parts = np.random.default_rng(0).normal(size=(len(bank), 11))
    apply = np.einsum("jk,kvw->jvw", bank, chebyshev_matrices(operator, bank.shape[1] - 1))
    root = np.sqrt(np.where(operator.degree > 0, operator.degree, 1))
    system, right = (root[:, None] * apply).reshape(-1, 11), (root * parts).ravel()
    expected = np.linalg.lstsq(system, right)[0]
    np.testing.assert_allclose(inverse(operator, bank, jnp.asarray(parts)), expected, atol=1e-11)


def test_inverse_by_transformation(operator, x64):
    """Compiled, batched and differentiated; its derivative is itself, for it is linear in the parts."""
    bank = jnp.asarray(BANKS["scaling"])
    parts = jnp.asarray(np.random.default_rng(0).normal(size=(2, len(bank), 11, 2)))
    alone = jnp.stack([inverse(operator, bank, one) for one in parts])
    np.testing.assert_allclose(jax.jit(jax.vmap(inverse, (None, None, 0)))(operator, bank, parts), alone, atol=1e-11)
    _, tangent = jax.jvp(lambda y: inverse(operator, bank, y), (parts[0],), (parts[1],))
    np.testing.assert_allclose(tangent, alone[1], atol=1e-11)
    check_grads(lambda y: inverse(operator, bank, y), (parts[0],), order=1, modes=["fwd", "rev"])
    check_grads(lambda c, y: synthesise(operator, c, y), (bank, parts[0]), order=1, modes=["fwd", "rev"])
    check_grads(jax.jit(lambda c: jnp.sin(inverse(operator, c, parts[0]))), (bank,), order=1, modes=["rev"])


def test_the_power_of_a_bank_is_one_series():
    bank, values = BANKS["itersine"], np.linspace(0, 2, 100)
    found = chebyshev.chebval(values - 1, np.asarray(frames._power(jnp.asarray(bank, jnp.float32)), float))
    np.testing.assert_allclose(found, power(bank, values), atol=2e-5)


def test_a_frame_that_is_hard_to_tighten_is_refused(monkeypatch):
    monkeypatch.setattr(frames, "_MAX_DEGREE", 50)
    with pytest.raises(JaxmarkError, match="larger tolerance"):
        tight(BANKS["scaling"])


def test_refusals(operator, unchecked):
    bank, parts = BANKS["scaling"], jnp.ones((12, 11))
    low_passes = bands.heat([20.0, 50.0])
    for call in (
        lambda: inverse(operator, low_passes, parts[:2]),
        lambda: tight(low_passes),
        lambda: inverse(operator, bank, parts[1:]),
        lambda: inverse(operator, bank, parts[:, 1:]),
        lambda: inverse(operator, bank, jnp.ones((12, 11), int)),
        lambda: inverse(operator, bank[0], parts),
        lambda: synthesise(operator, bank, parts[1:]),
        lambda: synthesise(operator, bank, parts[0]),
        lambda: frame_bounds(bank[0]),
        lambda: frame_bounds(bank[:, :0]),
    ):
        with pytest.raises(JaxmarkError):
            call()
