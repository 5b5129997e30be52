import jax
import numpy as np
import pytest
import trimesh

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, edges, make_mesh
from jaxmark.spectral import bands, spectrum
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import centre
from jaxmark.spectral.spectrum import eigenpairs, quadrature, white_probes
from jaxmark.spectral.subspaces import lowest_eigenpairs
from tests.dense import laplacian_matrix
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


@pytest.mark.parametrize("weights", ["valence", "inverse-length"])
def test_eigenpairs_of_a_hard_graph(hard_graph: Mesh, weights):
    operator = from_mesh(hard_graph, weights)
    pairs = eigenpairs(operator)
    delta, mass = laplacian_matrix(operator), np.diag(operator.degree)
    assert len(pairs.values) == 7  # 9 linked vertices in two components
    np.testing.assert_allclose(delta @ pairs.vectors, pairs.vectors * pairs.values, atol=1e-12)
    np.testing.assert_allclose(pairs.vectors.T @ mass @ pairs.vectors, np.eye(7), atol=1e-12)
    assert (np.diff(pairs.values) >= 0).all()
    np.testing.assert_array_equal(pairs.vectors[[5, 10]], 0)
    # Complete on centred signals.
    x = centre(operator, hard_graph.vertices)
    np.testing.assert_allclose(pairs.vectors @ (pairs.vectors.T @ mass @ x), x, atol=1e-12)


def test_iterated_pairs_are_the_dense_ones(sphere: Mesh, monkeypatch):
    operator = from_mesh(sphere, "inverse-length")  # by valence, this graph has repeated eigenvalues
    dense = eigenpairs(operator, 20)
    monkeypatch.setattr(spectrum, "_DENSE_LIMIT", 0)
    iterated = eigenpairs(operator, 20)
    np.testing.assert_allclose(iterated.values, dense.values, atol=1e-10)
    overlap = dense.vectors.T @ (operator.degree[:, None] * iterated.vectors)
    np.testing.assert_allclose(np.abs(np.diagonal(overlap)), 1, atol=1e-6)
    with pytest.raises(JaxmarkError, match="too many to iterate"):
        eigenpairs(operator, 300)


def test_repeated_eigenvalues_are_one_space():
    """The icosahedron's graph: eigenvalues 1 - 1/√5 (3 times), 6/5 (5 times), 1 + 1/√5 (3 times)."""
    ball = trimesh.creation.icosahedron()
    pairs = eigenpairs(from_mesh(make_mesh(ball.vertices, ball.faces)))
    np.testing.assert_allclose(pairs.values, [1 - 5**-0.5] * 3 + [1.2] * 5 + [1 + 5**-0.5] * 3, atol=1e-12)
    np.testing.assert_array_equal(pairs.space, [0] * 3 + [3] * 5 + [8] * 3)


def test_an_eigenspace_that_the_count_would_cut_is_left_out():
    """Part of an eigenspace would depend on the basis that a solver happened to pick."""
    ball = trimesh.creation.icosahedron()
    operator = from_mesh(make_mesh(ball.vertices, ball.faces))
    assert [len(eigenpairs(operator, count).values) for count in (3, 4, 7, 8, 10, 11, 50)] == [3, 3, 3, 8, 8, 11, 11]
    with pytest.raises(JaxmarkError, match="more pairs than count=2"):
        eigenpairs(operator, 2)


def with_thin_face(mesh: Mesh, height: float) -> Mesh:
    """With another face over an edge, of a third corner this high above the edge's middle."""
    points, (a, b, _) = np.asarray(mesh.vertices), np.asarray(mesh.faces)[20]
    top = (points[a] + points[b]) / 2 + height * np.array([1, 2, 3]) / 14**0.5
    return make_mesh(np.vstack([points, top]), np.vstack([mesh.faces, [a, b, len(points)]]))


