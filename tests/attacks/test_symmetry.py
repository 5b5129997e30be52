"""Averages over mirror images and repeated parts, beside the shapes that noise was put on, in poses that are known."""

import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.attacks import instance_averaging, mirror_averaging
from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh, vertex_normals
from tests.samples import bumpy_sphere, exact_sheet

pytestmark = pytest.mark.core

TURN = Rotation.from_rotvec([0.4, 1.1, -0.3]).as_matrix()
SHIFT = np.array([3.0, -2, 5])


@pytest.fixture(scope="module")
def face() -> tuple[Mesh, np.ndarray]:
    """A shape with one mirror plane, turned and shifted; and the vertices that are mirror images of its vertices."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = np.asarray(ball.vertices).T
    radius = 1 + 0.15 * np.sin(2 * x**2 + 3 * y + 1) + 0.1 * np.cos(4 * np.abs(x) + 2 * z) + 0.1 * y * z
    points = np.asarray(ball.vertices) * radius[:, None] * [1, 0.7, 1.4]
    far, partner = KDTree(points).query(points * [-1, 1, 1])
    assert far.max() < 1e-12
    return make_mesh(points @ TURN.T + SHIFT, np.asarray(ball.faces)), partner


def asymmetry(points: np.ndarray, partner: np.ndarray, normals: np.ndarray) -> float:
    """How far vertices' mirror images are off their partners, along normals."""
    image = (points - SHIFT) @ TURN * [-1, 1, 1] @ TURN.T + SHIFT
    return float(np.sqrt(np.mean(np.sum((points[partner] - image) * normals[partner], axis=1) ** 2)))


def test_antisymmetric_noise_goes(face: tuple[Mesh, np.ndarray]):
    pytest.importorskip("igl")
    mesh, partner = face
    size, normals = 0.001 * diagonal(mesh), vertex_normals(mesh)
    noise = np.random.default_rng(0).normal(size=len(partner))
    noise = (noise - noise[partner]) / np.sqrt(2)
    before = mesh._replace(vertices=mesh.vertices + size * noise[:, None] * normals)
    after = mirror_averaging(before, 1)
    np.testing.assert_array_equal(after.faces, mesh.faces)
    was = asymmetry(before.vertices, partner, normals)
    assert 1.5 * size < was
    assert 5 * asymmetry(after.vertices, partner, normals) < was
    left = np.sum((after.vertices - mesh.vertices) * normals, axis=1)
    assert 5 * np.std(left) < size
    # Half of the strength is half of the way.
    half = mirror_averaging(before, 0.5).vertices - before.vertices
    np.testing.assert_allclose(2 * half, after.vertices - before.vertices, atol=1e-12)


def test_noise_of_two_halves_is_averaged(face: tuple[Mesh, np.ndarray]):
    pytest.importorskip("igl")
    mesh, partner = face
    size, normals = 0.0005 * diagonal(mesh), vertex_normals(mesh)
    noise = size * np.random.default_rng(1).normal(size=len(partner))
    after = mirror_averaging(mesh._replace(vertices=mesh.vertices + noise[:, None] * normals), 1)
    left = np.sum((after.vertices - mesh.vertices) * normals, axis=1)
    off = (noise + noise[partner]) / 2
    assert np.corrcoef(left, off)[0, 1] > 0.98
    assert np.std(left) == pytest.approx(np.std(noise) / np.sqrt(2), rel=0.05)


def test_what_has_no_counterpart_stays(face: tuple[Mesh, np.ndarray]):
    pytest.importorskip("igl")
    mesh, _ = face
    ear = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    beside = np.asarray(ear.vertices) + np.array([1.4, 0, 0])
    both = make_mesh(
        np.concatenate([mesh.vertices, beside @ TURN.T + SHIFT]),
        np.concatenate([mesh.faces, np.asarray(ear.faces) + len(mesh.vertices)]),
    )
    after = mirror_averaging(both, 1)
    stays = np.arange(len(mesh.vertices), len(both.vertices))
    np.testing.assert_array_equal(after.vertices[stays], both.vertices[stays])
    assert rms(after.vertices - both.vertices) < 1e-3 * diagonal(mesh)


def posed(mesh: Mesh, seed: int, size: float) -> tuple[Mesh, np.ndarray, float]:
    """The mesh with noise, vertices in another order, in a random pose; where they are without noise, and the scale."""
    random = np.random.default_rng(seed)
    order = random.permutation(len(mesh.vertices))
    turn, shift = Rotation.random(random_state=seed).as_matrix(), 20.0 * np.array([seed, 1, -seed])
    scale = random.uniform(0.5, 2)
    noise = size * random.normal(size=mesh.vertices.shape)
    clean, rough = (scale * points[order] @ turn.T + shift for points in (mesh.vertices, mesh.vertices + noise))
    return Mesh(rough, np.argsort(order)[mesh.faces]), clean, scale


