"""Suspects brought back to the original, against least squares by NumPy."""

import sys

import numpy as np
import pytest
import trimesh
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import Original, make_original
from jaxmark.geometry.canonical import rounded
from jaxmark.geometry.mesh import Mesh, make_mesh, vertex_normals
from jaxmark.geometry.pose import Pose
from tests.samples import FINE, bumpy_sphere, exact_sheet, rough_sphere


def exact_original(mesh: Mesh) -> Original:
    """An original whose points are the vertices of its mesh, in the same order."""
    return make_original(rounded(mesh, FINE).points, FINE)


@pytest.fixture(scope="module")
def original() -> Original:
    """642 vertices."""
    return exact_original(bumpy_sphere(3))


def moved(original: Original, displacement: np.ndarray, matrix=None, shift=0.0) -> Mesh:
    """The original with points displaced (in diagonals), then mapped."""
    vertices = original.mesh.vertices + original.diagonal * displacement
    return make_mesh(vertices @ (np.eye(3) if matrix is None else matrix).T + shift, original.mesh.faces)


def affine_map(random: np.random.Generator) -> np.ndarray:
    """Rotated, sheared, and scaled by 0.5 to 2 along each axis; never reflected."""
    turn = Rotation.random(rng=random).as_matrix()
    shear = np.eye(3) + np.triu(random.uniform(-0.5, 0.5, (3, 3)), 1)
    return turn @ shear @ np.diag(random.uniform(0.5, 2, 3))


def without_affine(x: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """What is left of x + displacement, mapped onto x by the affine map that fits best, over x."""
    design = np.hstack([x + displacement, np.ones((len(x), 1))])
    return design @ np.linalg.lstsq(design, x, rcond=None)[0] - x


@pytest.mark.parametrize("seed", range(6))
def test_affine_maps_are_undone(seed, original: Original):
    random = np.random.default_rng(seed)
    matrix, shift = affine_map(random), 10 * random.normal(size=3)
    assert np.linalg.det(matrix) > 0
    found, weights, *_ = align(original, moved(original, np.zeros((642, 3)), matrix, shift))
    np.testing.assert_allclose(found, 0, atol=1e-12)
    np.testing.assert_array_equal(weights, 1)


@pytest.mark.parametrize("seed", range(6))
def test_a_small_displacement_survives_an_affine_map(seed, original: Original):
    """As it is, but for its own best affine part."""
    random = np.random.default_rng(seed)
    displacement = 1e-3 * random.normal(size=(642, 3))
    matrix, shift = affine_map(random), 10 * random.normal(size=3)
    found, weights, *_ = align(original, moved(original, displacement, matrix, shift))
    np.testing.assert_array_equal(weights, 1)
    expected = without_affine(original.positions, displacement)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    # To first order that is the displacement less the affine map that fits it.
    design = np.hstack([original.positions, np.ones((642, 1))])
    part = design @ np.linalg.lstsq(design, displacement, rcond=None)[0]
    assert np.linalg.norm(found - (displacement - part)) < 0.01 * np.linalg.norm(displacement)
    assert np.vdot(found, displacement) > 0.98 * np.vdot(displacement, displacement)


@pytest.mark.parametrize("seed", range(3))
def test_a_mark_along_the_normal_of_a_flat_mesh_survives(seed):
    """Out of the plane a map has nothing to be fitted to but the mark: there only a rotation is undone."""
    random = np.random.default_rng(seed)
    i, j = np.divmod(np.arange(400), 20)
    corner = (20 * i + j).reshape(20, 20)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 20, corner + 1], 1), np.stack([corner + 1, corner + 20, corner + 21], 1)]
    )
    # Any plane.
    turn = Rotation.random(rng=random).as_matrix()
    sheet = exact_original(make_mesh(np.stack([i, j + 0.0, 0 * i], axis=1) @ turn.T + 5, faces))
    i, j, _ = np.rint((np.asarray(sheet.mesh.vertices) - 5) @ turn).T
    mark = 1e-3 * random.normal(size=400)
    plane = np.stack([i, j, np.ones(400)], axis=1)
    expected = mark - plane @ np.linalg.lstsq(plane, mark, rcond=None)[0]
    for matrix, shift in ((None, 0.0), (1.7 * Rotation.random(rng=random).as_matrix(), np.array([3.0, -4.0, 5.0]))):
        found, weights, *_ = align(sheet, moved(sheet, mark[:, None] * turn[:, 2], matrix, shift))
        np.testing.assert_array_equal(weights, 1)
        np.testing.assert_allclose(found @ turn[:, 2], expected, atol=1e-5)
        assert np.abs(found @ turn[:, :2]).max() < 1e-5


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("where", "how", "share"),
    [
        ("anywhere", "apart", 0.5),
        ("at one end", "apart", 0.5),
        ("anywhere", "together", 0.3),
        ("at one end", "together", 0.2),
    ],
)
def test_up_to_half_of_the_points_may_be_elsewhere(where, how, share, turned, original: Original):
    """Those are masked, and the rest recovered as if they had never been there. What went together is recovered too."""
    for seed in range(4):
        random = np.random.default_rng(seed)
        displacement = 5e-4 * random.normal(size=(642, 3))
        height = original.positions[:, 2] if where == "at one end" else random.uniform(size=642)
        lost = height > np.quantile(height, 1 - share)
        edit = random.normal(size=(642, 3)) if how == "apart" else random.normal(size=3) * np.ones((642, 1))
        edit *= 0.05 / np.linalg.norm(edit, axis=1, keepdims=True)
        matrix = Rotation.random(rng=random).as_matrix() if turned else np.eye(3)
        suspect = moved(original, displacement + lost[:, None] * edit, matrix, random.normal(size=3))
        found, weights, *_ = align(original, suspect)
        seen = np.array([~lost, lost] if how == "together" else [~lost])
        np.testing.assert_array_equal(weights, seen.any(axis=0))
        np.testing.assert_array_equal(found[weights == 0], 0)
        for piece in seen:
            expected = without_affine(original.positions[piece], displacement[piece])
            np.testing.assert_allclose(found[piece], expected, atol=1e-9)


