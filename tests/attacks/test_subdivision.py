"""Subdivision against trimesh, libigl and MeshLab, and against its definitions by loops."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike

import jaxmark as jm
from jaxmark.attacks import loop, midpoint, sqrt3
from jaxmark.geometry.mesh import Mesh, compact, make_mesh
from tests.samples import bumpy_sphere, exact_sheet

pytestmark = pytest.mark.core

SCHEMES = {"midpoint": midpoint, "loop": loop, "sqrt3": sqrt3}


@pytest.fixture(scope="module")
def sheet() -> Mesh:
    """With a boundary all around, and no edge inside from boundary to boundary, of which trimesh knows no better."""
    whole = exact_sheet(8)
    faces = whole.faces[[not set(face) & {0, 63} for face in whole.faces.tolist()]]
    return compact(make_mesh(whole.vertices, faces))


def triangles(vertices: ArrayLike, faces: ArrayLike) -> np.ndarray:
    """The corners of all faces, each turned to begin with its least, in one order."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    least = np.lexsort(np.round(corners, 7).transpose(2, 0, 1)[::-1], axis=1)[:, 0]
    turned = np.take_along_axis(corners, ((least[:, None] + np.arange(3)) % 3)[:, :, None], axis=1).reshape(-1, 9)
    return turned[np.lexsort(np.round(turned, 7).T)]


def check_same(found: Mesh, vertices: ArrayLike, faces: ArrayLike) -> None:
    """As many points, and between them the same faces, whatever their order."""
    assert len(np.unique(np.asarray(found.faces))) == len(np.unique(np.asarray(faces)))
    np.testing.assert_allclose(triangles(*found), triangles(vertices, faces), atol=1e-12)


Point = np.ndarray


def by_definition(mesh: Mesh, scheme: str) -> tuple[list[Point], list[list[int]]]:
    """One step, vertex by vertex and face by face."""
    v, faces = np.asarray(mesh.vertices), [face for face in mesh.faces.tolist() if len(set(face)) == 3]
    has: dict[frozenset[int], list[int]] = {}
    for number, (a, b, c) in enumerate(faces):
        for side in ((a, b), (b, c), (c, a)):
            has.setdefault(frozenset(side), []).append(number)
    points: list[Point] = []
    for i, x in enumerate(v):
        near = [next(iter(edge - {i})) for edge in has if i in edge]
        rim = [next(iter(edge - {i})) for edge, users in has.items() if i in edge and len(users) != 2]
        n = len(near)
        if scheme == "midpoint" or not near or (rim and (scheme == "sqrt3" or len(rim) != 2)):
            points.append(x)
        elif rim:
            points.append(3 / 4 * x + v[rim[0]] / 8 + v[rim[1]] / 8)
        elif scheme == "loop":
            beta = (5 / 8 - (3 / 8 + math.cos(2 * math.pi / n) / 4) ** 2) / n
            points.append((1 - n * beta) * x + beta * sum(v[j] for j in near))
        else:
            alpha = (4 - 2 * math.cos(2 * math.pi / n)) / 9
            points.append((1 - alpha) * x + alpha / n * sum(v[j] for j in near))
    made: list[list[int]] = []
    if scheme == "sqrt3":
        points += [(v[a] + v[b] + v[c]) / 3 for a, b, c in faces]
        for number, (a, b, c) in enumerate(faces):
            for i, j in ((a, b), (b, c), (c, a)):
                users, here = has[frozenset((i, j))], len(v) + number
                if len(users) != 2:
                    made.append([i, j, here])
                elif number == users[0]:
                    there = len(v) + users[1]
                    made += [[i, there, here], [j, here, there]]
        return points, made
    middle = {}
    for edge, users in has.items():
        a, b = edge
        middle[edge] = len(points)
        if scheme == "loop" and len(users) == 2:
            c, d = (next(iter(set(faces[user]) - edge)) for user in users)
            points.append(3 / 8 * (v[a] + v[b]) + (v[c] + v[d]) / 8)
        else:
            points.append((v[a] + v[b]) / 2)
    for a, b, c in faces:
        ab, bc, ca = (middle[frozenset(side)] for side in ((a, b), (b, c), (c, a)))
        made += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    return points, made


@pytest.mark.parametrize("scheme", SCHEMES)
def test_each_scheme_follows_its_definition(scheme, hard_graph: Mesh, x64):
    quad = make_mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    faces = hard_graph.faces.copy()
    faces[4:6] = faces[4:6, ::-1]  # to the orientation of the face beside them
    for mesh in (bumpy_sphere(1), exact_sheet(5), quad, make_mesh(hard_graph.vertices, faces)):
        check_same(SCHEMES[scheme](mesh, 1), *by_definition(mesh, scheme))
    once = SCHEMES[scheme](exact_sheet(5), 1)
    check_same(SCHEMES[scheme](exact_sheet(5), 2), *by_definition(once, scheme))


