import importlib
from collections import deque

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, edges, make_mesh, weld
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

submeshes = importlib.import_module("benchmarks.common.submeshes")  # by name, as these tests have a folder of it, too

MESSAGES = [b"one", b"two", b"six"]


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return bumpy_sphere(5)


@pytest.fixture(scope="module")
def marker(sphere: Mesh, key: jm.Key):
    return submeshes.make_part_marker(sphere, key, len(MESSAGES), bits=24)


@pytest.fixture(scope="module")
def marked(marker) -> Mesh:
    return marker.embed(MESSAGES, 8e-4)[0]


def hops(mesh: Mesh, start: int) -> np.ndarray:
    """By a queue, point by point."""
    near: list[list[int]] = [[] for _ in mesh.vertices]
    for i, j in edges(mesh.faces):
        near[i].append(j)
        near[j].append(i)
    found, queue = np.full(len(near), np.inf), deque([start])
    found[start] = 0
    while queue:
        here = queue.popleft()
        for there in near[here]:
            if not np.isfinite(found[there]):
                found[there] = found[here] + 1
                queue.append(there)
    return found


def test_parts_are_nearest_by_breadth_first_search():
    mesh = bumpy_sphere(3)
    features = submeshes.farthest_vertices(mesh, 4)
    distance = np.stack([hops(mesh, int(feature)) for feature in features])
    label = submeshes.parts(mesh, features)
    np.testing.assert_array_equal(distance[label, np.arange(len(label))], distance.min(axis=0))
    # Each next feature is as far from those before it as any vertex is.
    for count in range(1, 4):
        nearest = distance[:count].min(axis=0)
        assert nearest[features[count]] == nearest.max()


def test_copies_of_a_point_are_in_one_part():
    whole = bumpy_sphere(2)
    soup = make_mesh(np.asarray(whole.vertices)[whole.faces].reshape(-1, 3), np.arange(whole.faces.size).reshape(-1, 3))
    label, point = submeshes.parts(soup, submeshes.farthest_vertices(soup, 3)), weld(soup.vertices).point
    np.testing.assert_array_equal(label, label[np.unique(point, return_index=True)[1]][point])
    assert set(label) == {0, 1, 2}


def test_another_component_is_a_part_or_none():
    whole = bumpy_sphere(1)
    two = make_mesh(
        np.concatenate([whole.vertices, whole.vertices + 9]), np.concatenate([whole.faces, whole.faces + 42])
    )
    features = submeshes.farthest_vertices(two, 2)
    assert (features < 42).sum() == 1
    assert (submeshes.parts(two, features[:1]) == -1).sum() == 42


@pytest.mark.slow
def test_each_part_reads_its_own_message(marker, marked: Mesh, sphere: Mesh):
    assert [one.message for one in marker.detect(marked)] == MESSAGES
    # Reassembled: the faces that there were, and no point has moved further than the mark moves it.
    np.testing.assert_array_equal(marked.faces, sphere.faces)
    length = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    shift = np.linalg.norm(marked.vertices - sphere.vertices, axis=1) / length
    for part in range(len(MESSAGES)):
        assert np.sqrt(np.mean(shift[marker.label == part] ** 2)) == pytest.approx(8e-4, rel=1e-2)


@pytest.mark.slow
def test_parts_read_after_similarity_noise_and_the_loss_of_one(marker, marked: Mesh):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = jm.attack(make_mesh(3 * np.asarray(marked.vertices) @ turn + 1, marked.faces), "noise", 1e-3, seed=1)
    assert [one.message for one in marker.detect(moved)] == MESSAGES
    kept = (marker.label[np.asarray(moved.faces)] != 1).any(axis=1)
    found = marker.detect(moved._replace(faces=moved.faces[kept]))
    assert [one.message for one in found] == [MESSAGES[0], None, MESSAGES[2]]
    assert [one.detected() for one in found] == [True, False, True]


@pytest.mark.slow
def test_what_is_unmarked_is_not_detected(marker, sphere: Mesh, key: jm.Key, marked: Mesh):
    other = submeshes.make_part_marker(sphere, jm.new_key(), len(MESSAGES), bits=24)
    for one in [*marker.detect(sphere), *other.detect(marked)]:
        assert one.message is None
        assert not one.detected()


def test_refusals(marker, sphere: Mesh, key: jm.Key):
    for features, sentence in [
        ([], "at least one"),
        ([-1], "that faces use"),
        ([len(sphere.vertices)], "that faces use"),
        ([3, 3], "different points"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            submeshes.parts(sphere, np.array(features, int))
    with pytest.raises(jm.JaxmarkError, match="not 0"):
        submeshes.farthest_vertices(sphere, 0)
    with pytest.raises(jm.JaxmarkError, match="3 parts need as many"):
        marker.embed(MESSAGES[:2], 8e-4)
    with pytest.raises(jm.JaxmarkError, match="Part 0 of 3"):
        marker.embed([b"long", b"two", b"six"], 8e-4)
