"""Methods of the literature: what they write is what their formulas say, and it reads back."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
import trimesh
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.bench.method import Method
from jaxmark.bench.methods import builtin_schemes as here
from jaxmark.bench.methods import influence as spheres
from jaxmark.bench.methods import moments as patches
from jaxmark.bench.methods import radial as programme
from jaxmark.bench.methods import shared
from jaxmark.bench.methods import vertex_norms as norms
from jaxmark.bench.methods.primitives import gather, normal, scatter
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.reading import context
from tests.meshes import shared_mesh

pytestmark = pytest.mark.core

FACTORIES: dict[str, tuple[Callable[[int], Method], float]] = {
    "cho": (norms.cho, 0.05),
    "cho-variance": (norms.cho_variance, 0.05),
    "radial": (programme.radial, 0.05),
    "moments": (patches.moments, 0.032),
    "influence": (spheres.influence, 4e-4),
}
BLIND = [name for name in FACTORIES if name != "influence"]
REAL = ["bunny_closed_34834.stl", "horse_48485.ply", "armadillo_14587.obj", "hand_10345.obj", "dragon_25007.obj"]
BITS = 32


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return jm.geometry.asteroid(3000)


@pytest.fixture(scope="module")
def message() -> np.ndarray:
    return np.random.default_rng(0).random(BITS) < 0.5


@pytest.mark.parametrize("name", FACTORIES)
def test_a_message_is_read_exactly_with_its_key_alone(name, mesh, message, key):
    factory, strength = FACTORIES[name]
    method = factory(BITS)
    original = None if method.blind else mesh
    marked = method.embed(mesh, message, key, strength)
    assert method.name == name
    assert np.array_equal(marked.faces, mesh.faces)
    assert 0 < jm.compare(mesh, marked, ("rms",)).rms < 2e-3
    found, unmarked = method.read(marked, key, original), method.read(mesh, key, original)
    assert np.array_equal(found.message, message)
    assert found.score > 2 * unmarked.score
    other = method.read(marked, bytes(32), original)
    assert 6 <= (other.message != message).sum() <= 26  # of 32, fair coins


@pytest.mark.parametrize("name", BLIND)
def test_blind_readers_know_no_pose_and_no_order(name, mesh, message, key):
    factory, strength = FACTORIES[name]
    method = factory(BITS)
    marked = method.embed(mesh, message, key, strength)
    turn = Rotation.from_rotvec([0.5, -1, 2])
    moved = marked._replace(vertices=3 * turn.apply(marked.vertices) + np.array([5, 0, -9]))
    moved = jm.attack(moved, "reordering", 1, seed=1)
    assert np.array_equal(method.read(moved, key, None).message, message)


def test_bits_are_scattered_and_gathered(message, key):
    written = scatter(message, key, "any")
    assert np.array_equal(gather(written, key, "any"), message)
    assert not np.array_equal(written, message)
    assert stats.kstest(normal(key, "any", "noise", 4000), "norm").pvalue > 1e-3


@pytest.mark.parametrize(("factory", "uniform"), [(norms.cho, 1 / 2), (norms.cho_variance, 1 / 3)])
def test_powers_shift_the_statistic_of_each_bin_to_its_target(factory, uniform, mesh, message, key):
    """Recomputed bin by bin from the marked points; a uniform variable's power k has the mean 1/(k + 1)."""
    method = factory(BITS)
    points = np.asarray(method.embed(mesh, message, key, 0.05).vertices)
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    rims = np.linspace(distance.min(), distance.max(), BITS + 1)
    written = scatter(message, key, method.name)
    for place, bit in enumerate(written):
        inside = distance[(distance >= rims[place]) & (distance <= rims[place + 1])]
        inside = (inside - inside.min()) / np.ptp(inside)
        value = inside.mean() if factory is norms.cho else np.mean((2 * inside - 1) ** 2)
        assert (value - uniform) * (1 if bit else -1) > 0.05 - 1e-3
    # A bin that holds a uniform sample moves to the power that the closed form gives.
    sample = np.linspace(0, 1, 100_001)
    statistic = norms.MEAN if factory is norms.cho else norms.VARIANCE
    one = norms.Bins(np.zeros(len(sample), np.int64), sample, np.zeros(1), np.ones(1))
    expected = 1 / 2.5 if factory is norms.cho else 1 / 4
    assert statistic.of(one, statistic.raised(sample, np.full(len(sample), 1.5)))[0] == pytest.approx(
        expected, rel=1e-4
    )


