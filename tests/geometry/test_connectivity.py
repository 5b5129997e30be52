"""Vertices recognised by their surroundings: against permutations that are known, and colours by their definition."""

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.geometry.connectivity import _MIN_RINGS, Rings, matching_vertices
from jaxmark.geometry.mesh import Mesh, boundary_vertices, edges, make_mesh
from tests.meshes import shared_mesh
from tests.samples import bumpy_sphere, exact_sheet

pytestmark = pytest.mark.core


def shuffled(mesh: Mesh, seed: int) -> tuple[Mesh, np.ndarray]:
    """Vertices and faces in another order, corners turned; and where each vertex went."""
    random = np.random.default_rng(seed)
    order = random.permutation(len(mesh.vertices))
    place = np.argsort(order)
    faces = random.permutation(place[mesh.faces])
    turned = np.take_along_axis(faces, (np.arange(3) + random.integers(0, 3, (len(faces), 1))) % 3, axis=1)
    return make_mesh(np.asarray(mesh.vertices)[order], turned), place


def cropped(mesh: Mesh, keep: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Only some vertices, and the faces between them; and where each went, or -1."""
    place = np.where(keep, np.cumsum(keep) - 1, -1)
    faces = place[np.asarray(mesh.faces)]
    return make_mesh(np.asarray(mesh.vertices)[keep], faces[(faces >= 0).all(axis=1)]), place


@pytest.mark.parametrize("seed", range(3))
def test_a_shuffled_mesh_is_recognised_wherever_it_went(seed):
    mesh = bumpy_sphere(4, seed)
    other, place = shuffled(mesh, seed)
    np.testing.assert_array_equal(matching_vertices(mesh, other), place)
    crumpled = other._replace(vertices=np.random.default_rng(seed).normal(size=other.vertices.shape))
    np.testing.assert_array_equal(matching_vertices(mesh, crumpled), place)


def test_a_mesh_whose_faces_are_turned_round_is_recognised():
    """As after a mirror, by as much as one that is as it was."""
    for mesh in (bumpy_sphere(4), cropped(bumpy_sphere(3), np.arange(642) % 7 > 0)[0]):
        other, _ = shuffled(mesh, 3)
        found = matching_vertices(mesh, other)
        np.testing.assert_array_equal(matching_vertices(mesh, other._replace(faces=other.faces[:, ::-1])), found)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_what_is_left_of_a_mesh_is_recognised(share):
    mesh = bumpy_sphere(4)
    height = np.asarray(mesh.vertices) @ [0.3, 0.5, 0.8]
    part, place = cropped(mesh, height > np.quantile(height, share))
    other, moved = shuffled(part, 1)
    found = matching_vertices(mesh, other)
    assert (found[found >= 0] == moved[place[found >= 0]]).all()
    # All but the rim, where faces are missing.
    inside = len(part.vertices) - len(boundary_vertices(part.faces))
    assert np.sum(found >= 0) > 0.97 * inside
    # And the other way round.
    assert np.sum(matching_vertices(other, mesh) >= 0) > 0.97 * inside


def test_a_mesh_among_others_is_recognised():
    mesh, torus = bumpy_sphere(3), trimesh.creation.torus(2.0, 1.0)
    size = len(mesh.vertices)
    scene = make_mesh(
        np.concatenate([torus.vertices, mesh.vertices, np.asarray(mesh.vertices)[:5]]),
        np.concatenate([torus.faces, len(torus.vertices) + np.asarray(mesh.faces)]),
    )
    np.testing.assert_array_equal(matching_vertices(mesh, scene), len(torus.vertices) + np.arange(size))


def test_nothing_is_matched_twice_and_sides_stay_sides():
    """Where many vertices look alike."""
    for mesh in (exact_sheet(15), bumpy_sphere(2)):
        other, _ = shuffled(mesh, 2)
        found = matching_vertices(mesh, other)
        some = found[found >= 0]
        assert len(np.unique(some)) == len(some)
        pairs = found[edges(mesh.faces)]
        pairs = np.sort(pairs[(pairs >= 0).all(axis=1)], axis=1)
        there = {tuple(pair) for pair in edges(other.faces)}
        assert {tuple(pair) for pair in pairs} <= there


def test_other_meshes_are_not_recognised():
    mesh = bumpy_sphere(4)
    for other in (bumpy_sphere(4, 7), exact_sheet(50), bumpy_sphere(3, 1)):
        assert np.mean(matching_vertices(mesh, other) >= 0) < 0.02


def test_colours_tell_apart_what_their_definition_does():
    """Multisets of the neighbours' colours, ring by ring."""
    mesh = exact_sheet(9)
    size, pairs = len(mesh.vertices), edges(mesh.faces)
    near = [np.concatenate([pairs[pairs[:, 0] == v, 1], pairs[pairs[:, 1] == v, 0]]) for v in range(size)]
    incident = np.bincount(np.ravel(mesh.faces), minlength=size)
    expected = [(len(near[v]), int(incident[v])) for v in range(size)]
    rings = Rings(mesh)
    for _ in range(_MIN_RINGS + 2):
        expected = [(expected[v], tuple(sorted(expected[u] for u in near[v]))) for v in range(size)]
        names = {name: place for place, name in enumerate(dict.fromkeys(expected))}
        expected = [names[name] for name in expected]
        found = rings.grow()
        same = found[:, None] == found
        np.testing.assert_array_equal(same, np.equal.outer(expected, expected))


def test_a_real_mesh_is_recognised():
    mesh = jm.load_mesh(shared_mesh("models/casting.off"))
    other, place = shuffled(mesh, 3)
    found = matching_vertices(mesh, other)
    assert np.mean(found >= 0) > 0.99
    assert (found[found >= 0] == place[found >= 0]).all()
