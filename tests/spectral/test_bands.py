from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import chebyshev
from scipy import integrate, optimize, special

from jaxmark import spectral
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral.bands import bernstein, equal_edges, hat, intervals, lagrange, minimax, nodes, report, scaling
from jaxmark.spectral.chebyshev import band_components, cross_moments, moments
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import centre
from jaxmark.spectral.spectrum import eigenpairs, quadrature, white_probes
from tests.dense import laplacian_matrix
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

KERNELS = ["halved", "printed"]
DAMPINGS = ["none", "jackson", "lanczos"]


@given(st.integers(1, 100), st.sampled_from(KERNELS), st.sampled_from(DAMPINGS))
def test_partition_of_unity(bands, kernel, damping):
    one = np.zeros(bands)
    one[0] = 1
    np.testing.assert_allclose(scaling(bands, kernel=kernel, damping=damping).sum(axis=0), one, atol=1e-13)


def test_nodes_are_the_zeros():
    np.testing.assert_allclose(nodes(12), np.sort(chebyshev.chebroots([0] * 12 + [1])) + 1, atol=1e-14)


def test_halved_kernel_is_the_lagrange_basis_at_the_nodes():
    values = chebyshev.chebval(nodes(12) - 1, scaling(12).T)
    np.testing.assert_allclose(values, np.eye(12), atol=1e-12)


def test_printed_kernel_is_not_zero_at_the_other_nodes():
    """Erratum: Theorem 3.4 holds only if the k = 0 term is halved; as printed 1/2 remains of it, times 1/bands."""
    values = chebyshev.chebval(nodes(12) - 1, scaling(12, kernel="printed").T)
    np.testing.assert_allclose(values[~np.eye(12, dtype=bool)], 0.5 / 12, atol=1e-12)


def test_bands_go_by_increasing_frequency():
    """Erratum: the paper's ξ_j falls with j, so that its first band is the highest."""
    for damping in DAMPINGS:
        grid = np.linspace(0, 2, 2001)
        peaks = grid[np.abs(chebyshev.chebval(grid - 1, scaling(16, damping=damping).T)).argmax(axis=1)]
        assert (np.diff(peaks) > 0).all()


def test_the_end_band_overshoots_its_node():
    """Erratum: "takes its maximum at ξ" fails for the outer bands, which peak at 1.27 times their node's value."""
    end = chebyshev.chebval(np.linspace(-1, 1, 20001), scaling(64)[0])
    assert end.max() == pytest.approx(1.27, abs=0.01)


def test_jackson_damping_is_positive_and_lanczos_nearly():
    grid = np.cos(np.linspace(0, np.pi, 4001))
    assert chebyshev.chebval(grid, scaling(32, damping="jackson").T).min() > -1e-12
    plain = chebyshev.chebval(grid, scaling(32).T).min()
    assert plain / 5 < chebyshev.chebval(grid, scaling(32, damping="lanczos").T).min() < 0


def test_damping_factors_by_their_closed_forms():
    bands = 10
    plain = scaling(bands)
    solid = np.abs(plain) > 1e-9
    for damping, factor in [
        ("lanczos", lambda k: np.sin(np.pi * k / bands) / (np.pi * k / bands)),
        (
            "jackson",
            lambda k: (
                (
                    (bands - k + 1) * np.cos(np.pi * k / (bands + 1))
                    + np.sin(np.pi * k / (bands + 1)) / np.tan(np.pi / (bands + 1))
                )
                / (bands + 1)
            ),
        ),
    ]:
        ratio = np.where(solid, scaling(bands, damping=damping) / np.where(solid, plain, 1), np.nan)
        for k in range(1, bands):
            np.testing.assert_allclose(ratio[solid[:, k], k], factor(k), atol=1e-12)


@pytest.mark.parametrize(("kernel", "damping"), [("printed", "none"), ("halved", "none"), ("halved", "jackson")])
def test_report_against_the_full_spectrum(sphere: Mesh, kernel, damping):
    operator = from_mesh(sphere)
    x = centre(operator, sphere.vertices)[:, 0]
    family = scaling(16, kernel=kernel, damping=damping)
    found = report(quadrature(operator, x, len(x)), family)
    assert found.partition_error < 1e-12

    # The same by a dense decomposition.
    root = np.sqrt(operator.degree)
    values, vectors = np.linalg.eigh(root[:, None] * laplacian_matrix(operator) / root)
    parts = (vectors.T @ (root * x)) * chebyshev.chebval(values - 1, family.T)
    unit = parts / np.linalg.norm(parts, axis=1, keepdims=True)
    cosines = np.abs(unit @ unit.T)[np.triu_indices(16, 1)]
    assert found.coherence_max == pytest.approx(cosines.max(), rel=1e-6)
    assert found.coherence_median == pytest.approx(np.median(cosines), rel=1e-6)
    place = np.arccos(np.clip(1 - values, -1, 1)) / np.pi * 16
    outside = np.abs(place - np.arange(16)[:, None] - 0.5) > 1.5
    leakage = (parts**2 * outside).sum(1) / (parts**2).sum(1)
    np.testing.assert_allclose(found.leakage, leakage, rtol=1e-3)
    short = report(quadrature(operator, x, 64), family)
    np.testing.assert_allclose(short.leakage, leakage, atol=0.06)
    assert short.coherence_max == pytest.approx(cosines.max(), rel=1e-6)  # exact, however few the nodes


