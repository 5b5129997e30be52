"""What every attack, carrier, band family and metric promises, one test a promise, over the registries."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries.by_name import ATTACKS
from jaxmark.alignment.original import make_original
from jaxmark.distortion import METRICS
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral import bands, filter, from_mesh
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark import SCHEMES
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from tests.samples import TWICE, bumpy_sphere

pytestmark = pytest.mark.core

TRACED = (
    *(("noise", 0.01), ("diagonal-noise", 0.01), ("gaussian-noise", 0.01), ("smoothing", 3), ("quantisation", 8)),
    *(("taubin", 3), ("cotangent-smoothing", 0.3), ("bilateral", 1)),
    *(("low-pass", 0.3), ("band-stop", 0.001), ("shrinkage", 0.001)),
    *(("jamming", 0.002), ("warp", 0.005), ("bending", 2), ("twisting", 2)),
    *(("similarity", 0.3), ("affine", 0.02)),
)
# With other connectivity, and traced where the faces are known; the others are host code.
REMESHING = {"midpoint": 1, "sqrt3": 1, "loop": 1, "edge-flips": 0.05, "cropping": 0.3, "holes": 0.05, "reordering": 1}
SMALL: dict[str, Scheme] = {
    "keyed": KeyedScheme(bands=16, profile=(0.0, 1.0, 1.0)),
    "host": HostScheme(bands=16),
    "eigen": EigenScheme(pairs=16),
}
FAMILIES: dict[str, Callable[[], np.ndarray]] = {
    "scaling": lambda: bands.scaling(6),
    "scaling, as printed": lambda: bands.scaling(6, kernel="printed"),
    "scaling, Jackson": lambda: bands.scaling(6, damping="jackson"),
    "scaling, Lanczos": lambda: bands.scaling(6, damping="lanczos"),
    "bernstein": lambda: bands.bernstein(6),
    "diffusion": lambda: bands.diffusion(3, 9),
    "hat": lambda: bands.hat(np.array([0.0, 0.5, 2.0]), 8),
    "intervals": lambda: bands.intervals(np.array([0.0, 0.5, 2.0]), 8),
    "heat": lambda: bands.heat([0.5, 5.0]),
    "mexican_hat": lambda: bands.mexican_hat(4, 30),
    "abspline": lambda: bands.abspline(4, 30),
    "meyer": lambda: bands.meyer(4, 30),
    "itersine": lambda: bands.itersine(4, 30),
    "lagrange": lambda: bands.lagrange(np.array([0.1, 0.7, 1.2])),
}


@pytest.fixture(scope="module")
def cap(sphere: Mesh) -> Mesh:
    """The sphere with a hole, and an isolated vertex."""
    return make_mesh(np.vstack([sphere.vertices, [[3.0, 3, 3]]]), sphere.faces[10:])


@pytest.fixture(scope="module")
def small() -> Mesh:
    """A closed surface of 162 vertices."""
    return bumpy_sphere(2)


def agree(function: Callable, each: jax.Array, atol: float, *others: jax.Array) -> None:
    """Compiled and for several inputs at once, a value and its gradient are what they are one by one."""
    both = jax.value_and_grad(lambda x, *others: jnp.sum(jnp.sin(function(x, *others))))
    values, gradients = jax.jit(jax.vmap(both))(each, *others)
    for one, value, gradient, *other in zip(each, values, gradients, *others, strict=True):
        alone, slope = both(one, *other)
        np.testing.assert_allclose(value, alone, rtol=1e-4, atol=1e-2 if each.dtype == jnp.float32 else 1e-6)
        np.testing.assert_allclose(gradient, slope, atol=atol * max(1, float(jnp.abs(slope).max())))
        assert np.isfinite(slope).all()
        assert np.abs(slope).max() > 0


# Attacks


def test_every_attack_is_held_to_the_contract():
    subdivisions = {"midpoint", "sqrt3", "loop"}  # have a module of their own
    assert {kind for kind, _ in TRACED} | subdivisions == {kind for kind, entry in ATTACKS.items() if not entry.host}


@pytest.mark.parametrize(("kind", "strength"), TRACED)
def test_attacks_by_transformation(kind, strength, small: Mesh):
    """For several meshes and keys at once."""
    apply, keys = ATTACKS[kind].apply, jax.random.key_data(jax.random.split(jax.random.key(0), 2))
    vertices = jnp.asarray(small.vertices, jnp.float32)

    def move(v: jax.Array, key: jax.Array) -> jax.Array:
        return apply(Mesh(v, small.faces), strength, jax.random.wrap_key_data(key)).vertices

    agree(move, jnp.stack([vertices, 1.01 * vertices]), 2e-3, keys)


@pytest.mark.parametrize(("kind", "strength"), TRACED)
def test_attacks_keep_the_dtype(kind, strength, cap: Mesh, dtype):
    key, vertices = jax.random.key(0), jax.ShapeDtypeStruct(cap.vertices.shape, dtype)
    moved = jax.eval_shape(lambda v: ATTACKS[kind].apply(Mesh(v, cap.faces), strength, key).vertices, vertices)
    assert moved.dtype == dtype


@pytest.mark.parametrize(("kind", "strength"), REMESHING.items())
def test_attacks_on_the_host_are_repeatable(kind, strength, small: Mesh):
    first, second = (jm.attack(small, kind, strength, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


@pytest.mark.slow
def test_attacks_keep_copies_together_and_digits_far_away(cap: Mesh):
    # With its isolated vertex it has as many points as the cap: what was compiled serves again.
    corners = np.vstack([cap.vertices[cap.faces].reshape(-1, 3), cap.vertices[-1:]])
    soup = make_mesh(corners + 1e6, np.arange(3 * len(cap.faces)).reshape(-1, 3))
    for kind, strength in TRACED:
        once = jm.attack(soup, kind, strength, seed=3)
        np.testing.assert_array_equal(once.vertices, jm.attack(soup, kind, strength, seed=3).vertices)
        pairs = {(tuple(a), tuple(b)) for a, b in zip(soup.vertices, once.vertices, strict=True)}
        assert len(pairs) == len({a for a, _ in pairs})
        near = jm.attack(soup._replace(vertices=soup.vertices - 1e6), kind, strength, seed=3)
        np.testing.assert_allclose(once.vertices - 1e6, near.vertices, atol=1e-5)
    noisy = [jm.attack(soup, "noise", 0.01, seed=seed).vertices for seed in (0, 1)]
    assert (noisy[0] != noisy[1]).any()
    np.testing.assert_array_equal(jm.attack(soup, "noise", 0, seed=0).vertices, soup.vertices)


@pytest.mark.slow
def test_attacks_leave_a_stray_vertex_alone(cap: Mesh):
    stray = make_mesh(np.vstack([cap.vertices[:-1], [[1e9, 0, 0]]]), cap.faces)
    for kind, strength in TRACED:
        alone, beside = (jm.attack(mesh, kind, strength, seed=0).vertices for mesh in (cap, stray))
        np.testing.assert_array_equal(beside[-1], stray.vertices[-1])
        np.testing.assert_allclose(beside[:-1], alone[:-1], atol=1e-6)
        assert kind == "similarity" or np.abs(beside[:-1] - cap.vertices[:-1]).max() < 0.05


# Carriers


def test_every_scheme_is_held_to_the_contract():
    assert SMALL.keys() == SCHEMES.keys()


@pytest.mark.parametrize("name", SMALL)
def test_carriers_by_transformation(name, small: Mesh, key: jm.Key, dtype):
    """Linear in the bits, back by the adjoint, the dtype kept, the same again, and nothing where no face is."""
    stray = make_mesh(np.vstack([small.vertices, [[9.0, 9, 9]]]), small.faces)
    original = make_original(stray)
    carrier, again = (SMALL[name].carrier(original, Choices(key, b""), 8, 8) for _ in range(2))
    words = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], (2, 8)), original.signal.dtype)
    if dtype == np.float64:
        agree(carrier.displacement, words, 1e-4)
    one, both = carrier.displacement(words[0]), carrier.displacement(words[0] + words[1])
    assert one.dtype == carrier.adjoint(one).dtype == carrier.gram().dtype == dtype
    close = (1e-3 if dtype == np.float32 else 1e-10) * float(jnp.abs(both).max())
    np.testing.assert_allclose(both, one + carrier.displacement(words[1]), atol=close)
    np.testing.assert_array_equal(one, again.displacement(words[0]))
    np.testing.assert_array_equal(one[len(small.vertices) :], 0)
    gram = np.asarray(carrier.gram())
    np.testing.assert_allclose(carrier.adjoint(one), gram @ words[0], atol=1e-4 * np.abs(gram).max() * 8)
    assert carrier.code_bits == 8


@pytest.mark.parametrize("name", SMALL)
def test_marks_move_copies_of_a_point_together(name, small: Mesh, key: jm.Key):
    corners = np.ravel(small.faces)
    soup = make_mesh(small.vertices[corners], np.arange(len(corners)).reshape(-1, 3))
    original = make_original(soup)
    marker = jm.make_marker(soup, key, bits=8, scheme=HostScheme(bands=32) if name == "host" else name)
    marked, _ = marker.write(marker.codeword(b"c"), 1e-3)
    moved = np.asarray(marked.vertices) - soup.vertices
    np.testing.assert_array_equal(moved, moved[original.weld.first][original.weld.point])


# Bands


@pytest.mark.parametrize("name", FAMILIES)
def test_families_filter_as_functions_of_the_spectrum(name, small: Mesh, dtype):
    """Against the dense eigenbasis, by every transformation."""
    family, operator = FAMILIES[name](), from_mesh(small)
    pairs = eigenpairs(operator)
    x = pairs.vectors @ np.random.default_rng(0).normal(size=(len(pairs.values), 2))
    response = np.polynomial.chebyshev.chebval(pairs.values - 1, family.T)
    expected = np.einsum("vi,ji,ic->jvc", pairs.vectors, response, pairs.vectors.T @ (operator.degree[:, None] * x))
    coefficients, signal = jnp.asarray(family, dtype), jnp.asarray(x, dtype)
    found = jax.vmap(lambda row: filter(operator, row, signal))(coefficients)
    assert found.dtype == dtype
    scale = np.abs(family).sum() * np.abs(x).max()
    np.testing.assert_allclose(found, expected, atol=(1e-4 if dtype == np.float32 else 1e-12) * scale)
    if dtype == np.float64:
        agree(lambda row: filter(operator, row, signal), coefficients, 1e-4)
        agree(lambda y: filter(operator, coefficients[-1], y), jnp.stack([signal, 2 * signal]), 1e-4)


# Metrics


@pytest.mark.parametrize("name", METRICS)
def test_metrics_see_neither_strays_nor_copies(name, small: Mesh):
    """A metric is zero for a mesh itself, the same each time, and of the surface, however it is stored."""
    noisy = jm.attack(small, "noise", 0.01, seed=0)

    def stray(mesh: Mesh) -> Mesh:
        return make_mesh(np.vstack([mesh.vertices, [[5.0, 5, 5]]]), mesh.faces)

    def measure(first: Mesh, second: Mesh) -> float:
        return jm.distortion.measure(first, second, [name])[name] or 0.0

    value = measure(small, noisy)
    assert value > 0
    assert measure(small, noisy) == pytest.approx(value, rel=TWICE, abs=0)
    assert measure(small, small) == pytest.approx(0, abs=1e-6)
    assert measure(stray(small), stray(noisy)) == pytest.approx(value, rel=1e-4)
    corners = np.ravel(small.faces)
    split = [make_mesh(mesh.vertices[corners], np.arange(len(corners)).reshape(-1, 3)) for mesh in (small, noisy)]
    assert measure(*split) == pytest.approx(value, rel=1e-4)