def test_a_shuffled_soup_is_not_taken_for_one_in_order(sphere):
    """All soups of one size have the same faces."""

    def soup(faces):
        return make_mesh(sphere.vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))

    original = make_original(soup(sphere.faces), FINE)
    assert align(original, soup(sphere.faces)).method == "same"
    found = align(original, soup(np.random.default_rng(0).permutation(sphere.faces)))
    assert found.method == "connectivity"
    assert found.residual < 1e-9


@pytest.mark.parametrize("far", [1.0, 1e9, 1e200])
def test_points_thrown_away_are_masked(far, original: Original):
    displacement = 1e-3 * np.random.default_rng(4).normal(size=(642, 3))
    thrown = moved(original, displacement, affine_map(np.random.default_rng(5)), 3.0)
    thrown.vertices[[7, 99]] = [[0, far, 0], [far, -far, 1]]
    with np.errstate(over="raise", invalid="raise"):
        found, weights, *_ = align(original, thrown)
    lost = np.isin(np.arange(642), [7, 99])
    np.testing.assert_array_equal(weights, ~lost)
    np.testing.assert_array_equal(found[lost], 0)
    expected = without_affine(original.positions[~lost], displacement[~lost])
    np.testing.assert_allclose(found[~lost], expected, atol=1e-9)


def test_an_unmoved_suspect_is_exactly_zero(original: Original):
    for mesh in (original.mesh, make_mesh(2.5 * original.mesh.vertices + 1e3, original.mesh.faces)):
        found, weights, *_ = align(original, mesh)
        np.testing.assert_array_equal(found, 0)
        np.testing.assert_array_equal(weights, 1)


def test_the_same_suspect_gives_the_same_to_the_last_bit(original: Original):
    """No key, no chance."""
    suspect = moved(
        original, 1e-3 * np.random.default_rng(6).normal(size=(642, 3)), affine_map(np.random.default_rng(7))
    )
    one, again = align(original, suspect), align(make_original(original.mesh, FINE), suspect)
    np.testing.assert_array_equal(one.displacement, again.displacement)
    np.testing.assert_array_equal(one.weights, again.weights)
    np.testing.assert_array_equal(one.pose.matrix, again.pose.matrix)


def test_points_that_no_face_uses_do_not_count():
    sphere = bumpy_sphere(2)
    loose = np.array([[1e5, 0.0, 0], [0, 3, 0]])
    mesh = make_mesh(np.vstack([loose[:1], sphere.vertices, loose[1:]]), sphere.faces + 1)
    original = make_original(mesh, FINE)
    suspect = make_mesh(1.3 * mesh.vertices + 2, mesh.faces)
    suspect.vertices[[0, -1]] = [[-1e7, 4, 5], [0, 0, 0]]
    found, weights, *_ = align(original, suspect)
    np.testing.assert_array_equal(weights[original.weld.point], [0, *np.ones(162), 0])
    np.testing.assert_allclose(found, 0, atol=1e-12)


