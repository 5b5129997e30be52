"""Directions that hide a displacement, on shapes whose directions are known, and marks that are written along them."""

import dataclasses
from threading import Thread

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.distortion import stretch, texture_drift
from jaxmark.geometry.mesh import Mesh, edges, face_normals, make_mesh
from jaxmark.watermark.carriers import KeyedCarrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.perception.budget import VISIBILITY, visibility_of
from jaxmark.watermark.perception.masking import hiding_directions
from jaxmark.watermark.perception.visibility import band_visibility
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.registry import make_scheme, parameters_of
from tests.distortion.test_shading import sheet
from tests.samples import bumpy_sphere, rough_sphere

pytestmark = pytest.mark.core


def box(cells: int = 12) -> Mesh:
    """A cube whose sides are meshed in squares."""
    shape = trimesh.creation.box()
    for _ in range(4):
        shape = shape.subdivide()
    return make_mesh(shape.vertices + 0.5, shape.faces)


def directions(mesh: Mesh) -> np.ndarray:
    """Matrices of the mesh's own vertices."""
    original = make_original(mesh)
    return hiding_directions(original)[original.weld.point]


def test_a_program_that_ends_and_starts_no_more_threads_hides_as_well(monkeypatch: pytest.MonkeyPatch):
    mesh = box()
    expected = directions(mesh)

    def refuse(thread: Thread) -> None:
        raise RuntimeError("can't create new thread at interpreter shutdown")

    monkeypatch.setattr(Thread, "start", refuse)
    np.testing.assert_array_equal(directions(mesh), expected)


def ratio(mesh: Mesh, axis: np.ndarray) -> np.ndarray:
    """How far each vertex moves along an axis, over how far any moves at all."""
    found = directions(mesh)
    return np.linalg.norm(found @ axis, axis=1) / np.linalg.norm(found, axis=(1, 2)).max()


def test_planes_edges_and_corners():
    mesh = box()
    x, found = np.asarray(mesh.vertices), directions(mesh)
    sizes = np.sqrt(np.mean(np.sum(found**2, axis=(1, 2))) / 3)
    assert sizes == pytest.approx(1, rel=1e-6)
    sides = np.isclose(x, 0) | np.isclose(x, 1)
    along = np.sqrt(np.einsum("nij,nij->nj", found, found))
    for count in (1, 2, 3):
        chosen = sides.sum(axis=1) == count
        across, within = along[chosen][sides[chosen]], along[chosen][~sides[chosen]]
        assert across.max() < 0.05 * along.max()
        assert count == 3 or within.min() > 0.5 * along.max()


def test_borders_hide_as_edges_do():
    vertices, faces = sheet(21)
    mesh = make_mesh(vertices, faces)
    row = vertices[:, 1]
    bottom = np.isclose(row, 0) & (vertices[:, 0] > 2) & (vertices[:, 0] < 18)
    inside = (row > 5) & (row < 12) & (vertices[:, 0] > 9) & (vertices[:, 0] < 18)
    assert ratio(mesh, np.array([0.0, 0, 1])).max() < 0.05
    assert ratio(mesh, np.array([0.0, 1, 0]))[bottom].max() < 0.05
    assert ratio(mesh, np.array([1.0, 0, 0]))[bottom].min() > 0.6
    np.testing.assert_allclose(ratio(mesh, np.array([0.0, 1, 0]))[inside], np.sqrt(0.5), atol=0.03)


def test_cylinders_hide_nothing_along_their_normals():
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 48, endpoint=False), np.linspace(0, 3, 24), indexing="ij")
    i, j = np.divmod(np.arange(48 * 23), 23)
    a, b = i * 24 + j, (i + 1) % 48 * 24 + j
    faces = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
    vertices = np.stack([np.cos(angle), np.sin(angle), height], axis=-1).reshape(-1, 3)
    found = directions(make_mesh(vertices, faces))
    normal = vertices * [1, 1, 0]
    across = np.linalg.norm(np.einsum("nij,nj->ni", found, normal), axis=1)
    assert across.max() < 0.12 * np.linalg.norm(found, axis=(1, 2)).max()


def test_rough_surfaces_hide_in_all_directions():
    mesh = rough_sphere(1000)
    values = np.linalg.eigvalsh(directions(mesh))
    assert np.median(values[:, 0] / values[:, 2]) > 0.3


