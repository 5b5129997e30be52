import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxmark as jm
from jaxmark.attacks import ATTACKS, laplacian_smoothing, quantisation, uniform_noise
from jaxmark.mesh import Mesh, make_mesh


@pytest.fixture(scope="module")
def cap(sphere: Mesh) -> Mesh:
    """The sphere with a hole, and an isolated vertex."""
    return make_mesh(np.vstack([sphere.vertices, [[3.0, 3, 3]]]), sphere.faces[10:])


def test_noise_is_uniform_relative_to_the_mean_radius(cap: Mesh, dtype):
    vertices = jnp.asarray(cap.vertices, dtype)
    moved = uniform_noise(Mesh(vertices, cap.faces), 0.01, jax.random.key(0)).vertices
    assert moved.dtype == dtype
    radius = np.linalg.norm(cap.vertices - cap.vertices.mean(axis=0), axis=1).mean()
    shift = np.asarray(moved - vertices, np.float64) / (0.01 * radius)
    edge = np.sort(np.concatenate([cap.faces[:, [0, 1]], cap.faces[:, [1, 2]], cap.faces[:, [2, 0]]]), axis=1)
    sides, count = np.unique(edge, axis=0, return_counts=True)
    still = np.append(np.unique(sides[count == 1]), len(shift) - 1)
    np.testing.assert_array_equal(shift[still], 0)
    free = np.delete(shift, still, axis=0)
    assert np.abs(free).max() <= 1 + 1e-3
    assert np.abs(free).max() > 0.99
    assert free.std() == pytest.approx(1 / np.sqrt(3), rel=0.05)


def test_smoothing_by_hand(cap: Mesh, x64):
    neighbours: list[set[int]] = [set() for _ in cap.vertices]
    for a, b, c in cap.faces:
        for i, j in ((a, b), (b, c), (c, a)):
            neighbours[i].add(j)
            neighbours[j].add(i)
    edge = np.sort(np.concatenate([cap.faces[:, [0, 1]], cap.faces[:, [1, 2]], cap.faces[:, [2, 0]]]), axis=1)
    sides, count = np.unique(edge, axis=0, return_counts=True)
    boundary = set(np.unique(sides[count == 1]))
    v = cap.vertices
    for _ in range(3):
        v = np.array(
            [
                x if i in boundary or not near else x + 0.1 * (v[sorted(near)].mean(axis=0) - x)
                for i, (x, near) in enumerate(zip(v, neighbours, strict=True))
            ]
        )
    smooth = laplacian_smoothing(Mesh(jnp.asarray(cap.vertices), cap.faces), 3)
    np.testing.assert_allclose(smooth.vertices, v, atol=1e-12)


@pytest.mark.parametrize("bits", [1, 5, 9])
def test_quantisation_rounds_to_its_grid(cap: Mesh, bits, x64):
    v = cap.vertices.copy()
    v[:, 2] = 4.0  # a flat axis
    rounded = np.asarray(quantisation(Mesh(jnp.asarray(v), cap.faces), bits).vertices)
    used = np.unique(cap.faces)
    np.testing.assert_array_equal(np.delete(rounded, used, axis=0), np.delete(v, used, axis=0))
    v, rounded = v[used], rounded[used]
    step = np.ptp(v, axis=0) / 2**bits
    np.testing.assert_array_equal(rounded[:, 2], 4.0)
    cells = (rounded[:, :2] - v[:, :2].min(axis=0)) / step[:2]
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-9)
    assert (np.abs(rounded - v)[:, :2] <= step[:2] / 2 + 1e-12).all()


def test_attacks_are_differentiable(cap: Mesh, x64):
    v = jnp.asarray(cap.vertices)

    def noisy(v, strength):
        return jnp.sum(jnp.sin(uniform_noise(Mesh(v, cap.faces), strength, jax.random.key(1)).vertices))

    def smoothed(v):
        return jnp.sum(jnp.sin(laplacian_smoothing(Mesh(v, cap.faces), 4).vertices))

    check_grads(jax.jit(noisy), (v, 0.01), order=1, modes=["rev", "fwd"])
    check_grads(jax.jit(smoothed), (v,), order=1, modes=["rev", "fwd"])
    straight = jax.grad(lambda v: jnp.sum(quantisation(Mesh(v, cap.faces), 4).vertices * 2))(v)
    np.testing.assert_array_equal(straight, 2)


def test_host_function_keeps_copies_together_and_digits_far_away(cap: Mesh):
    soup = make_mesh(cap.vertices[cap.faces].reshape(-1, 3) + 1e6, np.arange(3 * len(cap.faces)).reshape(-1, 3))
    for kind, strength in (("noise", 0.01), ("smoothing", 3), ("quantisation", 8)):
        once = jm.attack(soup, kind, strength, seed=3)
        np.testing.assert_array_equal(once.vertices, jm.attack(soup, kind, strength, seed=3).vertices)
        pairs = {(tuple(a), tuple(b)) for a, b in zip(soup.vertices, once.vertices, strict=True)}
        assert len(pairs) == len({a for a, _ in pairs})
        near = jm.attack(soup._replace(vertices=soup.vertices - 1e6), kind, strength, seed=3)
        np.testing.assert_allclose(once.vertices - 1e6, near.vertices, atol=1e-5)
    noisy = [jm.attack(soup, "noise", 0.01, seed=seed).vertices for seed in (0, 1)]
    assert (noisy[0] != noisy[1]).any()
    np.testing.assert_array_equal(jm.attack(soup, "noise", 0, seed=0).vertices, soup.vertices)


def test_a_stray_vertex_changes_nothing(cap: Mesh):
    stray = make_mesh(np.vstack([cap.vertices, [[1e9, 0, 0]]]), cap.faces)
    for kind, strength in (("noise", 0.01), ("smoothing", 3), ("quantisation", 8)):
        alone, beside = (jm.attack(mesh, kind, strength, seed=0).vertices for mesh in (cap, stray))
        np.testing.assert_array_equal(beside[-1], stray.vertices[-1])
        if kind != "noise":  # whose draws depend on the number of vertices
            np.testing.assert_allclose(beside[:-1], alone, atol=1e-6)
        assert np.abs(beside[:-1] - cap.vertices).max() < 0.05


def test_repeated_smoothing_is_compiled_once(cap: Mesh, caplog: pytest.LogCaptureFixture):
    compiled = []
    for seed in (0, 1):
        caplog.clear()
        with jax.log_compiles(True):
            jm.attack(cap, "smoothing", 7, seed=seed)  # a number of steps that no other test takes
        compiled.append([record.message for record in caplog.records if "ompil" in record.message])
    first, second = compiled
    assert first
    assert not second


def test_registry_states_units():
    assert all(entry.unit for entry in ATTACKS.values())


@pytest.mark.usefixtures("unchecked")
def test_refusals(cap: Mesh):
    for kind, strength, sentence in [
        ("melting", 1, "there are noise, smoothing, quantisation"),
        ("noise", -1, "not negative"),
        ("noise", float("nan"), "must be a number"),
        ("smoothing", 2.5, "whole number"),
        ("smoothing", 1e300, "to 100000"),
        ("quantisation", 0, "1 to 32"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(cap, kind, strength, seed=0)
