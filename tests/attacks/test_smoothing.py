"""Smoothing against trimesh, SciPy with libigl's weights, and loops by definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads
from scipy import sparse
from scipy.sparse.linalg import spsolve

import jaxmark as jm
from jaxmark.attacks import bilateral_smoothing, cotangent_smoothing, taubin_smoothing
from jaxmark.geometry.mesh import Mesh, boundary_vertices, edges, make_mesh, vertex_normals
from jaxmark.spectral.graphs import from_mesh
from tests.dense import laplacian_matrix
from tests.samples import exact_sheet, rough_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def cap() -> Mesh:
    """A rough sphere with a hole, and an isolated vertex; away from the origin."""
    mesh = rough_sphere(200)
    return make_mesh(np.vstack([mesh.vertices, [[3.0, 3, 3]]]) + 1, mesh.faces[10:])


@pytest.mark.parametrize("pairs", [1, 20])
def test_taubin_agrees_with_trimesh(cap: Mesh, pairs, x64):
    used = np.unique(cap.faces)
    surface = trimesh.Trimesh(cap.vertices[used], np.searchsorted(used, cap.faces), process=False)
    pinned = np.searchsorted(used, boundary_vertices(cap.faces))
    operator = trimesh.smoothing.laplacian_calculation(surface, pinned_vertices=pinned)
    trimesh.smoothing.filter_taubin(surface, 0.5, 0.53, 2 * pairs, laplacian_operator=operator)
    found = np.asarray(taubin_smoothing(cap, pairs).vertices)
    np.testing.assert_allclose(found[used], surface.vertices, atol=1e-12)
    np.testing.assert_array_equal(np.delete(found, used, axis=0), np.delete(cap.vertices, used, axis=0))


def volume(mesh: Mesh) -> float:
    return float(trimesh.Trimesh(*mesh, process=False).volume)


def test_taubin_does_not_shrink(sphere: Mesh):
    taubin, plain = (jm.attack(sphere, kind, steps, seed=0) for kind, steps in (("taubin", 50), ("smoothing", 500)))
    # Each pair raises low frequencies by up to 0.09 %; 500 steps of 0.1 go as far as 100 of 0.5.
    assert volume(sphere) < volume(taubin) < 1.0009 ** (3 * 50) * volume(sphere)
    assert volume(plain) < 0.9 * volume(sphere)
    assert abs(volume(taubin) / volume(sphere) - 1) < 0.5 * abs(volume(plain) / volume(sphere) - 1)


@pytest.mark.parametrize("time", [0.3, 20.0])
def test_cotangent_smoothing_solves_the_system_of_libigl(sphere: Mesh, time, x64):
    igl = pytest.importorskip("igl")
    mesh = make_mesh(np.vstack([sphere.vertices, [[3.0, 3, 3]]]) + 1, sphere.faces[10:])
    stiffness = sparse.coo_array(-igl.cotmatrix(mesh.vertices, mesh.faces))
    off = stiffness.row != stiffness.col
    tail, head, weight = stiffness.row[off], stiffness.col[off], -stiffness.data[off]
    size = len(mesh.vertices)
    graph = sparse.csr_array((np.maximum(weight, 1e-6 * np.median(np.abs(weight))), (tail, head)), (size, size))
    degree = graph.sum(axis=1)
    mass = sparse.diags_array(np.where(degree > 0, degree, 1))
    expected = spsolve(sparse.csc_array(mass + time * (sparse.diags_array(degree) - graph)), mass @ mesh.vertices)
    np.testing.assert_allclose(cotangent_smoothing(mesh, time).vertices, expected, atol=1e-11)


def bilateral_by_loops(mesh: Mesh, steps: int) -> np.ndarray:
    neighbours: list[set[int]] = [set() for _ in mesh.vertices]
    for i, j in edges(mesh.faces).tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    still, v = set(boundary_vertices(mesh.faces)), mesh.vertices.copy()
    lengths, offsets = [], []
    normal = vertex_normals(mesh)
    for i, near in enumerate(neighbours):
        lengths += [np.linalg.norm(v[j] - v[i]) for j in near]
        offsets += [normal[i] @ (v[j] - v[i]) for j in near]
    spatial, spread = np.mean(lengths), np.sqrt(np.mean(np.square(offsets)))
    for _ in range(steps):
        normal, before = vertex_normals(Mesh(v, mesh.faces)), v.copy()
        for i, near in enumerate(neighbours):
            if i in still or not near:
                continue
            total = weights = 0.0
            for j in near:
                t, h = np.linalg.norm(before[j] - before[i]), normal[i] @ (before[j] - before[i])
                w = np.exp(-(t**2) / (2 * spatial**2)) * np.exp(-(h**2) / (2 * spread**2))
                total, weights = total + w * h, weights + w
            v[i] = before[i] + normal[i] * total / weights
    return v


def test_bilateral_smoothing_by_loops(cap: Mesh, hard_graph: Mesh, x64):
    for mesh in (cap, hard_graph):
        np.testing.assert_allclose(bilateral_smoothing(mesh, 3).vertices, bilateral_by_loops(mesh, 3), atol=1e-12)


def test_bilateral_smoothing_keeps_a_crease_and_what_is_flat(x64):
    """Noise on two planes that meet at a right angle goes; the crease stays sharper than by Laplacian smoothing."""
    sheet = exact_sheet(21)
    x = sheet.vertices[:, 0] - 10
    roof = make_mesh(np.stack([x, sheet.vertices[:, 1], -np.abs(x)], axis=1), sheet.faces)
    level = make_mesh(roof.vertices * [1, 1, 0], sheet.faces)
    np.testing.assert_array_equal(bilateral_smoothing(level, 5).vertices, level.vertices)
    noise = 0.05 * np.random.default_rng(0).normal(size=x.shape)[:, None]
    rough = make_mesh(roof.vertices + noise * vertex_normals(roof), sheet.faces)

    def away(found: np.ndarray) -> np.ndarray:
        """From the planes."""
        return np.abs(found[:, 2] + np.abs(found[:, 0])) / np.sqrt(2)

    inner = np.delete(np.arange(len(x)), boundary_vertices(sheet.faces))
    slope, ridge = inner[np.abs(x[inner]) > 2], inner[np.abs(x[inner]) < 0.3]
    found = np.asarray(bilateral_smoothing(rough, 5).vertices)
    plain = np.asarray(jm.attacks.laplacian_smoothing(rough, 50).vertices)
    assert away(found)[slope].mean() < 0.6 * away(rough.vertices)[slope].mean()
    assert away(found)[ridge].mean() < 0.5 * away(plain)[ridge].mean()


@pytest.mark.slow
def test_smoothing_is_differentiable(cap: Mesh, x64):
    v = jnp.asarray(cap.vertices)

    def check(kind, modes):
        check_grads(jax.jit(lambda v: jnp.sum(jnp.sin(kind(Mesh(v, cap.faces), 3).vertices))), (v,), 1, modes)

    check(taubin_smoothing, ["rev", "fwd"])
    check(bilateral_smoothing, ["rev", "fwd"])

    def implicit(v, strength):
        return jnp.sum(jnp.sin(cotangent_smoothing(Mesh(v, cap.faces), strength).vertices))

    check_grads(jax.jit(implicit), (v, 2.0), 1, ["rev", "fwd"])


@pytest.mark.usefixtures("unchecked")
def test_refusals(cap: Mesh):
    for kind, strength, sentence in [
        ("taubin", 1.5, "whole number"),
        ("bilateral", 0.5, "whole number"),
        ("bilateral", 1e6, "to 100000"),
        ("cotangent-smoothing", -1, "from 0 to"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(cap, kind, strength, seed=0)


def test_degenerate_faces_have_no_cotangents(hard_graph: Mesh, x64):
    expected = from_mesh(hard_graph, "cotangent")
    matrix = np.eye(len(hard_graph.vertices)) + 2 * laplacian_matrix(expected)
    found = cotangent_smoothing(hard_graph, 2.0).vertices
    np.testing.assert_allclose(found, np.linalg.solve(matrix, hard_graph.vertices), atol=1e-11)
    line = make_mesh(np.arange(9.0).reshape(3, 3), [[0, 1, 2]])
    np.testing.assert_array_equal(cotangent_smoothing(line, 2.0).vertices, line.vertices)
