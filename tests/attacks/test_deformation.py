"""As-rigid-as-possible deformation against its energy, summed up triangle by triangle, and against rigid motions."""

import sys

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.attacks import as_rigid_as_possible
from jaxmark.attacks.deformation import _relax
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh
from tests.samples import bumpy_sphere, exact_sheet

pytestmark = pytest.mark.core

igl = pytest.importorskip("igl")


def energy(mesh: Mesh, found: np.ndarray) -> float:
    """Spokes and rims: around each vertex, what the best rotation leaves of all sides of its faces."""
    rest, total = mesh.vertices, 0.0
    for centre in np.unique(mesh.faces):
        rows = []
        for face in mesh.faces[(mesh.faces == centre).any(axis=1)]:
            for k in range(3):
                i, j, apex = np.roll(face, -k)
                one, other = rest[i] - rest[apex], rest[j] - rest[apex]
                cotangent = one @ other / np.linalg.norm(np.cross(one, other))
                rows.append((cotangent, rest[j] - rest[i], found[j] - found[i]))
        weight, before, after = (np.array(column) for column in zip(*rows, strict=True))
        u, _, v = np.linalg.svd((weight[:, None] * before).T @ after)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        total += float(weight @ np.sum((after - before @ turn) ** 2, axis=1))
    return total


@pytest.mark.parametrize("mesh", [bumpy_sphere(2), exact_sheet(9)])
def test_ends_go_where_they_are_dragged_and_the_rest_has_the_least_energy(mesh: Mesh):
    length, drag = diagonal(mesh), 0.2
    found = as_rigid_as_possible(mesh, drag, jax.random.key(0))
    np.testing.assert_array_equal(found.faces, mesh.faces)
    moved = found.vertices - mesh.vertices
    count = round(0.05 * len(moved))
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    axis = np.linalg.svd(centred)[2][0]
    order = np.argsort(centred @ axis)
    ends = order[:count], order[-count:]
    held, dragged = sorted(ends, key=lambda end: np.abs(moved[end]).max())
    np.testing.assert_array_equal(moved[held], 0)
    np.testing.assert_allclose(moved[dragged], moved[dragged][:1].repeat(count, axis=0), atol=1e-12 * length)
    np.testing.assert_allclose(np.linalg.norm(moved[dragged], axis=1), drag * length, rtol=1e-9)
    np.testing.assert_allclose(moved[dragged] @ axis, 0, atol=1e-9 * length)
    # Between the ends, no worse than a shear, and stationary: no way to go makes it better, up to single precision.
    along = np.abs(centred @ axis - (centred @ axis)[held].mean())
    low, high = along[held].max(), along[dragged].min()
    shear = mesh.vertices + np.clip((along - low) / (high - low), 0, 1)[:, None] * moved[dragged[0]]
    least = energy(mesh, found.vertices)
    assert least < 0.3 * energy(mesh, shear)
    free = np.setdiff1d(np.arange(len(moved)), np.concatenate([held, dragged]))
    way = np.zeros_like(moved)
    way[free] = 1e-3 * length * np.random.default_rng(0).normal(size=(len(free), 3))
    forth, back = (energy(mesh, found.vertices + step) - least for step in (way, -way))
    assert min(forth, back) > 0
    assert abs(forth - back) < 0.01 * (forth + back)


def test_handles_in_rigid_motion_take_the_mesh_along(sphere: Mesh):
    random = np.random.default_rng(0)
    there = sphere.vertices @ Rotation.from_rotvec([0.3, 0.2, 0.5]).as_matrix().T + 1
    share = np.where(np.arange(len(there)) % 6 == 0, 1.0, 0.5)
    handles = share == 1
    start = there + 0.02 * random.normal(size=there.shape)
    start[handles] = there[handles]
    found = _relax(sphere, start, share)
    np.testing.assert_array_equal(found[handles], there[handles])
    np.testing.assert_allclose(found, there, atol=1e-4)  # rotations are in single precision


def test_host_function_deforms_points(sphere: Mesh):
    """Copies move together, what no face uses or no handle holds stays, and size and place make no difference."""
    alone = jm.attack(sphere, "arap", 0.1, seed=0)
    count = len(sphere.vertices)
    faces = sphere.faces.copy()
    half = faces[::2]
    half[half < 10] += count
    copied = make_mesh(np.concatenate([sphere.vertices, sphere.vertices[:10], [[9.0, 9, 9]]]), faces)
    found = jm.attack(copied, "arap", 0.1, seed=0)
    np.testing.assert_array_equal(found.faces, copied.faces)
    np.testing.assert_array_equal(found.vertices[:count], alone.vertices)
    np.testing.assert_array_equal(found.vertices[count:-1], alone.vertices[:10])
    np.testing.assert_array_equal(found.vertices[-1], copied.vertices[-1])
    np.testing.assert_array_equal(jm.attack(sphere, "arap", 0, seed=0).vertices, sphere.vertices)
    assert (jm.attack(sphere, "arap", 0.1, seed=1).vertices != alone.vertices).any()
    far = jm.attack(make_mesh(1e3 * sphere.vertices + 1e6, sphere.faces), "arap", 0.1, seed=0)
    np.testing.assert_allclose((far.vertices - 1e6) / 1e3, alone.vertices, atol=1e-3)
    speck = 0.01 * sphere.vertices
    both = make_mesh(
        np.concatenate([sphere.vertices, speck]), np.concatenate([sphere.faces, sphere.faces + count, [[0, 0, 1]]])
    )
    found = jm.attack(both, "arap", 0.1, seed=0)
    assert (found.vertices[:count] != sphere.vertices).any()
    np.testing.assert_array_equal(found.vertices[count:], speck)


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh, hard_graph: Mesh, monkeypatch: pytest.MonkeyPatch):
    assert np.isfinite(jm.attack(hard_graph, "arap", 0.1, seed=0).vertices).all()
    with pytest.raises(jm.JaxmarkError, match="no surface to deform"):
        jm.attack(make_mesh(np.eye(3), [[0, 1, 1]]), "arap", 0.1, seed=0)
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(jm.JaxmarkError, match=r"pip install 'jaxmark\[attacks\]'"):
        jm.attack(sphere, "arap", 0.1, seed=0)