def test_the_programme_moves_as_little_as_another_solver_finds():
    """On the primal, with all its constraints, beside Newton's method on the dual."""
    small = jm.geometry.asteroid(162)
    seen = programme._radii(small, 4)
    mass = seen.mean(4)[1]
    wanted = np.array([0.02, -0.03, 0.02, -0.02]) * mass * seen.width
    shift = programme._least(seen, wanted, np.ones(4, bool))
    free = seen.place < 4
    low = np.where(free, np.minimum(programme._EDGE - seen.inside, 0), 0) * seen.width
    high = np.where(free, np.maximum(1 - programme._EDGE - seen.inside, 0), 0) * seen.width
    rows = np.stack([seen.weight * (seen.place == place) for place in range(4)] + list(seen.weight * seen.ray.T))
    # SciPy's bounded least squares; constraints are rows of great weight.
    matrix = np.concatenate([np.diag(np.sqrt(seen.weight)), 1e4 * rows])
    goal = np.concatenate([np.zeros(len(shift)), 1e4 * np.append(wanted, np.zeros(3))])
    other = optimize.lsq_linear(matrix, goal, (low - 1e-12, high + 1e-12), tol=1e-14).x
    assert rows @ shift == pytest.approx(np.append(wanted, np.zeros(3)), abs=1e-12)
    assert ((shift >= low) & (shift <= high)).all()
    assert shift == pytest.approx(other, abs=1e-3 * np.abs(shift).max())


def test_volumes_of_patches_are_those_of_points_thrown_into_a_box():
    solid = trimesh.creation.box(extents=(3, 2, 1))
    box = jm.make_mesh(solid.vertices + np.array([0.5, 7, -2]), solid.faces)
    seen = patches._posed(box, 5)
    found = patches._volumes(seen)
    assert found.sum() == pytest.approx(1, abs=1e-12)
    assert np.abs(seen.mesh.vertices).max(axis=0) * seen.size == pytest.approx([1.5, 1, 0.5])
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 3)) * np.array([1.5, 1, 0.5]) / seen.size
    assert np.bincount(seen.cells(points)[0], minlength=len(found)) / len(points) == pytest.approx(found, abs=2e-3)


def test_volumes_know_nothing_of_the_meshing_and_the_pose_is_kept(mesh, message, key):
    before = patches._posed(mesh, 6)
    finer = patches._posed(jm.attack(mesh, "midpoint", 1, seed=0), 6)
    assert patches._volumes(finer) == pytest.approx(patches._volumes(before), abs=1e-9)
    marked = patches._posed(patches.moments(BITS).embed(mesh, message, key, 0.032), 6)
    assert np.abs(marked.frame - before.frame).max() < 1e-3


def test_what_agreement_proves_is_no_less_than_counted():
    """Sums of 64 cosines of random angles, counted 100,000 times."""
    sums = np.cos(np.random.default_rng(0).uniform(0, 2 * np.pi, (100_000, 64))).sum(axis=1)
    for share in (0.1, 0.01, 0.001):
        assert patches._log10_tail(float(np.quantile(sums, 1 - share)), 64) >= np.log10(share)
    assert patches._log10_tail(0.0, 64) == 0


