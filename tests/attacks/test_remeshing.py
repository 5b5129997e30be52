"""Simplification and remeshing by other programs: surfaces that stay near, and what is asked for."""

import sys

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

import jaxmark as jm
from jaxmark.attacks import iso_surface, isotropic, poisson, simplification
from jaxmark.attacks.remeshing import apply_filter
from jaxmark.geometry.mesh import Mesh, diagonal, edges, make_mesh
from tests.samples import exact_sheet

pytestmark = pytest.mark.core

pytest.importorskip("fast_simplification")
pytest.importorskip("pymeshlab")
igl = pytest.importorskip("igl")
measure = pytest.importorskip("skimage.measure")

USUAL = (("simplification", 0.5), ("isotropic", 1), ("iso-surface", 20), ("poisson", 5))


def apart(first: Mesh, second: Mesh) -> float:
    """Root mean square distance of two surfaces, in diagonals."""
    return jm.distortion.surface_distance(first, second).mrms / diagonal(first)


def mean_length(mesh: Mesh) -> float:
    ends = mesh.vertices[edges(mesh.faces)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())


def check_closed(mesh: Mesh) -> None:
    """As the sphere is, facing outward."""
    surface = trimesh.Trimesh(*mesh, process=False)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.euler_number == 2
    assert surface.volume > 0


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_simplification_leaves_what_is_asked_for_as_near_as_meshlab_does(share, sphere: Mesh):
    found = simplification(sphere, share)
    assert len(found.faces) == round((1 - share) * len(sphere.faces))
    assert len(edges(found.faces)) == pytest.approx((1 - share) * len(edges(sphere.faces)), rel=0.01)
    check_closed(found)
    other = apply_filter("meshing_decimation_quadric_edge_collapse", sphere, targetfacenum=len(found.faces))
    assert len(other.faces) == len(found.faces)
    assert apart(sphere, found) == pytest.approx(apart(sphere, other), rel=0.1)


def test_simplification_of_nothing_changes_nothing(sphere: Mesh):
    found = jm.attack(sphere, "simplification", 0, seed=0)
    np.testing.assert_array_equal(found.vertices, sphere.vertices)
    np.testing.assert_array_equal(found.faces, sphere.faces)


@pytest.mark.parametrize("factor", [0.5, 1, 2])
def test_isotropic_edges_are_as_long_as_asked_for(factor, sphere: Mesh):
    found = isotropic(sphere, factor)
    check_closed(found)
    assert mean_length(found) == pytest.approx(factor * mean_length(sphere), rel=0.12)
    lengths = np.linalg.norm(np.diff(found.vertices[edges(found.faces)], axis=1)[:, 0], axis=1)
    before = np.linalg.norm(np.diff(sphere.vertices[edges(sphere.faces)], axis=1)[:, 0], axis=1)
    assert lengths.std() / lengths.mean() < before.std() / before.mean()
    assert apart(sphere, found) < 0.01 * factor


@pytest.mark.parametrize("cells", [12, 30])
def test_iso_surface_is_that_of_the_whole_grid(cells, sphere: Mesh):
    """Distances at all points of a grid, with libigl's exact winding numbers as signs."""
    found = iso_surface(sphere, cells)
    check_closed(found)
    cell = np.ptp(sphere.vertices, axis=0).max() / cells
    steps = (found.vertices - (sphere.vertices.min(axis=0) - 4 * cell)) / cell
    # Each point lies on a line of the grid.
    assert (np.abs(steps - np.round(steps)) < 1e-6).sum(axis=1).min() >= 2
    size = np.ceil(steps.max(axis=0)).astype(int) + 2
    points = sphere.vertices.min(axis=0) + cell * (np.argwhere(np.ones(size)) - 4.0)
    inside = igl.winding_number(sphere.vertices, sphere.faces, points) > 0.5
    distance = np.sqrt(igl.point_mesh_squared_distance(points, sphere.vertices, sphere.faces)[0]) / cell
    expected = measure.marching_cubes(np.where(inside, -distance, distance).reshape(size), 0)[0]
    assert len(expected) == len(found.vertices)
    # libigl's fast winding numbers are good to 0.3 %, and it multiplies distances with them.
    assert KDTree(expected).query(steps)[0].max() < 2e-3


