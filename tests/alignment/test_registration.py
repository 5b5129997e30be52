"""Poses by surfaces: against poses that are known, and closest points against brute force."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxmark.alignment.features import _reflected, descriptors
from jaxmark.alignment.registration import SETTINGS, refine, register_part, register_whole
from jaxmark.geometry.mesh import Mesh, make_mesh, vertex_normals
from jaxmark.geometry.pose import IDENTITY, Pose, affine, similarity
from jaxmark.geometry.surfaces import Surface, sample
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


def mirrored(pose: Pose) -> Pose:
    """A pose after a mirror."""
    return Pose(pose.matrix * [-1, 1, 1], pose.shift)


def turned_round(mesh: Mesh) -> Mesh:
    """With normals on the other side, as a program leaves a mesh that it then mirrors."""
    return mesh._replace(faces=mesh.faces[:, ::-1])


def placed(mesh: Mesh, pose: Pose) -> Surface:
    return Surface(mesh._replace(vertices=pose(np.asarray(mesh.vertices))))


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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_pose_of_another_meshing_is_found(seed, mesh: Mesh):
    other, pose = finer(mesh), anywhere(seed)
    found = register_whole(Surface(mesh), placed(other, pose))
    assert found is not None
    np.testing.assert_allclose(found(pose(np.asarray(mesh.vertices))), mesh.vertices, atol=1e-7)
    again = register_whole(Surface(mesh), placed(other, pose))
    assert again is not None
    np.testing.assert_array_equal(found.matrix, again.matrix)


@pytest.mark.parametrize("mirror", [False, True, None], ids=["turning", "mirroring", "either"])
def test_a_similarity_mirrors_on_request_or_where_that_fits(mirror):
    points = np.random.default_rng(0).normal(size=(50, 3))
    for pose in (anywhere(0), mirrored(anywhere(0))):
        found = similarity(points, pose(points), mirror)
        assert found.mirrors == (pose.mirrors if mirror is None else mirror)
        exact = mirror in (None, pose.mirrors)
        assert np.allclose(found(points), pose(points)) == exact
        # Otherwise it is the best of its hand: none nearby is better.
        least = np.sum((found(points) - pose(points)) ** 2)
        for seed in range(10):
            turn = Rotation.from_rotvec(1e-3 * np.random.default_rng(seed).normal(size=3)).as_matrix()
            assert np.sum((points @ (found.matrix @ turn).T + found.shift - pose(points)) ** 2) >= least * (1 - 1e-9)


def test_a_similarity_of_a_flat_shape_turns_if_nothing_tells():
    points = np.random.default_rng(0).normal(size=(50, 3)) * [1, 1, 0]
    deformed = points + 1e-3 * np.random.default_rng(1).normal(size=(50, 1)) * [0, 0, 1]
    assert not similarity(deformed, points, None).mirrors


@pytest.mark.parametrize("prepare", [turned_round, lambda mesh: mesh], ids=["outside", "inside"])
def test_the_pose_of_a_mirrored_meshing_is_found(prepare, mesh: Mesh):
    pose = mirrored(anywhere(1))
    found = register_whole(Surface(mesh), placed(prepare(finer(mesh)), pose))
    assert found is not None
    assert found.mirrors
    np.testing.assert_allclose(found(pose(np.asarray(mesh.vertices))), mesh.vertices, atol=1e-7)


def face(level: int, one_sided: float) -> Mesh:
    """Its own mirror image, but for a bump on one side."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    points = np.asarray(ball.vertices)
    bumps = [([0.0, 0.3, 0.95], 0.6), ([0.6, 0.7, 0.4], 0.3), ([-0.6, 0.7, 0.4], 0.3), ([0.6, -0.6, 0.5], one_sided)]
    grown = sum(size * np.exp(-np.sum((points - place) ** 2, axis=1) / 0.05) for place, size in bumps)
    points = points * [0.8, 1.3, 1.0] * (1 + grown)[:, None]
    return make_mesh(points / np.linalg.norm(np.ptp(points, axis=0)), ball.faces)


