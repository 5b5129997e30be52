import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.typing import ArrayLike
from scipy.stats import kstest

import jaxmark as jm
from jaxmark.adversaries.by_name import ATTACKS, attack_each
from jaxmark.attacks import (
    affine,
    diagonal_noise,
    gaussian_noise,
    laplacian_smoothing,
    mark_noise,
    quantisation,
    similarity,
    uniform_noise,
)
from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh, make_mesh
from tests.samples import bumpy_sphere
from tests.test_contract import TRACED

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def cap(sphere: Mesh) -> Mesh:
    """The sphere with a hole, and an isolated vertex."""
    return make_mesh(np.vstack([sphere.vertices, [[3.0, 3, 3]]]), sphere.faces[10:])


def relative_shift(kind, cap: Mesh, dtype: np.dtype) -> np.ndarray:
    """How far inner vertices move at a strength of 0.01, in units of it; boundary and isolated ones do not."""
    vertices = jnp.asarray(cap.vertices, dtype)
    moved = kind(Mesh(vertices, cap.faces), 0.01, jax.random.key(0)).vertices
    assert moved.dtype == dtype
    surface = cap.vertices[np.unique(cap.faces)]
    radius = np.linalg.norm(surface - surface.mean(axis=0), axis=1).mean()
    shift = np.asarray(moved - vertices, np.float64) / (0.01 * radius)
    edge = np.sort(np.concatenate([cap.faces[:, [0, 1]], cap.faces[:, [1, 2]], cap.faces[:, [2, 0]]]), axis=1)
    sides, count = np.unique(edge, axis=0, return_counts=True)
    still = np.append(np.unique(sides[count == 1]), len(shift) - 1)
    np.testing.assert_array_equal(shift[still], 0)
    return np.delete(shift, still, axis=0)


def test_noise_is_uniform_relative_to_the_mean_radius(cap: Mesh, dtype):
    free = relative_shift(uniform_noise, cap, dtype)
    assert np.abs(free).max() <= 1 + 1e-3
    assert np.abs(free).max() > 0.99
    assert free.std() == pytest.approx(1 / np.sqrt(3), rel=0.05)


def test_gaussian_noise_is_normal_relative_to_the_mean_radius(cap: Mesh, dtype):
    free = relative_shift(gaussian_noise, cap, dtype)
    for column in free.T:
        assert kstest(column, "norm").pvalue > 1e-3
    assert free.std() == pytest.approx(1, rel=0.05)
    assert np.abs(np.corrcoef(free.T) - np.eye(3)).max() < 4 / np.sqrt(len(free))


def check_uniform(shift: np.ndarray, width: float, used: np.ndarray) -> None:
    """Kolmogorov and Smirnov do not reject it, coordinates do not correlate, and no used vertex is left alone."""
    np.testing.assert_array_equal(np.delete(shift, used, axis=0), 0)
    shift = shift[used]
    for column in shift.T:
        assert kstest(column, "uniform", (-width, 2 * width)).pvalue > 1e-3
    assert np.abs(np.corrcoef(shift.T) - np.eye(3)).max() < 4 / np.sqrt(len(shift))
    assert (np.abs(shift).max(axis=1) > 0).all()
    # The vertices' root mean square is the half width.
    assert np.sqrt(np.mean(np.sum(shift**2, axis=1))) == pytest.approx(width, rel=0.05)


def test_noise_relative_to_the_diagonal_moves_boundaries_too(cap: Mesh, dtype):
    vertices = jnp.asarray(cap.vertices, dtype)
    moved = diagonal_noise(Mesh(vertices, cap.faces), 0.01, jax.random.key(2)).vertices
    assert moved.dtype == dtype
    used = np.unique(cap.faces)
    width = 0.01 * float(np.linalg.norm(np.ptp(cap.vertices[used], axis=0)))
    check_uniform(np.asarray(moved - vertices, np.float64), width, used)


def test_noise_relative_to_the_mark(cap: Mesh, dtype):
    vertices = jnp.asarray(cap.vertices, dtype)
    used = np.unique(cap.faces)
    mark = 1e-3 * np.random.default_rng(0).normal(size=vertices.shape)
    marked, original = Mesh(vertices + jnp.asarray(mark, dtype), cap.faces), Mesh(vertices, cap.faces)
    moved = mark_noise(marked, original, 3.0, jax.random.key(4)).vertices
    assert moved.dtype == dtype
    width = 3 * np.sqrt(np.mean(np.sum(mark[used] ** 2, axis=1)))
    check_uniform(np.asarray(moved - marked.vertices, np.float64), width, used)
    np.testing.assert_array_equal(mark_noise(original, original, 3.0, jax.random.key(4)).vertices, vertices)


