"""Suspects brought back to the original, against least squares by NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment import align
from jaxmark.mesh import Mesh, make_mesh
from jaxmark.original import Original, prepare
from tests.samples import bumpy_sphere


@pytest.fixture(scope="module")
def original() -> Original:
    """642 vertices."""
    return prepare(bumpy_sphere(3))


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
    found, weights = align(original, moved(original, np.zeros((642, 3)), matrix, shift))
    np.testing.assert_allclose(found, 0, atol=1e-12)
    np.testing.assert_array_equal(weights, 1)


@pytest.mark.parametrize("seed", range(6))
def test_a_small_displacement_survives_an_affine_map(seed, original: Original):
    """As it is, but for its own best affine part."""
    random = np.random.default_rng(seed)
    displacement = 1e-3 * random.normal(size=(642, 3))
    matrix, shift = affine_map(random), 10 * random.normal(size=3)
    found, weights = align(original, moved(original, displacement, matrix, shift))
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
    sheet = prepare(make_mesh(np.stack([i, j + 0.0, 0 * i], axis=1) @ turn.T + 5, faces))
    mark = 1e-3 * random.normal(size=400)
    plane = np.stack([i, j, np.ones(400)], axis=1)
    expected = mark - plane @ np.linalg.lstsq(plane, mark, rcond=None)[0]
    for matrix, shift in ((None, 0.0), (1.7 * Rotation.random(rng=random).as_matrix(), np.array([3.0, -4.0, 5.0]))):
        found, weights = align(sheet, moved(sheet, mark[:, None] * turn[:, 2], matrix, shift))
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
    """Those are masked, and the rest recovered as if they had never been there."""
    for seed in range(4):
        random = np.random.default_rng(seed)
        displacement = 5e-4 * random.normal(size=(642, 3))
        height = original.positions[:, 2] if where == "at one end" else random.uniform(size=642)
        lost = height > np.quantile(height, 1 - share)
        edit = random.normal(size=(642, 3)) if how == "apart" else random.normal(size=3) * np.ones((642, 1))
        edit *= 0.05 / np.linalg.norm(edit, axis=1, keepdims=True)
        matrix = Rotation.random(rng=random).as_matrix() if turned else np.eye(3)
        suspect = moved(original, displacement + lost[:, None] * edit, matrix, random.normal(size=3))
        found, weights = align(original, suspect)
        np.testing.assert_array_equal(weights, ~lost)
        np.testing.assert_array_equal(found[lost], 0)
        expected = without_affine(original.positions[~lost], displacement[~lost])
        np.testing.assert_allclose(found[~lost], expected, atol=1e-9)


@pytest.mark.parametrize("far", [1.0, 1e9, 1e200])
def test_points_thrown_away_are_masked(far, original: Original):
    displacement = 1e-3 * np.random.default_rng(4).normal(size=(642, 3))
    thrown = moved(original, displacement, affine_map(np.random.default_rng(5)), 3.0)
    thrown.vertices[[7, 99]] = [[0, far, 0], [far, -far, 1]]
    with np.errstate(over="raise", invalid="raise"):
        found, weights = align(original, thrown)
    lost = np.isin(np.arange(642), [7, 99])
    np.testing.assert_array_equal(weights, ~lost)
    np.testing.assert_array_equal(found[lost], 0)
    expected = without_affine(original.positions[~lost], displacement[~lost])
    np.testing.assert_allclose(found[~lost], expected, atol=1e-9)


def test_an_unmoved_suspect_is_exactly_zero(original: Original):
    for mesh in (original.mesh, make_mesh(2.5 * original.mesh.vertices + 1e3, original.mesh.faces)):
        found, weights = align(original, mesh)
        np.testing.assert_array_equal(found, 0)
        np.testing.assert_array_equal(weights, 1)


def test_the_same_suspect_gives_the_same_to_the_last_bit(original: Original):
    """No key, no chance."""
    suspect = moved(
        original, 1e-3 * np.random.default_rng(6).normal(size=(642, 3)), affine_map(np.random.default_rng(7))
    )
    for one, again in zip(align(original, suspect), align(prepare(original.mesh), suspect), strict=True):
        np.testing.assert_array_equal(one, again)


def test_points_that_no_face_uses_do_not_count():
    sphere = bumpy_sphere(2)
    loose = np.array([[1e5, 0.0, 0], [0, 3, 0]])
    mesh = make_mesh(np.vstack([loose[:1], sphere.vertices, loose[1:]]), sphere.faces + 1)
    original = prepare(mesh)
    suspect = make_mesh(1.3 * mesh.vertices + 2, mesh.faces)
    suspect.vertices[[0, -1]] = [[-1e7, 4, 5], [0, 0, 0]]
    found, weights = align(original, suspect)
    np.testing.assert_array_equal(weights, [0, *np.ones(162), 0])
    np.testing.assert_allclose(found, 0, atol=1e-12)


def test_another_connectivity_is_refused(original: Original):
    faces = original.mesh.faces
    for other in (bumpy_sphere(2), original.mesh._replace(faces=faces[::-1]), original.mesh._replace(faces=faces[:-1])):
        with pytest.raises(jm.JaxmarkError, match="does not share the connectivity"):
            align(original, other)
