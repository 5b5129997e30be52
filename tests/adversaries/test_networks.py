"""Networks that learn to remove marks: what they start from, that they learn, and that turning changes nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark import adversaries
from jaxmark.adversaries.expected import make_surrogate, random_mark, rms
from jaxmark.adversaries.networks import Goal, Learned, estimate, init_network, learn, learned_attack, removal
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh

MARK = 2e-3


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return asteroid(500, seed=1)


def drawn(key: jax.Array):
    """A network with no layer of zeros."""
    network = init_network(key)
    return jax.tree.map(lambda one: one + 0.1 * jax.random.normal(key, one.shape, one.dtype), network)


def test_a_fresh_network_gives_the_wiener_estimate(mesh, x64):
    """Band by band, the mark's share of the energy; by one filter for each band."""
    surrogate, _ = make_surrogate(mesh, "keyed", 8, MARK)
    found = estimate(init_network(jax.random.key(0)), surrogate, surrogate.signal)
    edges = np.array([0.0, 0.02, 0.05, 0.1, 0.17, 0.26, 0.36, 0.46, 2.0])
    filters = jm.spectral.bands.intervals(edges, 129)
    written = random_mark(surrogate, jax.random.key(0))[1]
    written *= MARK / rms(surrogate, written)
    expected, count = 0, surrogate.moving.sum()
    for series in filters:
        mark, part = (jm.spectral.filter(surrogate.operator, series, x) for x in (written, surrogate.signal))
        share = np.clip(jnp.sum(mark**2) / jnp.sum((surrogate.moving * part) ** 2), 1e-6, 0.5)
        expected += surrogate.moving * share * part
    np.testing.assert_allclose(found, expected, atol=2e-3 * float(jnp.abs(expected).max()))
    assert count == len(mesh.vertices)


@pytest.mark.parametrize("work", [estimate, removal])
def test_networks_turn_with_the_mesh(work, mesh, x64):
    surrogate, _ = make_surrogate(mesh, "keyed", 8, MARK)
    turn = jnp.asarray(Rotation.random(rng=np.random.default_rng(2)).as_matrix())
    network = drawn(jax.random.key(1))
    if work is estimate:
        straight, turned = (
            estimate(network, surrogate, signal) for signal in (surrogate.signal, surrogate.signal @ turn)
        )
        np.testing.assert_allclose(turned, straight @ turn, atol=1e-9)
    else:  # noise does not turn, so without it
        quiet = (*network[:-1], {**network[-1], "bias": network[-1]["bias"].at[8:].set(-1e3)})
        straight, turned = (
            removal(quiet, surrogate, signal, jax.random.key(3))
            for signal in (surrogate.signal, surrogate.signal @ turn)
        )
        np.testing.assert_allclose(turned, straight @ turn, atol=1e-9)
    assert np.abs(straight).max() > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "mark", "steps"), [("estimate", 1e-2, 100), ("removal", MARK, 20)])
def test_what_is_learned_holds_on_other_meshes_and_is_an_attack(goal: Goal, mark, steps, mesh):
    lines, key = [], jax.random.key(0)
    meshes = [asteroid(500, seed=seed) for seed in (2, 3, 4)]
    found = learn(meshes, [mesh], seed=key, goal=goal, bits=8, mark=mark, steps=steps, log=lines.append)
    assert found.after < 0.99 * found.before
    assert len(found.losses) == steps
    assert len(lines) == steps // 100
    attack = learned_attack(found.network, goal, bits=8, mark=mark)
    suspect = jm.attack(mesh, attack, 5e-3, seed=0)
    assert jm.compare(mesh, suspect, ["rms"]).rms == pytest.approx(5e-3, rel=0.05)
    again = learn(meshes, [mesh], seed=key, goal=goal, bits=8, mark=mark, steps=2)
    np.testing.assert_allclose(again.losses, found.losses[:2], rtol=1e-4)


def test_refusals(mesh, unchecked):
    with pytest.raises(jm.JaxmarkError, match="There is no goal 'x'; there are estimate, removal"):
        adversaries.learn([mesh], [mesh], seed=0, goal="x")  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="There is no goal 'x'"):
        learned_attack(init_network(jax.random.key(0)), "x")  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="pass its attributes `network` and `goal`"):
        learned_attack(Learned((), "estimate", np.zeros(0), 0.0, 0.0), "estimate")  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="of a mark must be positive, got -1"):
        adversaries.learn([mesh], [mesh], seed=0, mark=-1.0)
    with pytest.raises(jm.JaxmarkError, match="got 1, 0 and 400"):
        adversaries.learn([mesh], [], seed=0)
