"""Attackers without the key: sizes, gradients against finite differences, and each against weaker ones."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries import keyless as blind
from jaxmark.adversaries.expected import evidence, make_surrogate, random_mark, rescale, rms, size
from jaxmark.distortion import compare
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.reading.detectors import claims
from tests.samples import bumpy_sphere

MESSAGE, MARK = b"ok", 2e-3
SOUGHT = [("bands", 20), ("bands", 40), ("vertices", 40)]


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(3), key, bits=16)
    return marker, marker.embed(MESSAGE, jm.Budget(rms=MARK, noise=0))[0]


def owner_sees(marker: jm.watermark.NonBlindMarker, suspect: Mesh) -> float:
    """The largest S/‖a‖ of a claim of the message under the owner's key."""
    code = marker.codeword(MESSAGE)
    received = marker.receive(marker.register(suspect))
    scores, norms = claims(marker.reader, received, jnp.asarray(code, received.observed.residual.dtype))
    return float(jnp.max(scores / norms))


def test_an_attacker_sees_on_average_what_the_owner_sees(marked):
    marker, mesh = marked
    surrogate, _ = make_surrogate(mesh, "keyed", 16, MARK)
    still = jnp.zeros_like(surrogate.signal)
    found = [float(evidence(surrogate, still, jax.random.key(seed))) for seed in range(2)]
    assert np.mean(found) == pytest.approx(owner_sees(marker, mesh), rel=0.1)


@pytest.mark.parametrize("scheme", [pytest.param("keyed", marks=pytest.mark.slow), "host"])
def test_gradients_agree_with_finite_differences(scheme, key: jm.Key, x64):
    marker = jm.make_marker(bumpy_sphere(2), key, bits=8, scheme=scheme)
    mesh = marker.embed(b"k", jm.Budget(rms=5e-3, noise=0), read_back="never")[0]
    surrogate, _ = make_surrogate(mesh, scheme, 8, 5e-3)
    random = np.random.default_rng(0)
    place, way = (
        rescale(surrogate, jnp.asarray(random.normal(size=surrogate.signal.shape)), jnp.asarray(s))
        for s in (5e-3, 1e-6)
    )
    value = jax.jit(lambda shift: evidence(surrogate, shift, jax.random.key(1)))
    slope = jnp.sum(jax.grad(value)(place) * way)
    wanted = (value(place + way) - value(place - way)) / 2
    assert float(slope) == pytest.approx(float(wanted), rel=1e-5)


def test_sizes(marked):
    _, mesh = marked
    surrogate, original = make_surrogate(mesh, "keyed", 16, MARK, "dame")
    noise = jax.random.normal(jax.random.key(0), surrogate.signal.shape, surrogate.signal.dtype)
    # The metric, as small displacements make it.
    shift = rescale(surrogate, noise, jnp.asarray(2e-3, noise.dtype))
    assert float(size(surrogate, shift)) == pytest.approx(2e-3, rel=1e-4)
    moved = mesh._replace(vertices=mesh.vertices + original.diagonal * original.to_host(shift)[original.weld.point])
    assert compare(mesh, moved, ["dame"]).dame == pytest.approx(2e-3, rel=0.15)
    plain = make_surrogate(mesh, "keyed", 16, MARK)[0]
    assert float(rms(plain, rescale(plain, noise, jnp.asarray(1e-3, noise.dtype)))) == pytest.approx(1e-3, rel=1e-5)


@pytest.mark.parametrize(
    "scheme", [pytest.param("keyed", marks=pytest.mark.long), pytest.param("host", marks=pytest.mark.slow)]
)
def test_who_optimises_does_more_than_who_writes_another_mark(scheme, key: jm.Key):
    marker = jm.make_marker(bumpy_sphere(3), key, bits=16, scheme=scheme)
    mesh = marker.embed(MESSAGE, jm.Budget(rms=MARK, noise=0))[0]
    surrogate, original = make_surrogate(mesh, scheme, 16, MARK)
    strength = jnp.asarray(2 * MARK, surrogate.signal.dtype)
    fresh = jax.random.split(jax.random.key(7), 4)
    expected = jax.jit(lambda shift: jnp.mean(jax.lax.map(lambda one: evidence(surrogate, shift, one), fresh)))
    seek = {
        **{(family, steps): partial(blind.descend, family=family, steps=steps) for family, steps in SOUGHT},
        "evolution": partial(blind.evolve, family="bands", generations=10),
    }
    shifts = {name: jax.jit(one)(surrogate, strength, jax.random.key(1)) for name, one in seek.items()}
    found = {name: float(expected(shift)) for name, shift in shifts.items()}
    other = float(expected(rescale(surrogate, random_mark(surrogate, jax.random.key(1))[1], strength)))
    assert found["vertices", 40] < 0.97 * other
    if scheme == "keyed":  # whose bands are not equally strong
        assert max(found["bands", 40], found["evolution"]) < 0.97 * other
    # Twice the steps change next to nothing.
    assert found["bands", 40] == pytest.approx(found["bands", 20], rel=0.08)
    # The owner sees what was expected; by how much it varies is 1 for every key.
    suspect = mesh._replace(
        vertices=mesh.vertices + original.diagonal * original.to_host(shifts["bands", 40])[original.weld.point]
    )
    assert owner_sees(marker, suspect) == pytest.approx(found["bands", 40], abs=3)


def test_what_is_subtracted_is_some_of_the_mark(marked):
    original = marked[0].original.mesh
    gone, random = [], []
    for seed in range(6):
        marker = jm.make_marker(original, jm.Key(bytes([seed] * 32)), bits=16)
        mesh = marker.write(marker.codeword(b"ok"), MARK)[0]
        mark = np.asarray(mesh.vertices) - np.asarray(original.vertices)
        for found, attack in ((gone, blind.subtraction(bits=16, mark=MARK)), (random, "jamming")):
            shift = np.asarray(mesh.vertices) - np.asarray(jm.attack(mesh, attack, 1e-4, seed=seed).vertices)
            found.append(float(np.sum(mark * shift) / np.linalg.norm(mark) / np.linalg.norm(shift)))
    # The standard deviation of what random marks have in common with one is about 0.05, and 0.02 for the mean of six.
    assert np.mean(gone) > 0.07 > abs(np.mean(random))


@pytest.mark.slow
def test_restarts_by_vmap(marked):
    _, mesh = marked
    surrogate, _ = make_surrogate(mesh, "keyed", 16, MARK)
    strength = jnp.asarray(1e-3, surrogate.signal.dtype)
    seek = partial(blind.descend, surrogate, strength, family="warps", steps=2)
    keys = jax.random.split(jax.random.key(0), 2)
    together = jax.jit(jax.vmap(seek))(keys)
    assert together.shape == (2, *surrogate.signal.shape)
    np.testing.assert_allclose(together[1], jax.jit(seek)(keys[1]), atol=2e-6)
    assert not np.allclose(together[0], together[1], atol=1e-4)


def test_refusals(marked, unchecked):
    _, mesh = marked
    with pytest.raises(jm.JaxmarkError, match="no family of displacements 'faces'"):
        blind.descent("faces")  # pyright: ignore[reportArgumentType]
    with pytest.raises(jm.JaxmarkError, match="at least one step"):
        blind.descent(steps=0)
    with pytest.raises(jm.JaxmarkError, match="too many parameters"):
        blind.evolution("vertices")
    with pytest.raises(jm.JaxmarkError, match="no scheme 'none'"):
        jm.attack(mesh, blind.rewatermarking(scheme="none"), 1e-3, seed=0)