@pytest.mark.parametrize(
    ("one_sided", "mirror"),
    [pytest.param(0.02, False, marks=pytest.mark.slow), (0.02, True), pytest.param(0.0, False, marks=pytest.mark.slow)],
)
def test_a_nearly_symmetric_shape_is_mirrored_only_if_that_fits_clearly_better(one_sided, mirror):
    """What a mark displaces, a pose of either hand leaves."""
    mesh, pose = face(3, one_sided), mirrored(anywhere(2)) if mirror else anywhere(2)
    mark = 2e-4 * np.random.default_rng(5).normal(size=(len(mesh.vertices), 1))
    marked = mesh._replace(vertices=np.asarray(mesh.vertices) + mark * vertex_normals(mesh))
    found = register_whole(Surface(mesh), placed(finer(marked), pose))
    assert found is not None
    assert found.mirrors == mirror
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_the_pose_of_a_coarser_and_noisy_surface_is_nearly_found(seed, mesh: Mesh):
    pymeshlab = pytest.importorskip("pymeshlab")
    fine = finer(mesh)
    filters = pymeshlab.MeshSet()
    filters.add_mesh(pymeshlab.Mesh(fine.vertices, fine.faces))
    filters.meshing_decimation_quadric_edge_collapse(targetfacenum=800)
    coarse, pose = filters.current_mesh(), anywhere(seed)
    rough = coarse.vertex_matrix() + 1e-3 * np.random.default_rng(seed).normal(size=coarse.vertex_matrix().shape)
    found = register_whole(Surface(mesh), Surface(make_mesh(pose(rough), coarse.face_matrix().astype(int))))
    assert found is not None
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1e-3


def wheel(level: int) -> Mesh:
    """With 24 teeth, and a bump by which they are told apart."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    points = np.asarray(ball.vertices)
    angle, across = np.arctan2(points[:, 1], points[:, 0]), np.linalg.norm(points[:, :2], axis=1)
    rim = (1 + 0.05 * across**4 * np.cos(24 * angle))[:, None]
    bump = 0.03 * np.exp(-np.sum((points - [0.4, 0.2, 0.89]) ** 2, axis=1) / 0.02)
    points = points * [1.0, 1.0, 0.3] * rim + np.outer(bump, [0, 0, 1])
    return make_mesh(points / np.linalg.norm(np.ptp(points, axis=0)), ball.faces)


def lumps(level: int) -> Mesh:
    """A ball that is as wide along one axis as along another, but for bumps."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    points = np.asarray(ball.vertices)
    places = np.random.default_rng(3).normal(size=(20, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    bumps = sum(np.exp(-np.sum((points - place) ** 2, axis=1) / 0.01) for place in places)
    points = points * (1 + 0.03 * bumps[:, None])
    return make_mesh(points / np.linalg.norm(np.ptp(points, axis=0)), ball.faces)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("shape", [wheel, lumps])
def test_a_nearly_round_shape_is_told_by_its_small_features(shape, seed):
    mesh, pose = shape(4), anywhere(20 + seed)
    found = register_whole(Surface(mesh), placed(shape(5), pose))
    assert found is not None
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 2e-3


def part_of(mesh: Mesh, share: float) -> Mesh:
    """What lies on one side of a plane."""
    height = np.asarray(mesh.vertices) @ [0.5, 0.3, 0.8]
    return mesh._replace(faces=mesh.faces[(height <= np.quantile(height, share))[mesh.faces].all(axis=1)])


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.3])
def test_the_pose_of_a_part_is_found(share, mesh: Mesh):
    """By its points, each of which lies on the original."""
    rng = np.random.default_rng(6)
    other, pose = part_of(finer(mesh), share), anywhere(6)
    rough = np.asarray(other.vertices) + 2e-4 * rng.normal(size=other.vertices.shape)
    surface, suspect = Surface(mesh), Surface(other._replace(vertices=pose(rough)))
    assert register_whole(surface, suspect) is None
    found, again = register_part(surface, suspect), register_part(surface, suspect)
    assert found is not None
    assert again is not None
    np.testing.assert_array_equal(found.matrix, again.matrix)
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1e-3


