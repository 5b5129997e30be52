"""What Sohn et al. print and does not hold, beside what does; errata that one module answers for are in its own tests.

Each test shows that the printed form fails and the corrected one holds, with NumPy alone where the mathematics is
the matter, else with what jaxmark does. `docs/paper.md` lists them all.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

from jaxmark.alignment.observation import Observation
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import filter, transpose
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import centre
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark.carriers import ModulatedCarrier, eigenspaces, host_bands
from jaxmark.watermark.reading.detectors import correlate
from tests.dense import laplacian_matrix
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

GRID = np.cos(np.linspace(0, np.pi, 1001))


def kernels(bands: int, first: float) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev coefficients of K_n(·; ξ_j), whose k = 0 term counts so much; and ξ_j = cos((2j + 1)π/(2n + 2))."""
    angles = (2 * np.arange(bands) + 1) * np.pi / (2 * bands)
    k = np.arange(bands)
    return np.cos(np.outer(angles, k)) * np.where(k == 0, first, 1), np.cos(angles)


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return bumpy_sphere(2)


def test_method_2_starts_from_one():
    """Printed: t_0 = 0 and T_0 = 0."""

    def recurrence(start: float) -> np.ndarray:
        terms = [np.full_like(GRID, start), GRID]
        while len(terms) < 9:
            terms.append(2 * GRID * terms[-1] - terms[-2])
        return np.stack(terms)

    true = np.cos(np.outer(np.arange(9), np.arccos(GRID)))
    np.testing.assert_allclose(recurrence(1), true, atol=1e-12)
    assert np.abs(recurrence(0)[2:] - true[2:]).max(axis=1).min() > 0.99


def test_method_2_saves_before_it_assigns():
    """Printed: t_1, T_1 are assigned first, so that T_0 becomes the new T_1."""

    def recurrence(save_first: bool) -> np.ndarray:
        before, current = np.ones_like(GRID), GRID
        for _ in range(7):
            following = 2 * GRID * current - before
            before, current = (current, following) if save_first else (following, following)
        return current

    true = np.cos(8 * np.arccos(GRID))
    np.testing.assert_allclose(recurrence(True), true, atol=1e-12)
    assert np.abs(recurrence(False) - true).max() > 1


def test_method_1_needs_its_factor():
    """Printed: Π_{i≠j}(Δ̃ - ξ_i) without A_j = 1/Π_{i≠j}(ξ_j - ξ_i), by which it is another band than Method 2's."""
    rows, nodes = kernels(12, 0.5)
    for j, second in enumerate(chebyshev.chebval(GRID, rows.T) / 6):
        others = np.delete(nodes, j)
        first = (GRID[:, None] - others).prod(axis=1)
        np.testing.assert_allclose(first / (nodes[j] - others).prod(), second, atol=1e-12)
        assert np.abs(first - second).max() > 0.9


def test_a_filter_costs_what_its_edges_do():
    """Printed: O(nN²). Four times the vertices take four times the work and the memory; a dense product sixteen."""

    def cost(level: int, dense: bool) -> tuple[float, float]:
        operator = from_mesh(bumpy_sphere(level))
        x = jnp.ones((len(operator.degree), 3), jnp.float32)
        matrix = jnp.zeros((len(x), len(x)), jnp.float32)
        program = jax.jit(jnp.matmul if dense else type(operator).apply).lower(matrix if dense else operator, x)
        compiled = program.compile()
        analysis: Any = compiled.cost_analysis()
        return analysis["flops"], analysis["bytes accessed"]

    for dense, growth in ((False, 4), (True, 16)):
        np.testing.assert_allclose(np.divide(cost(4, dense), cost(3, dense)), growth, rtol=0.05)