@pytest.mark.parametrize("limit", [0, 2500], ids=["iterated", "dense"])
@pytest.mark.parametrize("height", [1e-6, 1e-2])
def test_a_thin_face_leaves_the_other_eigenvalues_as_they_are(height, limit, monkeypatch):
    """It joins two vertices of the sphere more closely, which changes one of the eigenvalues by its share of all."""
    sphere = bumpy_sphere(2)
    monkeypatch.setattr(spectrum, "_DENSE_LIMIT", limit)
    plain, thin = (from_mesh(mesh, "cotangent", mass="areas") for mesh in (sphere, with_thin_face(sphere, height)))
    expected, found = (eigenpairs(operator, 20).values[:8] * operator.scale for operator in (plain, thin))
    np.testing.assert_allclose(found, expected, rtol=0.03)


def test_a_flat_face_is_named_and_robust_weights_take_it(sphere: Mesh):
    """Up to rounding, its third corner has no mass; by an intrinsic triangulation it has."""
    flat = with_thin_face(sphere, 0)
    with pytest.raises(JaxmarkError, match=f"Vertex {len(sphere.vertices)} has edges, but no mass"):
        from_mesh(flat, "cotangent", mass="areas")
    pytest.importorskip("robust_laplacian")
    found, expected = (
        eigenpairs(operator, 20).values[:8] * operator.scale
        for operator in (from_mesh(flat, "robust", mass="areas"), from_mesh(sphere, "cotangent", mass="areas"))
    )
    np.testing.assert_allclose(found, expected, rtol=0.15)  # triangles near the face are other ones, of 0.3 radii


@pytest.mark.parametrize("factor", [1e-30, 1e30])
def test_no_result_depends_on_the_unit_of_weights_and_masses(factor, x64):
    sphere = bumpy_sphere(1)
    pairs, size = edges(sphere.faces), len(sphere.vertices)
    weights, mass = np.random.default_rng(0).uniform(0.1, 1, len(pairs)), np.random.default_rng(1).uniform(1, 2, size)
    for masses in (None, mass):
        one, other = (
            from_mesh(sphere, unit * weights, mass=None if masses is None else unit * masses) for unit in (1, factor)
        )
        expected, found = (eigenpairs(operator, 9) for operator in (one, other))
        np.testing.assert_allclose(found.values, expected.values, rtol=1e-9)
        expected, found = (lowest_eigenpairs(operator, 9, 0, dtype=np.float64).values for operator in (one, other))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        coefficients = bands.scaling(8)[2]
        expected, found = (filter(operator, coefficients, sphere.vertices) for operator in (one, other))
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_quadrature_is_exact_for_polynomials(hard_graph: Mesh):
    operator = from_mesh(hard_graph, "inverse-length")
    x = centre(operator, hard_graph.vertices)[:, 0]
    delta = laplacian_matrix(operator)
    for steps in (1, 3, 50):
        found = quadrature(operator, x, steps)
        for power in range(min(2 * steps, 12)):
            exact = x @ (operator.degree * (np.linalg.matrix_power(delta, power) @ x))
            assert found.weights @ found.nodes**power == pytest.approx(exact, rel=1e-9)
    assert quadrature(operator, 0 * x, 3).nodes.size == 0


def test_white_signals_estimate_traces(hard_graph: Mesh):
    """Σ f(λ_i) above the null space, within four of Hutchinson's standard deviations; without isolated vertices."""
    operator = from_mesh(hard_graph, "inverse-length")
    signals = white_probes(operator, 0, 1000)
    np.testing.assert_array_equal(white_probes(operator, jax.random.key(0), 1000), signals)
    delta, values = laplacian_matrix(operator), eigenpairs(operator).values
    np.testing.assert_array_equal(signals[[5, 10]], 0)
    for power in (0, 1, 3):
        applied = np.linalg.matrix_power(delta, power) @ signals
        estimate = (operator.degree[:, None] * signals * applied).sum()
        deviation = np.sqrt(2 * (values ** (2 * power)).sum() / 1000)
        assert abs(estimate - (values**power).sum()) < 4 * deviation


def test_refuses_no_pairs(sphere: Mesh):
    with pytest.raises(JaxmarkError, match="at least 1"):
        eigenpairs(from_mesh(sphere), 0)