def test_damping_makes_components_of_a_mesh_orthogonal(sphere: Mesh):
    """Condition 3: what the printed kernel lacks."""
    operator = from_mesh(sphere)
    measure = quadrature(operator, centre(operator, sphere.vertices)[:, 0], 128)
    printed = report(measure, scaling(32, kernel="printed"))
    damped = report(measure, scaling(32, damping="jackson"))
    assert printed.coherence_median > 5 * damped.coherence_median
    assert printed.overshoot.max() > 0.1
    assert damped.overshoot.max() < 1e-12


def test_report_of_any_responses_and_edges(sphere: Mesh):
    """Of indicators nothing leaks; half of it does where the edges say that two of four bands lie elsewhere."""
    operator = from_mesh(sphere)
    measure = quadrature(operator, centre(operator, sphere.vertices)[:, 0], 200)
    edges = np.array([0, 0.1, 0.3, 0.8, 1.1, 2])

    def indicators(values):
        return ((values >= edges[:-1, None]) & (values < edges[1:, None])).astype(float)

    found = report(measure, indicators, edges=edges)
    np.testing.assert_array_equal(found.leakage, 0)
    assert found.coherence_max == found.overshoot.max() == 0
    shifted = report(measure, indicators, edges=np.array([0, 0.01, 0.02, 0.03, 0.04, 2]))
    np.testing.assert_array_equal(shifted.leakage > 0.5, [False, True, True, False, False])


def test_bernstein_by_its_definition():
    grid = np.linspace(0, 2, 1001)
    found = chebyshev.chebval(grid - 1, bernstein(13).T)
    j = np.arange(13)[:, None]
    np.testing.assert_allclose(found, special.comb(12, j) * (grid / 2) ** j * (1 - grid / 2) ** (12 - j), atol=1e-13)
    np.testing.assert_allclose(grid[found.argmax(axis=1)], np.arange(13) / 6, atol=1e-3)


@pytest.mark.parametrize("bands", [1, 2, 100, 300])
def test_bernstein_is_a_non_negative_partition_of_unity(bands):
    values = chebyshev.chebval(np.cos(np.linspace(0, np.pi, 4001)), bernstein(bands).T)
    assert values.min() > -1e-13
    np.testing.assert_allclose(values.sum(axis=0), 1, atol=1e-11)


def test_intervals_are_damped_projections_of_indicators():
    """Coefficients by numerical integration; a partition of unity, within [0, 1] with Jackson's damping."""
    edges = np.array([0, 0.05, 0.4, 1.5, 2])
    plain = intervals(edges, 9, damping="none")
    for j, (low, high) in enumerate(pairwise(edges)):
        for k in range(9):
            angles = np.arccos([high - 1, low - 1])
            integral = integrate.quad(lambda phi, k=k: np.cos(k * phi), *angles)[0]
            assert plain[j, k] == pytest.approx((2 if k else 1) / np.pi * integral, abs=1e-12)
    for damping in DAMPINGS:
        np.testing.assert_allclose(intervals(edges, 40, damping=damping).sum(axis=0), np.eye(40)[0], atol=1e-14)
    values = chebyshev.chebval(np.cos(np.linspace(0, np.pi, 4001)), intervals(edges, 40).T)
    assert -1e-12 < values.min() < values.max() < 1 + 1e-12


