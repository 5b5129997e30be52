"""Originals that were saved again are brought back to exactly the geometry that was hashed, and nothing else is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.canonical import grid_spacing, rounded
from jaxmark.geometry.imprint import Imprint, make_imprint, restore
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh
from tests.samples import bumpy_sphere, rough_sphere

pytestmark = pytest.mark.core


def six_digits(x: np.ndarray) -> np.ndarray:
    return np.array([float(f"{number:.6g}") for number in x.ravel()]).reshape(x.shape)


def reordered(mesh: Mesh) -> Mesh:
    """Vertices, faces and corners in another order."""
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces][::-1][:, [1, 2, 0]]
    return make_mesh(mesh.vertices[order], faces)


def soup(mesh: Mesh) -> Mesh:
    """Each face with corners of its own, in float32, as STL stores them."""
    corners = np.asarray(mesh.vertices, np.float32)[mesh.faces].reshape(-1, 3)
    return make_mesh(corners.astype(float), np.arange(len(corners)).reshape(-1, 3))


TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
COPIES = {
    "float32": lambda mesh: mesh._replace(vertices=mesh.vertices.astype(np.float32).astype(float)),
    "six digits": lambda mesh: mesh._replace(vertices=six_digits(mesh.vertices)),
    "one ulp": lambda mesh: mesh._replace(vertices=np.nextafter(mesh.vertices, np.inf)),
    "a thousand times, moved": lambda mesh: mesh._replace(vertices=six_digits(1000 * mesh.vertices + 300)),
    "turned": lambda mesh: mesh._replace(vertices=six_digits(mesh.vertices @ TURN.T)),
    "reordered": reordered,
    "unwelded": soup,
    "turned and reordered": lambda mesh: reordered(mesh._replace(vertices=0.1 * mesh.vertices @ TURN.T)),
    "with a vertex that no face uses": lambda mesh: make_mesh(np.vstack([mesh.vertices, [[9, 9, 9]]]), mesh.faces),
}


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return bumpy_sphere(3)


@pytest.fixture(scope="module")
def imprint(mesh: Mesh) -> Imprint:
    return imprint_of(mesh)


def imprint_of(mesh: Mesh) -> Imprint:
    return make_imprint(rounded(mesh, grid_spacing(diagonal(mesh))), grid_spacing(diagonal(mesh)))


@pytest.mark.parametrize("name", COPIES)
def test_copies_are_restored_exactly(mesh: Mesh, imprint: Imprint, name):
    copy = COPIES[name](mesh)
    found = restore(copy, imprint)
    assert found.exact
    assert rounded(found.mesh, imprint.grid).hash == imprint.hash
    assert found.share == 1
    assert found.distance < 1e-3


def test_rounding_is_repeatable_and_the_grid_is_as_stated(mesh: Mesh):
    spacing = grid_spacing(diagonal(mesh))
    assert 2**-16 < spacing / diagonal(mesh) <= 2**-15
    assert np.frexp(spacing)[0] == 0.5
    once = rounded(mesh, spacing)
    np.testing.assert_allclose(once.points.vertices[once.weld.point], mesh.vertices, atol=spacing / 2)
    assert rounded(once.points, spacing).hash == once.hash == rounded(reordered(mesh), spacing).hash
    nudged = np.array(once.points.vertices)
    nudged[5, 1] += spacing
    assert rounded(Mesh(nudged, once.points.faces), spacing).hash != once.hash
    flipped = np.array(once.points.faces)
    flipped[3] = flipped[3][::-1]
    assert rounded(Mesh(once.points.vertices, flipped), spacing).hash != once.hash


def test_degenerate_faces_tell_nothing(mesh: Mesh, imprint: Imprint):
    """They are in no filter and no hash, so that who adds them changes nothing."""
    more = make_mesh(mesh.vertices, np.vstack([[[7, 7, 300]], mesh.faces, [[5, 80, 5]]]))
    found, expected = rounded(more, imprint.grid), rounded(mesh, imprint.grid)
    assert found.hash == expected.hash
    np.testing.assert_array_equal(found.points.faces, expected.points.faces)
    np.testing.assert_array_equal(found.points.vertices, expected.points.vertices)
    with pytest.raises(JaxmarkError, match="no surface"):
        rounded(make_mesh(mesh.vertices, [[7, 7, 300]]), imprint.grid)


def test_points_that_round_alike_are_one():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-7, 0, 0], [0, 0, 1.0]])
    found = rounded(make_mesh(vertices, [[0, 1, 2], [3, 2, 4], [0, 3, 4]]), 2.0**-16)
    assert len(found.points.vertices) == 4
    assert found.weld.point[0] == found.weld.point[3]
    np.testing.assert_array_equal(found.weld.point[found.weld.first], np.arange(4))


def test_other_meshes_are_not_taken_for_the_original(mesh: Mesh, imprint: Imprint):
    noise = np.random.default_rng(1).normal(size=mesh.vertices.shape)
    for amount in (1e-4, 1e-3):  # as a mark moves them
        found = restore(mesh._replace(vertices=mesh.vertices + amount * noise), imprint)
        assert not found.exact
        assert found.share < 0.5
        assert found.distance < 1e-2
    other = restore(rough_sphere(600), imprint)
    assert not other.exact
    assert other.share == 0
    far = restore(make_mesh(mesh.vertices * [1, 1, 2], mesh.faces), imprint)
    assert far.distance > 0.1


def test_an_edited_copy_says_which_points_are_left(mesh: Mesh, imprint: Imprint):
    kept = mesh.vertices[:, 0] < 0.5
    found = restore(mesh._replace(vertices=np.where(kept[:, None], mesh.vertices, 1.01 * mesh.vertices)), imprint)
    assert not found.exact
    np.testing.assert_array_equal(found.places >= 0, kept)
    assert found.share == pytest.approx(kept.mean())
    # Places are those in the canonical order.
    points = np.asarray(rounded(mesh, imprint.grid).points.vertices)
    np.testing.assert_allclose(points[found.places[kept]], mesh.vertices[kept], atol=imprint.grid / 2)


def test_short_hashes_that_coincide_are_told_apart(mesh: Mesh, imprint: Imprint, monkeypatch: pytest.MonkeyPatch):
    """With hashes of 16 bits one point in twelve has several candidates."""
    from jaxmark.geometry import imprint as module

    tags = module._tags
    monkeypatch.setattr(module, "_tags", lambda cells: tags(cells) >> np.uint32(16))
    short = imprint_of(mesh)
    assert restore(COPIES["float32"](mesh), short).exact
