"""What is nearly flat or round is made so, beside the shapes that noise was put on and planes fitted by SVD."""

import jax
import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares

import jaxmark as jm
from jaxmark.attacks import plane_fitting, primitive_fitting
from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

TURN = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
NOISE = 0.001  # of the diagonal, RMS
KINDS = {"plane-fitting": plane_fitting, "primitive-fitting": primitive_fitting}


def noisy(mesh: Mesh, seed: int = 0, size: float = NOISE) -> Mesh:
    noise = np.random.default_rng(seed).normal(size=mesh.vertices.shape) / np.sqrt(3)
    return make_mesh(mesh.vertices + size * diagonal(mesh) * noise, mesh.faces)


def of(mesh: trimesh.Trimesh) -> Mesh:
    """Welded, turned and off the origin, so that no axis is one of the coordinates'."""
    mesh.merge_vertices()
    return make_mesh(np.asarray(mesh.vertices) @ TURN.T + [3, 2, 1], np.asarray(mesh.faces))


def off_plane(points: np.ndarray) -> float:
    """The least singular value, per point: 0 if they are coplanar."""
    return float(np.linalg.svd(points - points.mean(axis=0))[1][2]) / np.sqrt(len(points))


@pytest.fixture(scope="module")
def cube() -> Mesh:
    """Of edges of an eighth, the middle at (3, 2, 1)."""
    box = trimesh.creation.box((2, 2, 2))
    for _ in range(3):
        box = box.subdivide()
    return of(box)


def sides(cube: Mesh) -> list[np.ndarray]:
    """The vertices of each side."""
    found = trimesh.Trimesh(*cube, process=False)
    return [np.unique(cube.faces[facet]) for facet in found.facets]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_a_cube_gets_its_sides_and_edges_back(kind, scale, cube: Mesh):
    mesh = make_mesh(scale * cube.vertices + 10 * scale, cube.faces)
    before = noisy(mesh)
    after = KINDS[kind](before, 10, jax.random.key(0))
    np.testing.assert_array_equal(after.faces, cube.faces)
    parts = sides(cube)
    assert len(parts) == 6
    normals = []
    for part in parts:
        assert off_plane(before.vertices[part]) > 1e-4 * scale
        assert off_plane(after.vertices[part]) < 1e-9 * scale
        # The plane of least squares is that of the noisy vertices.
        middle = before.vertices[part].mean(axis=0)
        normal = np.linalg.svd(before.vertices[part] - middle)[2][2]
        np.testing.assert_allclose((after.vertices[part] - middle) @ normal, 0, atol=1e-9 * scale)
        normals.append(normal)
    for one in range(6):
        for other in range(one):
            edge = np.intersect1d(parts[one], parts[other])
            if len(edge) > 0:
                assert len(edge) == 9
                line = after.vertices[edge] - after.vertices[edge].mean(axis=0)
                assert np.linalg.svd(line)[1][1] < 1e-9 * scale
    # Inside a side, vertices move along its normal only.
    count = np.bincount(np.concatenate(parts), minlength=len(cube.vertices))
    for part, normal in zip(parts, normals, strict=True):
        inner = part[count[part] == 1]
        np.testing.assert_allclose(
            np.cross(after.vertices[inner] - before.vertices[inner], normal), 0, atol=1e-9 * scale
        )
    for points in (after.vertices, before.vertices):
        assert np.isfinite(points).all()
    left = [off_cube(found.vertices / scale - 10) for found in (before, after)]
    assert left[1] < 0.3 * left[0]


def off_cube(points: np.ndarray) -> float:
    """RMS distance from the noiseless cube."""
    beyond = np.abs((points - [3, 2, 1]) @ TURN) - 1
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return float(np.sqrt(np.mean(np.where(outside > 0, outside, beyond.max(axis=1)) ** 2)))


def test_too_small_an_angle_finds_nothing(cube: Mesh):
    before = noisy(cube, size=0.01)
    for apply in KINDS.values():
        np.testing.assert_array_equal(apply(before, 1).vertices, before.vertices)


def test_nearly_parallel_planes_throw_no_vertex_far():
    """A roof of 6°: where its halves meet, their vertices go to the mean of both planes."""
    i, j = np.divmod(np.arange(21 * 21), 21)
    height = -np.tan(np.radians(3)) * np.abs(i - 10)
    corner = (i * 21 + j).reshape(21, 21)[:-1, :-1].ravel()
    faces = [[corner, corner + 21, corner + 1], [corner + 1, corner + 21, corner + 22]]
    roof = make_mesh(np.stack([i, j, height], axis=1).astype(float), np.concatenate([np.stack(f, 1) for f in faces]))
    random = np.random.default_rng(0)
    before = roof._replace(vertices=roof.vertices + [0, 0, 0.005] * random.normal(size=roof.vertices.shape))
    after = plane_fitting(before, 4.5)
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1)
    halves = [i <= 10, i >= 10]
    planes = []
    for half in halves:
        middle = before.vertices[half].mean(axis=0)
        planes.append((middle, np.linalg.svd(before.vertices[half] - middle)[2][2]))
        np.testing.assert_allclose((after.vertices[half & (i != 10)] - middle) @ planes[-1][1], 0, atol=1e-9)
    far = [(before.vertices - middle) @ normal for middle, normal in planes]
    ridge = i == 10
    assert (moved[ridge] <= np.sqrt(2) * np.maximum(*np.abs(far))[ridge] + 1e-12).all()
    assert moved[ridge].max() > 0.001


