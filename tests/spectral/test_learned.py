"""Learned filters, against dense algebra, and against PyTorch Geometric by its formulas."""

import pickle
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxmark import spectral
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral import learned
from jaxmark.spectral.laplacian import Laplacian
from tests.dense import chebyshev_matrices, laplacian_matrix, tolerance
from tests.samples import bumpy_sphere, ordered_laplacian

pytestmark = pytest.mark.core

DEGREE, INPUTS, OUTPUTS = 4, 3, 2


@pytest.fixture(scope="module")
def graph() -> Mesh:
    """Two pieces, a boundary, and an isolated vertex, the last one."""
    small = bumpy_sphere(0)
    vertices = np.vstack([small.vertices, small.vertices[:3] + 5, [[9.0, 9, 9]]])
    return make_mesh(vertices, np.vstack([small.faces[:-2], [[12, 13, 14]]]))


@pytest.fixture(scope="module")
def operator(graph: Mesh) -> Laplacian:
    return ordered_laplacian(graph, "inverse-length")


@pytest.fixture(scope="module")
def polynomials(operator: Laplacian) -> np.ndarray:
    return chebyshev_matrices(operator, DEGREE)


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def drawn(dtype: type = np.float64) -> dict[str, np.ndarray]:
    """Parameters, with a bias that is not zero."""
    return {
        "weight": np.moveaxis(numbers(DEGREE + 1, INPUTS, OUTPUTS), 0, -1).astype(dtype),
        "bias": numbers(OUTPUTS, seed=1).astype(dtype),
    }


def published(operator: Laplacian, normalization: str, weight: np.ndarray, bias: np.ndarray, x: np.ndarray):
    """The `ChebConv` of PyTorch Geometric, as its documentation and source have it, on dense arrays.

    Isolated vertices have an eigenvalue of 1 there. A message goes from the first vertex of an edge to the second, so
    that the matrix is multiplied from the other side.
    """
    degree = np.asarray(operator.degree)
    scale = 1 / np.where(degree > 0, degree, 1)
    adjacency = -degree[:, None] * laplacian_matrix(operator)
    np.fill_diagonal(adjacency, 0)
    left, right = (np.sqrt(scale), np.sqrt(scale)) if normalization == "sym" else (scale, np.ones_like(scale))
    laplacian = np.eye(len(degree)) - left[:, None] * adjacency * right
    lambda_max = 2 * laplacian.max()
    norm = (2 * laplacian / lambda_max - np.eye(len(degree))).T
    terms = [x, norm @ x]
    for _ in range(2, weight.shape[-1]):
        terms.append(2 * norm @ terms[-1] - terms[-2])
    return sum(t @ w for t, w in zip(terms, np.moveaxis(weight, -1, 0), strict=False)) + bias


@pytest.mark.parametrize("degree", [0, 1, DEGREE])
def test_convolution_is_the_sum_over_dense_polynomials(operator, polynomials, degree, dtype):
    weight, bias, x = drawn(dtype)["weight"][..., : degree + 1], drawn(dtype)["bias"], numbers(16, INPUTS, seed=2)
    expected = np.einsum("kuv,vi,iok->uo", polynomials[: degree + 1], x, weight) + bias
    y = learned.cheb_conv(operator, {"weight": weight, "bias": bias}, x.astype(dtype))
    assert y.dtype == dtype
    np.testing.assert_allclose(y, expected, atol=tolerance(dtype, 10))


