"""Metrics against trimesh, libigl, dense loops over the definitions, and published values."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.app import cli
from jaxmark.distortion import (
    METRICS,
    RENDERED,
    curvature,
    curvature_tensor,
    dame,
    dihedral_angles,
    fmpd,
    geometric_laplacian,
    gl,
    local_roughness,
    make_hinges,
    make_masking,
    msdm,
    msdm2,
    msdm2_views,
    msdm_views,
    shading,
    stretch,
    surface_distance,
    tensor_distance,
)
from jaxmark.distortion.neighbourhoods import Neighbourhoods, make_neighbourhoods
from jaxmark.geometry.mesh import Mesh, edges, make_mesh
from jaxmark.geometry.surfaces import Surface
from tests.meshes import MESHES, shared_mesh
from tests.samples import TWICE, rough_sphere

pytestmark = pytest.mark.core

REFERENCE = MESHES.parent / "reference"
published = pytest.mark.skipif(not REFERENCE.is_dir(), reason="published values of other programs are absent")


@pytest.fixture(scope="module")
def pair() -> tuple[Mesh, Mesh]:
    """A rough sphere of 300 vertices, and what a little noise makes of it."""
    mesh = rough_sphere(300)
    return mesh, make_mesh(mesh.vertices + 0.01 * np.random.default_rng(1).normal(size=(300, 3)), mesh.faces)


@pytest.fixture(scope="module")
def cap(pair: tuple[Mesh, Mesh]) -> Mesh:
    """With a boundary."""
    return make_mesh(pair[0].vertices, pair[0].faces[40:])


def test_dihedral_angles_are_trimesh_s(cap: Mesh, dtype):
    surface = trimesh.Trimesh(cap.vertices, cap.faces, process=False)
    hinges = make_hinges(cap.faces)
    found = dihedral_angles(jnp.asarray(cap.vertices, dtype), hinges)
    assert found.dtype == dtype
    expected = {
        tuple(sorted(pair)): angle if convex else -angle
        for pair, angle, convex in zip(
            surface.face_adjacency_edges.tolist(),
            surface.face_adjacency_angles,
            surface.face_adjacency_convex,
            strict=True,
        )
    }
    values = [expected.get(tuple(pair), 0.0) for pair in hinges.edges.tolist()]
    np.testing.assert_allclose(found, values, atol=2e-3 if dtype == np.float32 else 1e-7)
    assert hinges.inner.sum() == len(expected) < len(hinges.edges)


def test_an_edge_of_three_faces_is_no_hinge(hard_graph: Mesh):
    hinges = make_hinges(hard_graph.faces)
    inner = {tuple(pair) for pair, one in zip(hinges.edges.tolist(), hinges.inner, strict=True) if one}
    assert inner == {(7, 8), (6, 8), (8, 9)}
    assert np.isfinite(dihedral_angles(jnp.asarray(hard_graph.vertices, jnp.float32), hinges)).all()


@pytest.mark.parametrize(("before", "after"), [(0.0, 0.5), (1.0, 0.2), (-0.7, 0.4)])
def test_dame_of_one_hinge_in_closed_form(before, after, dtype):
    def folded(angle: float) -> jax.Array:
        far = [-np.cos(angle), 0, -np.sin(angle)]
        return jnp.array([[0, 0, 0], [0, 1, 0], far, [1, 0, 0]], dtype)

    hinges = make_hinges(np.array([[0, 1, 2], [1, 0, 3]]))
    angles = dihedral_angles(folded(before), hinges)
    np.testing.assert_allclose(np.abs(angles).max(), abs(before), atol=1e-6)
    expected = abs(after - before) * np.exp(np.log(0.01) * (before / np.pi) ** 2)
    assert float(dame(folded(before), folded(after), hinges)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("apex", "moved"), [((0.5, 0, 0), (0.5, 0, 1e-6)), ((0.5, 1, 1e-6), (0.5, 1, -1e-6))])
def test_faces_that_are_flat_or_folded_back_hardly_change_dame(apex, moved, dtype):
    """A flat face may turn to anywhere, and the two sides of a sheet may fold the other way, if one point moves."""
    hinges = make_hinges(np.array([[0, 1, 2], [1, 0, 3]]))
    before, after = (jnp.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], end], dtype) for end in (apex, moved))
    assert float(dame(before, after, hinges)) < 1e-5


def test_the_geometric_laplacian_by_hand(cap: Mesh, x64):
    v = np.vstack([cap.vertices, [[9.0, 9, 9]]])  # and one alone
    near: list[set[int]] = [set() for _ in v]
    for i, j in edges(cap.faces):
        near[i].add(j)
        near[j].add(i)
    expected = np.zeros_like(v)
    for i, around in enumerate(near):
        if around:
            weights = np.array([1 / np.linalg.norm(v[i] - v[j]) for j in sorted(around)])
            expected[i] = v[i] - weights @ v[sorted(around)] / weights.sum()
    found = geometric_laplacian(jnp.asarray(v), edges(cap.faces))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    moved = jnp.asarray(v).at[3].add(jnp.array([0.3, 0.4, 0]))
    change = np.asarray(geometric_laplacian(moved, edges(cap.faces))) - expected
    expected_gl = (0.5 / np.sqrt(len(v)) + np.sqrt(np.mean(np.sum(change**2, axis=1)))) / 2
    assert float(gl(jnp.asarray(v), moved, edges(cap.faces))) == pytest.approx(expected_gl)


def test_local_roughness_by_libigl(cap: Mesh, x64):
    igl = pytest.importorskip("igl")
    cotangents = -igl.cotmatrix(np.asarray(cap.vertices), np.asarray(cap.faces)).toarray()
    corners = np.asarray(cap.vertices)[cap.faces]
    # Halves of cotangents are clipped below, corner by corner; where none is, the matrix is libigl's.
    obtuse = np.zeros(len(cap.vertices), bool)
    for k in range(3):
        u, v = (np.roll(corners, -s, axis=1)[:, k] - corners[:, k] for s in (1, 2))
        flat = np.sum(u * v, axis=1) < 0.002 * np.linalg.norm(np.cross(u, v), axis=1)
        obtuse[cap.faces[flat]] = True
    defect = np.abs(igl.gaussian_curvature(np.asarray(cap.vertices), np.asarray(cap.faces)))
    border = np.unique(igl.boundary_facets(np.asarray(cap.faces))[0])
    total = np.zeros(len(defect))
    for k in range(3):
        u, v = (np.roll(corners, -s, axis=1)[:, k] - corners[:, k] for s in (1, 2))
        np.add.at(total, cap.faces[:, k], np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.sum(u * v, axis=1)))
    defect[border] = np.abs(np.pi - total[border])
    used = np.diagonal(cotangents) > 0
    obtuse[~used] = True
    rough = np.abs(cotangents @ defect / np.where(used, np.diagonal(cotangents), 1))
    found = local_roughness(jnp.asarray(cap.vertices), cap.faces)
    assert (~obtuse).sum() > 50
    np.testing.assert_allclose(found.roughness[~obtuse], rough[~obtuse], atol=1e-9)
    np.testing.assert_allclose(found.area.sum(), trimesh.Trimesh(*cap, process=False).area)


def reached(v: np.ndarray, near: list[set[int]], centre: int, radius: float) -> tuple[set, set]:
    """Edges and vertices by a search from the definition."""
    stack, inside, found = [centre], {centre}, set()
    while stack:
        p = stack.pop()
        for q in near[p]:
            if p == centre or (v[q] - v[p]) @ (v[p] - v[centre]) > 0:
                found.add((centre, p, q))
                if np.linalg.norm(v[q] - v[centre]) < radius and q not in inside:
                    inside.add(q)
                    stack.append(q)
    return found, inside


def test_neighbourhoods_by_a_search_from_each_vertex(cap: Mesh):
    v, radius = np.asarray(cap.vertices), 0.5
    near: list[set[int]] = [set() for _ in v]
    for i, j in edges(cap.faces).tolist():
        near[i].add(j)
        near[j].add(i)
    balls, points = (
        Neighbourhoods(*(array[pieces.centre < len(v)] for array in pieces[:4]), pieces.radius)
        for pieces in make_neighbourhoods(v, np.asarray(cap.faces), radius)
    )
    found = list(zip(balls.centre.tolist(), balls.tail.tolist(), balls.head.tolist(), strict=True))
    assert len(found) == len(set(found))
    expected, whole, cut = set(), set(), set()
    for centre in range(len(v)):
        pieces, inside = reached(v, near, centre, radius)
        expected |= pieces
        whole |= {(centre, vertex) for vertex in inside}
        cut |= {(c, p, q) for c, p, q in pieces if np.linalg.norm(v[q] - v[centre]) >= radius}
    assert set(found) == expected
    assert {tuple(pair) for pair in edges(cap.faces)[balls.edge].tolist()} == {
        tuple(p) for p in edges(cap.faces).tolist()
    }
    where = points.edge < 0
    assert set(zip(points.centre[where].tolist(), points.head[where].tolist(), strict=True)) == whole
    assert set(zip(*(array[~where].tolist() for array in points[:3]), strict=True)) == cut


def test_the_curvature_tensor_by_a_loop_over_edges(cap: Mesh, x64):
    v, radius = np.asarray(cap.vertices), 0.5
    near: list[set[int]] = [set() for _ in v]
    for i, j in edges(cap.faces).tolist():
        near[i].add(j)
        near[j].add(i)
    surface = trimesh.Trimesh(*cap, process=False)
    sine = {}
    for (i, j), (one, other) in zip(surface.face_adjacency_edges.tolist(), surface.face_adjacency, strict=True):
        size = np.linalg.norm(np.cross(surface.face_normals[one], surface.face_normals[other]))
        sine[i, j] = sine[j, i] = np.arcsin(min(size, 1))
    convex = surface.face_adjacency_convex
    for (i, j), one in zip(surface.face_adjacency_edges.tolist(), convex, strict=True):
        if not one:
            sine[i, j] = sine[j, i] = -sine[i, j]
    hinges = make_hinges(cap.faces)
    found = curvature_tensor(jnp.asarray(v), hinges, make_neighbourhoods(v, np.asarray(cap.faces), radius)[0])
    for centre in (50, 100, 200):
        expected = np.zeros((3, 3))
        for _, p, q in reached(v, near, centre, radius)[0]:
            along = v[q] - v[p]
            low, high = 0.0, 1.0
            if np.linalg.norm(v[q] - v[centre]) >= radius:
                for _ in range(60):
                    middle = (low + high) / 2
                    within = np.linalg.norm(v[p] + middle * along - v[centre]) < radius
                    low, high = (middle, high) if within else (low, middle)
            along = high * along
            expected += sine.get((p, q), 0) * np.outer(along, along) / np.linalg.norm(along)
        np.testing.assert_allclose(found[centre], expected / (np.pi * radius**2), atol=1e-9)


def tensors(shape: trimesh.Trimesh, radius: float) -> np.ndarray:
    balls, _ = make_neighbourhoods(np.asarray(shape.vertices), np.asarray(shape.faces), radius)
    return np.asarray(curvature_tensor(jnp.asarray(shape.vertices), make_hinges(shape.faces), balls))


def test_curvature_is_inverse_to_size_and_follows_a_prism_s_edges(x64):
    ball = trimesh.creation.icosphere(subdivisions=3)
    one = tensors(ball, 0.3)
    ball.apply_scale(2.0)
    np.testing.assert_allclose(tensors(ball, 0.6), one / 2, rtol=1e-9)
    # On a sphere nothing is bent along the normal, and all directions across it are alike.
    values, vectors = np.linalg.eigh(one)
    assert (np.abs(values[:, 0]) < 0.1 * values[:, 2]).all()
    assert (np.abs(np.sum(vectors[:, :, 0] * ball.vertices, axis=1)) > 2 * 0.98).all()
    prism = trimesh.creation.cylinder(radius=1.0, height=6.0, sections=16).subdivide().subdivide().subdivide()
    middle = tensors(prism, 0.5)[np.abs(prism.vertices[:, 2]) < 2]
    size = np.trace(middle, axis1=1, axis2=2)
    np.testing.assert_allclose(middle, size[:, None, None] * np.diag([0.0, 0, 1]), atol=1e-9)
    np.testing.assert_allclose(curvature(jnp.asarray(middle)), size / 2, atol=1e-7)
    assert size.max() > 0.1


def test_curvature_is_that_of_the_eigenvalues(dtype):
    random = np.random.default_rng(2).normal(size=(500, 3, 3))
    matrices = random + random.transpose(0, 2, 1)
    matrices[:4] = [np.zeros((3, 3)), np.eye(3), np.diag([1.0, 1, 3]), np.diag([0, 0, -2.0])]
    sizes = np.sort(np.abs(np.linalg.eigvalsh(matrices)), axis=1)
    given = jnp.asarray(matrices, dtype)
    np.testing.assert_allclose(curvature(given), sizes[:, 1:].mean(axis=1), atol=2e-3 if dtype == np.float32 else 1e-7)
    assert np.isfinite(jax.grad(lambda x: curvature(x).sum())(given)).all()


def metric(name: str, mesh: Mesh, dtype):
    """A metric of positions near a mesh's own."""
    x = jnp.asarray(mesh.vertices, dtype)
    match name:
        case "gl":
            return lambda y: gl(x, y, edges(mesh.faces))
        case "dame":
            return lambda y: dame(x, y, make_hinges(mesh.faces))
        case "fmpd":
            return lambda y: fmpd(local_roughness(x, mesh.faces), local_roughness(y, mesh.faces))
        case "msdm":
            views = msdm_views(mesh, mesh)
            return lambda y: msdm(x, y, views)
        case "msdm2":
            views = msdm2_views(mesh, mesh)
            return lambda y: msdm2(x, y, views)
        case "shading":
            masking = make_masking(mesh.vertices, mesh.faces)
            return lambda y: shading(x, y, masking)
        case _:
            hinges, balls = (
                make_hinges(mesh.faces),
                make_neighbourhoods(np.asarray(mesh.vertices), np.asarray(mesh.faces), 0.5)[0],
            )
            return lambda y: tensor_distance(*(curvature_tensor(z, hinges, balls) for z in (x, y)))


