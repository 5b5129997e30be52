"""Edge flips against their definition, by loops, and by trimesh."""

import jax
import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike

import jaxmark as jm
from jaxmark.attacks import edge_flips
from jaxmark.geometry.mesh import Mesh, make_mesh
from tests.samples import bumpy_sphere, exact_sheet

pytestmark = pytest.mark.core

Side = tuple[int, int]


def uses(faces: ArrayLike) -> dict[Side, list[tuple[int, int, int]]]:
    """The faces of each undirected edge."""
    found: dict[Side, list[tuple[int, int, int]]] = {}
    for a, b, c in np.asarray(faces).tolist():
        for i, j in ((a, b), (b, c), (c, a)):
            if i != j:
                found.setdefault((min(i, j), max(i, j)), []).append((a, b, c))
    return found


def check(before: Mesh, after: Mesh, share: float) -> None:
    """The edges asked for are replaced, and nothing else is."""
    np.testing.assert_array_equal(after.vertices, before.vertices)
    assert after.faces.shape == before.faces.shape
    old, new = uses(before.faces), uses(after.faces)
    wanted = round(share * len(old))
    assert len(new) == len(old)
    assert len(old.keys() - new.keys()) == wanted
    for edge in old.keys() - new.keys():
        assert len(old[edge]) == 2
    # No edge has more faces than before, and a new one has just two; boundaries are where they were.
    for edge, faces in new.items():
        assert len(faces) == len(old.get(edge, [0, 0]))
    for face in after.faces[(after.faces != before.faces).any(axis=1)]:
        assert len(set(face)) == 3


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.5])
def test_the_surface_stays_one(share, sphere: Mesh):
    after = edge_flips(sphere, share, jax.random.key(0))
    check(sphere, after, share)
    first, second = (trimesh.Trimesh(*mesh, process=False) for mesh in (sphere, after))
    assert second.is_watertight
    assert second.is_winding_consistent
    assert second.euler_number == first.euler_number == 2
    assert second.nondegenerate_faces(height=0).all()


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_flat_sheet_stays_covered_once(share):
    """All faces look up, and have together the area that they had."""
    sheet = exact_sheet(20)
    sheet = make_mesh(sheet.vertices * [1, 1, 0], sheet.faces)
    after = edge_flips(sheet, share, jax.random.key(3))
    check(sheet, after, share)
    up = [np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).swapaxes(0, 1))[:, 2] for mesh in (sheet, after)]
    assert (up[0] > 0).all()
    assert (up[1] > 0).all()
    assert up[1].sum() == pytest.approx(up[0].sum(), rel=1e-12)


def test_one_flip_turns_no_face_by_90_degrees_and_makes_none_thin():
    """Flip by flip: the shape of what replaced the two faces of each edge."""
    mesh = bumpy_sphere(2)
    rough = make_mesh(mesh.vertices + 0.1 * np.random.default_rng(0).normal(size=mesh.vertices.shape), mesh.faces)
    one, size = 1 / len(uses(rough.faces)), []
    for seed in range(60):
        after = edge_flips(rough, one, jax.random.key(seed))
        check(rough, after, one)
        changed = np.flatnonzero((after.faces != rough.faces).any(axis=1))
        assert len(changed) == 2
        old, new = (trimesh.Trimesh(rough.vertices, mesh.faces[changed], process=False) for mesh in (rough, after))
        assert set(old.faces.ravel()) == set(new.faces.ravel())
        assert (new.face_normals @ old.face_normals.sum(axis=0) > 0).all()
        longest = np.linalg.norm(np.diff(new.triangles[:, [0, 1, 2, 0]], axis=1), axis=2).max(axis=1)
        size.append((2 * new.area_faces / longest**2).min())
    assert min(size) > 0.01


def test_what_cannot_be_flipped_is_refused(hard_graph: Mesh):
    """Its other diagonal is there, or lies outside, or it would be thin, or it has one face or two of
    unlike orientation."""
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]
    tetrahedron = make_mesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    concave = make_mesh([[0, 0, 0], [2, 0, 0], [3, 1, 0], [3, -0.1, 0]], [[0, 1, 2], [1, 0, 3]])
    diamond = [[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]]
    thin = make_mesh([[0, 0, 0], [1, 0, 0], [0.01, 1, 0], [0.01, -1, 0]], [[0, 1, 2], [1, 0, 3]])
    for mesh in (tetrahedron, concave, thin, make_mesh(diamond, [[0, 1, 2], [0, 1, 3]]), hard_graph):
        with pytest.raises(jm.JaxmarkError, match="Only 0 of"):
            edge_flips(mesh, 0.2, jax.random.key(0))
    flipped = edge_flips(make_mesh(diamond, [[0, 1, 2], [1, 0, 3]]), 0.2, jax.random.key(0))
    assert uses(flipped.faces).keys() == {(2, 3), (0, 2), (0, 3), (1, 2), (1, 3)}


def test_an_edge_with_three_faces_and_a_degenerate_face_stay(sphere: Mesh):
    a, b, c = sphere.faces[0]
    fin = make_mesh(
        np.vstack([sphere.vertices, [9.0, 9, 9]]), np.vstack([sphere.faces, [a, b, len(sphere.vertices)], [b, c, c]])
    )
    after = edge_flips(fin, 0.4, jax.random.key(1))
    check(fin, after, 0.4)
    np.testing.assert_array_equal(after.faces[-2:], fin.faces[-2:])


def test_the_key_decides(sphere: Mesh):
    once, again, other = (edge_flips(sphere, 0.1, jax.random.key(seed)).faces for seed in (5, 5, 6))
    np.testing.assert_array_equal(once, again)
    assert (once != other).any()


def test_host_function_flips_points_and_names_their_first_copies(sphere: Mesh):
    expected = jm.attack(sphere, "edge-flips", 0.1, seed=0)
    check(sphere, expected, 0.1)
    # With a copy of some points for every second face, as along a seam, far from the origin.
    seam = np.arange(10)
    faces = sphere.faces.copy()
    half = faces[::2]
    half[half < len(seam)] += len(sphere.vertices)
    copied = make_mesh(np.concatenate([sphere.vertices, sphere.vertices[seam]]) + 100, faces)
    found = jm.attack(copied, "edge-flips", 0.1, seed=0)
    np.testing.assert_array_equal(found.vertices, copied.vertices)
    count = len(sphere.vertices)
    points = np.where(found.faces >= count, found.faces - count, found.faces)
    check(sphere, make_mesh(sphere.vertices, points), 0.1)
    kept = (found.faces == copied.faces).all(axis=1)
    assert found.faces[~kept].max() < count <= found.faces[kept].max()


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh):
    for share, sentence in [(1.5, r"in \[0, 1\]"), (float("nan"), "must be a number"), (-0.1, "from 0 to")]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(sphere, "edge-flips", share, seed=0)
    with pytest.raises(jm.JaxmarkError, match=r"Only \d+ of the mesh's \d+ edges .* at most 0\.\d+") as told:
        jm.attack(sphere, "edge-flips", 1, seed=0)
    most = float(str(told.value).split()[-1].rstrip("."))
    check(sphere, jm.attack(sphere, "edge-flips", most, seed=0), most)