@pytest.mark.parametrize(("form", "normalization"), [("symmetric", "sym"), ("transposed", "rw")])
def test_weights_of_pytorch_geometric_serve(operator, form, normalization, dtype):
    parameters, x = drawn(dtype), numbers(16, INPUTS, seed=2)
    y = learned.cheb_conv(operator, parameters, x.astype(dtype), form=form)
    expected = published(operator, normalization, **parameters, x=x)
    np.testing.assert_allclose(y[:-1], expected[:-1], atol=1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.parametrize(("form", "normalization"), [("symmetric", "sym"), ("transposed", "rw")])
def test_layers_of_pytorch_geometric_agree(operator, form, normalization):
    torch, geometric = pytest.importorskip("torch"), pytest.importorskip("torch_geometric.nn")
    torch.manual_seed(0)
    layer = geometric.ChebConv(INPUTS, OUTPUTS, DEGREE + 1, normalization=normalization)
    edges, weights, x = np.asarray(operator.edges), np.asarray(operator.weights), numbers(16, INPUTS, seed=2)
    both = torch.tensor(np.concatenate([edges, edges[:, ::-1]]).T.astype(np.int64).copy())
    with torch.no_grad():
        theirs = layer(torch.tensor(x).float(), both, torch.tensor(np.tile(weights, 2)).float()).numpy()
        weight = np.stack([lin.weight.T.numpy() for lin in layer.lins], -1)
    ours = learned.cheb_conv(operator, {"weight": weight, "bias": layer.bias.detach().numpy()}, x, form=form)
    np.testing.assert_allclose(ours[:-1], theirs[:-1], atol=1e-5)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_derivatives_in_every_mode(operator, order, x64):
    def loss(weight, x):
        return jnp.sum(jnp.sin(learned.cheb_conv(operator, {"weight": weight, "bias": jnp.ones(OUTPUTS)}, x)))

    weight, x = jnp.asarray(drawn()["weight"]), jnp.asarray(numbers(16, INPUTS, seed=2))
    check_grads(jax.jit(loss), (weight, x), order=order)
    gradients = jax.vmap(jax.grad(loss, (0, 1)), (None, 0))(weight, jnp.stack([x, 2 * x]))
    for many, one in zip(gradients, jax.grad(loss, (0, 1))(weight, 2 * x), strict=True):
        np.testing.assert_allclose(many[1], one, atol=1e-12)


def test_gradients_are_those_of_the_dense_jacobian(operator, polynomials, dtype):
    weight, x, y_bar = drawn(dtype)["weight"], *(numbers(16, n, seed=n).astype(dtype) for n in (INPUTS, OUTPUTS))
    parameters = {"weight": jnp.asarray(weight), "bias": jnp.zeros(OUTPUTS, dtype)}
    _, pull = jax.vjp(lambda p, x: learned.cheb_conv(operator, p, x), parameters, jnp.asarray(x))
    p_bar, x_bar = pull(jnp.asarray(y_bar))
    close = {"atol": tolerance(dtype, 10)}
    np.testing.assert_allclose(p_bar["weight"], np.einsum("kuv,vi,uo->iok", polynomials, x, y_bar), **close)
    np.testing.assert_allclose(p_bar["bias"], y_bar.sum(axis=0), **close)
    np.testing.assert_allclose(x_bar, np.einsum("kuv,iok,uo->vi", polynomials, weight, y_bar), **close)


def test_edge_weights_have_derivatives(operator, x64):
    def loss(weights, weight, x):
        moved = operator._replace(weights=weights)
        p = {"weight": weight, "bias": jnp.zeros(OUTPUTS)}
        return jnp.sum(jnp.sin(learned.cheb_conv(moved, p, x, form="symmetric")))

    inputs = (operator.weights, drawn()["weight"], numbers(16, INPUTS, seed=2))
    check_grads(jax.jit(loss), tuple(map(jnp.asarray, inputs)), order=1, modes=["rev"])


def test_memory_of_the_gradient_does_not_grow_with_the_degree(operator):
    def scratch(degree: int) -> int:
        p = learned.init_cheb_conv(0, INPUTS, OUTPUTS, degree)
        x = jnp.zeros((16, INPUTS))
        loss = jax.jit(jax.grad(lambda p, x: jnp.sum(learned.cheb_conv(operator, p, x) ** 2), (0, 1)))
        of_parameters = sum(leaf.nbytes for leaf in jax.tree.leaves(p))
        return loss.lower(p, x).compile().memory_analysis().temp_size_in_bytes - 3 * of_parameters

    assert scratch(64) < scratch(4) + 16 * INPUTS * 4 * 8


def test_layers_learn_a_filter(operator, polynomials):
    x = jnp.asarray(numbers(16, INPUTS, seed=2), jnp.float32)
    target = jnp.asarray(polynomials[2] - 0.5 * polynomials[1], jnp.float32) @ x
    parameters = learned.init_cheb_conv(0, INPUTS, INPUTS, 2)

    def miss(p):
        return jnp.mean((learned.cheb_conv(operator, p, x) - target) ** 2)

    @jax.jit
    def descend(p):
        slope = jax.grad(miss)
        return jax.lax.fori_loop(0, 500, lambda _, p: jax.tree.map(lambda a, b: a - 0.2 * b, p, slope(p)), p)

    assert miss(descend(parameters)) < 0.02 * miss(parameters)


def test_parameters_are_drawn_within_their_limit():
    p = learned.init_cheb_conv(0, 30, 20, 9)
    assert p["weight"].shape == (30, 20, 10)
    assert p["bias"].tolist() == [0] * 20
    limit = np.sqrt(6 / 50)
    assert 0.99 * limit < np.abs(p["weight"]).max() <= limit
    np.testing.assert_allclose(np.std(p["weight"]), limit / np.sqrt(3), rtol=0.02)


def test_what_does_not_fit_is_refused(operator, unchecked):
    p, x = drawn(np.float32), numbers(16, INPUTS).astype(np.float32)
    for signal in (x[:, 0], x[1:], x.astype(int)):
        with pytest.raises(JaxmarkError, match=r"signal \[N|floating-point"):
            learned.cheb_conv(operator, p, signal)
    for wrong in (p | {"weight": p["weight"][1:]}, p | {"bias": p["bias"][1:]}, p | {"weight": p["weight"][..., :0]}):
        with pytest.raises(JaxmarkError, match=r"cheb_conv needs weight \[3, outputs, degree \+ 1\]"):
            learned.cheb_conv(operator, wrong, x)
    with pytest.raises(JaxmarkError, match="form is 'random-walk'"):
        learned.cheb_conv(operator, p, x, form="rw")
    for sizes in ((0, 1, 1), (1, 0, 1), (1, 1, -1)):
        with pytest.raises(JaxmarkError, match="one input and output at least"):
            learned.init_cheb_conv(0, *sizes)


def test_equinox_module_is_the_function(operator):
    eqx = pytest.importorskip("equinox")
    layer = learned.ChebConv(INPUTS, OUTPUTS, DEGREE, form="symmetric", key=jax.random.key(0))
    x = jnp.asarray(numbers(16, INPUTS, seed=2), jnp.float32)
    parameters = learned.init_cheb_conv(0, INPUTS, OUTPUTS, DEGREE)
    expected = learned.cheb_conv(operator, parameters, x, form="symmetric")
    np.testing.assert_array_equal(layer(operator, x), expected)
    gradient = eqx.filter_grad(lambda layer: jnp.sum(layer(operator, x)))(layer)
    assert [leaf.shape for leaf in jax.tree.leaves(gradient)] == [(INPUTS, OUTPUTS, DEGREE + 1), (OUTPUTS,)]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(layer)).weight, layer.weight)
    assert "ChebConv" in dir(learned)


