"""The visible turn of normals against closed forms on planes and dense matrices; shapes that hide and that do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.distortion import Masking, make_masking, shading, vertex_means, visible_turn
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import rough_sphere

pytestmark = pytest.mark.core

JUST_SEEN = 0.006 / np.tan(np.radians(60))  # the turn on a plane, in radians
SIZE = 41


def sheet(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of size² vertices, one apart, of triangles that are nearly equilateral."""
    i, j = np.divmod(np.arange(size * size), size)
    corner = (i * size + j).reshape(size, size)[:-1, :-1].ravel()
    one = np.stack([corner, corner + size, corner + 1], 1)
    other = np.stack([corner + 1, corner + size, corner + size + 1], 1)
    return np.stack([i + j / 2, j * np.sqrt(3) / 2, 0.0 * i], axis=1), np.concatenate([one, other])


def wave(vertices: np.ndarray, length: float, turn: float) -> np.ndarray:
    """The sheet bent to a wave along y whose normals turn by up to this angle."""
    height = np.tan(turn) * length / (2 * np.pi) * np.sin(2 * np.pi * vertices[:, 1] / length)
    return vertices + height[:, None] * [0, 0, 1]


def seen(original: np.ndarray, distorted: np.ndarray, faces: np.ndarray, share: float = 0.95) -> float:
    return float(shading(jnp.asarray(original), jnp.asarray(distorted), make_masking(original, faces), share))


@pytest.mark.parametrize("length", [3.0, 6.0, 9.0, 12.0, 18.0])
def test_a_wave_on_a_plane_is_seen_as_far_as_normals_turn(length, x64):
    v, faces = sheet()
    # Its normals are those of the wave where it is sampled finely; a band's best wave is 3 · 2^k long.
    found = np.array([seen(v, wave(v, length, np.radians(angle)), faces) for angle in (0.2, 0.4, 0.8)])
    sampled = np.sinc(np.sqrt(3) / 2 / length)
    np.testing.assert_allclose(found, np.radians([0.2, 0.4, 0.8]) / JUST_SEEN * sampled, rtol=0.15)
    np.testing.assert_allclose(found / found[0], [1, 2, 4], rtol=1e-2)


def test_what_is_seen_by_dense_matrices(x64):
    mesh = rough_sphere(60)
    x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    y = x + 0.02 * np.random.default_rng(0).normal(size=x.shape)
    normals, moved = (np.asarray(trimesh.Trimesh(z, faces, process=False).face_normals) for z in (x, y))
    surface = trimesh.Trimesh(x, faces, process=False)
    weights = np.zeros((len(faces), len(faces)))
    for (i, j), angle in zip(surface.face_adjacency, surface.face_adjacency_angles, strict=True):
        weights[i, j] = weights[j, i] = surface.area_faces[i] * surface.area_faces[j] * np.exp(-((angle / 0.7854) ** 4))
    step = (np.eye(len(faces)) + weights / weights.sum(axis=1, keepdims=True)) / 2
    powers = [np.linalg.matrix_power(step, 4**k) for k in range(6)]
    bands = [before - after for before, after in zip([np.eye(len(faces)), *powers[:-1]], powers, strict=True)]
    pooled = np.zeros(len(faces))
    for band, power, gain in zip(bands, powers, (1, 2, 2, 2, 2, 2), strict=True):
        turn = gain * np.linalg.norm(band @ (moved - normals), axis=1)
        own = gain * np.sqrt(power @ np.sum((band @ normals) ** 2, axis=1))
        pooled += (turn / (JUST_SEEN * (1 + (0.0078 * 88.29 * own / JUST_SEEN) ** 4.207) ** (1 / 4.207))) ** 4
    found = visible_turn(jnp.asarray(x), jnp.asarray(y), make_masking(x, faces))
    np.testing.assert_allclose(found, pooled**0.25, rtol=2e-3)
    order = np.argsort(pooled)
    share = np.cumsum(surface.area_faces[order]) / surface.area
    for least in (0.5, 0.95, 0.99):
        expected = pooled[order][np.searchsorted(share, least)] ** 0.25
        assert seen(x, y, faces, least) == pytest.approx(expected, rel=2e-3)


