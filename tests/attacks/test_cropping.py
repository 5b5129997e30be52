"""What is cut out, moved apart, put beside and reordered: all else stays exactly as it was."""

import heapq

import jax
import numpy as np
import pytest
import trimesh
from scipy.optimize import linprog
from scipy.spatial.distance import pdist

import jaxmark as jm
from jaxmark.attacks import adding_geometry, cropping, holes, missing_pieces, mosaic, region_cropping, reordering
from jaxmark.geometry.mesh import Mesh, diagonal, edges, make_mesh
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

CUTS = {"cropping": cropping, "region-cropping": region_cropping, "holes": holes}
USUAL = (
    *(("cropping", 0.3), ("region-cropping", 0.3), ("holes", 0.1), ("reordering", 0.5)),
    *(("added-geometry", 0.5), ("mosaic", 0.1), ("missing-pieces", 0.25)),
)


@pytest.fixture(scope="module")
def dotted() -> Mesh:
    """A surface of 162 vertices, each with a degenerate face of its own: so each that is left is seen."""
    mesh = bumpy_sphere(2)
    return make_mesh(mesh.vertices, np.concatenate([mesh.faces, np.arange(162)[:, None].repeat(3, axis=1)]))


def numbers(mesh: Mesh, found: Mesh) -> np.ndarray:
    """Which vertices of the mesh another one's are; they are exactly where they were."""
    number = {tuple(point): i for i, point in enumerate(mesh.vertices.tolist())}
    return np.array([number[tuple(point)] for point in found.vertices.tolist()])


def separable(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether a plane has all of the first points on one side, and the second on the other."""
    rows = np.concatenate([np.c_[first, -np.ones(len(first))], np.c_[-second, np.ones(len(second))]])
    return linprog(np.zeros(4), rows, -np.ones(len(rows)), bounds=(None, None)).status == 0


def along_edges(mesh: Mesh, start: int) -> np.ndarray:
    """Dijkstra's distances, step by step."""
    near: dict[int, list[tuple[int, float]]] = {}
    for i, j in edges(mesh.faces).tolist():
        length = float(np.linalg.norm(mesh.vertices[i] - mesh.vertices[j]))
        near.setdefault(i, []).append((j, length))
        near.setdefault(j, []).append((i, length))
    found, heap = np.full(len(mesh.vertices), np.inf), [(0.0, start)]
    while heap:
        far, i = heapq.heappop(heap)
        if far < found[i]:
            found[i] = far
            for j, length in near.get(i, []):
                heapq.heappush(heap, (far + length, j))
    return found


def cut(mesh: Mesh, kind: str, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices are left and which are lost, once the faces have been looked at."""
    found = CUTS[kind](mesh, share, jax.random.key(seed))
    left = numbers(mesh, found)
    np.testing.assert_array_equal(left, np.sort(left))
    np.testing.assert_array_equal(left[found.faces], mesh.faces[np.isin(mesh.faces, left).all(axis=1)])
    lost = np.setdiff1d(np.arange(len(mesh.vertices)), left)
    assert len(lost) == round(share * len(mesh.vertices))
    return left, lost


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_cropping_is_by_a_plane(share, dotted: Mesh):
    lost = []
    for seed in range(4):
        left, gone = cut(dotted, "cropping", share, seed)
        assert separable(dotted.vertices[left], dotted.vertices[gone])
        lost.append(set(gone.tolist()))
    assert all(lost[0] != other for other in lost[1:])


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_a_region_grows_along_edges(share, dotted: Mesh):
    for seed in range(2):
        left, lost = cut(dotted, "region-cropping", share, seed)
        distance = [along_edges(dotted, centre) for centre in lost.tolist()]
        assert any(one[lost].max() < one[left].min() for one in distance)


def test_a_region_goes_on_in_other_parts(dotted: Mesh):
    """Where the part it began in is used up: by distance in space."""
    size = len(dotted.vertices)
    places = [dotted.vertices + np.array([shift, 0, 0]) for shift in (0, 5, 20)]
    three = make_mesh(np.concatenate(places), np.concatenate([dotted.faces + k * size for k in range(3)]))
    for seed in range(6):
        left, lost = cut(three, "region-cropping", 0.5, seed)
        count = np.bincount(lost // size, minlength=3)
        assert sorted(count) == [0, size // 2, size]
        assert count[2 if count.argmax() < 2 else 0] == 0
        assert len(left) + len(lost) == 3 * size


def test_holes_are_ten_of_one_size(dotted: Mesh):
    parts = []
    for seed in range(8):
        lost = cut(dotted, "holes", 40 / 162, seed)[1]
        inside = edges(dotted.faces)
        inside = inside[np.isin(inside, lost).all(axis=1)]
        sizes = [len(part) for part in trimesh.graph.connected_components(inside, nodes=lost)]
        assert sum(sizes) == 40
        assert all(size % 4 == 0 for size in sizes)
        parts.append(len(sizes))
    assert max(parts) <= 10
    assert max(parts) >= 5
    few = cut(dotted, "holes", 30 / 162, 0)[1]
    assert len(few) == 30


def turned(faces: np.ndarray) -> list[tuple[int, ...]]:
    """Faces from their least corner on."""
    return [tuple(np.roll(face, -int(np.argmin(face))).tolist()) for face in faces]


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_reordering_changes_places_only(share, sphere: Mesh):
    found = reordering(sphere, share, jax.random.key(0))
    place = numbers(sphere, found)
    assert (place != np.arange(len(place))).sum() == round(share * len(place))
    before, after = turned(sphere.faces), turned(place[found.faces])
    assert sorted(before) == sorted(after)
    assert sum(a != b for a, b in zip(before, after, strict=True)) == round(share * len(before))
    starts = [int(np.argmin(face)) for face in place[found.faces]]
    assert share < 1 or np.bincount(starts).min() > len(before) / 4


def test_what_is_put_beside_touches_nothing(sphere: Mesh):
    for seed, size in enumerate([0.1, 0.5, 2]):
        found = adding_geometry(sphere, size, jax.random.key(seed))
        np.testing.assert_array_equal(found.vertices[: len(sphere.vertices)], sphere.vertices)
        np.testing.assert_array_equal(found.faces[: len(sphere.faces)], sphere.faces)
        mesh, ring, box = trimesh.Trimesh(*found, process=False).split(only_watertight=False)
        assert len(mesh.vertices) == len(sphere.vertices)
        assert (ring.euler_number, box.euler_number) == (0, 2)
        assert ring.is_watertight
        assert box.is_watertight
        assert pdist(box.vertices).max() == pytest.approx(size * diagonal(sphere))
        # A ring of radii 3 and 1 is 8 wide in a box of 8 by 8 by 2.
        assert pdist(ring.vertices).max() == pytest.approx(size * diagonal(sphere) * 8 / np.sqrt(132))
        for one, other in ((mesh, ring), (mesh, box), (ring, box)):
            assert separable(np.asarray(one.vertices), np.asarray(other.vertices))
    centres = np.array([ring.vertices.mean(axis=0), box.vertices.mean(axis=0)])
    np.testing.assert_allclose(centres.sum(axis=0), sphere.vertices.min(axis=0) + sphere.vertices.max(axis=0))


def pieces(mesh: Mesh, seed: int, shift: float = 0.1) -> np.ndarray:
    """The number of each face's piece, by how `mosaic` shifts it."""
    found = mosaic(mesh, shift, jax.random.key(seed))
    assert found.faces.shape == mesh.faces.shape
    moved = found.vertices[found.faces] - mesh.vertices[mesh.faces]
    np.testing.assert_allclose(moved, moved[:, :1].repeat(3, axis=1), atol=1e-12)
    ways, piece = np.unique(moved[:, 0].round(9), axis=0, return_inverse=True)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), shift * diagonal(mesh), rtol=1e-6)
    assert len(found.vertices) == sum(len(np.unique(mesh.faces[piece == one])) for one in range(len(ways)))
    return piece