def test_bands_by_density_hold_equal_counts_of_eigenvalues(sphere: Mesh, x64):
    """Exactly so of the damped estimate; of the eigenvalues themselves within its error: the probes' and the blur's."""
    operator, probes, bands = from_mesh(sphere), 16, 8
    signals = jnp.asarray(white_probes(operator, 0, probes))
    found = np.asarray(moments(operator, signals, degree=100)).sum(axis=1)
    edges = equal_edges(found, bands)
    family = intervals(edges, len(found))
    np.testing.assert_allclose(family @ found, found[0] / bands, rtol=1e-9)
    values = eigenpairs(operator).values
    counts = np.histogram(values, edges)[0]
    assert counts.sum() == 641
    traces = chebyshev.chebval(values - 1, family.T).sum(axis=1)  # without the probes' error
    assert (np.abs(traces - 641 / bands) < 4 * np.sqrt(2 * 641 / bands / probes)).all()
    angle, blur = np.arccos(values - 1), np.pi / len(found)
    near = (np.abs(angle - np.arccos(edges - 1)[:, None]) < blur).sum(axis=1)
    assert (np.abs(counts - traces) < near[:-1] + near[1:]).all()
    assert counts.min() > 0.7 * 641 / bands
    # Bands of equal width in the angle leave the top of the spectrum empty.
    assert np.histogram(values, 1 - np.cos(np.linspace(0, np.pi, bands + 1)))[0].min() == 0


def test_bands_by_energy_hold_equal_parts_of_the_host(sphere: Mesh, dtype):
    operator = from_mesh(sphere)
    x = jnp.asarray(centre(operator, sphere.vertices).astype(dtype))
    found = np.asarray(moments(operator, x, degree=32)).sum(axis=1)
    family = intervals(equal_edges(found, 10), len(found))
    parts = band_components(operator, family, x)
    energies = np.einsum("v,vc,bvc->b", operator.degree, x, parts)
    np.testing.assert_allclose(energies, energies.sum() / 10, rtol=100 * np.finfo(dtype).eps * 10)


def test_lagrange_at_the_zeros_is_scaling():
    np.testing.assert_allclose(lagrange(nodes(20)), scaling(20), atol=1e-12)
    np.testing.assert_array_equal(lagrange(np.array([0.3])), [[1.0]])


def test_lagrange_at_the_eigenvalues_projects(x64):
    """Equations 8 to 10: idempotent, D-orthogonal, complete, and c² = ⟨f_λ(Δ)x, x⟩_D; eigenspaces of several."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    operator = from_mesh(make_mesh(ball.vertices, ball.faces))
    pairs = eigenpairs(operator)
    spaces = np.unique(pairs.space)
    family = lagrange(np.append(0, pairs.values[spaces]))
    projectors = np.asarray(band_components(operator, family, jnp.eye(42)))
    identity = np.eye(len(family))[:, :, None, None] * projectors
    rounding = np.finfo(np.float64).eps * np.abs(family).sum(axis=1).max()
    assert rounding < 1e-10
    np.testing.assert_allclose(np.einsum("iuv,jvw->ijuw", projectors, projectors), identity, atol=100 * rounding)
    np.testing.assert_allclose(projectors.sum(axis=0), np.eye(42), atol=100 * rounding)
    weighted = operator.degree[:, None] * projectors
    np.testing.assert_allclose(weighted, weighted.transpose(0, 2, 1), atol=600 * rounding)  # valences to 6
    x = np.random.default_rng(0).normal(size=42)
    energies = family @ cross_moments(operator, jnp.asarray(x), jnp.asarray(x), degree=len(family) - 1)
    products = (pairs.vectors.T @ (operator.degree * x)) ** 2
    np.testing.assert_allclose(energies[1:], [products[pairs.space == one].sum() for one in spaces], atol=1e-8)


def test_minimax_equioscillates():
    """Chebyshev's theorem: degree + 2 extrema of equal size and alternating sign prove an approximation best."""

    def ramp(values):
        return np.interp(values, [0.4, 0.7], [0, 1])

    for degree in (0, 1, 7, 40):
        best = minimax(ramp, degree, kinks=[0.4, 0.7])
        errors = ramp(best.reference) - chebyshev.chebval(best.reference - 1, best.coefficients)
        assert len(errors) == degree + 2
        np.testing.assert_allclose(np.abs(errors), best.deviation, rtol=1e-6)
        assert (np.sign(errors[1:]) == -np.sign(errors[:-1])).all()
        fine = np.linspace(0, 2, 100_001)
        assert np.abs(ramp(fine) - chebyshev.chebval(fine - 1, best.coefficients)).max() < 1.003 * best.deviation


def test_minimax_against_linear_programming():
    grid = np.union1d(np.cos(np.linspace(0, np.pi, 801)) + 1, [0.6 - 1 / 3, 0.6, 0.6 + 1 / 3])
    target, powers = np.maximum(0, 1 - 3 * np.abs(grid - 0.6)), chebyshev.chebvander(grid - 1, 10)
    ones = np.ones((len(grid), 1))
    bound = np.block([[powers, -ones], [-powers, -ones]])
    programme = optimize.linprog([0] * 11 + [1], bound, np.concatenate([target, -target]), bounds=(None, None))
    found = minimax(lambda x: np.maximum(0, 1 - 3 * np.abs(x - 0.6)), 10, kinks=[0.6 - 1 / 3, 0.6, 0.6 + 1 / 3])
    assert found.deviation == pytest.approx(programme.fun, rel=0.005)


