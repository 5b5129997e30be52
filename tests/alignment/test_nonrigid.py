"""Bends that are undone around each point, against dense algebra, and marks that are read without them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.nonrigid import _STEPS, DeformedPoints, undo_deformation
from jaxmark.alignment.original import Original, make_original
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, edges
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    rock = asteroid(3000, seed=4)
    return Mesh(np.asarray(rock.vertices) * [3.0, 1, 1], rock.faces)


@pytest.fixture(scope="module")
def original(mesh) -> Original:
    return make_original(mesh)


def folded(mesh: Mesh, degrees: float, joints: int = 2) -> Mesh:
    """A chain of joints along x: each piece turns with those before it, and passes into the next one smoothly."""
    vertices, random = np.asarray(mesh.vertices, float), np.random.default_rng(1)
    x = vertices[:, 0]
    place = (x - x.min()) / np.ptp(x) * joints
    low = np.minimum(place.astype(int), joints - 1)
    share = (place - low) ** 2 * (3 - 2 * (place - low))
    linear, shift, poses = np.eye(3), np.zeros(3), [(np.eye(3), np.zeros(3))]
    for joint in range(joints):
        pivot = vertices[low == joint].mean(axis=0)
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        linear, shift = linear @ turn, linear @ (pivot - turn @ pivot) + shift
        poses.append((linear, shift))
    moved = np.array([vertices @ linear.T + shift for linear, shift in poses])
    every = np.arange(len(vertices))
    return Mesh((1 - share)[:, None] * moved[low, every] + share[:, None] * moved[low + 1, every], mesh.faces)


def test_maps_are_least_squares_with_the_weights_of_a_random_walk(monkeypatch):
    """Each point's map by a dense power of the walk, and NumPy's lstsq."""
    monkeypatch.setattr("jaxmark.alignment.nonrigid._RIDGE", 0.0)
    random, original = np.random.default_rng(0), make_original(bumpy_sphere(2))
    x = np.asarray(original.positions)
    y = x + 0.1 * np.sin(3 * x[:, [1, 2, 0]]) + 1e-3 * random.normal(size=x.shape)
    found = undo_deformation(original.operator, x, DeformedPoints(y, original.used))
    walk = np.zeros((len(x), len(x)))
    walk[tuple(edges(original.points.faces).T)] = 1
    walk += walk.T
    walk = np.linalg.matrix_power((np.eye(len(x)) + walk / walk.sum(axis=1, keepdims=True)) / 2, _STEPS)
    design = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    for place in range(0, len(x), 7):
        root = np.sqrt(walk[place])[:, None]
        fitted = np.linalg.lstsq(root * design, root * y, rcond=None)[0]
        back = np.linalg.solve(fitted[:3].T, y[place] - fitted[3])
        np.testing.assert_allclose(found.displacement[place], back - x[place], atol=1e-9)
    energy = walk @ np.sum(found.displacement**2, axis=1)
    np.testing.assert_allclose(found.weights, 1 / (energy / np.median(energy) + 0.25), rtol=1e-6)


def test_a_turned_shape_leaves_nothing_and_what_is_unknown_counts_nothing(original):
    x = np.asarray(original.positions)
    turn = Rotation.from_euler("xyz", [40, -70, 10], degrees=True)
    found = undo_deformation(original.operator, x, DeformedPoints(turn.apply(x) + np.array([1.0, 2, 3]), original.used))
    np.testing.assert_allclose(found.displacement, 0, atol=1e-10)
    known = x[:, 0] < 0.1
    lost = np.where(known[:, None], turn.apply(x), 1e6)
    part = undo_deformation(original.operator, x, DeformedPoints(lost, known))
    np.testing.assert_allclose(part.displacement, 0, atol=1e-10)
    assert (part.weights[known] > 0).all()
    assert (part.weights[~known] == 0).all()


def test_the_mark_turns_back_with_its_surroundings(mesh, original):
    """A rigid fold of a rough displacement leaves it as it was, away from the joints."""
    rough = 1e-3 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    moved = Mesh(np.asarray(mesh.vertices) + original.diagonal * rough, mesh.faces)
    aligned = align(original, folded(moved, 40))
    assert aligned.deformed is not None
    assert aligned.residual > 0.005
    found = aligned.undeformed(original, aligned.deformed)
    assert found.residual < 0.3 * aligned.residual
    sound = found.weights > np.median(found.weights)
    alike = [
        np.corrcoef(one.displacement[sound].ravel(), rough[original.weld.first][sound].ravel())[0, 1]
        for one in (aligned, found)
    ]
    assert alike[0] < 0.1
    assert alike[1] > 0.5


def test_what_no_map_brings_back_is_finite_or_counts_nothing(original):
    x = np.asarray(original.positions)
    for squeezed in ([1.0, 1, 0], [1.0, 0, 0], [0.0, 0, 0]):
        found = undo_deformation(original.operator, x, DeformedPoints(x * squeezed, original.used))
        assert np.isfinite(found.displacement).all()
        assert np.isfinite(found.weights).all()
    assert (found.weights == 0).all()
    nothing = undo_deformation(original.operator, x, DeformedPoints(x, np.zeros(len(x), bool)))
    assert (nothing.weights == 0).all()


def test_a_message_is_read_in_another_pose_without_a_skeleton(mesh, key: jm.Key):
    marker = jm.make_marker(mesh, key, bits=16)
    marked, _ = marker.embed(b"ok", 8e-4)
    suspect = folded(marked, 40)
    aligned = align(marker.original, suspect)
    assert marker.decode(marker.soft_decisions(marker.receive(aligned))) is None  # by a single map
    found = marker.read(aligned)
    assert found.message == b"ok"
    assert found.detected()
    # Whether bends were undone depends on the key, and what unites several meshes must not.
    assert found.registration is aligned
    assert "non-rigid registration" in found.notes[0]


@pytest.mark.long
def test_without_a_mark_or_its_key_nothing_is_read(mesh, key: jm.Key):
    marker = jm.make_marker(mesh, key, bits=16)
    suspect = folded(marker.embed(b"ok", 8e-4)[0], 40)
    assert not marker.detect(folded(mesh, 40)).detected(1e-3)
    other = jm.make_marker(mesh, jm.Key(bytes(32)), bits=16)
    assert not other.detect(suspect).detected(1e-3)


def test_a_mark_that_reads_by_one_map_is_not_straightened(mesh, key: jm.Key, monkeypatch):
    marker = jm.make_marker(mesh, key, bits=16)
    marked, _ = marker.embed(b"ok", 8e-4)
    monkeypatch.setattr("jaxmark.alignment.result.undo_deformation", None)
    deformed = jm.attack(marked, "bending", 45, seed=0)
    assert align(marker.original, deformed).deformed is not None
    assert marker.detect(deformed).message == b"ok"
    assert align(marker.original, marked).deformed is None