def together(meshes: list[Mesh]) -> Mesh:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]
    return make_mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def test_noise_of_three_instances_falls_by_the_root_of_three(sphere: Mesh):
    size, count = 0.002, len(sphere.vertices)
    copies = [posed(sphere, seed, size) for seed in (1, 2, 3)]
    stretched = make_mesh(sphere.vertices * [1, 1, 2] + 200, sphere.faces)  # the same faces, another shape
    other = make_mesh(bumpy_sphere(2).vertices - 300, bumpy_sphere(2).faces)
    before = together([*(mesh for mesh, *_ in copies), stretched, other])
    after = instance_averaging(before, 1)
    np.testing.assert_array_equal(after.faces, before.faces)
    np.testing.assert_array_equal(after.vertices[3 * count :], before.vertices[3 * count :])
    half = instance_averaging(before, 0.5).vertices
    np.testing.assert_allclose(half, (before.vertices + after.vertices) / 2, atol=1e-9)
    for place, (_, clean, scale) in enumerate(copies):
        part = slice(place * count, (place + 1) * count)
        was, left = (rms((points - clean) / scale) for points in (before.vertices[part], after.vertices[part]))
        assert was == pytest.approx(np.sqrt(3) * size, rel=0.05)
        assert left == pytest.approx(was / np.sqrt(3), rel=0.05)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", ["mirror-averaging", "instance-averaging"])
def test_host_function_averages_points(kind, face: tuple[Mesh, np.ndarray]):
    """Copies move together, what no face uses stays, size and place make no difference; strength 0 changes nothing."""
    if kind == "mirror-averaging":
        pytest.importorskip("igl")
        mesh = face[0]
    else:
        mesh = together([posed(bumpy_sphere(2), seed, 0.002)[0] for seed in (1, 2)])
    mesh = mesh._replace(vertices=mesh.vertices + 1e-3 * np.random.default_rng(0).normal(size=mesh.vertices.shape))
    alone = jm.attack(mesh, kind, 1, seed=0)
    assert rms(alone.vertices - mesh.vertices) > 1e-4
    corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3), [[90.0, 9, 9]]])
    found = jm.attack(make_mesh(corners, np.arange(3 * len(mesh.faces)).reshape(-1, 3)), kind, 1, seed=1)
    np.testing.assert_array_equal(found.vertices[-1], [90, 9, 9])
    np.testing.assert_allclose(found.vertices[:-1], alone.vertices[mesh.faces].reshape(-1, 3), atol=1e-6)
    far = jm.attack(make_mesh(1e3 * mesh.vertices + 1e6, mesh.faces), kind, 1, seed=0)
    np.testing.assert_allclose((far.vertices - 1e6) / 1e3, alone.vertices, atol=1e-6)
    np.testing.assert_array_equal(jm.attack(mesh, kind, 0, seed=0).vertices, mesh.vertices)
    with pytest.raises(jm.JaxmarkError, match=r"in \[0, 1\]"):
        jm.attack(mesh, kind, 1.5, seed=0)


@pytest.mark.usefixtures("unchecked")
def test_what_repeats_nothing_is_refused(sphere: Mesh, hard_graph: Mesh, monkeypatch: pytest.MonkeyPatch):
    for mesh in (sphere, hard_graph):
        with pytest.raises(jm.JaxmarkError, match="No part of the mesh is repeated"):
            jm.attack(mesh, "instance-averaging", 1, seed=0)
    points = make_mesh(np.zeros((8, 3)), [[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]])
    with pytest.raises(jm.JaxmarkError, match="No part"):
        instance_averaging(points, 1)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "igl", None)
        with pytest.raises(jm.JaxmarkError, match="igl is needed"):
            jm.attack(sphere, "mirror-averaging", 1, seed=0)
    pytest.importorskip("igl")
    # A screw is not its mirror image.
    t, u = (step * 2 * np.pi / 32 for step in np.divmod(np.arange(33 * 33), 33))
    out = 1 + 0.2 * np.cos(u)
    spring = np.stack([out * np.cos(t), out * np.sin(t), 0.6 * t + 0.2 * np.sin(u)], axis=1)
    uneven = make_mesh(spring, exact_sheet(33).faces)
    with pytest.raises(jm.JaxmarkError, match=r"no mirror symmetry: .* % of the diagonal off"):
        jm.attack(uneven, "mirror-averaging", 1, seed=0)
