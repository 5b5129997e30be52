import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, edges, make_mesh
from jaxmark.spectral import laplacian
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, centre, host_edges, sparse_matrices
from jaxmark.spectral.spectrum import eigenpairs
from tests.dense import laplacian_matrix, tolerance

pytestmark = pytest.mark.core

WEIGHTINGS = ["valence", "inverse-length", "cotangent"]


@pytest.fixture(params=["gather", "segments", "ordered"])
def lowering(request, monkeypatch):
    """Small meshes are not ordered otherwise."""
    if request.param != "ordered":
        return request.param
    monkeypatch.setattr("jaxmark.spectral.laplacian._MIN_ORDERED_VERTICES", 0)
    return "gather"


@pytest.mark.parametrize("weights", WEIGHTINGS)
@pytest.mark.parametrize("columns", [(), (3,)])
def test_apply_is_the_dense_matrix(hard_graph: Mesh, lowering, weights, columns, dtype):
    operator = from_mesh(hard_graph, weights, lowering=lowering)
    x = np.random.default_rng(0).normal(size=(len(hard_graph.vertices), *columns)).astype(dtype)
    y = operator.apply(jnp.asarray(x))
    assert y.dtype == dtype
    np.testing.assert_allclose(y, laplacian_matrix(operator) @ x, atol=tolerance(dtype))


@pytest.mark.parametrize("weights", WEIGHTINGS)
def test_spectrum_lies_in_0_2_and_each_component_is_in_the_null_space(hard_graph: Mesh, weights):
    values = np.linalg.eigvals(laplacian_matrix(from_mesh(hard_graph, weights)))
    assert np.abs(values.imag).max() < 1e-12
    assert values.real.min() > -1e-12
    assert values.real.max() < 2 + 1e-12
    assert np.sum(np.abs(values) < 1e-12) == 4  # two components and two isolated vertices


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(WEIGHTINGS))
def test_self_adjoint_in_the_inner_product(seed, weights):
    random = np.random.default_rng(seed)
    mesh = make_mesh(random.normal(size=(12, 3)), random.integers(0, 12, (20, 3)))
    operator = from_mesh(mesh, weights)
    x, y = jnp.asarray(random.normal(size=(2, 12)), jnp.float32)
    assert operator.inner(operator.apply(x), y) == pytest.approx(float(operator.inner(x, operator.apply(y))), abs=1e-3)


def test_the_papers_mass_is_not_self_adjoint(hard_graph: Mesh):
    """Erratum: with D = diag(1/d), as printed, Lemma 3.1 fails."""
    operator = from_mesh(hard_graph)
    delta = laplacian_matrix(operator)
    linked = operator.degree > 0
    right = np.diag(operator.degree) @ delta
    printed = np.diag(np.where(linked, 1 / np.where(linked, operator.degree, 1), 0)) @ delta
    np.testing.assert_allclose(right, right.T, atol=1e-12)
    assert np.abs(printed - printed.T).max() > 0.1


def test_inner_is_weighted_by_row_sums(hard_graph: Mesh, dtype):
    operator = from_mesh(hard_graph, "inverse-length")
    x, y = np.random.default_rng(1).normal(size=(2, len(hard_graph.vertices), 3)).astype(dtype)
    expected = np.einsum("v,vc,vc->c", operator.degree, x, y)
    np.testing.assert_allclose(operator.inner(jnp.asarray(x), jnp.asarray(y)), expected, rtol=tolerance(dtype, 10))


def test_signals_of_one_column_are_centred_alike(sphere: Mesh, unchecked):
    operator, x = from_mesh(sphere), np.asarray(sphere.vertices)
    np.testing.assert_array_equal(centre(operator, x[:, 0]), centre(operator, x)[:, 0])
    assert centre(operator, x[:, :0]).shape == (len(x), 0)
    with pytest.raises(JaxmarkError, match=r"centre needs a signal \[N\] or \[N, C\]"):
        centre(operator, x[1:])


