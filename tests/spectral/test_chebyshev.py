from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral import chebyshev, recurrence
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.kernels import installed
from jaxmark.spectral.laplacian import Laplacian
from tests.dense import chebyshev_matrices, tolerance
from tests.samples import bumpy_sphere, ordered_laplacian

pytestmark = pytest.mark.core

DEGREE = 9


@pytest.fixture(scope="module")
def graph() -> Mesh:
    """Small enough for dense algebra, with everything that is hard in a graph."""
    small = bumpy_sphere(0)
    vertices = np.vstack([small.vertices, small.vertices[:4] + 5, [[9.0, 9, 9]]])
    extra = np.array([[12, 13, 14], [13, 14, 15], [0, 1, 5]])
    return make_mesh(vertices, np.vstack([small.faces[:-2], extra]))


@pytest.fixture(scope="module")
def operator(graph: Mesh) -> Laplacian:
    return ordered_laplacian(graph, "inverse-length")


@pytest.fixture(scope="module")
def polynomials(operator: Laplacian) -> np.ndarray:
    return chebyshev_matrices(operator, 2 * DEGREE)


def random_array(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("degree", [0, 1, 2, DEGREE])
@pytest.mark.parametrize(("columns", "per_column"), [((), False), ((3,), False), ((3,), True)])
def test_filter_is_the_polynomial_of_the_dense_matrix(operator, polynomials, degree, columns, per_column, dtype):
    c = random_array(*(columns if per_column else ()), degree + 1).astype(dtype)
    x = random_array(len(operator.degree), *columns, seed=1).astype(dtype)
    subscripts = "ck,kuv,vc->uc" if per_column else "k,kuv,v...->u..."
    expected = np.einsum(subscripts, c, polynomials[: degree + 1], x)
    y = chebyshev.filter(operator, c, jnp.asarray(x))
    assert y.dtype == dtype
    np.testing.assert_allclose(y, expected, atol=tolerance(dtype, 10))


def test_band_components_moments_and_grams(operator, polynomials, dtype):
    bands = random_array(4, DEGREE + 1).astype(dtype)
    x, u = random_array(2, len(operator.degree), 3, seed=1).astype(dtype)
    exact = np.einsum("jk,kuv,vc->juc", bands, polynomials[: DEGREE + 1], x)
    close = {"atol": tolerance(dtype, 100), "rtol": tolerance(dtype, 10)}
    np.testing.assert_allclose(chebyshev.band_components(operator, bands, jnp.asarray(x)), exact, **close)

    cross = np.einsum("v,vc,kvu,uc->kc", operator.degree, u, polynomials[: DEGREE + 1], x)
    np.testing.assert_allclose(
        chebyshev.cross_moments(operator, jnp.asarray(u), jnp.asarray(x), degree=DEGREE), cross, **close
    )
    moments = np.einsum("v,vc,kvu,uc->kc", operator.degree, x, polynomials, x)
    np.testing.assert_allclose(chebyshev.moments(operator, jnp.asarray(x), degree=DEGREE), moments, **close)
    assert chebyshev.moments(operator, jnp.asarray(x), degree=0).shape == (1, 3)

    gram = np.einsum("v,ivc,jvc->cij", operator.degree, exact, exact)
    for method in ("bands", "moments"):
        np.testing.assert_allclose(chebyshev.gram(operator, bands, jnp.asarray(x), method=method), gram, **close)
        single = chebyshev.gram(operator, bands, jnp.asarray(x[:, 0]), method=method)
        np.testing.assert_allclose(single, gram[0], **close)


@pytest.mark.parametrize("per_column", [False, True])
def test_reverse_mode_agrees_with_dense_jacobians(operator, polynomials, per_column, x64):
    c = jnp.asarray(random_array(*([3] if per_column else []), DEGREE + 1))
    x = jnp.asarray(random_array(len(operator.degree), 3, seed=1))
    y_bar = jnp.asarray(random_array(len(operator.degree), 3, seed=2))
    _, pull = jax.vjp(lambda c, x: chebyshev.filter(operator, c, x), c, x)
    c_bar, x_bar = pull(y_bar)
    terms = polynomials[: DEGREE + 1]
    per_column_c = jnp.broadcast_to(c, (3, DEGREE + 1))
    np.testing.assert_allclose(x_bar, np.einsum("ck,kuv,uc->vc", per_column_c, terms, y_bar), atol=1e-10)
    expected = np.einsum("uc,kuv,vc->ck", y_bar, terms, x)
    np.testing.assert_allclose(c_bar, expected if per_column else expected.sum(0), atol=1e-10)


def dense_filter(parts, c, x):
    """The same filter by dense matrices that JAX differentiates: of edges and their weights, degrees and mass."""
    pairs, weights, degree, mass, scale = parts
    stiffness = jnp.diag(degree).at[pairs[:, 0], pairs[:, 1]].add(-weights).at[pairs[:, 1], pairs[:, 0]].add(-weights)
    inverse = jnp.where(degree > 0, 1 / jnp.where(degree > 0, mass * scale, 1), 0)
    shifted = inverse[:, None] * stiffness - jnp.eye(len(degree))
    terms = [x, shifted @ x]
    while len(terms) < len(c):
        terms.append(2 * shifted @ terms[-1] - terms[-2])
    return sum(c_k * t for c_k, t in zip(c, terms, strict=False))


@pytest.mark.parametrize(
    ("lumped", "order"),
    [
        (False, ("rev", "fwd")),
        (True, ("rev",)),
        pytest.param(True, ("fwd", "fwd"), marks=pytest.mark.slow),
        pytest.param(True, ("rev", "fwd"), marks=pytest.mark.slow),
        pytest.param(True, ("fwd", "rev"), marks=pytest.mark.slow),
        pytest.param(False, ("rev", "rev"), marks=pytest.mark.slow),
    ],
)
def test_all_derivatives_are_those_of_dense_matrices(operator, lumped, order, x64):
    """With respect to weights, degrees, mass, coefficients and signal, along one direction, in nested modes."""
    size = len(operator.degree)
    random = np.random.default_rng(1)
    mass = np.where(operator.degree > 0, random.uniform(1, 2, size), 0) if lumped else operator.degree
    scale = np.max(operator.degree) if lumped else np.float64(1)
    arguments = (operator.weights, operator.degree, mass, random.normal(size=5), random.normal(size=(size, 2)))
    arguments = tuple(map(jnp.asarray, arguments))
    tangents = tuple(jnp.asarray(random.normal(size=part.shape)) for part in arguments)

    def ours(weights, degree, mass, c, x):
        changed = operator._replace(weights=weights, degree=degree)
        if lumped:
            changed = changed._replace(lumped_mass=mass, scale=scale)
        moments = chebyshev.moments(changed, x, degree=2)
        return jnp.sum(jnp.sin(0.1 * chebyshev.filter(changed, c, x))) + jnp.sum(jnp.sin(0.01 * moments))

    def dense(weights, degree, mass, c, x):
        mass = mass if lumped else degree
        parts = (operator.edges, weights, degree, mass, scale)
        moments = jnp.stack([jnp.sum(mass[:, None] * x * dense_filter(parts, one, x), axis=0) for one in jnp.eye(5)])
        return jnp.sum(jnp.sin(0.1 * dense_filter(parts, c, x))) + jnp.sum(jnp.sin(0.01 * moments))

    def along(function, mode):
        if mode == "fwd":
            return lambda *given: jax.jvp(function, given, tangents)[1]
        return lambda *given: sum(map(jnp.vdot, jax.grad(function, range(5))(*given), tangents))

    found, expected = (jax.jit(reduce(along, order, function))(*arguments) for function in (ours, dense))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.skipif(installed(), reason="compiled kernels run the recurrences")
def test_both_gradients_take_one_recurrence(operator):
    """That of the value and one for the gradients by coefficients and signal, which read the same polynomials."""
    c, x = (jnp.asarray(random_array(*shape), jnp.float32) for shape in ((DEGREE + 1,), (len(operator.degree), 3)))

    def recurrences(of):
        lowered = jax.jit(jax.grad(lambda c, x: jnp.sum(jnp.sin(chebyshev.filter(operator, c, x))), of)).lower(c, x)
        return lowered.compile().as_text().count(" while(")

    assert recurrences((0, 1)) == recurrences(0) == recurrences(1) == 2


@pytest.mark.parametrize("axes", [(0, None), (None, 0), (0, 0)])
def test_derivatives_of_mapped_filters(operator, axes, x64):
    """What all members share collects the derivatives of all; and derivatives are mapped as well."""
    several = (random_array(3, DEGREE + 1), random_array(3, len(operator.degree), 2, seed=1))
    given = tuple(jnp.asarray(part if axis == 0 else part[0]) for part, axis in zip(several, axes, strict=True))

    def loss(c, x):
        return jnp.sum(jnp.sin(chebyshev.filter(operator, c, x)))

    mapped = jax.vmap(jax.grad(loss, (0, 1)), axes)(*given)
    total = jax.grad(lambda c, x: jax.vmap(loss, axes)(c, x).sum(), (0, 1))(*given)
    single = [
        jax.grad(loss, (0, 1))(*(part[k] if axis == 0 else part for part, axis in zip(given, axes, strict=True)))
        for k in range(3)
    ]
    for part, axis in enumerate(axes):
        every = jnp.stack([found[part] for found in single])
        np.testing.assert_allclose(mapped[part], every, atol=1e-10)
        np.testing.assert_allclose(total[part], every if axis == 0 else every.sum(axis=0), atol=1e-10)


@pytest.mark.parametrize(("columns", "per_column"), [((), False), ((3,), False), ((3,), True)])
def test_derivatives_are_those_of_the_recurrence(columns, per_column, dtype):
    """On more vertices than are summed at once: those in O(N) memory, and JAX's own of the recurrence."""
    operator = from_mesh(bumpy_sphere(3), "inverse-length")
    c = jnp.asarray(random_array(*(columns if per_column else ()), DEGREE + 1), dtype)
    x, u = (jnp.asarray(random_array(642, *columns, seed=seed), dtype) for seed in (1, 2))

    def loss(filter, weights, c, x):
        return jnp.sum(u * jnp.sin(filter(operator._replace(weights=weights), c, x)))

    def by_steps(operator, c, x):
        return recurrence.filter_scan(operator, jnp.broadcast_to(c, (*x.shape[1:], DEGREE + 1)).T, x)

    gradients = [
        jax.jit(jax.grad(partial(loss, filter), (0, 1, 2)))(jnp.asarray(operator.weights, dtype), c, x)
        for filter in (chebyshev.filter, by_steps)
    ]
    for got, expected in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, expected, atol=tolerance(dtype, 30) * (1 + abs(expected).max()))