@pytest.mark.slow
def test_finer_grids_and_deeper_trees_come_nearer(sphere: Mesh):
    off = [apart(sphere, iso_surface(sphere, cells)) for cells in (10, 20, 40)]
    assert off[0] > 1.5 * off[1] > 1.5**2 * off[2]
    trees = [apart(sphere, poisson(sphere, depth, jax.random.key(0))) for depth in (4, 6)]
    assert trees[0] > 1.5 * trees[1]
    assert trees[1] < 0.002


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "strength"), USUAL)
def test_host_function_makes_the_mesh_of_the_points(kind, strength, sphere: Mesh):
    """Copies along a seam and an isolated vertex make no difference, nor do large coordinates; the seed decides."""
    expected = jm.attack(sphere, kind, strength, seed=0)
    check_closed(expected)
    faces = sphere.faces.copy()
    half = faces[::2]
    half[half < 10] += len(sphere.vertices)
    stray = [[9.0, 9, 9]]
    copied = make_mesh(np.concatenate([sphere.vertices, sphere.vertices[:10], stray]), faces)
    found = jm.attack(copied, kind, strength, seed=0)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)
    assert (len(jm.attack(sphere, kind, strength, seed=1).vertices) == len(expected.vertices)) == (kind != "poisson")
    far = jm.attack(make_mesh(1e3 * sphere.vertices + 1e6, sphere.faces), kind, strength, seed=0)
    near = make_mesh((far.vertices - 1e6) / 1e3, far.faces)
    assert apart(sphere, near) == pytest.approx(apart(sphere, expected), rel=0.02)


@pytest.mark.parametrize(("kind", "strength"), USUAL)
def test_open_and_broken_meshes(kind, strength, hard_graph: Mesh):
    """A surface with a boundary all around, one with edges of three faces, and a point that is no surface."""
    flat = make_mesh(exact_sheet(6).vertices * [1, 1, 0], exact_sheet(6).faces)
    if kind == "iso-surface":
        with pytest.raises(jm.JaxmarkError, match="no inside"):
            jm.attack(flat, kind, strength, seed=0)
    else:
        assert len(jm.attack(flat, kind, strength, seed=0).faces) > 1
    assert len(jm.attack(hard_graph, kind, strength, seed=0).faces) > 1
    if kind in ("iso-surface", "poisson"):
        with pytest.raises(jm.JaxmarkError, match=r"at one point|no area"):
            jm.attack(make_mesh(np.ones((3, 3)), [[0, 1, 2]]), kind, strength, seed=0)


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh, monkeypatch: pytest.MonkeyPatch):
    for kind, strength, sentence in [
        ("simplification", 1, "below 1"),
        ("simplification", 0.9999, "share of at most 0.999"),
        ("isotropic", 0, "0.1 to 100"),
        ("iso-surface", 3, "4 to 512"),
        ("iso-surface", 10.5, "whole number"),
        ("poisson", 13, "from 1 to 12"),
        ("poisson", 4.5, "whole depth"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(sphere, kind, strength, seed=0)
    with pytest.raises(jm.JaxmarkError, match=r"MeshLab could not .*no_such_filter"):
        apply_filter("no_such_filter", sphere)
    for module, kind in [
        ("fast_simplification", "simplification"),
        ("pymeshlab", "isotropic"),
        ("pymeshlab", "poisson"),
        ("igl", "iso-surface"),
        ("skimage.measure", "iso-surface"),
    ]:
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            with pytest.raises(jm.JaxmarkError, match=r"pip install 'jaxmark\[attacks\]'"):
                jm.attack(sphere, kind, dict(USUAL)[kind], seed=0)
