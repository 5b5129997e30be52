"""Laplacians of edges and of points, against dense matrices and trees that are searched by brute force."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg
from scipy.spatial import distance

import jaxmark as jm
from jaxmark import spectral
from jaxmark.spectral.padding import pad_edges
from tests.dense import tolerance
from tests.samples import bumpy_sphere, ordered_laplacian

pytestmark = pytest.mark.core


def dense(edges: np.ndarray, weights: np.ndarray, size: int) -> np.ndarray:
    """Δ, by definition."""
    matrix = np.zeros((size, size))
    np.add.at(matrix, tuple(edges.T), weights)
    matrix += matrix.T
    return np.eye(size) - matrix / matrix.sum(axis=1, keepdims=True)


@pytest.fixture(scope="module")
def graph() -> tuple[np.ndarray, np.ndarray]:
    """A connected graph of 20 vertices, whose edges run in either direction, and weights."""
    rng = np.random.default_rng(0)
    chosen = rng.permutation([(i, j) for i in range(20) for j in range(i) if i == j + 1 or rng.random() < 0.2])
    turned = rng.random(len(chosen)) < 0.5
    return np.where(turned[:, None], chosen[:, ::-1], chosen), rng.uniform(0.1, 2, len(chosen))


@pytest.mark.parametrize("lowering", ["gather", "segments"])
def test_filters_of_any_graph_are_those_of_dense_matrices(graph, lowering, x64):
    edges, weights = graph
    operator = spectral.from_edges(edges, weights, lowering=lowering)
    matrix, x = dense(edges, weights, 20), np.random.default_rng(1).normal(size=(20, 2))
    np.testing.assert_allclose(operator.apply(jnp.asarray(x)), matrix @ x, atol=1e-12)
    bands = spectral.bands.scaling(6, damping="jackson")
    mass = np.diag(np.asarray(operator.degree))
    values, vectors = linalg.eigh(mass @ matrix, mass)  # M-orthonormal
    for band in bands:
        gain = np.polynomial.chebyshev.chebval(values - 1, band)
        expected = vectors @ np.diag(gain) @ vectors.T @ mass @ x
        np.testing.assert_allclose(spectral.filter(operator, band, jnp.asarray(x)), expected, atol=1e-10)
    np.testing.assert_allclose(spectral.eigenpairs(operator).values, values[1:], atol=1e-10)


@pytest.mark.parametrize("lowering", ["gather", "segments"])
def test_duplicates_are_refused_or_added(graph, lowering, x64):
    edges, weights = graph
    twice = np.concatenate([edges, edges[:5, ::-1], edges[:2]])
    more = np.concatenate([weights, weights[:5], weights[:2]])
    with pytest.raises(jm.JaxmarkError, match=r"The edge \[.*\] is there more than once; merge them"):
        spectral.from_edges(twice, more)
    operator = spectral.from_edges(twice, more, duplicates="add", lowering=lowering)
    x = np.random.default_rng(1).normal(size=20)
    np.testing.assert_allclose(operator.apply(jnp.asarray(x)), dense(twice, more, 20) @ x, atol=1e-12)
    both = np.concatenate([edges, edges[:, ::-1]])
    again = spectral.from_edges(both, duplicates="add", lowering=lowering).apply(jnp.asarray(x))
    np.testing.assert_allclose(again, spectral.from_edges(edges).apply(jnp.asarray(x)), atol=1e-12)


@pytest.mark.parametrize(
    ("edges", "weights", "size", "sentence"),
    [
        ([[0, 1], [2, 2]], None, None, r"Edge 1, \[2, 2\], joins a vertex to itself"),
        ([[0, 1], [1, 5]], None, 5, r"Edge 1, \[1, 5\], has a vertex that is not among 0 to 4"),
        ([[0, 1], [-1, 2]], None, None, r"Edge 1, \[-1, 2\], has a vertex that is not"),
        ([[0.0, 1.0]], None, None, r"Edges are whole numbers \[E, 2\], got float64"),
        ([0, 1], None, None, r"Edges are whole numbers \[E, 2\]"),
        ([[0, 1]], [-1.0], None, "weights must be finite and not negative"),
        ([[0, 1]], [np.nan], None, "weights must be finite and not negative"),
        ([[0, 1]], [1.0, 2.0], None, "one value for each of the 1 edges"),
    ],
)
def test_what_is_no_graph_is_refused(edges, weights, size, sentence):
    with pytest.raises(jm.JaxmarkError, match=sentence):
        spectral.from_edges(edges, weights, size)


def test_vertices_without_edges():
    operator = spectral.from_edges([[0, 2]], size=4)
    np.testing.assert_array_equal(operator.apply(jnp.array([1.0, 2, 3, 4])), [-2, 0, 2, 0])
    empty = spectral.from_edges(np.zeros((0, 2), int), size=3)
    np.testing.assert_array_equal(empty.apply(jnp.ones(3)), np.zeros(3))


@pytest.mark.parametrize("weights", ["valence", "inverse-length", "gaussian"])
def test_points_are_joined_to_their_nearest(weights, x64):
    points, k = np.random.default_rng(0).normal(size=(60, 3)), 6
    apart = distance.cdist(points, points)
    nearest = np.argsort(apart, axis=1)[:, 1 : k + 1]
    joined = np.zeros((60, 60), bool)
    np.put_along_axis(joined, nearest, True, axis=1)
    edges = np.argwhere(np.triu(joined | joined.T))
    lengths = apart[tuple(edges.T)]
    reach = np.sort(apart, axis=1)[:, k].mean()
    value = {
        "valence": np.ones(len(edges)),
        "inverse-length": 1 / lengths,
        "gaussian": np.exp(-(lengths**2) / 2 / reach**2),
    }
    operator = spectral.from_points(points, k, weights)
    expected = dense(edges, value[weights], 60) @ points
    np.testing.assert_allclose(operator.apply(jnp.asarray(points)), expected, atol=1e-12)


@pytest.mark.usefixtures("unchecked")
def test_points_that_cannot_be_joined():
    points = np.zeros((5, 3))
    assert spectral.from_points(points, 2).degree.min() >= 2
    assert np.isfinite(spectral.from_points(points, 2, "gaussian").degree).all()
    with pytest.raises(jm.JaxmarkError, match="are at the same position"):
        spectral.from_points(points, 2, "inverse-length")
    with pytest.raises(jm.JaxmarkError, match="Each of 5 points has up to 4 neighbours, not 5"):
        spectral.from_points(points, 5)
    with pytest.raises(jm.JaxmarkError, match="Points are finite numbers"):
        spectral.from_points([[np.nan, 0.0]] * 3, 1)
    with pytest.raises(jm.JaxmarkError, match="weights are 'valence'"):
        spectral.from_points(points, 2, "heavy")  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def ball() -> jm.Mesh:
    return bumpy_sphere(2)


@pytest.mark.parametrize("weights", ["cotangent", "valence"])
def test_a_mass_gives_the_generalised_problem(ball, weights, x64):
    """Filters, bands, moments and eigenpairs against SciPy's dense decomposition of (S, M)."""
    operator = spectral.from_mesh(ball, weights, mass="areas")
    pairs, size = np.asarray(operator.edges), len(ball.vertices)
    stiffness = np.zeros((size, size))
    stiffness[tuple(pairs.T)] = -(1.0 if operator.weights is None else np.asarray(operator.weights))
    stiffness += stiffness.T
    stiffness -= np.diag(stiffness.sum(axis=1))
    mass = np.diag(np.asarray(operator.mass))
    values, vectors = linalg.eigh(stiffness, mass)
    assert values[-1] < 2 * operator.scale < 1.02 * values[-1]
    relative = values / operator.scale
    x = np.random.default_rng(1).normal(size=(size, 2))
    parts = vectors.T @ mass @ x
    bands = spectral.bands.scaling(8, damping="jackson")
    gains = np.polynomial.chebyshev.chebval(relative - 1, bands.T)
    expected = np.einsum("vi,bi,ic->bvc", vectors, gains, parts)
    np.testing.assert_allclose(spectral.band_components(operator, bands, jnp.asarray(x)), expected, atol=1e-10)
    np.testing.assert_allclose(spectral.filter(operator, bands[1], jnp.asarray(x)), expected[1], atol=1e-10)
    energies = np.einsum("vc,uv,buc->bc", x, mass, expected)
    moments = spectral.moments(operator, jnp.asarray(x), degree=4)
    np.testing.assert_allclose(bands @ moments[: bands.shape[1]], energies, rtol=1e-10)
    found = spectral.eigenpairs(operator, 20)
    np.testing.assert_allclose(found.values * operator.scale, values[1:21], rtol=1e-10)
    np.testing.assert_allclose(found.vectors.T @ mass @ found.vectors, np.eye(20), atol=1e-10)
    root = spectral.filter_rational(operator, np.array([[1, 0, 0, 1, 3.0, 0]]), jnp.asarray(x))
    np.testing.assert_allclose(root, vectors @ (parts / (1 + 3 * relative)[:, None]), atol=1e-9)