@pytest.mark.parametrize("prepare", [turned_round, lambda mesh: mesh], ids=["outside", "inside"])
def test_the_pose_of_a_mirrored_part_is_found(prepare, mesh: Mesh):
    pose = mirrored(anywhere(6))
    found = register_part(Surface(mesh), placed(prepare(part_of(finer(mesh), 0.5)), pose))
    assert found is not None
    assert found.mirrors
    off = found(pose(np.asarray(mesh.vertices))) - mesh.vertices
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1e-3


@pytest.mark.slow
def test_settings_are_frozen_and_reach_what_they_set(mesh: Mesh):
    """No pose leaves nothing at all, and a part has none if poses by local shape are not tried, or too large for it."""
    surface, suspect = Surface(mesh), placed(finer(mesh), anywhere(6))
    assert register_whole(surface, suspect, settings=replace(SETTINGS, whole_distance=0.0)) is None
    assert register_part(surface, suspect, settings=replace(SETTINGS, feature_poses=0)) is None
    large = replace(SETTINGS, features=replace(SETTINGS.features, min_side=2.0))
    assert register_part(surface, suspect, settings=large) is None
    assert hash(large) != hash(SETTINGS)
    with pytest.raises(FrozenInstanceError):
        large.rounds = 1  # pyright: ignore[reportAttributeAccessIssue]


def test_descriptors_do_not_depend_on_pose_and_scale(mesh: Mesh):
    points, normals, _ = sample(mesh, 600)
    pose = anywhere(7)
    scale = np.cbrt(np.linalg.det(pose.matrix))
    one = descriptors(points, normals, 0.12)
    other = descriptors(pose(points), normals @ pose.matrix.T / scale, 0.12 * scale)
    # Angles on the edge between two bins may fall on either side.
    assert np.mean(np.abs(one - other) > 1e-9) < 0.01
    # Three angles, of the points around a point, and once more of those around its neighbours.
    alone = one.sum(axis=1)
    np.testing.assert_allclose(alone[alone > 0], 6, atol=1e-9)


def test_descriptors_of_a_mirrored_surface_are_the_same_in_another_order(mesh: Mesh):
    points, normals, _ = sample(mesh, 600)
    mirror = np.array([-1, 1, 1])
    there = _reflected(descriptors(points, normals, 0.12))
    for way, expected in zip((1, -1), there, strict=True):
        found = descriptors(points * mirror, way * normals * mirror, 0.12)
        assert np.mean(np.abs(found - expected) > 1e-9) < 0.01


def test_descriptors_on_a_plane_and_a_sphere_are_what_their_angles_say():
    rng = np.random.default_rng(8)
    flat = np.concatenate([rng.uniform(-1, 1, (900, 2)), np.zeros((900, 1))], axis=1)
    up = np.broadcast_to([0.0, 0, 1], flat.shape)
    # No angle turns: the middle one of eleven bins has it all.
    np.testing.assert_allclose(descriptors(flat, np.ascontiguousarray(up), 0.3)[:, 5::11].sum(), 6 * 900)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    below = descriptors(ball, ball, 0.3).mean(axis=0)[11:22]
    # Seen along the normal, every other point of a sphere lies below: by half of its distance.
    assert below[:6].sum() == pytest.approx(2)
    assert below[4] > 1


def test_an_affine_map_is_found_from_nearby(mesh: Mesh):
    other = finer(mesh)
    change = Pose(np.eye(3) + 0.03 * np.random.default_rng(5).normal(size=(3, 3)), np.array([0.01, -0.01, 0.0]))
    surface = Surface(other._replace(vertices=change.inverse()(np.asarray(other.vertices))))
    points, normals = np.asarray(mesh.vertices), vertex_normals(mesh)
    found = refine(surface, points, normals, IDENTITY, by_affine=True)
    np.testing.assert_allclose(found.matrix, change.matrix, atol=1e-6)
    np.testing.assert_allclose(found.shift, change.shift, atol=1e-6)
