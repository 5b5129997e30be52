"""The recipes of `docs/how-to/features.md`, against published packages or dense algebra, on the same graphs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from jaxmark import spectral
from tests.dense import laplacian_matrix
from tests.project.test_documents import blocks
from tests.samples import bumpy_sphere

PAGE = "docs/how-to/features.md"


@pytest.fixture(scope="module")
def page() -> dict:
    """What the page defines, without the blocks of packages that are missing, whose tests skip them by name."""
    names: dict = {"mesh": bumpy_sphere(2)}
    for block in blocks(PAGE, "python"):
        try:
            exec(compile(block, PAGE, "exec"), names)
        except ModuleNotFoundError as missing:
            if missing.name not in ("lineax", "matfree"):
                raise
    return names


def as_arrays(operator):
    """The operator in the precision that is set now; JAX keeps programs of NumPy arrays across precisions."""
    return jax.tree.map(jnp.asarray, operator)


def signal(page: dict) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(page["size"], 2))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_kernel_signatures_are_those_of_pyfm(page):
    laplacian = pytest.importorskip("pyFM.mesh.laplacian", reason="pyFM (pyfmaps) is not installed")
    signatures = pytest.importorskip("pyFM.signatures")
    mesh, pairs, surface = page["mesh"], page["pairs"], page["surface"]
    stiffness, mass = (
        build(mesh.vertices, mesh.faces) for build in (laplacian.cotangent_weights, laplacian.dia_area_mat)
    )
    theirs = laplacian.laplacian_spectrum(stiffness, mass, 1 + len(pairs.values))
    times, width = np.array([0.01, 0.1, 1.0]), 7 * (page["energies"][1] - page["energies"][0])
    expected = signatures.HKS_functions.HKS(*theirs, times)
    np.testing.assert_allclose(page["heat_kernel_signature"](surface, pairs, times), expected, rtol=1e-5)
    expected = signatures.WKS_functions.WKS(*theirs, page["energies"], width, scaled=True)
    np.testing.assert_allclose(page["wks"], expected, rtol=1e-5)


def test_kernel_signatures_are_diagonals_of_dense_kernels(page):
    """k_t(v, v) of e^{-tL} with L = M⁻¹(D - W), over the mass of v."""
    surface = page["surface"]
    pairs = spectral.eigenpairs(surface)
    stiffness, mass = (matrix.toarray() for matrix in spectral.sparse_matrices(surface))
    kernel = jax.scipy.linalg.expm(-0.5 * float(surface.scale) * np.linalg.solve(mass, stiffness))
    expected = np.diagonal(kernel) / np.diagonal(mass)
    np.testing.assert_allclose(page["heat_kernel_signature"](surface, pairs, [0.5])[:, 0], expected, rtol=1e-5)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_graphwave_is_that_of_the_heat_kernels_of_pygsp(page, x64):
    pygsp = pytest.importorskip("pygsp", reason="pygsp is not installed")
    operator, times, points = page["combinatorial"], [0.5, 2.0], np.linspace(0, 50, 7)
    stiffness, _ = spectral.sparse_matrices(operator)
    weights = -stiffness * float(operator.scale)
    weights.setdiag(0)
    graph = pygsp.graphs.Graph(weights.tocsr())
    graph.compute_fourier_basis()
    heat = pygsp.filters.Heat(graph, scale=[t * graph.lmax for t in times])
    wavelets = heat.filter(np.eye(graph.N), method="exact")  # [vertices, starts, times]
    expected = np.exp(1j * points[:, None, None, None] * wavelets).mean(axis=1)
    actual = page["graphwave"](as_arrays(operator), np.arange(graph.N), times, points)
    np.testing.assert_allclose(actual, np.transpose(expected, (1, 2, 0)), atol=1e-5)


def test_scattering_is_that_of_dense_powers(page, x64):
    """Ψ_j = P^{2^(j-1)} - P^{2^j} with P = (I + WD⁻¹)/2, and Σ_v |…|^q (Gao, Wolf, Hirn 2019)."""
    operator, x = page["graph"], signal(page)
    walk = np.eye(len(x)) - laplacian_matrix(operator).T / 2
    wavelets = [np.linalg.matrix_power(walk, 2 ** (j - 1)) - np.linalg.matrix_power(walk, 2**j) for j in range(1, 4)]
    first = [np.abs(wavelet @ x) for wavelet in wavelets]
    second = [np.abs(wavelets[k] @ first[j]) for j in range(3) for k in range(j + 1, 3)]
    expected = [[np.sum(part**q, axis=0) for q in (1, 2, 3)] for part in (x, *first, *second)]
    actual = page["scattering"](as_arrays(operator), jnp.asarray(x), scales=3, moments=(1, 2, 3))
    np.testing.assert_allclose(actual, expected, rtol=1e-5)


def test_the_block_does_not_depend_on_vertices_that_fill_up(page):
    _, block, _ = page["model"]
    operator = page["operators"][0]
    graphs = spectral.stack(page["operators"][:2], size=180, edges=600)
    u = np.random.default_rng(0).normal(size=(180, 16)).astype(np.float32)
    filled = block(jax.tree.map(lambda leaf: leaf[0], graphs), u)
    count = len(operator.degree)
    np.testing.assert_allclose(filled[:count], block(operator, u[:count]), atol=1e-4)


def test_lineax_solves_the_implicit_step(page, x64):
    pytest.importorskip("lineax", reason="lineax is not installed")
    operator, x = page["surface"], signal(page)
    stiffness, mass = spectral.sparse_matrices(operator)
    expected = spsolve((mass + 10 * stiffness).tocsc(), mass @ x)
    np.testing.assert_allclose(page["implicit_step"](as_arrays(operator), jnp.asarray(x), 10.0), expected, atol=1e-5)


def test_matfree_takes_the_square_root(page, x64):
    pytest.importorskip("matfree", reason="matfree is not installed")
    operator, x = page["surface"], signal(page)[:, 0]
    pairs = spectral.eigenpairs(operator)
    expected = pairs.vectors * np.sqrt(pairs.values) @ (pairs.vectors.T @ (np.asarray(operator.mass) * x))
    actual = page["square_root"](as_arrays(operator), jnp.asarray(x), len(x) - 1)
    np.testing.assert_allclose(actual, expected, atol=1e-5)