@pytest.mark.parametrize("steps", [1, 2])
def test_midpoint_is_that_of_trimesh_and_libigl(steps, sphere: Mesh, sheet: Mesh, x64):
    igl = pytest.importorskip("igl")
    for mesh in (sphere, sheet):
        found = midpoint(mesh, steps)
        np.testing.assert_array_equal(found.vertices[: len(mesh.vertices)], mesh.vertices)
        vertices, faces = mesh
        for _ in range(steps):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
        check_same(found, vertices, faces)
        check_same(found, *igl.upsample(mesh.vertices, mesh.faces, steps))


@pytest.mark.parametrize("steps", [1, 2])
def test_loop_is_that_of_trimesh(steps, sphere: Mesh, sheet: Mesh, x64):
    for mesh in (sphere, sheet):
        check_same(loop(mesh, steps), *trimesh.remesh.subdivide_loop(*mesh, steps))


def test_loop_is_that_of_meshlab(sphere: Mesh, x64):
    pymeshlab = pytest.importorskip("pymeshlab")
    filters = pymeshlab.MeshSet()
    filters.add_mesh(pymeshlab.Mesh(*sphere))
    every = pymeshlab.PercentageValue(0)
    filters.apply_filter("meshing_surface_subdivision_loop", loopweight="Loop", iterations=1, threshold=every)
    expected = filters.current_mesh()
    check_same(loop(sphere, 1), expected.vertex_matrix(), expected.face_matrix())


@pytest.mark.parametrize("scheme", SCHEMES)
def test_surfaces_stay_closed(scheme, sphere: Mesh, x64):
    finer = trimesh.Trimesh(*map(np.asarray, SCHEMES[scheme](sphere, 2)), process=False)
    assert finer.is_watertight
    assert finer.is_winding_consistent
    assert finer.euler_number == 2
    assert len(finer.faces) == len(sphere.faces) * (9 if scheme == "sqrt3" else 16)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_faces_of_unlike_orientation_are_subdivided_too(scheme):
    """A square of two faces, one of them turned round, is covered once all the same."""
    flat = make_mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 3, 2]])
    finer = trimesh.Trimesh(*map(np.asarray, SCHEMES[scheme](flat, 1)), process=False)
    assert (finer.area_faces > 0.01).all()
    # By hand: Loop's scheme takes from each corner of the square two triangles of base 1/2 and height 1/8.
    assert finer.area == pytest.approx(3 / 4 if scheme == "loop" else 1, rel=1e-6)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_subdivision_is_linear_and_traced(scheme, dtype):
    sphere = bumpy_sphere(1)
    apply: Callable[[ArrayLike], jax.Array] = lambda v: SCHEMES[scheme](Mesh(v, sphere.faces), 1).vertices  # noqa: E731
    first, second = (jnp.asarray(sphere.vertices, dtype), jnp.asarray(np.sin(sphere.vertices), dtype))
    both = jax.jit(jax.vmap(apply))(jnp.stack([first, second]))
    assert both.dtype == dtype
    close = 100 * np.finfo(dtype).eps
    np.testing.assert_allclose(both[1], apply(second), atol=close)
    np.testing.assert_allclose(apply(2 * first - second), 2 * both[0] - both[1], atol=close)
    tangent = jax.jvp(apply, (first,), (second,))[1]
    np.testing.assert_allclose(tangent, both[1], atol=close)
    weight = jnp.cos(jnp.arange(both[0].size, dtype=dtype)).reshape(both[0].shape)
    back = jax.grad(lambda v: jnp.sum(weight * apply(v)))(first)
    np.testing.assert_allclose(jnp.sum(back * second), jnp.sum(weight * both[1]), rtol=2000 * np.finfo(dtype).eps)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_host_function_subdivides_points(scheme, sphere: Mesh):
    """Copies along a seam are one point, isolated vertices go, digits far from the origin stay."""
    expected = jm.attack(sphere, scheme, 1, seed=0)
    faces = sphere.faces.copy()
    half = faces[::2]
    half[half < 10] += len(sphere.vertices)
    copied = make_mesh(np.concatenate([sphere.vertices, sphere.vertices[:10], [[9.0, 9, 9]]]) + 1e4, faces)
    found = jm.attack(copied, scheme, 1, seed=0)
    assert found.vertices.dtype == np.float64
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_allclose(found.vertices - 1e4, expected.vertices, atol=1e-6)
    if scheme == "midpoint":
        np.testing.assert_array_equal(expected.vertices[: len(sphere.vertices)], sphere.vertices)


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh):
    for scheme in SCHEMES:
        for steps in (0, 6, 1.5):
            with pytest.raises(jm.JaxmarkError, match="whole number of steps from 1 to 5"):
                jm.attack(sphere, scheme, steps, seed=0)
    nothing = make_mesh(np.eye(3), [[0, 1, 1]])
    with pytest.raises(jm.JaxmarkError, match="no faces"):
        jm.attack(nothing, "midpoint", 1, seed=0)