def test_weights_and_areas_are_those_of_libigl(ball):
    igl = pytest.importorskip("igl")
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    expected = igl.cotmatrix(vertices, faces)
    pairs = jm.geometry.edges(faces)
    theirs = np.asarray(expected[pairs[:, 0], pairs[:, 1]]).ravel()
    ours = spectral.cotangent_weights(vertices, faces)
    np.testing.assert_allclose(ours, np.maximum(theirs, 1e-6 * np.median(np.abs(theirs))), atol=1e-12)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    np.testing.assert_allclose(spectral.vertex_areas(vertices, faces), mass, rtol=1e-12)


def test_weights_of_degenerate_faces_are_finite_and_the_same_traced(x64):
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2]])

    def values(vertices):
        return spectral.cotangent_weights(vertices, faces), spectral.vertex_areas(vertices, faces)

    for host, traced in zip(values(vertices), jax.jit(values)(jnp.asarray(vertices)), strict=True):
        assert np.isfinite(host).all()
        np.testing.assert_allclose(traced, host, atol=1e-14)
    gradient = jax.grad(lambda v: sum(part.sum() for part in values(v)))(jnp.asarray(vertices))
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize(("weights", "mass"), [("cotangent", "areas"), ("inverse-length", None)])
def test_derivatives_by_positions_go_through_the_operator(ball, weights, mass, x64):
    bound = None if mass is None else float(2 * spectral.from_mesh(ball, weights, mass=mass).scale)
    c = np.random.default_rng(0).normal(size=7)
    vertices, turn = jnp.asarray(ball.vertices), jnp.asarray(np.random.default_rng(1).normal(size=ball.vertices.shape))

    @jax.jit
    def loss(vertices):
        operator = spectral.from_mesh(jm.Mesh(vertices, ball.faces), weights, mass=mass, bound=bound)
        return jnp.sum(jnp.sin(spectral.filter(operator, c, vertices)))

    fixed = spectral.from_mesh(ball, weights, mass=mass)
    np.testing.assert_allclose(loss(vertices), jnp.sum(jnp.sin(spectral.filter(fixed, c, vertices))), rtol=1e-12)
    difference = (loss(vertices + 1e-6 * turn) - loss(vertices - 1e-6 * turn)) / 2e-6
    np.testing.assert_allclose(jax.jvp(loss, (vertices,), (turn,))[1], difference, rtol=1e-6)
    np.testing.assert_allclose(jnp.vdot(jax.grad(loss)(vertices), turn), difference, rtol=1e-6)