def test_cotangents_agree_with_angles(sphere: Mesh):
    operator = from_mesh(sphere, "cotangent")
    angles = trimesh.Trimesh(*sphere, process=False).face_angles
    expected = {tuple(edge): 0.0 for edge in operator.edges}
    for face, corners in zip(sphere.faces, angles, strict=True):
        for k in range(3):
            expected[tuple(sorted((face[(k + 1) % 3], face[(k + 2) % 3])))] += 0.5 / np.tan(corners[k])
    values = np.array(list(expected.values()))
    np.testing.assert_allclose(operator.weights, np.maximum(values, 1e-6 * np.median(np.abs(values))), rtol=1e-9)


def test_array_weights_and_their_refusal(sphere: Mesh, unchecked):
    count = len(edges(sphere.faces))
    given_weights = np.random.default_rng(2).uniform(size=count)
    np.testing.assert_array_equal(from_mesh(sphere, given_weights).weights, given_weights)
    for bad, sentence in [(np.ones(3), "one value for each"), (-np.ones(count), "not negative"), ("cot", "not 'cot'")]:
        with pytest.raises(JaxmarkError, match=sentence):
            from_mesh(sphere, bad)
    with pytest.raises(JaxmarkError, match="length zero"):
        from_mesh(make_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), "inverse-length")


def test_centring_removes_the_position_of_every_piece(hard_graph: Mesh):
    operator = from_mesh(hard_graph, "inverse-length")
    centred = centre(operator, hard_graph.vertices)
    pieces = [[0, 1, 2, 3, 4], [6, 7, 8, 9]]
    shifted = hard_graph.vertices + 1e6
    shifted[pieces[1]] += 3e5
    for piece in pieces:
        np.testing.assert_allclose(operator.degree[piece] @ centred[piece], 0, atol=1e-12)
    np.testing.assert_array_equal(centred[[5, 10]], 0)
    np.testing.assert_allclose(centre(operator, shifted), centred, atol=1e-9)


def test_an_edge_of_weight_zero_joins_nothing():
    mesh = make_mesh(np.random.default_rng(4).normal(size=(6, 3)), np.array([[0, 1, 2], [3, 4, 5], [2, 3, 3]]))
    weights = np.array([0.0 if {*edge} == {2, 3} else 1.0 for edge in edges(mesh.faces)])
    operator = from_mesh(mesh, weights)
    centred = centre(operator, mesh.vertices)
    for piece in ([0, 1, 2], [3, 4, 5]):
        np.testing.assert_allclose(operator.degree[piece] @ centred[piece], 0, atol=1e-12)
    assert len(eigenpairs(operator).values) == 4


def test_shapes_and_types_are_checked(hard_graph: Mesh, unchecked):
    operator = from_mesh(hard_graph)
    x = jnp.ones((len(hard_graph.vertices), 3))
    with pytest.raises(JaxmarkError, match="one shape"):
        operator.inner(x, x[:, :1])
    with pytest.raises(JaxmarkError, match="floating-point"):
        operator.apply(x.astype(int))


def test_sparse_matrices(hard_graph: Mesh):
    operator = from_mesh(hard_graph, "inverse-length")
    stiffness, mass = sparse_matrices(operator)
    np.testing.assert_allclose(stiffness.toarray(), mass.toarray() @ laplacian_matrix(operator), atol=1e-12)


def test_transformations(hard_graph: Mesh, lowering, x64):
    operator = from_mesh(hard_graph, lowering=lowering)
    matrix = laplacian_matrix(operator)
    batch = jnp.asarray(np.random.default_rng(3).normal(size=(4, len(matrix), 3)))
    np.testing.assert_allclose(jax.jit(Laplacian.apply)(operator, batch[0]), matrix @ batch[0], atol=1e-12)
    mapped = jax.vmap(Laplacian.apply, (None, 0))(operator, batch)
    np.testing.assert_allclose(mapped, np.einsum("uv,bvc->buc", matrix, batch), atol=1e-12)
    np.testing.assert_allclose(jax.jacobian(operator.apply)(batch[0, :, 0]), matrix, atol=1e-12)
    gradient = jax.vmap(jax.grad(lambda x: jnp.sum(operator.apply(x) ** 2)))(batch)
    np.testing.assert_allclose(gradient, np.einsum("uv,bvc->buc", 2 * matrix.T @ matrix, batch), atol=1e-12)


