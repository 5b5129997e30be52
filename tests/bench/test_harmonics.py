"""The protocol of SMI 2010: its definitions by hand, and the scheme of a public tool."""

import importlib
from types import ModuleType

import jax
import numpy as np
import pytest
from scipy import sparse

import jaxmark as jm
from jaxmark.bench.tracks import PROTOCOL
from jaxmark.geometry.mesh import Mesh, edges, vertex_normals
from jaxmark.geometry.pose import similarity
from tests.samples import bumpy_sphere


@pytest.fixture
def harmonics() -> ModuleType:
    pytest.importorskip("igl")
    return importlib.import_module("jaxmark.bench.methods.harmonics")


def attacked(mesh: Mesh, attack: str, seed: int) -> list[Mesh]:
    """What an attack of the protocol makes of a mesh."""
    return PROTOCOL[attack].suspects(mesh, seed)


def cotangents(mesh: Mesh) -> np.ndarray:
    """The cotangent matrix by its definition, corner by corner."""
    size = len(mesh.vertices)
    matrix = np.zeros((size, size))
    for face in mesh.faces:
        for k in range(3):
            i, j, o = np.roll(face, -k)
            u, v = mesh.vertices[i] - mesh.vertices[o], mesh.vertices[j] - mesh.vertices[o]
            half = u @ v / np.linalg.norm(np.cross(u, v)) / 2
            matrix[[i, j], [j, i]] -= half
            matrix[[i, j], [i, j]] += half
    return matrix


def test_harmonics_are_eigenvectors_of_the_cotangent_matrix(harmonics):
    mesh = bumpy_sphere(2)
    values, vectors = np.linalg.eigh(cotangents(mesh))
    found = harmonics.harmonics(mesh)
    assert found.shape == (len(mesh.vertices), 20)
    np.testing.assert_allclose(np.abs(found.T @ vectors[:, 1:21]), np.eye(20), atol=1e-6)
    assert values[21] - values[20] > 1e-6  # else the last one is not determined


def test_the_carrier_of_the_tool_is_its_formula_and_its_adjoint(harmonics, x64):
    mesh, random = bumpy_sphere(2), np.random.default_rng(0)
    vectors = harmonics.harmonics(mesh)
    carrier, normals = harmonics.carrier(vectors, mesh), vertex_normals(mesh)
    bits, residual = random.normal(size=20), random.normal(size=mesh.vertices.shape)
    moved = carrier.displacement(jax.numpy.asarray(bits))
    np.testing.assert_allclose(moved, normals * (vectors @ bits)[:, None], atol=1e-12)
    read = carrier.adjoint(jax.numpy.asarray(residual))
    np.testing.assert_allclose(read, vectors.T @ np.sum(normals * residual, axis=1), atol=1e-12)
    columns = np.stack([carrier.displacement(row).ravel() for row in jax.numpy.eye(20)])
    np.testing.assert_allclose(carrier.gram(), columns @ columns.T, atol=1e-12)


def test_the_tool_confirms_its_mark_in_noise_and_a_quarter_of_what_is_none(harmonics):
    mesh = bumpy_sphere(3)
    mark = harmonics.make_mark(mesh, [1])
    marked = mark.embed(jm.Budget(rms=1e-3).bounds(mesh))
    expected = jm.distortion.displacement_size(mesh, marked).max
    assert mark.correlation(jm.attack(marked, "noise", 0.002, seed=0), expected) > 0.9
    assert mark.correlation(mesh, expected) == 0  # nothing moved
    assert mark.correlation(bumpy_sphere(3, seed=9), expected) <= 1
    # What 20 random coefficients correlate by: (r + 1)/2 is of a beta distribution; 0.26 of it lies above 0.15.
    noisy, confirmed = jm.attack(mesh, "noise", 0.01, seed=3), 0
    for seed in range(100):
        pattern = np.random.default_rng(seed).normal(size=20)
        other = harmonics.HarmonicMark(mark.original, mark.points, mark.vectors, pattern / np.linalg.norm(pattern))
        confirmed += other.correlation(noisy, expected) >= harmonics.THRESHOLD
    assert 12 <= confirmed <= 42


def test_attacks_of_the_protocol_are_what_it_says():
    mesh = bumpy_sphere(3)
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    radius = np.linalg.norm(centred, axis=1).mean()
    assert len(PROTOCOL) == 29
    scales, shifts = [], []
    for trial in range(40):
        (posed,) = attacked(mesh, "similarity", trial)
        pose = similarity(mesh.vertices, posed.vertices)
        np.testing.assert_allclose(pose(mesh.vertices), posed.vertices, atol=1e-9)
        scales.append(np.cbrt(np.linalg.det(pose.matrix)))
        shifts.append(pose.shift / radius)
    assert 0.1 <= min(scales) < 2
    assert 8 < max(scales) <= 10
    assert 4 < np.abs(shifts).max() <= 5
    (simpler,) = attacked(mesh, "simplification 0.7", 0)
    assert len(edges(simpler.faces)) == pytest.approx(0.3 * len(edges(mesh.faces)), rel=0.01)
    crops = attacked(mesh, "cropping 0.3", 0)
    assert len(crops) == 3
    assert {len(crop.vertices) for crop in crops} <= set(
        range(int(0.68 * len(mesh.vertices)), int(0.71 * len(mesh.vertices)))
    )
    assert not np.array_equal(crops[0].vertices, crops[1].vertices)
    # One step for all, from what was before.
    (smooth,), (i, j) = attacked(mesh, "smoothing 5", 0), edges(mesh.faces).T
    graph = sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i]))).tocsr()
    v = mesh.vertices
    for _ in range(5):
        v = v + 0.1 * (graph @ v / graph.sum(axis=1)[:, None] - v)
    np.testing.assert_allclose(smooth.vertices, v, atol=1e-5)


def test_published_rates_stand_beside_their_attacks():
    rates = {name: (line.cho, line.wang) for name, line in PROTOCOL.items()}
    assert rates["noise 0.005"] == ((0.28, 0.24), (0.16, 0.40))
    assert rates["quantisation 7"] == ((0.46, 0.41), (0.17, 0.53))
    assert rates["loop 1"] == ((0.16, 0.09), (0.0, 0.01))
    assert rates["cropping 0.5"] == (None, None)