@pytest.mark.parametrize("name", ["gl", "dame", "fmpd", "msdm", "msdm2", "curvature", "shading"])
def test_metrics_are_differentiable_and_batched(name, pair: tuple[Mesh, Mesh], dtype):
    measure = jax.jit(jax.vmap(jax.value_and_grad(metric(name, pair[0], dtype))))
    x, y = (jnp.asarray(mesh.vertices, dtype) for mesh in pair)
    values, gradients = measure(jnp.stack([x, y, y]))
    assert values.dtype == dtype
    assert float(values[0]) == pytest.approx(0, abs=1e-5 if dtype == np.float32 else 1e-12)
    assert float(values[1]) > 1e-4
    assert np.isfinite(gradients).all()
    along = gradients[1] / jnp.linalg.norm(gradients[1])
    step = 1e-7 if dtype == np.float64 else 1e-3
    after, _ = measure(jnp.stack([y - step * along, y, y + step * along]))
    assert after[0] < after[1] < after[2]
    if dtype == np.float64:
        slope = (after[2] - after[0]) / (2 * step)
        assert float(slope) == pytest.approx(float(jnp.linalg.norm(gradients[1])), rel=1e-3)


def test_two_squares_apart(dtype):
    low = trimesh.creation.box((1, 1, 1e-9)).subdivide()
    high = make_mesh(low.vertices + np.array([0, 0, 0.25]), low.faces)
    found = surface_distance(make_mesh(low.vertices, low.faces), high)
    np.testing.assert_allclose(found, 0.25, rtol=1e-6)
    half = make_mesh(np.asarray(low.vertices) * [0.5, 1, 1], low.faces)
    found = surface_distance(make_mesh(low.vertices, low.faces), half)
    assert found.hausdorff == pytest.approx(0.25)
    # Half of the points are on it, the others up to a quarter off.
    assert found.mrms == pytest.approx(np.sqrt(0.25**2 / 3 / 2), rel=0.01)


