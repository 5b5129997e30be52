import jax
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import (
    Mesh,
    boundary_vertices,
    components,
    diagonal,
    edges,
    face_pairs,
    make_mesh,
    weld,
    weld_mesh,
)

pytestmark = pytest.mark.core

TRIANGLE = np.array([[0, 1, 2]])
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("vertices", "faces", "sentence"),
    [
        (CORNERS[:, :2], TRIANGLE, r"\[N, 3\]"),
        (np.zeros((0, 3)), np.zeros((0, 3), int), "no vertices"),
        (CORNERS, TRIANGLE.astype(float), "integers"),
        (CORNERS, np.array([[0, 1]]), "split polygons"),
        (CORNERS, np.array([[0, 1, 3]]), r"Face 0 .*\[0, 1, 3\]"),
        (CORNERS, np.array([[0, 1, -1]]), "Face 0"),
        (np.where([[0], [1], [0]], np.nan, CORNERS), TRIANGLE, "Vertex 1 .*finite"),
        (np.where([[0], [0], [1]], np.inf, CORNERS), TRIANGLE, "Vertex 2 .*finite"),
        (CORNERS.astype(complex), TRIANGLE, "real"),
    ],
)
def test_refuses_by_name(vertices, faces, sentence):
    with pytest.raises(JaxmarkError, match=sentence):
        make_mesh(vertices, faces)


def test_is_a_pytree(sphere: Mesh):
    doubled = jax.tree.map(lambda leaf: leaf * 2, sphere)
    assert isinstance(doubled, Mesh)
    np.testing.assert_array_equal(doubled.vertices, 2 * sphere.vertices)


@given(st.lists(st.sampled_from([-1.0, -0.0, 0.0, 1.0, 1 + 1e-16, 1 + 1e-15]), min_size=3, max_size=30))
def test_weld_groups_equal_positions_by_first_occurrence(numbers):
    vertices = np.array(numbers[: len(numbers) // 3 * 3]).reshape(-1, 3)
    found = weld(vertices)
    first_seen: dict[tuple, int] = {}
    for vertex, point in zip(vertices, found.point, strict=True):
        assert first_seen.setdefault(tuple(vertex), len(first_seen)) == point
    np.testing.assert_array_equal(vertices[found.first][found.point], vertices)


def test_edges_are_those_of_trimesh(sphere: Mesh):
    ours = edges(sphere.faces)
    theirs = np.unique(np.sort(trimesh.Trimesh(*sphere, process=False).edges_unique, axis=1), axis=0)
    np.testing.assert_array_equal(ours, theirs)


def test_degenerate_sides_are_no_edges():
    np.testing.assert_array_equal(edges(np.array([[0, 0, 1], [2, 2, 2]])), [[0, 1]])


def test_boundary_vertices(sphere: Mesh, hard_graph: Mesh):
    assert boundary_vertices(sphere.faces).size == 0
    open_faces = sphere.faces[1:]
    np.testing.assert_array_equal(boundary_vertices(open_faces), np.unique(sphere.faces[0]))
    # The sides of the three faces around the edge 1-2, and the rim of the second component.
    np.testing.assert_array_equal(boundary_vertices(hard_graph.faces), [0, 1, 2, 3, 4, 6, 7, 9])


def test_diagonal_ignores_unused_vertices():
    mesh = make_mesh(np.vstack([CORNERS, [[100.0, 0, 0]]]), TRIANGLE)
    assert diagonal(mesh) == pytest.approx(np.sqrt(2))
    with pytest.raises(JaxmarkError, match="diagonal of 0"):
        diagonal(make_mesh(np.ones((3, 3)), TRIANGLE))


def test_welded_mesh_keeps_positions_of_faces():
    soup = make_mesh(np.vstack([CORNERS, CORNERS[[1, 2]], [[1.0, 1, 0]]]), np.array([[0, 1, 2], [4, 3, 5]]))
    points = weld_mesh(soup, weld(soup.vertices))
    assert len(points.vertices) == 4
    np.testing.assert_array_equal(points.vertices[points.faces], soup.vertices[soup.faces])


def test_components_are_the_connected_parts():
    ball, torus = trimesh.creation.icosphere(2), trimesh.creation.torus(2.0, 1.0)
    loose = [[0.0, 0, 9]]
    both = make_mesh(
        np.concatenate([ball.vertices, loose, torus.vertices]),
        np.concatenate([ball.faces, np.asarray(torus.faces) + len(ball.vertices) + 1]),
    )
    first, second = components(both, 3)
    assert len(components(both, 1)) == 1
    assert (len(first.faces), len(second.faces)) == (len(torus.faces), len(ball.faces))
    np.testing.assert_array_equal(second.faces, ball.faces)
    np.testing.assert_array_equal(first.vertices, both.vertices)
    parts = trimesh.Trimesh(both.vertices, both.faces, process=False).split(only_watertight=False)
    assert sorted(len(part.faces) for part in parts) == sorted([len(first.faces), len(second.faces)])


def test_pairs_of_faces_are_those_that_alone_share_an_edge():
    # Faces 0 and 1 share two edges, 1 and 2 run along theirs in the same direction, and three faces meet in 6-7.
    faces = np.array(
        [[0, 1, 2], [1, 0, 2], [0, 1, 3], [4, 5, 3], [5, 6, 3], [6, 7, 8], [7, 6, 9], [6, 7, 10], [2, 0, 11]]
    )
    sides = {}
    for number, face in enumerate(faces):
        for one, other in zip(face, np.roll(face, -1), strict=True):
            sides.setdefault(frozenset((one, other)), []).append((number, (one, other)))
    expected = {}
    for found in sides.values():
        if len(found) == 2:
            (first, one), (second, other) = found
            expected.setdefault((first, second), one == other)
    pairs, against = face_pairs(faces)
    assert dict(zip(map(tuple, pairs.tolist()), against.tolist(), strict=True)) == expected