def test_roughness_hides_and_a_plane_does_not(x64):
    v, faces = sheet()
    bend = wave(v, 6.0, np.radians(0.5)) - v
    random = np.random.default_rng(1).normal(size=len(v))[:, None] * [0, 0, 1]
    found = [seen(v + rough * random, v + rough * random + bend, faces) for rough in (0, 0.02, 0.1, 0.3)]
    assert found[0] > 1.2 * found[1] > 4 * found[2] > 8 * found[3]
    # A wave hides others of its length, and shorter or longer ones less.
    beside = [seen(wave(v, length, 0.1), wave(v, length, 0.1) + bend, faces) for length in (6.0, 24.0)]
    assert beside[0] < beside[1] / 4


def test_a_side_of_a_box_is_compared_with_itself(x64):
    box = trimesh.creation.box((1.0, 1, 1))
    for _ in range(4):
        box = box.subdivide()
    v, faces = np.asarray(box.vertices), np.asarray(box.faces)
    top = (v[faces][:, :, 2] > 0.5 - 1e-9).all(axis=1)
    dent = np.where(v[:, 2] > 0.5 - 1e-9, 1e-3 * np.cos(np.pi * v[:, 0]) * np.cos(np.pi * v[:, 1]), 0)
    after = v - dent[:, None] * [0, 0, 1]
    whole = visible_turn(jnp.asarray(v), jnp.asarray(after), make_masking(v, faces))
    alone = visible_turn(jnp.asarray(v), jnp.asarray(after), make_masking(v * [1, 1, 1], faces[top]))
    np.testing.assert_allclose(np.asarray(whole)[top], alone, rtol=0.02, atol=1e-3)
    assert np.asarray(whole)[~top].max() < 1e-6 < 0.1 < alone.max()


def test_nothing_is_seen_of_shifts_along_a_plane(x64):
    v, faces = sheet(12)
    along = v + 0.1 * np.random.default_rng(2).normal(size=v.shape) * [1, 1, 0]
    assert seen(v, along, faces, 1.0) < 1e-12


def test_size_place_pose_and_the_order_of_corners_do_not_count(x64):
    mesh = rough_sphere(200)
    x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    y = x + 0.01 * np.random.default_rng(3).normal(size=x.shape)
    value = seen(x, y, faces)
    rotation = Rotation.random(random_state=4).as_matrix()
    assert seen(*(3 * z @ rotation.T + 5 for z in (x, y)), faces) == pytest.approx(value, rel=1e-9)
    mixed = np.where(np.random.default_rng(5).random(len(faces))[:, None] < 0.5, faces, faces[:, ::-1])
    assert seen(x, y, mixed) == pytest.approx(value, rel=1e-9)


def test_hard_meshes_have_finite_values_and_gradients(hard_graph: Mesh, dtype):
    x, faces = np.asarray(hard_graph.vertices), np.asarray(hard_graph.faces)
    masking = make_masking(x, faces)
    y = jnp.asarray(x, dtype) + jnp.asarray(0.1 * np.random.default_rng(0).normal(size=x.shape), dtype)
    flat = jnp.asarray(x * [1, 0, 0], dtype)
    for moved in (jnp.asarray(x, dtype), y, flat):
        values, slope = jax.value_and_grad(lambda z: visible_turn(jnp.asarray(x, dtype), z, masking).sum())(moved)
        assert values.dtype == dtype
        assert np.isfinite(values)
        assert np.isfinite(slope).all()
    assert np.isfinite(shading(jnp.asarray(x, dtype), y, masking))


def test_of_a_mesh_itself_nothing_is_seen():
    """Not even by rounding, in single precision."""
    for v, faces in (sheet(7), (rough_sphere(333).vertices, rough_sphere(333).faces)):
        x = np.asarray(v, np.float32)
        assert seen(x, x, np.asarray(faces), 1.0) == 0


def test_without_faces_nothing_is_seen(x64):
    x = np.zeros((3, 3))
    assert seen(x, x, np.array([[0, 1, 2]])) == 0


def test_means_around_vertices(x64):
    v, faces = sheet(5)
    masking: Masking = make_masking(np.vstack([v, [[9.0, 9, 9]]]), faces)
    found = vertex_means(jnp.full(len(faces), 2.5), masking, len(v) + 1)
    np.testing.assert_allclose(found, [2.5] * len(v) + [0])


def test_limits_are_kept(x64):
    """It bounds a mark as other metrics do."""
    mesh = make_mesh(*sheet(24))
    marker = jm.make_marker(mesh, bytes(32), bits=8, scheme=KeyedScheme(hiding=False))
    marked, _ = marker.write(marker.codeword(b"c"), {"shading": 1.0})
    assert 0.98 < jm.compare(mesh, marked, ["shading"]).shading <= 1