@published
@pytest.mark.parametrize(
    ("original", "distorted", "value"),
    [
        ("cow.off", "cow_simp.off", 0.512943),
        ("cow_simp.off", "cow.off", 0.671231),
        ("bimba_original.off", "bimba_deformed.obj", 0.390897),
        ("bimba_deformed.obj", "bimba_original.off", 0.372344),
    ],
)
def test_msdm2_is_that_of_mepp2(original, distorted, value):
    first, second = (jm.load_mesh(REFERENCE / name) for name in (original, distorted))
    x, y = (jnp.asarray(mesh.vertices, jnp.float32) for mesh in (first, second))
    assert float(msdm2(x, y, msdm2_views(first, second))) == pytest.approx(value, rel=0.05)


@published
def test_distances_are_those_of_metro():
    surface = Surface(jm.load_mesh(REFERENCE / "knot_orig.ply"))
    for name, most in (("knot_vcg_simplified.ply", 0.774724), ("knot_subsampled.ply", 0.000717192)):
        points = np.asarray(jm.load_mesh(REFERENCE / name).vertices, np.float64)
        assert np.linalg.norm(surface.closest(points)[0] - points, axis=1).max() == pytest.approx(most, rel=1e-4)


@pytest.mark.long
def test_severities_of_noise_are_those_published():
    """RMS, MRMS, FMPD and MSDM2 of noise of 0.1 % of the mean radius on the bunny, which other programs measured."""
    mesh = jm.load_mesh(shared_mesh("models/bunny_closed_34834.stl"))
    found = jm.compare(mesh, jm.attack(mesh, "noise", 1e-3, seed=0))
    assert found.rms == pytest.approx(0.000249, rel=0.01)
    assert found.mrms == pytest.approx(0.000101, rel=0.02)
    assert found.fmpd == pytest.approx(0.189, rel=0.05)
    assert found.msdm2 == pytest.approx(0.275, rel=0.05)