@pytest.mark.parametrize("order", [("rev",), pytest.param(("fwd", "rev"), marks=pytest.mark.slow)])
def test_derivatives_of_components_and_of_their_synthesis(operator, order, x64):
    """Those of one filter for each band, along one direction in weights, degrees, coefficients and signals."""
    size = len(operator.degree)
    given = (operator.weights, operator.degree, *(random_array(*shape) for shape in ((3, 5), (size, 2), (3, size, 2))))
    given = tuple(map(jnp.asarray, given))
    tangents = tuple(jnp.asarray(random_array(*part.shape, seed=1)) for part in given)

    def loss(components, synthesise, weights, degree, c, x, parts):
        changed = operator._replace(weights=weights, degree=degree)
        taken, whole = components(changed, c, x), synthesise(changed, c, parts)
        return jnp.sum(jnp.sin(0.1 * taken)) + jnp.sum(jnp.sin(0.1 * whole))

    def one(operator, c, x):
        return recurrence.filter_scan(operator, jnp.broadcast_to(c[:, None], (len(c), 2)), x)

    def along(function, mode):
        if mode == "fwd":
            return lambda *given: jax.jvp(function, given, tangents)[1]
        return lambda *given: sum(map(jnp.vdot, jax.grad(function, range(5))(*given), tangents))

    every = jax.vmap(one, (None, 0, None)), lambda *args: jax.vmap(one, (None, 0, 0))(*args).sum(axis=0)
    found, expected = (
        jax.jit(reduce(along, order, partial(loss, *pair)))(*given)
        for pair in ((chebyshev.band_components, chebyshev.synthesise), every)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_memory_does_not_grow_with_the_degree():
    operator = jax.tree.map(jnp.asarray, from_mesh(bumpy_sphere(4)))
    x = jnp.ones((len(operator.degree), 3), jnp.float32)

    weights = jnp.ones(len(operator.edges), jnp.float32)
    weighted = operator._replace(weights=weights)

    def by_steps(operator, c, x):
        return recurrence.filter_scan(operator, c.T, x)

    def scratch(degree: int, filter=chebyshev.filter, derived=jax.value_and_grad) -> int:
        def loss(c, x, weights):
            return jnp.sum(filter(weighted._replace(weights=weights), c, x) ** 2)

        def along(*given):
            return jax.jvp(derived(loss, (0, 1, 2)), given, given)

        of = derived(loss, (0, 1, 2)) if derived is jax.value_and_grad else along
        lowered = jax.jit(of).lower(jnp.ones((3, degree + 1), jnp.float32), x, weights)
        return lowered.compile().memory_analysis().temp_size_in_bytes

    def scratch_of_moments(degree: int) -> int:
        def loss(u, x):
            return jnp.sum(chebyshev.cross_moments(operator, u, x, degree=degree) ** 2)

        compiled = jax.jit(jax.value_and_grad(loss, (0, 1))).lower(x, x).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    def scratch_of_own_moments(degree: int) -> int:
        def loss(x):
            return jnp.sum(chebyshev.moments(operator, x, degree=degree) ** 2)

        return jax.jit(jax.value_and_grad(loss)).lower(x).compile().memory_analysis().temp_size_in_bytes

    series = 2 * 3 * x.itemsize * (256 - 32)  # of three columns, and what is multiplied with them
    assert scratch_of_moments(256) < 1.1 * scratch_of_moments(32) + series
    assert scratch_of_own_moments(256) < 1.1 * scratch_of_own_moments(32) + series
    assert scratch(256) < 1.1 * scratch(32)
    assert scratch(256, derived=jax.grad) < 1.1 * scratch(32, derived=jax.grad)  # forward mode over reverse mode
    assert scratch(256, by_steps) > 4 * scratch(32, by_steps)  # what the rules are for


def test_band_by_band_is_the_same_as_all_at_once(operator, dtype):
    """Also where the last group of bands is not full."""
    bands = random_array(21, DEGREE + 1).astype(dtype)
    x = jnp.asarray(random_array(len(operator.degree), 3, seed=1).astype(dtype))
    every = chebyshev.band_components(operator, bands, x)
    sums, squares = chebyshev.over_bands(lambda y: (y.sum(axis=0), jnp.sum(y**2)), operator, bands, x)
    np.testing.assert_allclose(sums, every.sum(axis=1), atol=tolerance(dtype, 100))
    np.testing.assert_allclose(squares, jnp.sum(every**2, axis=(1, 2)), rtol=tolerance(dtype, 100))


def test_memory_does_not_grow_with_the_bands():
    operator = jax.tree.map(jnp.asarray, from_mesh(bumpy_sphere(4)))
    x = jnp.ones((len(operator.degree), 3), jnp.float32)

    def scratch(bands: int) -> int:
        def energies(x):
            c = jnp.ones((bands, 17), jnp.float32)
            return chebyshev.over_bands(lambda y: jnp.sum(y**2), operator, c, x)

        return jax.jit(energies).lower(x).compile().memory_analysis().temp_size_in_bytes

    assert scratch(160) < 1.1 * scratch(20)


def test_derivative_of_moments(operator, x64):
    x = jnp.asarray(random_array(len(operator.degree), 3))
    check_grads(lambda x: chebyshev.moments(operator, x, degree=DEGREE), (x,), order=2)


def test_moments_in_float32_lose_weak_bands_and_components_do_not(sphere):
    """Why `gram` has two methods, and which is the default."""
    operator = from_mesh(sphere)
    family = scaling(48, damping="jackson")
    x = sphere.vertices - operator.degree @ sphere.vertices / operator.degree.sum()
    with jax.enable_x64(True):
        exact = np.asarray(chebyshev.gram(operator, family, jnp.asarray(x)))
        by_moments = np.asarray(chebyshev.gram(operator, family, jnp.asarray(x), method="moments"))
    np.testing.assert_allclose(by_moments, exact, atol=1e-11 * exact.max())
    weak = np.argmin(np.diagonal(exact[0]))
    assert exact[0, weak, weak] < 1e-6 * exact[0].max()
    single = np.asarray(chebyshev.gram(operator, family, jnp.asarray(x, jnp.float32)))
    lost = np.asarray(chebyshev.gram(operator, family, jnp.asarray(x, jnp.float32), method="moments"))
    by_components = abs(single[0, weak, weak] / exact[0, weak, weak] - 1)
    assert by_components < 0.05
    assert abs(lost[0, weak, weak] / exact[0, weak, weak] - 1) > 10 * by_components


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_linearity_pose_and_vertex_order(seed):
    random = np.random.default_rng(seed)
    mesh = bumpy_sphere(1)
    c = random.normal(size=6)
    with jax.enable_x64(True):
        operator = from_mesh(mesh)
        x, y = (jnp.asarray(random.normal(size=mesh.vertices.shape)) for _ in range(2))
        a, b = random.normal(size=2)
        out = chebyshev.filter(operator, c, x)
        both = chebyshev.filter(operator, c, a * x + b * y)
        np.testing.assert_allclose(both, a * out + b * chebyshev.filter(operator, c, y), atol=1e-10)
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        np.testing.assert_allclose(chebyshev.filter(operator, c, x @ turn), out @ turn, atol=1e-10)
        order = random.permutation(len(x))
        rank = np.argsort(order)
        shuffled = from_mesh(make_mesh(mesh.vertices[order], rank[mesh.faces]))
        np.testing.assert_allclose(chebyshev.filter(shuffled, c, x[order]), out[order], atol=1e-10)


def test_refusals(operator, unchecked):
    size = len(operator.degree)
    x = jnp.ones((size, 3), jnp.float32)
    for call, sentence in [
        (lambda: chebyshev.filter(operator, np.ones(3), x[1:]), f"N = {size}"),
        (lambda: chebyshev.filter(operator, np.ones((2, 3)), x), "coefficients"),
        (lambda: chebyshev.filter(operator, np.ones((4, 3)).T, jnp.ones((size, 4))), r"\[C, degree \+ 1\]"),
        (lambda: chebyshev.filter(operator, np.ones(0), x), "coefficients"),
        (lambda: chebyshev.filter(operator, np.ones(3), x.astype(int)), "floating"),
        (lambda: chebyshev.moments(operator, x.astype(jnp.bfloat16), degree=3), "float32 or float64, got bfloat16"),
        (lambda: chebyshev.filter(operator, np.array([1, 1j]), x), "real coefficients"),
        (lambda: operator.inner(x.astype(jnp.int8), x.astype(jnp.int8)), "float32 or float64, got int8"),
        (lambda: chebyshev.band_components(operator, np.ones((2, 0)), x), r"\[bands, degree \+ 1\]"),
    ]:
        with pytest.raises(JaxmarkError, match=sentence):
            call()