def test_shapes_decide_and_nothing_else():
    """Not where they are, how large, how turned, in what order, or which way their faces run."""
    mesh = rough_sphere(300)
    turn, rng = Rotation.random(rng=0).as_matrix(), np.random.default_rng(1)
    order = rng.permutation(300)
    found = directions(mesh)
    moved = 7 * mesh.vertices[order] @ turn.T + [3, 4, 5]
    faces = rng.permutation(np.argsort(order)[mesh.faces])[:, ::-1]
    np.testing.assert_allclose(directions(make_mesh(moved, faces)), turn @ found[order] @ turn.T, atol=1e-2)
    assert (np.linalg.eigvalsh(found) > 0).all()
    np.testing.assert_allclose(found, found.transpose(0, 2, 1), atol=1e-9)


def test_points_without_a_surface():
    """Faces without an area, and vertices without faces, move nothing and break nothing."""
    mesh = box()
    vertices = np.vstack([mesh.vertices, [[9.0, 9, 9], [5, 5, 5], [6, 5, 5], [7, 5, 5]]])
    size = len(mesh.vertices)
    found = directions(make_mesh(vertices, np.vstack([mesh.faces, [[size + 1, size + 2, size + 3]]])))
    assert np.isfinite(found).all()
    assert (found[size] == 0).all()


def test_the_adjoint_and_gram(key: jm.Key, dtype):
    original = make_original(rough_sphere(200))
    carrier = KeyedScheme().carrier(original, Choices(key, b""), 8, 64)
    assert isinstance(carrier, KeyedCarrier)
    rng = np.random.default_rng(0)
    bits = jnp.asarray(rng.normal(size=64), dtype)
    residual = jnp.asarray(rng.normal(size=original.signal.shape), dtype)
    mass = np.asarray(original.operator.degree)[:, None]
    exact = 1e-4 if dtype == np.float32 else 1e-10
    for place in (carrier, jax.jit(lambda one: one)(carrier)):
        written = place.displacement(bits)
        assert written.dtype == dtype
        assert float(jnp.sum(mass * written * residual)) == pytest.approx(
            float(bits @ place.adjoint(residual)), rel=10 * exact
        )
    gram = np.asarray(carrier.gram())
    np.testing.assert_allclose(gram, gram.T, atol=exact * np.abs(gram).max())
    assert float(bits @ gram @ bits) == pytest.approx(float(jnp.sum(mass * carrier.displacement(bits) ** 2)), rel=1e-3)
    # A direction that hides little is one that little is written in.
    plain = KeyedScheme(hiding=False).carrier(original, Choices(key, b""), 8, 64)
    expected = np.einsum("nij,nj->ni", hiding_directions(original), original.to_host(plain.displacement(bits)))
    np.testing.assert_allclose(original.to_host(carrier.displacement(bits)), expected, atol=10 * exact)


@pytest.mark.slow
def test_carriers_are_made_in_traced_code(key: jm.Key):
    original = make_original(rough_sphere(200))

    @jax.jit
    def written(signal: jax.Array) -> jax.Array:
        carrier = KeyedScheme().carrier(dataclasses.replace(original, signal=signal), Choices(key, b""), 8, 64)
        return carrier.displacement(jnp.ones(64, signal.dtype))

    carrier = KeyedScheme().carrier(original, Choices(key, b""), 8, 64)
    expected = carrier.displacement(jnp.ones(64, original.signal.dtype))
    np.testing.assert_allclose(written(original.signal), expected, atol=1e-5)


@pytest.mark.slow
def test_planes_stay_plane(key: jm.Key):
    """By default: what is written on a box is read, and its sides stay where they are."""
    mesh = box()
    marked, info = jm.embed(mesh, b"plane", key)
    turn = np.degrees(np.arccos(np.clip(np.sum(face_normals(mesh) * face_normals(marked), axis=1), -1, 1)))
    assert np.quantile(turn, 0.95) < 0.1
    assert info.rms > 3e-4
    found = jm.compare(mesh, marked, ["shading", "dame", "stretch"])._asdict()
    limits = VISIBILITY["hidden"]
    assert all(found[name] <= limit for name, limit in limits.items())
    suspect = jm.attack(marked, "noise", 0.003, seed=0)
    assert jm.detect(suspect, original=mesh, key=key, record=info.record).message == b"plane"
    # Without a record, as the scheme's defaults are.
    assert jm.detect(suspect, original=mesh, key=key, bits=40).message == b"plane"
    plain = jm.make_marker(mesh, key, bits=40, scheme=KeyedScheme(hiding=False))
    isotropic, told = plain.write(plain.codeword(b"plane"), None)
    assert told.rms < info.rms / 3
    assert plain.read_quickly(plain.observe(plain.register(isotropic))) == b"plane"