@pytest.mark.long
def test_compare_leaves_out_what_needs_the_same_connectivity(pair: tuple[Mesh, Mesh], tmp_path, monkeypatch, capsys):
    mesh, other = pair
    same, count = jm.compare(mesh, other), len(METRICS)
    assert None not in same[:count]
    assert same[count:] == (None,) * len(RENDERED)  # not asked for
    assert same.rms == pytest.approx(jm.distortion.displacement_size(mesh, other).rms)
    vertices, faces = trimesh.remesh.subdivide(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    finer = jm.compare(mesh, make_mesh(vertices, faces))
    lacking = {name for name in METRICS if getattr(finer, name) is None}
    assert lacking == {"rms", "max", "gl", "dame", "msdm", "curvature", "shading", "stretch", "point_to_plane"}
    assert finer.hausdorff < 1e-9
    with jax.enable_x64(True):
        np.testing.assert_allclose(jm.compare(mesh, other)[:count], same[:count], rtol=1e-4)
    # Size and place do not count.
    again = jm.compare(*(make_mesh(3 * np.asarray(one.vertices) + 5, one.faces) for one in pair))
    np.testing.assert_allclose(again[:count], same[:count], rtol=1e-3)

    files = [tmp_path / name for name in ("a.ply", "b.ply")]
    for one, file in zip((mesh, make_mesh(vertices, faces)), files, strict=True):
        jm.save_mesh(one, file)
    monkeypatch.setattr(sys, "argv", ["jaxmark", "compare", *map(str, files), "--json"])
    cli.main()
    answer = json.loads(capsys.readouterr().out)
    assert set(answer) == set(METRICS)
    assert answer["rms"] is None
    assert answer["msdm2"] == pytest.approx(finer.msdm2, rel=1e-3)


def test_shapes_without_an_area_are_refused():
    flat = make_mesh([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]])
    with pytest.raises(jm.JaxmarkError, match="area of 0"):
        jm.compare(flat, flat)