def linear_map(before: ArrayLike, after: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The affine map between two sets of points, which must be one: its matrix, and where the mean goes from where."""
    before, after = np.asarray(before), np.asarray(after)
    centred, other = before - before.mean(axis=0), after - after.mean(axis=0)
    matrix = np.linalg.lstsq(centred, other, rcond=None)[0].T
    np.testing.assert_allclose(centred @ matrix.T, other, atol=1e-12)
    return matrix, after.mean(axis=0) - before.mean(axis=0)


def test_similarities_turn_scale_and_shift(cap: Mesh, x64):
    used, strength = np.unique(cap.faces), 0.3
    start = cap.vertices[used]
    turns, scales = [], []
    keys = jax.random.split(jax.random.key(0), 200)
    for moved in np.asarray(jax.jit(jax.vmap(lambda key: similarity(cap, strength, key).vertices))(keys)):
        np.testing.assert_array_equal(np.delete(moved, used, axis=0), np.delete(cap.vertices, used, axis=0))
        matrix, shift = linear_map(start, moved[used])
        scale = np.cbrt(np.linalg.det(matrix))
        np.testing.assert_allclose(matrix @ matrix.T, scale**2 * np.eye(3), atol=1e-12)
        assert np.linalg.norm(shift) == pytest.approx(strength * np.linalg.norm(np.ptp(start, axis=0)), rel=1e-9)
        turns.append(np.trace(matrix / scale))
        scales.append(np.log(scale) / np.log1p(strength))
    assert kstest(scales, "uniform", (-1, 2)).pvalue > 1e-3
    # Of uniformly random rotations, the angle has the distribution (θ - sin θ)/π.
    angle = np.arccos((np.array(turns) - 1) / 2)
    assert kstest((angle - np.sin(angle)) / np.pi, "uniform").pvalue > 1e-3


def test_affine_maps_are_as_far_from_the_identity_as_asked(cap: Mesh, x64):
    used = np.unique(cap.faces)
    keys = jax.random.split(jax.random.key(0), 20)
    for strength in (0.2, 0.99):
        for moved in np.asarray(
            jax.jit(jax.vmap(lambda s, key: affine(cap, s, key).vertices, (None, 0)))(strength, keys)
        ):
            np.testing.assert_array_equal(np.delete(moved, used, axis=0), np.delete(cap.vertices, used, axis=0))
            matrix, shift = linear_map(cap.vertices[used], moved[used])
            assert np.linalg.norm(matrix - np.eye(3)) == pytest.approx(strength, rel=1e-9)
            assert np.linalg.det(matrix) > 0
            np.testing.assert_allclose(shift, 0, atol=1e-12)


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


@pytest.mark.slow
def test_attacks_are_differentiable(cap: Mesh, x64):
    v = jnp.asarray(cap.vertices)

    def noisy(v, strength):
        return jnp.sum(jnp.sin(uniform_noise(Mesh(v, cap.faces), strength, jax.random.key(1)).vertices))

    def smoothed(v):
        return jnp.sum(jnp.sin(laplacian_smoothing(Mesh(v, cap.faces), 4).vertices))

    def others(v, strength):
        key = jax.random.key(1)
        meshes = [
            kind(Mesh(v, cap.faces), strength, key) for kind in (diagonal_noise, gaussian_noise, similarity, affine)
        ]
        return sum(jnp.sum(jnp.sin(mesh.vertices)) for mesh in [*meshes, mark_noise(meshes[0], cap, strength, key)])

    check_grads(jax.jit(noisy), (v, 0.01), order=1, modes=["rev", "fwd"])
    check_grads(jax.jit(others), (v, 0.2), order=1, modes=["rev", "fwd"])
    check_grads(jax.jit(smoothed), (v,), order=1, modes=["rev", "fwd"])
    straight = jax.grad(lambda v: jnp.sum(quantisation(Mesh(v, cap.faces), 4).vertices * 2))(v)
    np.testing.assert_array_equal(straight, 2)


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


@pytest.mark.parametrize("kind", ATTACKS)
def test_registry_states_units_and_strengths(kind):
    entry = ATTACKS[kind]
    assert entry.unit
    assert len(entry.strengths) > 1
    # They go one way: most attacks are the stronger for more, and quantisation for fewer bits.
    steps = np.diff(entry.strengths)
    assert (steps > 0).all() or (steps < 0).all()


def moved_by(mesh: Mesh, kind: str, strength: float) -> float:
    return float(rms(jm.attack(mesh, kind, strength, seed=0).vertices - mesh.vertices))


@pytest.mark.parametrize("kind", [kind for kind, _ in TRACED])
def test_the_last_usual_strength_moves_vertices_further_than_the_first(kind, cap: Mesh):
    weakest, *_, strongest = ATTACKS[kind].strengths
    assert 0 < moved_by(cap, kind, weakest) < moved_by(cap, kind, strongest)


@pytest.mark.usefixtures("unchecked")
def test_refusals(cap: Mesh):
    for kind, strength, sentence in [
        ("melting", 1, "there are noise, .*edge-flips"),
        ("noise", -1, "from 0 to"),
        ("noise", float("nan"), "must be a number"),
        ("smoothing", 2.5, "whole number"),
        ("smoothing", 1e20, "to 100000"),
        ("quantisation", 0, "1 to 32"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(cap, kind, strength, seed=0)


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(4), key, bits=64)
    return marker, marker.embed(b"jaxmark!")[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "strength"),
    [
        *(("noise", 0.005), ("diagonal-noise", 0.002), ("smoothing", 30), ("quantisation", 9)),
        *(("gaussian-noise", 0.003), ("taubin", 50), ("cotangent-smoothing", 3), ("bilateral", 5)),
        *(("low-pass", 0.8), ("band-stop", 0.1), ("jamming", 0.0002)),
        *(("warp", 0.01), ("bending", 10), ("twisting", 10)),
        *(("similarity", 0.5), ("affine", 0.3), ("edge-flips", 0.005), ("edge-flips", 0.3)),
    ],
)
def test_marks_of_the_default_budget_read(kind, strength, marked: tuple[jm.watermark.NonBlindMarker, Mesh]):
    marker, mesh = marked
    suspect = jm.attack(mesh, kind, strength, seed=1)
    if (kind, strength) == ("edge-flips", 0.3):
        pytest.importorskip("igl")
    found = marker.detect(suspect)
    assert found.message == b"jaxmark!"
    assert found.detected()
    # A few flips leave most vertices' surroundings as they were; many leave only the surface.
    assert (
        found.registration.method == {0.005: "connectivity", 0.3: "surface"}[strength]
        if kind == "edge-flips"
        else "same"
    )


@pytest.mark.slow
def test_a_mark_reads_in_noise_of_twice_its_size(marked: tuple[jm.watermark.NonBlindMarker, Mesh]):
    marker, mesh = marked
    noisy = mark_noise(mesh, marker.original.mesh, 2.0, jax.random.key(0))
    assert marker.detect(noisy).message == b"jaxmark!"


@pytest.mark.parametrize(
    ("kind", "strength"),
    [
        *(pytest.param(*one, marks=() if one[0] in ("noise", "smoothing") else pytest.mark.slow) for one in TRACED),
        *(("midpoint", 1), ("holes", 0.1)),
    ],
)
def test_several_meshes_at_once_are_as_one_by_one(cap: Mesh, kind: str, strength: float):
    # With a copy of a vertex, at two sizes and places.
    faces = np.vstack([cap.faces, [[len(cap.vertices), 0, 1]]])
    vertices = np.vstack([cap.vertices, cap.vertices[300]])
    meshes = [make_mesh(scale * vertices + 7, faces) for scale in (1.0, 3.0)]
    found = attack_each(meshes, kind, strength, seeds=[4, 5])
    for mesh, one, seed in zip(meshes, found, (4, 5), strict=True):
        alone = jm.attack(mesh, kind, strength, seed=seed)
        np.testing.assert_array_equal(one.faces, alone.faces)
        np.testing.assert_allclose(one.vertices, alone.vertices, rtol=0, atol=1e-5)
        moved = one.vertices.shape != mesh.vertices.shape or np.abs(one.vertices - mesh.vertices).max() > 1e-4
        assert moved


def test_meshes_of_different_faces_are_attacked_each_by_itself(sphere: Mesh, cap: Mesh):
    found = attack_each([sphere, cap], "noise", 0.01, seeds=[1, 2])
    for mesh, one, seed in zip((sphere, cap), found, (1, 2), strict=True):
        np.testing.assert_array_equal(one.vertices, jm.attack(mesh, "noise", 0.01, seed=seed).vertices)
    with pytest.raises(jm.JaxmarkError, match="strength of an attack"):
        attack_each([sphere], "noise", -1.0, seeds=[1])


def test_attacks_of_the_host_refuse_to_be_traced_by_name():
    mesh = bumpy_sphere(1)
    for entry in ATTACKS.values():
        if not entry.host:
            continue

        def traced(vertices, entry=entry):
            return entry.apply(Mesh(vertices, mesh.faces), entry.strengths[0], None).vertices.sum()

        with pytest.raises(jm.JaxmarkError, match=f"^{entry.apply.__name__} runs on the host"):
            jax.grad(traced)(jnp.asarray(mesh.vertices))
    with pytest.raises(jm.JaxmarkError, match="runs on the host"):
        jax.jit(lambda v: jm.attack(Mesh(v, mesh.faces), "noise", 0.1, seed=0).vertices)(jnp.asarray(mesh.vertices))
