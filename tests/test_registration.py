"""Poses by surfaces: against poses that are known, and closest points against brute force."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxmark.mesh import Mesh, make_mesh, vertex_normals
from jaxmark.pose import IDENTITY, Pose, affine, similarity
from jaxmark.registration import Surface, refine, register
from tests.samples import bumpy_sphere


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """642 vertices, one across."""
    points = bumpy_sphere(3)
    vertices = np.asarray(points.vertices) - np.mean(points.vertices, axis=0)
    return make_mesh(vertices / np.linalg.norm(np.ptp(vertices, axis=0)), points.faces)


def anywhere(seed: int) -> Pose:
    """A random similarity, of scale 0.01 to 100."""
    random = np.random.default_rng(seed)
    scale = 10 ** random.uniform(-2, 2)
    return Pose(scale * Rotation.random(rng=random).as_matrix(), 3 * scale * random.normal(size=3))


def finer(mesh: Mesh) -> Mesh:
    """The same surface with other vertices and faces."""
    vertices, faces = trimesh.remesh.subdivide(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return make_mesh(vertices, faces)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_closest_points_by_brute_force(scale, mesh: Mesh):
    """The nearest of many points on each face is hardly nearer, and never much farther."""
    random = np.random.default_rng(0)
    vertices = scale * np.asarray(mesh.vertices)
    points = scale * random.uniform(-0.6, 0.6, (40, 3))
    closest, face = Surface(mesh._replace(vertices=vertices)).closest(points)
    corners = vertices[np.asarray(mesh.faces)]
    i, j = np.divmod(np.arange(31 * 31), 31)
    share = np.stack([i, j, 30 - i - j], axis=1)[i + j <= 30] / 30
    every = np.einsum("sk,fkc->fsc", share, corners)
    for point, found, on in zip(points, closest, face, strict=True):
        off = np.linalg.norm(every - point, axis=2)
        least = off.min()
        assert least - 0.02 * scale < np.linalg.norm(found - point) <= least * (1 + 1e-12)
        # It lies on the face it names.
        a, b, c = corners[on]
        normal = np.cross(b - a, c - a)
        assert abs(np.dot(found - a, normal)) < 1e-9 * scale * np.linalg.norm(normal)


@pytest.mark.parametrize("seed", range(4))
def test_a_similarity_and_an_affine_map_by_least_squares(seed):
    random = np.random.default_rng(seed)
    points, pose = random.normal(size=(50, 3)), anywhere(seed)
    found = similarity(pose.inverse()(points), points)
    np.testing.assert_allclose(found(pose.inverse()(points)), points, atol=1e-12)
    np.testing.assert_allclose(found.matrix, pose.matrix, rtol=1e-9, atol=1e-12 * np.abs(pose.matrix).max())
    noisy = points + 0.01 * random.normal(size=points.shape)
    design = np.hstack([noisy, np.ones((50, 1))])
    expected = design @ np.linalg.lstsq(design, points, rcond=None)[0]
    np.testing.assert_allclose(affine(noisy, points)(noisy), expected, atol=1e-10)
    both = pose.then(anywhere(seed + 10))
    np.testing.assert_allclose(both(points), anywhere(seed + 10)(pose(points)))


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_of_another_meshing_is_found(seed, mesh: Mesh):
    other, pose = finer(mesh), anywhere(seed)
    found, _ = register(mesh, other._replace(vertices=pose(np.asarray(other.vertices))))
    np.testing.assert_allclose(found(pose(np.asarray(mesh.vertices))), mesh.vertices, atol=1e-7)
    again, _ = register(mesh, other._replace(vertices=pose(np.asarray(other.vertices))))
    np.testing.assert_array_equal(found.matrix, again.matrix)


@pytest.mark.parametrize("seed", range(2))
def test_the_pose_of_a_coarser_and_noisy_surface_is_nearly_found(seed, mesh: Mesh):
    pymeshlab = pytest.importorskip("pymeshlab")
    fine = finer(mesh)
    filters = pymeshlab.MeshSet()
    filters.add_mesh(pymeshlab.Mesh(fine.vertices, fine.faces))
    filters.meshing_decimation_quadric_edge_collapse(targetfacenum=800)
    coarse, pose = filters.current_mesh(), anywhere(seed)
    rough = coarse.vertex_matrix() + 1e-3 * np.random.default_rng(seed).normal(size=coarse.vertex_matrix().shape)
    found, _ = register(mesh, make_mesh(pose(rough), coarse.face_matrix().astype(int)))
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1e-3


def test_an_affine_map_is_found_from_nearby(mesh: Mesh):
    other = finer(mesh)
    change = Pose(np.eye(3) + 0.03 * np.random.default_rng(5).normal(size=(3, 3)), np.array([0.01, -0.01, 0.0]))
    surface = Surface(other._replace(vertices=change.inverse()(np.asarray(other.vertices))))
    points, normals = np.asarray(mesh.vertices), vertex_normals(mesh)
    found = refine(surface, points, normals, IDENTITY, by_affine=True)
    np.testing.assert_allclose(found.matrix, change.matrix, atol=1e-6)
    np.testing.assert_allclose(found.shift, change.shift, atol=1e-6)