def test_without_libigl_compare_names_the_extra(pair: tuple[Mesh, Mesh], monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(jm.JaxmarkError, match=r"jaxmark\[align\]"):
        jm.compare(*pair)
    assert jm.distortion.displacement_size(*pair).rms > 0


def volume_change(original: Mesh, distorted: Mesh) -> float:
    """Relative change of the enclosed volume."""
    before, after = (trimesh.Trimesh(*mesh, process=False).volume for mesh in (original, distorted))
    return abs(after / before - 1)


def test_a_metric_of_ones_own_stands_beside_the_others(pair: tuple[Mesh, Mesh]):
    found = jm.distortion.measure(*pair, ["gl", volume_change, "rms"])
    assert list(found) == ["gl", "volume_change", "rms"]
    compared = jm.compare(*pair, ["gl", "rms"])
    assert (found["gl"], found["rms"]) == pytest.approx((compared.gl, compared.rms), rel=TWICE, abs=0)
    assert found["volume_change"] == pytest.approx(volume_change(*pair))
    larger = pair[0]._replace(vertices=2 * np.asarray(pair[0].vertices))
    assert jm.distortion.measure(pair[0], larger, [volume_change])["volume_change"] == pytest.approx(7)
    with pytest.raises(jm.JaxmarkError, match="Two metrics are called 'volume_change'"):
        jm.distortion.measure(*pair, [volume_change, volume_change])


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_metrics_that_are_no_distances(pair: tuple[Mesh, Mesh], value: float):
    def broken(original: Mesh, distorted: Mesh) -> float:
        return value

    with pytest.raises(jm.JaxmarkError, match="The metric 'broken' must be a finite number, not negative"):
        jm.distortion.measure(*pair, [broken])


def test_faces_whose_corners_coincide_have_no_angles():
    """Where a side joins the last point to itself, too."""
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 3, 2], [3, 3, 3]])
    hinges, plain = make_hinges(faces), make_hinges(faces[:2])
    assert len(hinges.edges) == len(plain.edges) == 5
    both = np.all(plain.edges == [1, 2], axis=1)
    assert plain.inner[both] == hinges.inner[both] == 1
    for name in ("left", "right"):
        assert getattr(plain, name)[both] == getattr(hinges, name)[both]


def test_a_face_that_names_a_vertex_twice_changes_no_roughness(pair: tuple[Mesh, Mesh]):
    """Libraries that weld vertices leave such faces behind."""
    tail, head = edges(pair[0].faces)[0]
    more = [mesh._replace(faces=np.vstack([mesh.faces, [[tail, head, head]]])) for mesh in pair]
    assert jm.compare(*more).fmpd == pytest.approx(jm.compare(*pair).fmpd, rel=1e-6)


def test_positions_of_different_meshes_are_no_pair(pair: tuple[Mesh, Mesh], unchecked):
    """Reading beyond the last row would give a number that looks right."""
    x, y = (jnp.asarray(mesh.vertices) for mesh in pair)
    links, hinges = edges(pair[0].faces), make_hinges(pair[0].faces)
    masking = make_masking(np.asarray(pair[0].vertices), pair[0].faces)
    for call in (
        lambda: dame(x, y[:5], hinges),
        lambda: gl(x[1:], y, links),
        lambda: stretch(x, y[:5], links),
        lambda: shading(x, y[1:], masking),
    ):
        with pytest.raises(jm.JaxmarkError, match="compares positions of the same vertices, got the shapes"):
            call()
