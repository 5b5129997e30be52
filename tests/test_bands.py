import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import chebyshev

from jaxmark.bands import report, scaling
from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import centre, make_laplacian
from jaxmark.mesh import Mesh
from tests.dense import laplacian_matrix

KERNELS = ["halved", "printed"]
DAMPINGS = ["none", "jackson", "lanczos"]


def nodes(bands: int) -> np.ndarray:
    """λ at the zeros of T_bands(λ - 1), ascending, by NumPy's root finder."""
    return np.sort(chebyshev.chebroots([0] * bands + [1])) + 1


@given(st.integers(1, 100), st.sampled_from(KERNELS), st.sampled_from(DAMPINGS))
def test_partition_of_unity(bands, kernel, damping):
    one = np.zeros(bands)
    one[0] = 1
    np.testing.assert_allclose(scaling(bands, kernel=kernel, damping=damping).sum(axis=0), one, atol=1e-13)


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
def test_report_against_the_full_spectrum(sphere: Mesh, kernel, damping, x64):
    operator = make_laplacian(sphere)
    x = centre(operator, sphere.vertices)[:, 0]
    family = scaling(16, kernel=kernel, damping=damping)
    found = report(operator, family, x, nodes=len(x))
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
    np.testing.assert_allclose(report(operator, family, x).leakage, leakage, atol=0.06)


def test_damping_makes_components_of_a_mesh_orthogonal(sphere: Mesh):
    """Condition 3: what the printed kernel lacks."""
    operator = make_laplacian(sphere)
    x = centre(operator, sphere.vertices)[:, 0]
    printed = report(operator, scaling(32, kernel="printed"), x)
    damped = report(operator, scaling(32, damping="jackson"), x)
    assert printed.coherence_median > 5 * damped.coherence_median
    assert printed.overshoot.max() > 0.1
    assert damped.overshoot.max() < 1e-12


def test_refusals(unchecked):
    for call in (lambda: scaling(0), lambda: scaling(3, kernel="x"), lambda: scaling(3, damping="x")):
        with pytest.raises(JaxmarkError):
            call()
