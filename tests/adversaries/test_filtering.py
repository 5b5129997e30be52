"""Filters against dense eigendecompositions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxmark as jm
from jaxmark.adversaries.by_name import band_stop, low_pass
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral.graphs import from_mesh
from tests.dense import laplacian_matrix
from tests.samples import rough_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def cap() -> Mesh:
    """A rough sphere with a hole, far from the origin, and an isolated vertex."""
    mesh = rough_sphere(400)
    return make_mesh(np.vstack([mesh.vertices, [[3.0, 3, 3]]]) + 5, mesh.faces[10:])


@pytest.fixture(scope="module")
def spectrum(cap: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues and orthonormal eigenvectors of D^½ Δ D^-½, and D^½; of the vertices that faces use."""
    operator, used = from_mesh(cap), np.unique(cap.faces)
    root = np.sqrt(np.asarray(operator.degree)[used])
    symmetric = root[:, None] * laplacian_matrix(operator)[np.ix_(used, used)] / root
    np.testing.assert_allclose(symmetric, symmetric.T, atol=1e-15)
    return *np.linalg.eigh(symmetric), root


def jackson(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Which part of a frequency lies in [low, high] once blurred by Jackson's kernel: an integral, by quadrature."""
    terms = 65
    k = np.arange(terms)
    q = np.pi / (terms + 1)
    damping = ((terms - k + 1) * np.cos(q * k) + np.sin(q * k) / np.tan(q)) / (terms + 1)
    # Chebyshev coefficients of a step, by the midpoint rule in the angle, whose cells the ends cut.
    ends = np.arccos(np.array([high, low]) - 1)
    angle = np.linspace(*ends, 40001)
    middle, width = (angle[1:] + angle[:-1]) / 2, np.diff(angle)
    c = np.array([np.sum(np.cos(j * middle) * width) for j in k]) * np.where(k == 0, 1, 2) / np.pi
    return np.cos(np.outer(np.arccos(np.clip(values - 1, -1, 1)), k)) @ (c * damping)


@pytest.mark.parametrize(
    ("kind", "strength", "low", "high"),
    [(low_pass, 0.5, 1.0, 2.0), (low_pass, 0.9, 0.2, 2.0), (band_stop, 0.2, 0.02, 0.22), (band_stop, 1.98, 0.02, 2.0)],
)
def test_filters_by_eigendecomposition(kind, strength, low, high, cap: Mesh, spectrum, x64):
    values, vectors, root = spectrum
    response = 1 - jackson(values, low, high)
    response /= response[0]  # the constant
    used = np.unique(cap.faces)
    expected = (vectors * response @ vectors.T @ (root[:, None] * cap.vertices[used])) / root[:, None]
    found = np.asarray(kind(cap, strength).vertices)
    np.testing.assert_allclose(found[used], expected, atol=1e-8)
    np.testing.assert_array_equal(np.delete(found, used, axis=0), np.delete(cap.vertices, used, axis=0))
    # Each axis has its mean where it was.
    mass = root**2
    np.testing.assert_allclose(mass @ found[used], mass @ cap.vertices[used], rtol=1e-12)


@pytest.mark.parametrize(
    ("kind", "strength", "stopped", "passed"),
    [
        (low_pass, 0.5, (1.1, 2.0), (0.0, 0.9)),
        (low_pass, 0.8, (0.5, 2.0), (0.0, 0.3)),
        (band_stop, 0.5, (0.08, 0.43), (0.64, 2.0)),
        (band_stop, 0.2, (0.07, 0.18), (0.32, 2.0)),
    ],
)
def test_what_is_stopped_goes_and_what_is_passed_stays(kind, strength, stopped, passed, cap: Mesh, spectrum, dtype):
    values, vectors, root = spectrum
    used = np.unique(cap.faces)
    for (low, high), most_lost, least_lost in ((stopped, 1.01, 0.9), (passed, 0.1, -0.01)):
        inside = np.flatnonzero((values >= low) & (values <= high))
        assert len(inside) > 3
        for column in inside[:: max(1, len(inside) // 5)]:
            wave = np.zeros(cap.vertices.shape)
            wave[used] = 0.01 * (vectors[:, column] / root)[:, None]
            # Linear: of one wave more, one filtered wave more is left.
            with_wave, without = (
                np.asarray(kind(Mesh(v.astype(dtype), cap.faces), strength).vertices, np.float64)
                for v in (cap.vertices + wave, cap.vertices)
            )
            left = np.sum((with_wave - without) * wave) / np.sum(wave**2)
            assert least_lost <= 1 - left <= most_lost


def test_nothing_is_removed_at_strength_zero(cap: Mesh):
    for kind in ("low-pass", "band-stop"):
        np.testing.assert_array_equal(jm.attack(cap, kind, 0, seed=0).vertices, cap.vertices)


def test_components_stay_where_they_are(hard_graph: Mesh, x64):
    degree = np.asarray(from_mesh(hard_graph).degree)
    for kind in (low_pass, band_stop):
        shift = np.asarray(kind(hard_graph, 0.9).vertices) - hard_graph.vertices
        assert np.abs(shift).max() > 0.01
        for part in (np.arange(5), np.arange(6, 10)):
            np.testing.assert_allclose(degree[part] @ shift[part], 0, atol=1e-12)


@pytest.mark.slow
def test_filters_are_differentiable(cap: Mesh, x64):
    v = jnp.asarray(cap.vertices)
    for kind in (low_pass, band_stop):
        check_grads(
            jax.jit(lambda v, kind=kind: jnp.sum(jnp.sin(kind(Mesh(v, cap.faces), 0.5).vertices))), (v,), 1, "rev"
        )


@pytest.mark.usefixtures("unchecked")
def test_refusals(cap: Mesh):
    for kind, strength, sentence in [("low-pass", 1, r"\[0, 1\)"), ("band-stop", 2, r"\[0, 1.98\]")]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(cap, kind, strength, seed=0)