def test_graphs_of_faces_and_of_edges(ball):
    faces, pairs = np.asarray(ball.faces), jm.geometry.edges(ball.faces)
    by_faces = spectral.from_mesh(ball, elements="faces")
    expected = {
        (i, j) for i in range(len(faces)) for j in range(i + 1, len(faces)) if len(set(faces[i]) & set(faces[j])) == 2
    }
    assert set(map(tuple, np.asarray(by_faces.edges).tolist())) == expected
    by_edges = spectral.from_mesh(ball, "inverse-length", elements="edges")
    meet = np.array([[len(set(a) & set(b)) == 1 for b in pairs.tolist()] for a in pairs.tolist()])
    rows, columns = np.nonzero(np.triu(meet))
    found = np.asarray(by_edges.edges)
    order = np.lexsort(found.T[::-1])
    np.testing.assert_array_equal(found[order], np.stack([rows, columns], axis=1))
    middles = np.asarray(ball.vertices)[pairs].mean(axis=1)
    lengths = np.linalg.norm(middles[found[:, 0]] - middles[found[:, 1]], axis=1)
    np.testing.assert_allclose(by_edges.weights, 1 / lengths)


def test_matrices_of_other_libraries(ball, x64):
    """S of a graph with a mass, and the intrinsic Delaunay triangulation of its own library."""
    operator = spectral.from_mesh(ball, "cotangent", mass="areas")
    stiffness, mass = spectral.sparse_matrices(operator)
    again = spectral.from_matrices(stiffness * float(operator.scale), mass)
    x = jnp.asarray(ball.vertices)
    np.testing.assert_allclose(again.apply(x), operator.apply(x), atol=1e-10)
    np.testing.assert_allclose(spectral.from_matrices(stiffness).mass, stiffness.diagonal(), rtol=1e-12)


