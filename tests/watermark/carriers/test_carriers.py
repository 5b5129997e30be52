"""Every carrier by every transformation, against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxmark as jm
from jaxmark.alignment.observation import observe
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, centre
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark.carriers import Carrier, ModulatedCarrier, eigenspaces, host_bands
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.sequences import orthogonal_sequences
from tests.dense import chebyshev_matrices
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

BANDS = 16
BITS = 5


@pytest.fixture(scope="module")
def mesh():
    return bumpy_sphere(1)


@pytest.fixture(scope="module")
def operator(mesh) -> Laplacian:
    return from_mesh(mesh, "inverse-length")


@pytest.fixture(scope="module")
def signal(mesh, operator) -> np.ndarray:
    rough = mesh.vertices + 0.2 * np.random.default_rng(6).normal(size=mesh.vertices.shape)  # fills all bands
    return centre(operator, rough)


def dense_components(kind: str, operator: Laplacian, signal: np.ndarray) -> np.ndarray:
    """`[bands, N, 3]`."""
    if kind == "eigen":
        pairs = eigenpairs(operator, BANDS)
        parts = pairs.vectors.T[:, :, None] * (pairs.vectors.T @ (operator.degree[:, None] * signal))[:, None]
    else:
        family = scaling(BANDS, damping="jackson")
        parts = np.einsum("jk,kuv,vc->juc", family, chebyshev_matrices(operator, BANDS - 1), signal)
    if kind == "as printed":
        return parts
    return parts / np.sqrt(np.einsum("v,jvc->jc", operator.degree, parts**2))[:, None]


def make_carrier(
    kind: str, operator: Laplacian, signal: jax.Array, key: bytes, shared: bool = False
) -> ModulatedCarrier:
    columns = 1 if shared else 3
    sequences = orthogonal_sequences(Choices(key, b"geometry"), BITS, BANDS * columns).reshape(BITS, BANDS, columns)
    if kind == "eigen":
        return ModulatedCarrier(eigenspaces(operator, signal, eigenpairs(operator, BANDS)), sequences)
    family = scaling(BANDS, damping="jackson")
    return ModulatedCarrier(host_bands(operator, signal, family, unit_norm=kind == "host"), sequences)


@pytest.mark.parametrize("kind", ["host", "as printed", "eigen"])
@pytest.mark.parametrize("beta", ["scalar", "per band", "per band and coordinate"])
@pytest.mark.parametrize("shared", [False, True])
def test_against_dense_algebra(kind, beta, shared, operator, signal, key: jm.Key, dtype):
    random = np.random.default_rng(0)
    strength = {"scalar": 0.7, "per band": random.uniform(size=BANDS)}.get(beta, random.uniform(size=(BANDS, 3)))
    full = np.broadcast_to(np.atleast_2d(np.asarray(strength).T).T, (BANDS, 3))
    carrier = make_carrier(kind, operator, jnp.asarray(signal, dtype), key, shared)
    assert isinstance(carrier, Carrier)
    parts = dense_components(kind, operator, signal)
    # One column per bit.
    columns = np.einsum("kjc,jc,jvc->kvc", np.broadcast_to(carrier.sequences, (BITS, BANDS, 3)), full, parts)
    amplitudes = random.normal(size=BITS)
    residual = random.normal(size=signal.shape)

    def check(actual, expected):
        """Relative to the whole: in float32, scaling weak bands to unit norm scales their rounding errors too."""
        error = np.linalg.norm(np.asarray(actual, np.float64) - expected) / np.linalg.norm(expected)
        assert error < (1e-9 if dtype == np.float64 else 5e-3 if kind == "host" else 1e-5)

    beta_array = jnp.asarray(strength, dtype)
    displacement = carrier.displacement(jnp.asarray(amplitudes, dtype), beta_array)
    assert displacement.dtype == dtype
    check(displacement, np.einsum("k,kvc->vc", amplitudes, columns))
    adjoint = carrier.adjoint(jnp.asarray(residual, dtype), beta_array)
    check(adjoint, np.einsum("kvc,v,vc->k", columns, operator.degree, residual))
    check(carrier.gram(beta_array), np.einsum("avc,v,bvc->ab", columns, operator.degree, columns))


@pytest.mark.parametrize("kind", ["host", "as printed", "eigen"])
def test_adjoint_is_the_transpose(kind, operator, signal, key: jm.Key, x64):
    """By JAX's own transposition of `displacement`, in the D inner product."""
    carrier = make_carrier(kind, operator, jnp.asarray(signal), key)
    residual = jnp.asarray(np.random.default_rng(1).normal(size=signal.shape))
    (transposed,) = jax.vjp(carrier.displacement, jnp.zeros(BITS))[1](operator.degree[:, None] * residual)
    np.testing.assert_allclose(carrier.adjoint(residual), transposed, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["host", "eigen"])
def test_claim_is_a_sum_over_keyed_signs(kind, operator, signal, key: jm.Key, x64):
    """S = Σ s·a: turning one keyed sign turns its term in S, and leaves ‖a‖ alone."""
    carrier = make_carrier(kind, operator, jnp.asarray(signal), key)
    random = np.random.default_rng(2)
    residual, bits = jnp.asarray(random.normal(size=signal.shape)), jnp.asarray(random.choice([-1.0, 1.0], BITS))
    score, norm = carrier.claim(observe(residual), bits)
    assert float(score) == pytest.approx(float(bits @ carrier.adjoint(residual)))
    terms = []
    for band, coordinate in np.ndindex(BANDS, 3):
        turned = np.array(carrier.sequences)
        turned[:, band, coordinate] *= -1
        other, same = carrier._replace(sequences=turned).claim(observe(residual), bits)
        terms.append(float(score - other) / 2)
        assert float(same) == pytest.approx(float(norm))
    assert sum(terms) == pytest.approx(float(score))
    assert np.linalg.norm(terms) == pytest.approx(float(norm))