def test_without_equinox_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "equinox", None)
    with pytest.raises(JaxmarkError, match=r"pip install 'jaxmark\[learned\]'"):
        learned.ChebConv  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'GraphConv'"):
        learned.GraphConv  # noqa: B018


@pytest.mark.parametrize("options", [{}, {"weights": "cotangent", "mass": "areas"}], ids=["valence", "cotangent"])
def test_optimisers_change_layers_and_weights_but_no_frozen_operator(options):
    """Equinox and optax, with weight decay, which also changes what has no gradient."""
    eqx, optax = pytest.importorskip("equinox"), pytest.importorskip("optax")
    mesh = bumpy_sphere(1)
    operator = spectral.from_mesh(mesh, **options)
    x = jnp.asarray(mesh.vertices, jnp.float32)
    ones = jnp.ones(len(operator.edges))

    class Model(eqx.Module):
        frozen: spectral.FrozenLaplacian
        layer: learned.ChebConv
        weights: jax.Array

        def __call__(self, x):
            smooth = spectral.filter(self.frozen.operator.with_weights(self.weights), jnp.array([1, 0.5]), x)
            return smooth + self.layer(self.frozen.operator, x)

    model = Model(spectral.freeze(operator), learned.ChebConv(3, 3, 2, key=jax.random.key(0)), ones)
    optimiser = optax.adamw(1e-2, weight_decay=0.1)
    state = optimiser.init(eqx.filter(model, eqx.is_inexact_array))

    @eqx.filter_jit
    def step(model, state):
        loss, slopes = eqx.filter_value_and_grad(lambda model: jnp.mean((model(x) - x) ** 2))(model)
        updates, state = optimiser.update(slopes, state, eqx.filter(model, eqx.is_inexact_array))
        return eqx.apply_updates(model, updates), state, loss

    losses = []
    with jax.numpy_dtype_promotion("standard"):  # which optax needs
        for _ in range(10):
            model, state, loss = step(model, state)
            losses.append(float(loss))
    assert losses[-1] < 0.8 * losses[0]
    assert not np.array_equal(model.weights, ones)
    for before, after in zip(jax.tree.leaves(operator), jax.tree.leaves(model.frozen.operator), strict=True):
        np.testing.assert_array_equal(after, jnp.asarray(before))
    np.testing.assert_array_equal(
        spectral.filter(model.frozen.operator, jnp.ones(3), x), spectral.filter(operator, jnp.ones(3), x)
    )