def test_robust_weights_are_those_of_their_own_library(ball, x64):
    """Of an intrinsic Delaunay triangulation, with a non-manifold edge; a lone vertex moves nothing."""
    robust = pytest.importorskip("robust_laplacian")
    vertices = np.vstack([ball.vertices, [[2, 2, 2], [9, 9, 9]]])
    faces = np.vstack([ball.faces, [*np.asarray(ball.faces)[0, :2], len(ball.vertices)]])
    mesh, x = jm.make_mesh(vertices, faces), jnp.asarray(vertices)
    stiffness, mass = robust.mesh_laplacian(vertices, faces)
    expected = (stiffness @ vertices)[:-1]
    operator = spectral.from_mesh(mesh, "robust", mass="areas")
    by_mass = expected / mass.diagonal()[:-1, None]
    np.testing.assert_allclose((operator.apply(x) * operator.scale)[:-1], by_mass, atol=1e-9 * np.abs(by_mass).max())
    plain = spectral.from_mesh(mesh, "robust")
    np.testing.assert_allclose(plain.apply(x)[:-1], expected / stiffness.diagonal()[:-1, None], atol=1e-9)
    for found in (operator, plain):
        assert np.min(found.weights) > 0
        np.testing.assert_array_equal(found.apply(x)[-1], 0)