def test_a_reader_who_knows_the_step_is_surer(mesh, message, key):
    marked = patches.moments(BITS).embed(mesh, message, key, 0.032)
    tries = [patches.moments(BITS, steps).read(marked, key, None) for steps in (patches.STEPS, (0.032,))]
    assert tries[1].log10_p == pytest.approx(tries[0].log10_p - np.log10(len(patches.STEPS)))


def nothing_there(*given: object) -> None:
    raise jm.JaxmarkError("Not aligned.")


def test_presence_alone_is_proved_by_spheres(mesh, key, monkeypatch):
    method = spheres.influence(0)
    marked = method.embed(mesh, np.zeros(0, bool), key, 2e-4)
    assert method.read(jm.attack(marked, "noise", 0.003, seed=0), key, mesh).log10_p < -10
    assert method.read(marked, bytes(32), mesh).log10_p > -4
    monkeypatch.setattr(spheres, "aligned", nothing_there)
    assert method.read(marked, key, mesh).log10_p == 0
    with pytest.raises(jm.JaxmarkError, match="is not blind"):
        method.read(marked, key, None)


@pytest.mark.parametrize("name", ["radial", "moments"])
def test_surfaces_are_asked_for(name, key):
    factory, _ = FACTORIES[name]
    cloud = jm.make_mesh(np.random.default_rng(0).normal(size=(100, 3)), np.zeros((0, 3), np.int64))
    with pytest.raises(jm.JaxmarkError, match="needs faces"):
        factory(8).read(cloud, key, None)


def test_what_no_key_decides_is_looked_at_once(sphere, monkeypatch):
    asked = []

    def views(scheme, suspect, choices):
        asked.append(suspect)
        if suspect is not sphere:
            raise jm.JaxmarkError("nothing to look at")
        yield from "abc"

    monkeypatch.setattr(FieldScheme, "views", views)
    scheme, mine, yours = here.SharedField(), context(bytes(32), 64, "field"), context(bytes([1] * 32), 64, "field")
    begun = scheme.views(sphere, mine)
    assert next(begun) == "a"
    assert list(scheme.views(sphere, yours)) == ["a", "b", "c"]
    assert list(begun) == ["b", "c"]
    assert len(asked) == 1
    other = Mesh(sphere.vertices.copy(), sphere.faces)
    for choices in (mine, yours):  # a refusal is one for each key
        with pytest.raises(jm.JaxmarkError, match="nothing to look at"):
            scheme.views(other, choices)


def test_a_suspect_is_aligned_once_for_all_methods_and_keys(mesh, key, monkeypatch):
    asked, align = [], shared.align
    suspect = Mesh(np.array(mesh.vertices), mesh.faces)  # a new array: other tests read the mesh itself
    nothing = Mesh(np.array(mesh.vertices) * [1, 1, 0], mesh.faces)

    def counted(original, suspect):
        asked.append(suspect)
        if suspect is nothing:
            raise jm.JaxmarkError("Not aligned.")
        return align(original, suspect)

    monkeypatch.setattr(shared, "align", counted)
    methods = [here.keyed(16), spheres.influence(16)]
    for method, some in product(methods, (key, bytes(32))):
        method.read(suspect, some, mesh)
    assert [each is suspect for each in asked] == [True]
    with pytest.raises(jm.JaxmarkError, match="Not aligned"):
        methods[0].read(nothing, key, mesh)
    assert methods[1].read(nothing, key, mesh).log10_p == 0, "a refusal is remembered, too"
    assert [each is nothing for each in asked] == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("name", FACTORIES)
@pytest.mark.parametrize("file", REAL)
def test_64_bits_are_read_exactly_from_real_meshes(name, file, key):
    factory, strength = FACTORIES[name]
    real, method = jm.load_mesh(shared_mesh(f"models/{file}")), factory(64)
    message = np.random.default_rng(1).random(64) < 0.5
    found = method.read(method.embed(real, message, key, strength), key, None if method.blind else real)
    assert np.array_equal(found.message, message)