def fan(spokes: int) -> Mesh:
    """A disc whose centre has many more neighbours than any other vertex."""
    rim = 1 + np.arange(spokes)
    faces = np.stack([np.zeros(spokes, int), rim, np.roll(rim, -1)], axis=1)
    return make_mesh(np.random.default_rng(5).normal(size=(spokes + 1, 3)), faces)


@pytest.mark.parametrize("weights", WEIGHTINGS)
def test_what_a_table_has_no_slots_for_is_added_one_by_one(weights, dtype):
    mesh = fan(200)
    operator = from_mesh(mesh, weights)
    assert operator.neighbours is not None
    assert len(operator.neighbours.vertices) == 4
    assert len(operator.neighbours.rest) == 196
    x = np.random.default_rng(6).normal(size=(201, 3)).astype(dtype)
    np.testing.assert_allclose(operator.apply(jnp.asarray(x)), laplacian_matrix(operator) @ x, atol=tolerance(dtype))


def test_a_table_is_used_where_it_pays(unchecked):
    assert from_mesh(fan(5)).neighbours is not None
    assert from_mesh(fan(200)).neighbours is not None
    # One triangle among a thousand vertices without edges.
    sparse = make_mesh(np.random.default_rng(7).normal(size=(1000, 3)), np.array([[0, 1, 2]]))
    assert from_mesh(sparse).neighbours is None
    assert from_mesh(sparse, lowering="gather").neighbours is not None
    assert from_mesh(fan(5), lowering="segments").neighbours is None
    with pytest.raises(JaxmarkError, match="'gather', 'segments', not 'scatter'"):
        from_mesh(sparse, lowering="scatter")


def test_what_is_past_the_last_vertex_counts_nothing(hard_graph: Mesh, lowering, dtype):
    """Arrays can be filled up to one shape."""
    operator = from_mesh(hard_graph, lowering=lowering)
    size = len(hard_graph.vertices)
    filled = operator._replace(edges=np.concatenate([operator.edges, np.full((3, 2), size)]))
    if (table := operator.neighbours) is not None:
        table = table._replace(rest=np.concatenate([table.rest, np.full((2, 3), size)]))
    filled = filled._replace(neighbours=table)
    x = jnp.asarray(hard_graph.vertices, dtype)
    np.testing.assert_array_equal(filled.apply(x), operator.apply(x))
    np.testing.assert_array_equal(laplacian_matrix(filled), laplacian_matrix(operator))


@pytest.mark.parametrize("weights", WEIGHTINGS)
def test_gradients_of_weights_are_finite_and_right(hard_graph: Mesh, lowering, weights, x64):
    operator = from_mesh(hard_graph, weights, lowering=lowering)
    assert (operator.weights is None) == (weights == "valence")
    x = jnp.asarray(hard_graph.vertices)

    def loss(weights, degree):
        return jnp.sum(operator._replace(weights=weights, degree=degree).apply(x) ** 2)

    at = host_edges(operator)[1], np.asarray(operator.degree)
    gradients = jax.grad(loss, (0, 1))(*map(jnp.asarray, at))
    rng = np.random.default_rng(8)
    for step in ((rng.normal(size=len(at[0])), 0), (0, rng.normal(size=len(at[1])) * np.sign(at[1]))):
        ahead, behind = (loss(at[0] + 1e-6 * sign * step[0], at[1] + 1e-6 * sign * step[1]) for sign in (1, -1))
        along = sum(jnp.sum(gradient * part) for gradient, part in zip(gradients, step, strict=True))
        assert along == pytest.approx(float(ahead - behind) / 2e-6, rel=1e-6)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize("weights", ["valence", "cotangent"])
def test_products_of_large_and_small_signals_are_equal(weights, monkeypatch, sphere: Mesh):
    operator = from_mesh(sphere, weights, lowering="gather")
    x = jnp.asarray(sphere.vertices, jnp.float32)
    at_once = operator.product(x)(x)
    monkeypatch.setattr(laplacian, "MIN_LARGE_VALUES", 0)
    np.testing.assert_array_equal(operator.product(x)(x), at_once)