def test_what_must_share_the_connectivity_is_refused_without(original: Original, unchecked):
    faces = original.mesh.faces
    for other in (bumpy_sphere(2), original.mesh._replace(faces=faces[::-1]), original.mesh._replace(faces=faces[:-1])):
        with pytest.raises(jm.JaxmarkError, match="does not share the connectivity"):
            align(original, other, "same")
    with pytest.raises(jm.JaxmarkError, match="aligned by auto, same, similarity, affine, not 'rigid'"):
        align(original, other, "rigid")  # pyright: ignore[reportArgumentType]


def anywhere(mesh: Mesh, seed: int) -> tuple[Mesh, Pose]:
    """In a random pose and scale."""
    random = np.random.default_rng(seed)
    scale = 10 ** random.uniform(-2, 2)
    pose = Pose(scale * Rotation.random(rng=random).as_matrix(), 10 * scale * random.normal(size=3))
    return make_mesh(pose(np.asarray(mesh.vertices)), mesh.faces), pose


def check_pose(original: Original, found: Pose, true: Pose, tolerance: float) -> None:
    """In the units of the files."""
    points = np.asarray(original.mesh.vertices)
    assert np.linalg.norm(found(true(points)) - points, axis=1).max() < tolerance * original.diagonal


@pytest.mark.parametrize("seed", range(3))
def test_points_are_found_in_any_order(seed, original: Original):
    random = np.random.default_rng(seed)
    displacement = 1e-3 * random.normal(size=(642, 3))
    marked = moved(original, displacement)
    posed, pose = anywhere(marked, seed)
    order = random.permutation(642)
    suspect = make_mesh(posed.vertices[order], random.permutation(np.argsort(order)[posed.faces]))
    straight, found = align(original, marked), align(original, suspect)
    assert (straight.method, found.method) == ("same", "connectivity")
    np.testing.assert_allclose(found.displacement, straight.displacement, atol=1e-9)
    np.testing.assert_array_equal(found.weights, 1)
    assert found.normals is None
    assert found.residual == pytest.approx(np.sqrt(np.mean(np.sum(found.displacement**2, axis=1))))
    check_pose(original, found.pose, pose, 3e-3)
    # As a soup of triangles, and with others around it.
    corners = posed.vertices[posed.faces].reshape(-1, 3)
    soup = make_mesh(np.concatenate([corners, 100 * corners[:30]]), np.arange(len(corners) + 30).reshape(-1, 3))
    again = align(original, soup)
    assert again.method == "connectivity"
    np.testing.assert_allclose(again.displacement, straight.displacement, atol=1e-9)


@pytest.mark.parametrize("step", [-1, 1], ids=["outside", "inside"])
def test_points_of_a_mirrored_mesh_are_found(step, original: Original):
    """With faces turned round, so that normals stay outside, or as they were."""
    displacement = 1e-3 * np.random.default_rng(0).normal(size=(642, 3))
    marked = moved(original, displacement)
    posed, pose = anywhere(marked._replace(vertices=np.asarray(marked.vertices) * [-1, 1, 1]), 0)
    suspect = make_mesh(posed.vertices, posed.faces[:, ::step])
    order = np.random.default_rng(1).permutation(642)
    shuffled = make_mesh(posed.vertices[order], np.argsort(order)[suspect.faces])
    straight = align(original, marked)
    for seen, method in ((suspect, "same"), (shuffled, "connectivity")):
        found = align(original, seen)
        assert found.method == method
        assert found.pose.mirrors
        np.testing.assert_allclose(found.displacement, straight.displacement, atol=1e-9)
        check_pose(original, found.pose, Pose(pose.matrix * [-1, 1, 1], pose.shift), 3e-3)


def test_a_mirrored_relief_is_told_from_one_that_is_turned_over():
    """It is so flat that no affine map is fitted to its height."""
    sheet = exact_sheet(30)
    vertices = np.asarray(sheet.vertices, float)
    height = 2e-3 * np.sin(vertices @ np.random.default_rng(0).normal(size=(3, 12)) * 30).sum(axis=1)
    size = np.ptp(vertices, axis=0).max()
    coin = make_original(make_mesh(vertices / size * [1, 1, 0] + np.outer(height, [0, 0, 1]), sheet.faces), FINE)
    mirrored = make_mesh(np.asarray(coin.mesh.vertices) * [-1, 1, 1], sheet.faces)
    assert align(coin, anywhere(mirrored, 1)[0]).residual < 1e-9


