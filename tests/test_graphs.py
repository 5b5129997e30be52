"""Laplacians of edges and of points, against dense matrices and trees that are searched by brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg
from scipy.spatial import distance

import jaxmark as jm
from jaxmark import spectral


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