def test_a_claim_does_not_depend_on_the_size_of_the_residual(operator, signal, key: jm.Key):
    """In float32, squares underflow long before sums do."""
    carrier = make_carrier("host", operator, jnp.asarray(signal, jnp.float32), key)
    residual = np.random.default_rng(7).normal(size=signal.shape)
    ratios = []
    for size in (1.0, 1e-15, 1e-21, 1e-25, 1e15):
        score, norm = carrier.claim(observe(jnp.asarray(size * residual, jnp.float32)), jnp.ones(BITS, jnp.float32))
        ratios.append(float(score) / float(norm))
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-3)


@pytest.mark.parametrize("kind", ["host", "eigen"])
def test_the_hosts_dtype_is_kept(kind, operator, signal, key: jm.Key, x64):
    carrier = make_carrier(kind, operator, jnp.asarray(signal, jnp.float32), key)
    bits, residual, beta = np.ones(BITS), np.ones(signal.shape), np.full(BANDS, 0.5)
    outputs = (
        carrier.displacement(jnp.asarray(bits), beta),
        carrier.adjoint(jnp.asarray(residual), beta),
        carrier.gram(beta),
        *carrier.claim(observe(jnp.asarray(residual)), jnp.asarray(bits)),
    )
    assert {output.dtype for output in outputs} == {np.dtype("float32")}


def test_sequences_shared_by_coordinates_have_one_sign_a_band(operator, signal, key: jm.Key, x64):
    carrier = make_carrier("host", operator, jnp.asarray(signal), key, shared=True)
    residual = jnp.asarray(np.random.default_rng(3).normal(size=signal.shape))
    bits = jnp.ones(BITS)
    score, norm = carrier.claim(observe(residual), bits)
    terms = np.einsum("kj,jc->j", carrier.sequences[:, :, 0], carrier.components.analyse(residual))
    assert float(score) == pytest.approx(terms.sum())
    assert float(norm) == pytest.approx(np.linalg.norm(terms))


def test_differentiable_with_respect_to_host_bits_and_strength(operator, signal, key: jm.Key, x64):
    def loss(signal, bits, beta):
        return jnp.sum(jnp.sin(make_carrier("host", operator, signal, key).displacement(bits, beta)))

    check_grads(
        jax.jit(loss), (jnp.asarray(signal), jnp.ones(BITS), jnp.full(BANDS, 0.3)), order=1, modes=["rev"], eps=1e-7
    )


def test_vmap_over_messages(operator, signal, key: jm.Key, x64):
    carrier = make_carrier("host", operator, jnp.asarray(signal), key)
    messages = jnp.asarray(np.random.default_rng(4).choice([-1.0, 1.0], (3, BITS)))
    mapped = jax.jit(jax.vmap(ModulatedCarrier.displacement, (None, 0)))(carrier, messages)
    for one, message in zip(mapped, messages, strict=True):
        np.testing.assert_allclose(one, carrier.displacement(message), atol=1e-12)


def test_empty_bands_carry_nothing(operator, key: jm.Key, x64):
    """A host that is one eigenvector leaves nearly every band empty; unit norm must not blow up what is not there."""
    pairs = eigenpairs(operator)
    signal = jnp.asarray(pairs.vectors[:, :3])
    for components in (host_bands(operator, signal, scaling(BANDS)[:, :BANDS]), eigenspaces(operator, signal, pairs)):
        assert np.isfinite(components.gram).all()
        used = np.diagonal(components.gram, axis1=1, axis2=2)
        assert set(np.round(used.ravel(), 6)) <= {0.0, 1.0}
    assert used.sum() == 3  # one eigenspace per coordinate


def test_the_whole_eigenspace_stands_for_a_repeated_eigenvalue(key: jm.Key, x64):
    """The components do not depend on the basis that a solver happened to pick in an eigenspace."""
    import trimesh

    from jaxmark.geometry.mesh import make_mesh

    ball = trimesh.creation.icosahedron()
    mesh = make_mesh(ball.vertices * [1, 1.2, 1.5] + 0.1 * np.cos(3 * ball.vertices[:, [1, 2, 0]] + 1), ball.faces)
    operator = from_mesh(mesh)
    signal = jnp.asarray(centre(operator, mesh.vertices))
    pairs = eigenpairs(operator)
    turn = np.eye(11)
    for start, size in ((0, 3), (3, 5), (8, 3)):
        block = np.random.default_rng(start).normal(size=(size, size))
        turn[start : start + size, start : start + size] = np.linalg.qr(block)[0]
    turned = pairs._replace(vectors=pairs.vectors @ turn)
    amplitudes = jnp.asarray(np.random.default_rng(5).normal(size=(11, 3)))
    first, second = (eigenspaces(operator, signal, which).synthesise(amplitudes) for which in (pairs, turned))
    np.testing.assert_allclose(first, second, atol=1e-10)
    assert np.trace(eigenspaces(operator, signal, pairs).gram[0]) == pytest.approx(3)