def test_what_was_cut_away_is_masked(original: Original):
    displacement = 1e-3 * np.random.default_rng(3).normal(size=(642, 3))
    posed, pose = anywhere(moved(original, displacement), 3)
    keep = original.positions[:, 0] > np.quantile(original.positions[:, 0], 0.4)
    faces = np.where(keep, np.cumsum(keep) - 1, -1)[posed.faces]
    found = align(original, make_mesh(posed.vertices[keep], faces[(faces >= 0).all(axis=1)]))
    assert found.method == "connectivity"
    seen = found.weights > 0
    assert 0.8 * keep.sum() < seen.sum() <= keep.sum()
    assert not seen[~keep].any()
    assert np.abs(found.displacement - displacement)[seen].max() < 1e-3
    check_pose(original, found.pose, pose, 5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_surface_shows_displacement_along_its_normals(seed, original: Original):
    """The same surface in twice as many triangles; its edges are straight, so closest points lie on it."""
    vertices, faces = trimesh.remesh.subdivide(np.asarray(original.mesh.vertices), np.asarray(original.mesh.faces))
    suspect, pose = anywhere(make_mesh(vertices, faces), seed)
    found = align(original, suspect)
    assert found.method == "surface"
    check_pose(original, found.pose, pose, 1e-7)
    np.testing.assert_allclose(found.displacement, 0, atol=1e-7)
    np.testing.assert_array_equal(found.weights, 1)
    assert found.normals is not None
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1)
    # Blown up along the normals by a known smooth amount.
    amount = 2e-3 * np.sin(20 * original.positions[:, 0])
    blown = moved(original, amount[:, None] * vertex_normals(original.mesh))
    vertices, faces = trimesh.remesh.subdivide(np.asarray(blown.vertices), np.asarray(blown.faces))
    seen = align(original, anywhere(make_mesh(vertices, faces), seed)[0])
    assert seen.normals is not None
    along = np.sum(seen.normals * seen.displacement, axis=1)
    expected = amount * np.sum(seen.normals * vertex_normals(original.mesh), axis=1)
    assert np.corrcoef(along, expected)[0, 1] > 0.9
    # Along other directions a surface shows less.
    assert np.std(along) == pytest.approx(np.std(expected), rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("step", [-1, 1], ids=["outside", "inside"])
def test_a_mirrored_surface_shows_the_same(step, original: Original):
    amount = 2e-3 * np.sin(20 * original.positions[:, 0])
    marked = moved(original, amount[:, None] * vertex_normals(original.mesh))
    vertices, faces = trimesh.remesh.subdivide(np.asarray(marked.vertices), np.asarray(marked.faces))
    straight = align(original, make_mesh(vertices, faces))
    found = align(original, anywhere(make_mesh(vertices * [-1, 1, 1], faces[:, ::step]), 2)[0])
    assert found.method == "surface"
    assert found.pose.mirrors
    np.testing.assert_allclose(found.displacement, straight.displacement, atol=1e-6)
    np.testing.assert_array_equal(found.weights, straight.weights)


def test_a_hole_in_a_surface_is_masked(original: Original):
    vertices, faces = trimesh.remesh.subdivide(np.asarray(original.mesh.vertices), np.asarray(original.mesh.faces))
    gone = vertices[:, 2] > np.quantile(vertices[:, 2], 0.9)
    found = align(original, make_mesh(vertices, faces[~gone[faces].any(axis=1)]))
    assert found.method == "surface"
    beyond = np.asarray(original.mesh.vertices)[:, 2] > np.quantile(vertices[:, 2], 0.9)
    assert not found.weights[beyond].any()
    assert found.weights[~beyond].mean() > 0.9
    np.testing.assert_allclose(found.displacement, 0, atol=1e-4)


@pytest.mark.slow
def test_other_objects_beside_a_surface_are_ignored(original: Original):
    ball, torus = original.mesh, trimesh.creation.torus(2.0, 1.0)
    vertices, faces = trimesh.remesh.subdivide(np.asarray(ball.vertices), np.asarray(ball.faces))
    scene = make_mesh(
        np.concatenate([torus.vertices + 9, vertices]), np.concatenate([torus.faces, faces + len(torus.vertices)])
    )
    suspect, pose = anywhere(scene, 5)
    found = align(original, suspect)
    assert found.method == "surface"
    check_pose(original, found.pose, pose, 1e-7)
    np.testing.assert_array_equal(found.weights, 1)


def halves(mesh: Mesh) -> tuple[Mesh, Mesh]:
    """On either side of a plane; the faces across it are gone."""
    upper = (np.asarray(mesh.vertices)[:, 2] > np.median(mesh.vertices[:, 2]))[mesh.faces]
    return mesh._replace(faces=mesh.faces[upper.all(axis=1)]), mesh._replace(faces=mesh.faces[~upper.any(axis=1)])


def together(one: Mesh, other: Mesh) -> Mesh:
    """As two objects of one file, with only the vertices that faces use."""
    meshes = [trimesh.Trimesh(*mesh, process=False) for mesh in (one, other)]
    for mesh in meshes:
        mesh.remove_unreferenced_vertices()
    both = trimesh.util.concatenate(meshes)
    assert isinstance(both, trimesh.Trimesh)
    return make_mesh(both.vertices, both.faces)


@pytest.mark.slow
@pytest.mark.parametrize("foreign", [False, True])
def test_pieces_that_moved_apart_are_aligned_one_by_one(foreign, original: Original):
    displacement = 2e-4 * np.random.default_rng(8).normal(size=(642, 3))
    marked = moved(original, displacement)
    if foreign:
        marked = make_mesh(*trimesh.remesh.subdivide(np.asarray(marked.vertices), np.asarray(marked.faces)))
    upper, lower = halves(marked)
    whole = align(original, together(upper, lower))
    apart = align(original, together(anywhere(upper, 1)[0], anywhere(lower, 2)[0]))
    assert whole.method == apart.method == ("surface" if foreign else "connectivity")
    seen = (whole.weights > 0) & (apart.weights > 0)
    assert seen.sum() > 0.8 * 642
    assert apart.residual < 1e-3
    # Each piece has a map of its own, so that a little less than of the whole is left.
    left = np.vdot(apart.displacement[seen], whole.displacement[seen]) / np.sum(whole.displacement[seen] ** 2)
    assert 0.85 < left <= 1


@pytest.mark.slow
def test_a_remeshed_part_is_aligned(original: Original):
    vertices, faces = trimesh.remesh.subdivide(np.asarray(original.mesh.vertices), np.asarray(original.mesh.faces))
    part, _ = halves(make_mesh(vertices, faces))
    suspect, pose = anywhere(part, 4)
    found = align(original, suspect)
    assert found.method == "surface"
    assert 0.4 < found.weights.mean() < 0.5
    assert found.residual < 2e-4
    check_pose(original, found.pose, pose, 1e-3)


@pytest.mark.slow
def test_an_affine_map_of_a_surface_is_undone_on_request(original: Original):
    change = np.eye(3) + 0.03 * np.random.default_rng(4).normal(size=(3, 3))
    vertices, faces = trimesh.remesh.subdivide(np.asarray(original.mesh.vertices), np.asarray(original.mesh.faces))
    suspect = make_mesh(vertices @ change.T, faces)
    assert align(original, suspect, "affine").residual < 1e-6 < 1e-4 < align(original, suspect).residual


@pytest.mark.slow
def test_smoothing_of_another_meshing_is_noticed():
    original = make_original(bumpy_sphere(4), FINE)
    vertices, faces = trimesh.remesh.subdivide(np.asarray(original.mesh.vertices), np.asarray(original.mesh.faces))
    finer = make_mesh(vertices, faces)
    assert align(original, finer).nuisance is None
    found = align(original, jm.attack(finer, "smoothing", 40, seed=0))
    assert found.nuisance is not None
    assert found.normals is not None
    # It explains what happened to the original, far beyond chance.
    design = (found.nuisance[:, :, None] * found.normals[:, None, :]).reshape(len(found.normals), -1)
    along = np.sum(found.normals * found.displacement, axis=1)
    left = along - design @ np.linalg.lstsq(design, along, rcond=1e-9)[0]
    assert np.linalg.norm(left) < 0.35 * np.linalg.norm(along)


@pytest.mark.slow
def test_smoothing_by_cotangents_is_noticed_and_taken_off():
    """Implicitly, by libigl's cotangents: another operator than the filters', and another function of it."""
    igl = pytest.importorskip("igl")
    message = b"16"
    marker = jm.make_marker(rippled_ball(), bytes(32), bits=16)
    marked = marker.embed(message, jm.Budget(rms=3e-4, noise=0))[0]
    vertices, faces = np.asarray(marked.vertices, np.float64), np.asarray(marked.faces)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    smoothed = spsolve((mass - 2e-3 * igl.cotmatrix(vertices, faces)).tocsc(), mass @ vertices)
    aligned = align(marker.original, make_mesh(smoothed, faces))
    assert aligned.nuisance is not None
    before, after = (marker.read(one, message=message).log10_p for one in (aligned._replace(nuisance=None), aligned))
    assert marker.read(aligned).message == message
    assert after < 1.5 * before
    for other in (marked, jm.attack(marked, "noise", 1e-3, seed=0)):
        assert align(marker.original, other).nuisance is None


def rippled_ball() -> Mesh:
    """Of irregular triangles, with waves that smoothing takes away."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = trimesh.convex.convex_hull(points)
    vertices = np.asarray(hull.vertices)
    waves = np.cos(9 * vertices @ rng.normal(size=(3, 12))).sum(axis=1, keepdims=True)
    return make_mesh(vertices * (1 + 0.02 * waves), np.asarray(hull.faces))


@pytest.mark.slow
def test_a_surface_with_little_more_than_the_shape_is_read_as_a_whole_only():
    """Strong smoothing moves it further than anything else is allowed to; half of it is not enough to tell the pose."""
    mesh = rough_sphere(1500)
    original = make_original(mesh)
    smooth = jm.attack(jm.attack(mesh, "smoothing", 80, seed=0), "midpoint", 1, seed=0)
    turn = Rotation.from_euler("xyz", [20, 40, 60], degrees=True)
    found = align(original, Mesh(3 * turn.apply(smooth.vertices), smooth.faces))
    assert 0.005 < found.residual < 0.01
    assert found.nuisance is not None  # what smoothing did to the host
    np.testing.assert_allclose(found.pose.matrix @ turn.as_matrix() * 3, np.eye(3), atol=0.05)
    with pytest.raises(jm.JaxmarkError, match="could not be aligned: the distance of its surface"):
        align(original, jm.attack(smooth, "cropping", 0.6, seed=0))


@pytest.mark.slow
def test_what_remeshing_smoothed_is_kept_apart_from_the_mark():
    """Remeshing cuts off what sticks out, which is most of the displacement; the mark is read from the rest."""
    pytest.importorskip("pymeshlab")
    mesh, key = rough_sphere(1500), b"k" * 32
    marked, _ = jm.embed(mesh, b"p", key)
    found = align(make_original(mesh), jm.attack(marked, "isotropic", 1, seed=0))
    assert found.method == "surface"
    assert found.nuisance is not None
    reader = jm.make_marker(mesh, key, bits=8)
    blurred = reader.read(found._replace(nuisance=None), b"p")
    assert reader.read(found, b"p").log10_p < blurred.log10_p - 3 < -10
    assert jm.make_marker(mesh, b"w" * 32, bits=8).read(found, b"p").log10_p > -2


@pytest.mark.slow
def test_what_cannot_be_aligned_is_refused(original: Original):
    for other in (bumpy_sphere(4, 3), make_mesh(*tetrahedron())):
        with pytest.raises(jm.JaxmarkError, match="could not be aligned"):
            align(original, other)
    with pytest.raises(jm.JaxmarkError, match="area of 0"):
        align(original, make_mesh([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]]))
    with pytest.raises(jm.JaxmarkError, match="area of 0"):
        align(original, make_mesh(np.ones((642, 3)), np.asarray(original.mesh.faces)[::-1]))


def tetrahedron() -> tuple[np.ndarray, np.ndarray]:
    return np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array(
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )


def test_without_libigl_surfaces_are_refused_by_the_name_of_the_extra(original: Original, monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(jm.JaxmarkError, match=r"jaxmark\[align\]"):
        align(original, bumpy_sphere(4, 3))
    assert align(original, original.mesh).method == "same"


@pytest.mark.slow
def test_a_suspect_is_aligned_once_for_several_keys(original: Original):
    mesh, message = original.mesh, b"m"
    first, second = (jm.make_marker(mesh, bytes([i]) * 32, bits=8) for i in (1, 2))
    suspect, _ = anywhere(first.embed(message, jm.Budget(noise=0))[0], 6)
    aligned = align(first.original, suspect)
    found, again = first.detect(suspect), first.read(aligned)
    assert found.message == again.message == message
    assert found.log10_p == again.log10_p
    assert second.read(aligned).message is None