def test_minimax_of_a_kink_has_bernsteins_constant():
    """The deviation of |t| is β/n, β = 0.28016949902… (Varga, Carpenter, Constr. Approx. 1, 1985)."""
    assert 60 * minimax(lambda x: np.abs(x - 1), 60, kinks=[1.0]).deviation == pytest.approx(0.2801694990, abs=1e-3)
    assert minimax(lambda x: (x - 1) ** 2, 4).deviation < 1e-12


@pytest.mark.parametrize("degree", [15, 63])
def test_hats_are_near_best_and_a_partition_of_unity(degree):
    knots = nodes(16)
    family = hat(knots, degree)
    np.testing.assert_allclose(family.sum(axis=0), np.eye(degree + 1)[0], atol=1e-12)
    grid = np.sort(np.append(1 - np.cos(np.linspace(0, np.pi, 4001)), knots))
    off = np.abs(chebyshev.chebval(grid - 1, family.T) - [np.interp(grid, knots, row) for row in np.eye(16)])
    for j in (0, 1, 8):
        best = minimax(lambda x, j=j: np.interp(x, knots, np.eye(16)[j]), degree, kinks=knots)
        assert 0.998 * best.deviation < off[j].max() < 1.5 * best.deviation
    # Gibbs: at the degree of 64 undamped scaling functions the hats overshoot less than a third of what these do.
    if degree == 63:
        summed = scaling(64).reshape(16, 4, 64).sum(axis=1)
        overshoot = -chebyshev.chebval(grid - 1, summed.T).min()
        assert -chebyshev.chebval(grid - 1, family.T).min() < overshoot / 3


def test_refusals(unchecked):
    for call in (
        lambda: scaling(0),
        lambda: scaling(3, kernel="x"),
        lambda: scaling(3, damping="x"),
        lambda: bernstein(0),
        lambda: intervals(np.array([0.0, 1, 1]), 4),
        lambda: intervals(np.array([0.0, 2.1]), 4),
        lambda: equal_edges(np.zeros(4), 3),
        lambda: lagrange(np.array([1.0, 1.0])),
        lambda: lagrange(np.linspace(0, 2, 60)),
        lambda: lagrange(np.linspace(0.9, 1, 300)),
        lambda: hat(np.array([1.0]), 4),
        lambda: hat(np.array([1.0, 0.5]), 4),
    ):
        with pytest.raises(JaxmarkError):
            call()


def test_a_fitted_function_is_interpolated_and_its_error_said():
    """Against SciPy's interpolation at the same points, and the bound by the best polynomial, on a finer grid."""

    def function(x):
        return 1 / (1 + 10 * x)

    fine = np.linspace(0, 2, 100_003)
    for degree in (0, 5, 20, 60):
        found = spectral.fit(function, degree)
        expected = chebyshev.chebinterpolate(lambda y: function(y + 1), degree)
        np.testing.assert_allclose(found.coefficients, expected, atol=1e-14)
        errors = np.abs(chebyshev.chebval(fine - 1, found.coefficients) - function(fine))
        assert errors.max() <= 1.001 * found.error + 1e-15
        assert found.error <= (2 + 2 / np.pi * np.log(degree + 1)) * minimax(function, degree).deviation + 1e-15
    operator = from_mesh(bumpy_sphere(1))
    x = np.random.default_rng(0).normal(size=42)
    values, vectors, _ = spectral.eigenpairs(operator)
    exact = x + vectors @ ((function(values) - 1) * (vectors.T @ (np.asarray(operator.mass) * x)))
    smooth = spectral.filter(operator, spectral.fit(function, 60).coefficients, jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(smooth, exact, atol=1e-5)


def test_functions_that_cannot_be_fitted_are_refused(unchecked):
    operator = from_mesh(bumpy_sphere(1))
    for call, sentence in [
        (lambda: spectral.fit(np.exp, -1), "whole number of at least 0, got -1"),
        (lambda: spectral.fit(np.exp, 2.5), "whole number of at least 0, got 2.5"),  # pyright: ignore
        (lambda: spectral.fit(lambda x: 1j * x, 3), "real values"),
        (lambda: spectral.fit(lambda x: np.where(x < 1, np.nan, x), 3), "one finite value for each"),
        (lambda: spectral.fit(lambda x: np.float64(1), 3), "one finite value for each"),
        (lambda: spectral.filter(operator, np.exp, jnp.ones(42)), r"spectral.fit\(function, degree\)"),  # pyright: ignore
    ]:
        with pytest.raises(JaxmarkError, match=sentence):
            call()