def test_bands_are_numbered_from_the_highest():
    """Printed: in increasing frequency. ξ_j falls with j, so peaks do; `scaling` numbers them the other way."""
    rows, nodes = kernels(16, 0.5)
    for family, step in ((rows, -1), (scaling(16), 1)):
        peaks = GRID[chebyshev.chebval(GRID, family.T).argmax(axis=1)]
        assert (step * np.diff(peaks) > 0).all()
    assert (np.diff(nodes) < 0).all()


def test_there_are_n_plus_1_bands():
    """Printed: sums over j = 1 … n of bands that are numbered from 0."""
    values = chebyshev.chebval(GRID, scaling(17).T)
    np.testing.assert_allclose(values.sum(axis=0), 1, atol=1e-12)
    for end in (values[1:], values[:-1]):
        assert np.abs(end.sum(axis=0) - 1).max() > 0.99


def test_sums_of_the_kernels():
    """Their scale: n + 1 as printed, (n + 1)/2 with the k = 0 term halved."""
    for first, total in ((1, 16), (0.5, 8)):
        np.testing.assert_allclose(chebyshev.chebval(GRID, kernels(16, first)[0].T).sum(axis=0), total, atol=1e-12)


def test_the_kernel_reproduces_if_halved_and_scaled():
    """Printed: ∫ p(x) K(x; ξ) dx/√(1 - x²) = p(ξ) for polynomials up to degree n."""
    bands, p = 12, np.random.default_rng(0).normal(size=12)
    x, weights = chebyshev.chebgauss(64)

    def reproduced(first: float) -> np.ndarray:
        return chebyshev.chebval(x, kernels(bands, first)[0].T) @ (weights * chebyshev.chebval(x, p))

    expected = chebyshev.chebval(kernels(bands, 1)[1], p)
    np.testing.assert_allclose(2 / np.pi * reproduced(0.5), expected, atol=1e-12)
    for factor, first in ((1, 1), (1, 0.5), (2 / np.pi, 1), (1 / np.pi, 1)):
        assert np.abs(factor * reproduced(first) - expected).max() > 0.1


@pytest.mark.slow
def test_bands_cover_the_spectrum_up_to_58_percent():
    """(13), printed for any δ: every point is in some B_j(δ), where a band has δ of its value at the node or more."""
    dense = np.cos(np.linspace(0, np.pi, 100_001))
    for bands in (16, 64):
        rows, nodes = kernels(bands, 0.5)
        at_nodes = np.diagonal(chebyshev.chebval(nodes, rows.T))
        covered = (chebyshev.chebval(dense, rows.T) / at_nodes[:, None]).max(axis=0)
        assert covered.min() == pytest.approx(0.58, abs=2e-3)


def test_side_lobes_where_meshes_have_their_energy():
    """Printed: bands are small elsewhere. At λ = 0 the next ones keep -0.42, 0.25 and -0.18 of their node's value."""
    at_zero = chebyshev.chebval(-1, scaling(64).T)
    np.testing.assert_allclose(at_zero[1:4], [-0.42, 0.25, -0.18], atol=5e-3)


def test_detection_value_needs_the_mass(sphere: Mesh, x64):
    """Printed: a plain inner product in 2.2.2, by which components that are orthogonal by ⟨·,·⟩_D are not."""
    operator = from_mesh(sphere, "inverse-length")
    signal = jnp.asarray(centre(operator, sphere.vertices))
    components = eigenspaces(operator, signal, eigenpairs(operator, 8))
    amplitudes = np.random.default_rng(1).normal(size=(components.gram.shape[-1], 3))
    shift = components.synthesise(jnp.asarray(amplitudes))
    found = components.analyse(shift) / np.diagonal(components.gram, axis1=1, axis2=2).T
    np.testing.assert_allclose(found, amplitudes, atol=1e-10)
    units = np.stack([components.synthesise(jnp.zeros_like(amplitudes).at[j].set(1.0)) for j in range(len(amplitudes))])
    plain = np.einsum("ivc,vc->ic", units, shift) / np.einsum("ivc,ivc->ic", units, units)
    assert np.abs(plain - amplitudes).max() > 0.05