def test_negative_cotangents_are_clipped_kept_or_refused(ball, x64, unchecked):
    """Kept, they are libigl's, and with a mass the spectrum is that of the dense pencil, in [0, 2]."""
    igl = pytest.importorskip("igl")
    vertices, faces = np.asarray(ball.vertices) * [1, 1, 0.2], np.asarray(ball.faces)
    mesh = jm.make_mesh(vertices, faces)
    stiffness = -igl.cotmatrix(vertices, faces).toarray()
    pairs = jm.geometry.edges(faces)
    weights = -stiffness[tuple(pairs.T)]
    assert (weights < 0).any()
    np.testing.assert_allclose(spectral.cotangent_weights(vertices, faces, "keep"), weights, atol=1e-12)
    operator = spectral.from_mesh(mesh, "cotangent", negative="keep", mass="areas")
    values = linalg.eigh(stiffness, np.diag(operator.mass), eigvals_only=True)
    assert values[0] > -1e-9 * values[-1]
    assert values[-1] <= 2 * operator.scale <= 1.02 * values[-1]
    np.testing.assert_allclose(spectral.eigenpairs(operator).values * operator.scale, values[1:], rtol=1e-9)
    traced = jax.jit(lambda v: spectral.cotangent_weights(v, faces, "keep"))(jnp.asarray(vertices))
    np.testing.assert_allclose(traced, weights, atol=1e-12)
    bad = pairs[np.flatnonzero(weights < 0)[0]].tolist()
    for options, sentence in [
        ({"negative": "refuse"}, f"negative cotangent weights, the first is {re.escape(str(bad))}"),
        ({"negative": "keep"}, "needs a mass"),
        ({"negative": "drop"}, "not 'drop'"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            spectral.from_mesh(mesh, "cotangent", **options)


@pytest.mark.parametrize("options", [{}, {"weights": "cotangent", "mass": "areas"}])
def test_a_batch_of_unlike_meshes_is_each_of_them(options, dtype):
    """Of all sizes, some of them long enough to have an order of their own, and with neighbours without a slot."""
    fan = np.array([[0, k, k + 1] for k in range(1, 40)])
    angles = np.arange(41)
    wheel = jm.make_mesh(np.stack([np.cos(angles), np.sin(angles), 0.1 * angles], axis=1), fan)
    meshes = [bumpy_sphere(1), wheel, bumpy_sphere(2)]
    operators = [spectral.from_mesh(mesh, lowering="gather", **options) for mesh in meshes]
    operators[1] = pad_edges(operators[1], 5)
    operators.append(ordered_laplacian(meshes[0], **options))
    check_batch(operators, dtype)
    check_batch([operators[0], spectral.from_mesh(wheel, lowering="segments")], dtype)


def check_batch(operators: list, dtype) -> None:
    rng = np.random.default_rng(0)
    batch = spectral.stack(operators)
    size = batch.degree.shape[1]
    c = rng.normal(size=9).astype(dtype)
    x = rng.normal(size=(len(operators), size, 2)).astype(dtype)
    found = jax.vmap(spectral.filter, (0, None, 0))(batch, c, x)
    gradient = jax.grad(lambda c: jnp.sum(jnp.sin(jax.vmap(spectral.filter, (0, None, 0))(batch, c, x))))(c)
    assert gradient.shape == c.shape
    for k, one in enumerate(operators):
        own = len(one.degree)
        expected = spectral.filter(one, c, x[k, :own])
        np.testing.assert_allclose(found[k, :own], expected, atol=tolerance(dtype, 10))


def test_batches_of_one_size_share_a_program(dtype):
    """Other graphs in each batch, with and without weights; too small a size is refused."""
    rng = np.random.default_rng(0)
    batched = jax.jit(jax.vmap(spectral.filter, (0, None, 0)))
    for weights, programs in (("valence", 1), ("gaussian", 2)):
        for _ in range(3):
            clouds = [rng.normal(size=(size, 3)) for size in rng.integers(40, 100, 3)]
            operators = [spectral.from_points(cloud, 5, weights) for cloud in clouds]
            x = rng.normal(size=(3, 128)).astype(dtype)
            found = batched(spectral.stack(operators, size=128, edges=512), rng.normal(size=6).astype(dtype), x)
            assert batched._cache_size() == programs  # pyright: ignore[reportAttributeAccessIssue]
            c = rng.normal(size=6).astype(dtype)
            found = batched(spectral.stack(operators, size=128, edges=512), c, x)
            for k, one in enumerate(operators):
                expected = spectral.filter(one, c, x[k, : len(one.degree)])
                np.testing.assert_allclose(found[k, : len(expected)], expected, atol=tolerance(dtype, 10))
    with pytest.raises(jm.JaxmarkError, match="do not fit into size=128 and edges=99"):
        spectral.stack(operators, size=128, edges=99)


def test_operators_of_traced_positions_stack(ball, x64):
    """Gradients of meshes of unequal sizes in one batch are those of each alone."""
    meshes, bound = [ball, bumpy_sphere(1)], 300.0
    x = [jnp.asarray(mesh.vertices) for mesh in meshes]
    c = np.random.default_rng(0).normal(size=5)

    def operators(positions):
        made = zip(positions, meshes, strict=True)
        return [spectral.from_mesh(jm.Mesh(v, mesh.faces), "cotangent", mass="areas", bound=bound) for v, mesh in made]

    def together(positions):
        size = max(map(len, positions))
        signals = jnp.stack([jnp.pad(v, ((0, size - len(v)), (0, 0))) for v in positions])
        batch = spectral.stack(operators(positions))
        found = jax.vmap(spectral.filter, (0, None, 0))(batch, c, signals)
        return sum(jnp.sum(jnp.sin(one[: len(v)])) for one, v in zip(found, positions, strict=True))

    def alone(positions):
        return sum(
            jnp.sum(jnp.sin(spectral.filter(one, c, v))) for one, v in zip(operators(positions), positions, strict=True)
        )

    for found, expected in zip(jax.jit(jax.grad(together))(x), jax.jit(jax.grad(alone))(x), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.slow
def test_a_batch_of_32_unlike_meshes(dtype):
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(size, 3)) for size in rng.integers(40, 400, 32)]
    check_batch([spectral.from_points(cloud, 5, "gaussian") for cloud in clouds], dtype)


def test_what_is_no_operator_is_refused(ball, unchecked):
    size = len(ball.vertices)
    stiffness = spectral.sparse_matrices(spectral.from_mesh(ball))[0].toarray()
    signed = stiffness.copy()
    signed[0, 1] += 5
    signed[1, 0] += 5
    signed[[0, 1], [0, 1]] -= 5
    flat = jm.Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for call, sentence in [
        (lambda: spectral.from_mesh(ball, mass=np.ones(3)), f"one number for each of {size} vertices"),
        (lambda: spectral.from_mesh(ball, mass=np.zeros(size)), "Vertex 0 has edges, but no mass"),
        (lambda: spectral.from_mesh(ball, mass="volumes"), "mass is an array, or 'areas', not 'volumes'"),
        (lambda: spectral.from_mesh(ball, elements="corners"), "not 'corners'"),
        (lambda: spectral.from_mesh(ball, "cotangent", elements="faces"), "cotangents of a mesh belong to its vert"),
        (
            lambda: jax.jit(lambda m: spectral.from_mesh(m).degree)(ball),
            "from_mesh needs concrete faces, but is called",
        ),
        (lambda: jax.jit(lambda w: spectral.from_mesh(ball, w).degree)(np.ones(480)), "unlike `with_weights`"),
        (lambda: jax.jit(lambda p: spectral.from_points(p).degree)(ball.vertices), "from_points needs concrete points"),
        (
            lambda: jax.jit(lambda e: spectral.from_edges(e).degree)(np.array([[0, 1]])),
            "from_edges needs concrete edges",
        ),
        (lambda: spectral.from_mesh(ball, "robust", elements="edges"), "robust weights of a mesh belong to its vert"),
        (lambda: jax.jit(lambda v: spectral.from_mesh(jm.Mesh(v, ball.faces), "robust"))(ball.vertices), "concrete"),
        (lambda: spectral.from_mesh(flat, "cotangent"), "No edge has a positive cotangent"),
        (lambda: spectral.from_matrices(stiffness[1:]), "square"),
        (lambda: spectral.from_matrices(stiffness + np.eye(size)), "rows sum to zero"),
        (lambda: spectral.from_matrices(signed), r"The edge \[0, 1\] has the weight -4"),
        (lambda: spectral.from_matrices(stiffness, np.ones((size, size))), "diagonal"),
        (lambda: spectral.from_mesh(ball, mass="areas", bound=1.0), "1 is no bound of the spectrum, which reaches"),
        (lambda: spectral.from_mesh(ball, mass="areas", bound=float("nan")), "nan is no bound"),
        (lambda: spectral.from_mesh(ball, bound=3.0), "belongs to a mass"),
        (lambda: spectral.stack([]), "no operator"),
        (lambda: spectral.from_mesh("ball.ply"), "A mesh is needed, got str"),
        (lambda: spectral.from_mesh(jm.Mesh(ball.vertices[:9], ball.faces)), "but the mesh has 9 vertices"),
        (lambda: spectral.from_mesh(jm.Mesh(ball.vertices, ball.faces - 1)), "A face refers to vertex -1"),
        (lambda: spectral.from_mesh(jm.Mesh(ball.vertices[:, :2], ball.faces)), r"array \[N, 3\], got"),
        (lambda: spectral.from_mesh(jm.Mesh(ball.vertices, ball.faces[:, :2])), r"whole numbers \[F, 3\], got"),
        (lambda: spectral.from_mesh(jm.Mesh(ball.vertices * np.nan, ball.faces), "inverse-length"), "is not finite"),
        (lambda: spectral.from_mesh(ball).with_weights(jnp.ones(3)), r"edges; got weights of the shape \(3,\)"),
        (lambda: spectral.from_mesh(ball).apply(jnp.ones(3)), rf"a signal of {size} vertices, got \(3,\)"),
        (
            lambda: jax.jit(lambda v: spectral.from_mesh(jm.Mesh(v, ball.faces), mass="areas").mass)(ball.vertices),
            "need a positive bound",
        ),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            call()