def test_capacity_counts_the_dimensions_that_are_left(key: jm.Key):
    """Half of what is hidden in one coordinate alone is hidden in a third of the dimensions."""
    original = make_original(rough_sphere(200))
    carrier = KeyedScheme(hiding=False).carrier(original, Choices(key, b""), 8, 64)
    assert isinstance(carrier, KeyedCarrier)
    assert carrier.masked_share() == 1
    rows = len(original.signal)
    flat = np.zeros((rows, 3, 3))
    flat[:, 0, 0] = np.sqrt(3)
    assert carrier._replace(masking=flat).masked_share() == pytest.approx(rows / 200 / 3)
    half = np.where(np.arange(rows) < 100, 2.0, 0.0)
    assert carrier._replace(masking=half).masked_share() == pytest.approx(0.5)
    room = carrier.reader().room(original.to_traced(original.used))
    less = carrier._replace(masking=half).reader().room(original.to_traced(original.used))
    np.testing.assert_allclose(less.dimensions * less.energy, room.dimensions * room.energy, rtol=1e-6)


@pytest.mark.usefixtures("unchecked")
def test_visibility_has_names():
    mesh = bumpy_sphere(3)
    assert visibility_of(mesh)["hidden"]["shading"] == VISIBILITY["hidden"]["shading"]
    assert jm.Budget().bounds(mesh) == jm.Budget(visibility="hidden").bounds(mesh)
    visible = jm.Budget(limits={"dame": 1.0}, visibility="visible").bounds(mesh)
    assert visible.limits == {**visibility_of(mesh)["visible"]}
    assert jm.Budget(rms=1e-3, visibility="careful look").bounds(mesh).rms == 1e-3
    assert jm.Budget(rms=1e-3).bounds(mesh).limits == {}
    for name in ("shading", "dame", "stretch"):
        assert VISIBILITY["hidden"][name] < VISIBILITY["careful look"][name] < VISIBILITY["visible"][name]
    with pytest.raises(jm.JaxmarkError, match="visibility is one of 'hidden', 'careful look', 'visible'"):
        jm.Budget(visibility="invisible")  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_what_bands_show_is_measured_as_they_are_hidden():
    mesh, family = box(), KeyedScheme(bands=16).family()
    original = make_original(mesh)
    mask = KeyedScheme().mask(original)
    (plain,), (hidden,) = (band_visibility(original, family, ["shading"], one) for one in (None, mask))
    assert (hidden[1:8] < 0.2 * plain[1:8]).all()


def test_records_keep_how_a_mark_was_hidden():
    assert parameters_of(KeyedScheme())["hiding"] is True
    assert make_scheme("keyed", parameters_of(KeyedScheme())) == KeyedScheme()
    before = {name: value for name, value in parameters_of(KeyedScheme()).items() if name != "hiding"}
    assert make_scheme("keyed", before) == KeyedScheme(hiding=False)


def test_a_texture_drifts_as_far_as_its_surface_moves():
    vertices, faces = sheet(9)
    mesh = make_mesh(vertices, faces)
    places = (vertices[:, :2] @ [[0.05, 0.0], [0.02, 0.03]])[faces]
    moved = mesh._replace(vertices=vertices + np.array([0.01, 0.02, 0.3]))
    # What is moved off the surface stays where it was in the texture.
    expected = 1024 * np.hypot(0.05 * 0.01 + 0.02 * 0.02, 0.03 * 0.02)
    assert texture_drift(mesh, moved, places, 1024) == pytest.approx(expected)
    places[:4] = np.nan
    assert texture_drift(mesh, moved, places, 1024) == pytest.approx(expected)
    assert texture_drift(mesh, moved, np.full_like(places, np.nan)) is None


def test_the_edges_that_change_most():
    vertices, faces = sheet(9)
    pairs = edges(faces)
    stretched = jnp.asarray(vertices * [1.1, 1.1, 1])
    assert float(stretch(jnp.asarray(vertices), stretched, pairs)) == pytest.approx(0.1, rel=1e-4)
    rng = np.random.default_rng(0)
    moved = vertices + 0.05 * rng.normal(size=vertices.shape)
    before, after = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (vertices, moved))
    change = np.sort(np.abs(after - before) / before)
    found = float(stretch(jnp.asarray(vertices), jnp.asarray(moved), pairs))
    assert change[-4] < found < change[-1]
    assert np.mean(change > found + 1e-6) <= 0.01 <= np.mean(change > found - 0.01)
    slope = jax.grad(stretch, argnums=1)(jnp.asarray(vertices), jnp.asarray(moved), pairs)
    assert np.count_nonzero(np.asarray(slope).any(axis=1)) == 2
    assert float(stretch(jnp.zeros((3, 3)), jnp.ones((3, 3)), np.array([[0, 1], [1, 2]]))) == 0