def off_round(points: np.ndarray, axis: np.ndarray | None = None) -> tuple[float, float]:
    """The radius of the closest sphere, or cylinder about nearly that axis, and how far points are off it at most."""
    start = np.append(points.mean(axis=0), 1.0)
    across = np.zeros((2, 3)) if axis is None else np.linalg.svd(axis[None])[2][1:]

    def off(x: np.ndarray) -> np.ndarray:
        out = points - x[:3]
        if axis is not None:
            way = axis + x[4:] @ across
            out = np.cross(out, way / np.linalg.norm(way))
        return np.linalg.norm(out, axis=1) - x[3]

    best = least_squares(off, start if axis is None else np.append(start, [0, 0]), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(best.x[3]), float(np.abs(off(best.x)).max())


def test_a_sphere_is_round_again():
    before = noisy(of(trimesh.creation.icosphere(subdivisions=3)))
    after = primitive_fitting(before, 10)
    assert off_round(before.vertices)[1] > 1e-3
    radius, off = off_round(after.vertices)
    assert off < 1e-9
    assert radius == pytest.approx(1, abs=2e-4)
    assert rms(after.vertices - before.vertices) < NOISE * diagonal(before)


@pytest.fixture(scope="module")
def cylinder() -> Mesh:
    """Of radius 1 and height 2, in 60 facets."""
    outline = [[0, -1], *([1, height] for height in np.linspace(-1, 1, 11)), [0, 1]]
    return of(trimesh.creation.revolve(np.array(outline, float), sections=60))


@pytest.mark.parametrize(("angle", "size"), [(10, NOISE), (5, 0.1 * NOISE), (2.5, 0.1 * NOISE)])
def test_a_cylinder_is_round_again_and_its_ends_flat(angle, size, cylinder: Mesh):
    """Also where its facets, 6° apart, are flat regions."""
    along = (cylinder.vertices - [3, 2, 1]) @ TURN
    side = np.linalg.norm(along[:, :2], axis=1) > 1 - 1e-9
    before = noisy(cylinder, size=size)
    after = primitive_fitting(before, angle)
    for end in (-1, 1):
        ring = np.abs(along[:, 2] - end) < 1e-9
        assert off_plane(before.vertices[ring]) > 1e-5
        assert off_plane(after.vertices[ring]) < 1e-9
    assert off_round(before.vertices[side], TURN[:, 2])[1] > 1e-4
    radius, off = off_round(after.vertices[side], TURN[:, 2])
    assert off < 1e-9
    assert radius == pytest.approx(1, abs=5e-4)
    # Planes alone do not make it round.
    planes = plane_fitting(before, angle)
    assert off_round(planes.vertices[side], TURN[:, 2])[1] > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_planes_part_from_what_goes_over_into_them(kind):
    """A can whose bottom goes over into its side by steps of 3°, less than the angle."""
    turn = np.radians(np.arange(3, 91, 3))
    fillet = np.stack([0.7 + 0.3 * np.sin(turn), -0.7 - 0.3 * np.cos(turn)], axis=1)
    bottom, side = ([[x, -1] for x in np.linspace(0, 0.7, 8)], [[1, y] for y in np.linspace(-0.6, 1, 17)])
    can = of(trimesh.creation.revolve(np.concatenate([bottom, fillet, side]), sections=120))
    before = noisy(can, size=1e-5)
    after = KINDS[kind](before, 5)
    along = (can.vertices - [3, 2, 1]) @ TURN
    inside = (np.abs(along[:, 2] + 1) < 1e-9) & (np.linalg.norm(along[:, :2], axis=1) < 0.65)
    assert inside.sum() == 6 * 120 + 1
    assert off_plane(before.vertices[inside]) > 1e-6
    assert off_plane(after.vertices[inside]) < 1e-9


def test_organic_shapes_hardly_change(sphere: Mesh):
    for apply in KINDS.values():
        np.testing.assert_array_equal(apply(sphere, 2).vertices, sphere.vertices)
        fine = bumpy_sphere(4)
        assert rms(apply(fine, 5).vertices - fine.vertices) < 1e-4 * diagonal(fine)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", KINDS)
def test_host_function_and_refusals(kind, cube: Mesh, hard_graph: Mesh):
    """Copies move together, what no face uses stays; at no angle nothing moves."""
    before = noisy(cube)
    alone = jm.attack(before, kind, 10, seed=0)
    soup = make_mesh(
        np.concatenate([before.vertices[before.faces].reshape(-1, 3), [[90.0, 9, 9]]]),
        np.arange(3 * len(cube.faces)).reshape(-1, 3),
    )
    found = jm.attack(soup, kind, 10, seed=1)
    np.testing.assert_array_equal(found.vertices[-1], [90, 9, 9])
    np.testing.assert_allclose(found.vertices[:-1], alone.vertices[cube.faces].reshape(-1, 3), atol=1e-12)
    np.testing.assert_array_equal(jm.attack(before, kind, 0, seed=0).vertices, before.vertices)
    np.testing.assert_array_equal(jm.attack(hard_graph, kind, 5, seed=0).vertices, hard_graph.vertices)
    with pytest.raises(jm.JaxmarkError, match="0 to 30 degrees"):
        jm.attack(before, kind, 31, seed=0)
    with pytest.raises(jm.JaxmarkError, match="diagonal of 0"):
        jm.attack(make_mesh(np.zeros((3, 3)), [[0, 1, 2]]), kind, 5, seed=0)