def test_the_filter_matched_to_white_noise_is_the_plain_adjoint(sphere: Mesh, x64):
    """Printed: correlation with f(Δ)x. Noise that is white on coordinates needs f(Δ)ᵀ = D f(Δ) D⁻¹."""
    operator = from_mesh(sphere, "inverse-length")
    x, y = jnp.asarray(np.random.default_rng(2).normal(size=(2, len(sphere.vertices))))
    c = scaling(12)[3]
    plain = float(jnp.vdot(filter(operator, c, x), y))
    assert float(jnp.vdot(x, transpose(operator, c, y))) == pytest.approx(plain, rel=1e-12)
    assert float(jnp.vdot(x, filter(operator, c, y))) != pytest.approx(plain, rel=1e-3)


def test_bound_3_needs_the_strength(sphere: Mesh, x64):
    """Printed: |W| ≥ n - … whatever β is. Unattacked, on orthonormal components (ε = 0), W is nβ and no more."""
    operator = from_mesh(sphere)
    signal = jnp.asarray(centre(operator, sphere.vertices))
    components = eigenspaces(operator, signal, eigenpairs(operator, 8))
    norm = np.sqrt(np.diagonal(components.gram, axis1=1, axis2=2).T)
    signs = np.where(np.random.default_rng(3).random(norm.shape) < 0.5, -1, 1)[None]
    carrier, beta, n = ModulatedCarrier(components, signs), 1e-3, norm.size
    residual = carrier.displacement(jnp.ones(1), beta / norm)
    seen = Observation(residual, jnp.ones(len(residual)))
    value = float(correlate(carrier.reader(), seen, jnp.asarray(1 / norm))[0])
    assert value == pytest.approx(n * beta, rel=1e-9)
    assert value < n / 100


def test_bound_3_says_nothing_on_meshes(sphere: Mesh, x64):
    """Printed: for small ε. Of n components, the others' part of W is bounded by εn(n - 1), and ε is near 1."""
    operator, n = from_mesh(sphere), 16
    signal = jnp.asarray(centre(operator, sphere.vertices))
    products = np.asarray(host_bands(operator, signal, scaling(n, kernel="printed")).gram)
    printed = np.abs(products - np.eye(n)).max(axis=(1, 2))
    assert (printed > 0.9).all()
    assert (n - printed * n * (n - 1) < 0).all()
    exact = np.asarray(eigenspaces(operator, signal, eigenpairs(operator, n)).gram)
    assert (n - np.triu(np.abs(exact), 1).max(axis=(1, 2)) * n * (n - 1) > n - 1e-9).all()


def test_components_depend_on_the_position_unless_centred(sphere: Mesh, x64):
    """Not in the paper: λ = 0 is where the mesh stands, so without centring the mark grows with the distance to 0."""
    operator, rows = from_mesh(sphere), scaling(16, kernel="printed")
    near, far = (jnp.asarray(np.asarray(sphere.vertices) + shift) for shift in (0.0, 100.0))

    def marks(position) -> np.ndarray:
        return np.asarray(filter(operator, rows[3], position))

    assert np.abs(marks(far) - marks(near)).max() > 1
    still = [marks(jnp.asarray(centre(operator, np.asarray(position)))) for position in (near, far)]
    np.testing.assert_allclose(*still, atol=1e-10)


def test_the_spectrum_is_real_for_symmetric_weights_only(sphere: Mesh):
    """Printed: for any weights with rows that sum to 1."""
    stochastic = np.eye(len(sphere.vertices)) - laplacian_matrix(from_mesh(sphere))
    factors = np.random.default_rng(4).uniform(0.1, 1, stochastic.shape)
    for scale, real in ((factors + factors.T, True), (factors, False)):
        weights = scale * (stochastic > 0)
        values = np.linalg.eigvals(np.eye(len(weights)) - weights / weights.sum(axis=1, keepdims=True))
        assert (np.abs(values.imag).max() < 1e-9) == real