def test_pieces_are_parted_by_planes_and_move_as_wholes(sphere: Mesh):
    for seed in range(2):
        piece = pieces(sphere, seed)
        centroid = sphere.vertices[sphere.faces].mean(axis=1)
        assert piece.max() == 7
        for one in range(8):
            for other in range(one):
                assert separable(centroid[piece == one], centroid[piece == other])


@pytest.mark.parametrize("share", [0.1, 0.25, 0.75, 0.9])
def test_missing_pieces_are_whole_ones(share, sphere: Mesh):
    lost = []
    for seed in range(3):
        found = missing_pieces(sphere, share, jax.random.key(seed))
        left = numbers(sphere, found)[found.faces].tolist()
        gone = np.array([face not in left for face in sphere.faces.tolist()])
        piece = pieces(sphere, seed)
        lost.append({one for one in range(8) if gone[piece == one].all()})
        assert len(lost[-1]) == round(8 * share)
        np.testing.assert_array_equal(gone, np.isin(piece, list(lost[-1])))
        assert left == sphere.faces[~gone].tolist()


@pytest.mark.parametrize(("kind", "strength"), USUAL)
def test_host_function_does_it_to_points(kind, strength, sphere: Mesh):
    """Copies along a seam are one point, an isolated vertex is none, a boundary is no obstacle; the seed decides."""
    cap = make_mesh(sphere.vertices, sphere.faces[10:])
    expected = jm.attack(cap, kind, strength, seed=0)
    faces = cap.faces.copy()
    half = faces[::2]
    half[half < 10] += len(sphere.vertices)
    copied = make_mesh(np.concatenate([cap.vertices, cap.vertices[:10], [[9.0, 9, 9]]]), faces)
    found = jm.attack(copied, kind, strength, seed=0)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)
    other = jm.attack(cap, kind, strength, seed=1)
    assert not np.array_equal(other.vertices, expected.vertices)
    far = jm.attack(make_mesh(cap.vertices + 2.0**30, cap.faces), kind, strength, seed=0)
    np.testing.assert_allclose(far.vertices - 2.0**30, expected.vertices, atol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh, hard_graph: Mesh):
    for kind, strength, sentence in [
        *((kind, 1, "below 1") for kind in (*CUTS, "missing-pieces")),
        *((kind, 0.999, "no face of the mesh would be left") for kind in CUTS),
        ("missing-pieces", 0.95, "No piece"),
        ("reordering", 1.1, r"in \[0, 1\]"),
        ("added-geometry", 0, "positive size"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(sphere, kind, strength, seed=0)
    for kind, strength in USUAL:
        assert len(jm.attack(hard_graph, kind, strength, seed=0).faces) > 0
    for kind in (*CUTS, "missing-pieces", "reordering"):
        same = jm.attack(sphere, kind, 0, seed=0)
        np.testing.assert_array_equal(same.vertices, sphere.vertices)
        np.testing.assert_array_equal(same.faces, sphere.faces)
