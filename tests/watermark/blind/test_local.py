"""Marks that are read from parts, and several marks in one mesh."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.graphs import from_mesh
from jaxmark.watermark import EmbedInfo, FieldScheme, LocalScheme
from jaxmark.watermark.blind import local, reading
from jaxmark.watermark.blind.reading import context
from jaxmark.watermark.blind.scheme import measure
from jaxmark.watermark.blind.writing import Writer
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.markers import CombinedMarker, make_blind_marker, prepare, unite
from jaxmark.watermark.perception.capacity import Survival
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES
from tests.app.test_cli import MESSAGE as CLI_MESSAGE
from tests.app.test_cli import Workshop
from tests.dense import laplacian_matrix
from tests.samples import rough_sphere
from tests.watermark.blind.test_field import turned

MESSAGE = b"\xc0"
CHOICES = context(bytes(range(32)), 8, "local")


@pytest.fixture(scope="module")
def shape() -> Mesh:
    return rough_sphere(4000)


@pytest.fixture(scope="module")
def marked(shape: Mesh) -> tuple[Mesh, EmbedInfo]:
    return jm.embed(shape, MESSAGE, jm.Key(bytes(range(32))), budget=2e-3, scheme="local")


def part_of(mesh: Mesh, share: float) -> Mesh:
    """What lies on one side of a plane."""
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return mesh._replace(faces=faces[(points[faces, 0] < np.quantile(points[:, 0], share)).all(axis=1)])


@pytest.mark.slow
def test_anchors_are_apart_and_do_not_depend_on_what_is_cut_off(shape: Mesh):
    whole, part = (local._anchors(one, CHOICES) for one in (shape, part_of(shape, 0.6)))
    here = set(whole.vertices[whole.vertices >= 0].tolist())
    there = set(part.vertices[part.vertices >= 0].tolist())
    assert len(here) > 60
    assert 0.3 * len(here) < len(there) < 0.6 * len(here)
    assert len(there - here) <= 0.1 * len(there)  # some rings see more than is kept away from the border
    names = dict(zip(whole.vertices.tolist(), whole.names[:, 0].tolist(), strict=True))
    found = zip(part.vertices.tolist(), part.names[:, 0].tolist(), strict=True)
    assert all(names[vertex] == name for vertex, name in found if vertex in here)
    reach = laplacian_matrix(from_mesh(shape)) != 0
    near = np.linalg.matrix_power(reach.astype(np.float32), 3)[np.ix_(sorted(here), sorted(here))] > 0
    assert near.sum() == len(here)  # each only itself


def test_values_are_differences_of_averages_over_sizes(x64):
    """By powers of the dense matrix; scaling, turning and moving change nothing."""
    mesh = rough_sphere(1000)
    original = make_original(mesh)
    host = LocalScheme(widths=(8,)).hosts(original, CHOICES)[8]
    points = original.positions
    average = np.eye(len(points)) - laplacian_matrix(from_mesh(original.points)) / 2
    smooth, faces = np.linalg.matrix_power(average, 16) @ points, np.asarray(original.points.faces)
    across = np.cross(*(smooth[faces[:, corner]] - smooth[faces[:, 0]] for corner in (1, 2)))
    normals = np.zeros_like(points)
    np.add.at(normals, faces, across[:, None])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    narrow, wide = (np.linalg.matrix_power(average, power) @ points for power in (8, 16))
    values = np.sum((narrow - wide) * normals, axis=1)
    usual = np.median(np.abs(values)) / 0.6745
    square = np.linalg.matrix_power(average, 32) @ np.minimum(values**2, (4 * usual) ** 2)
    values /= np.sqrt(usual * np.sqrt(square + (0.1 * usual) ** 2))
    good = host.good > 0
    anchors = local._anchors(original.points, CHOICES).vertices
    np.testing.assert_allclose(host.values[good], values[anchors[good]], rtol=1e-3)
    view = next(LocalScheme(widths=(8,)).views(turned(mesh), CHOICES))[0]
    assert sorted(view.names[0, view.good, 0].tolist()) == sorted(host.names[good, 0].tolist())
    np.testing.assert_allclose(np.sort(np.asarray(view.values)[view.good]), np.sort(host.values[good]), atol=1e-3)


def test_measuring_has_derivatives(shape: Mesh, dtype: np.dtype):
    """As if normals and sizes were constants, which linear changes of the values show."""
    original = make_original(shape)
    host = LocalScheme().hosts(original, CHOICES)[32]
    points = original.to_traced(original.positions)
    along = jnp.asarray(1e-3 * np.random.default_rng(0).normal(size=points.shape), dtype)
    values, push = jax.linearize(lambda at: measure(host.shape, at)[0], points)
    assert values.dtype == dtype
    change = push(along)
    (pulled,) = jax.vjp(lambda at: measure(host.shape, at)[0], points)[1](change)
    np.testing.assert_allclose(jnp.vdot(pulled, along), jnp.vdot(change, change), rtol=1e-3)


@pytest.mark.parametrize("way", ["turned", "cut", "smoothing 30", "noise 0.002", "affine 0.05"])
def test_a_message_is_read_from_what_is_left(marked, key: jm.Key, way: str):
    mesh, info = marked
    assert info.rms == pytest.approx(2e-3, rel=0.01)
    match way.split():
        case ["turned"]:
            suspect = turned(mesh)
        case ["cut"]:
            suspect = turned(part_of(mesh, 0.8))
        case [kind, strength]:
            suspect = jm.attack(mesh, kind, float(strength), seed=1)
    found = jm.detect(suspect, key=key, bits=8, scheme="local")
    assert found.message == MESSAGE
    assert found.detected()
    assert found.scheme == "local"
    assert jm.detect(suspect, key=key, record=info.record).message == MESSAGE


def test_all_blind_schemes_are_tried_and_paid_for(marked, key: jm.Key):
    mesh, _ = marked
    alone = jm.detect(mesh, key=key, bits=8, scheme="local")
    found = jm.detect(mesh, key=key, bits=8)
    assert found.message == MESSAGE
    assert found.log10_p == pytest.approx(alone.log10_p)
    (charge,) = [one for one in found.evidence.charges if one.choice == ledger.BLIND_SCHEME.name]
    assert charge.log10 == pytest.approx(math.log10(len(BLIND_SCHEMES)))
    marker = make_blind_marker(mesh, key, bits=8, scheme=LocalScheme())
    assert marker.detect(mesh).log10_p == pytest.approx(alone.log10_p)


@pytest.mark.slow
def test_nothing_is_detected_where_nothing_is(shape: Mesh, marked):
    for mesh in (shape, marked[0], jm.attack(shape, "noise", 0.01, seed=0)):
        for number in range(2):
            found = jm.detect(mesh, key=jm.Key(bytes([number]) * 32), bits=8, scheme="local")
            assert found.message is None
            assert not found.detected(1e-3)


def test_equal_surroundings_count_once(key: jm.Key):
    """Two copies beside each other say no more than one."""
    mesh = rough_sphere(1000)
    two = Mesh(
        np.concatenate([mesh.vertices, np.asarray(mesh.vertices) + 5]), np.concatenate([mesh.faces, mesh.faces + 1000])
    )
    readings = []
    for one in (mesh, two):
        view = next(LocalScheme().views(one, CHOICES))[0]
        readings.append(reading._readings(view, LocalScheme(), CHOICES, 128)[0])
    # Far from the origin, coordinates have fewer digits, and the median is another one.
    assert readings[1].anchors == readings[0].anchors
    np.testing.assert_allclose(readings[1].square, readings[0].square, rtol=0.01)


def test_the_noise_to_survive_is_demanded_of_each_of_several_marks(shape: Mesh, key: jm.Key, monkeypatch):
    monkeypatch.setattr(Writer, "survives", lambda *_: Survival(1e-4, 0.0))
    with pytest.raises(jm.JaxmarkError, match=r"'local' would survive noise of 0\.0001, less than 0\.001"):
        jm.embed(shape, MESSAGE, key, budget=jm.Budget(rms=2e-3, noise=1e-3), scheme=("keyed", "local"))


@pytest.mark.slow
def test_several_marks_are_read_each_alone_and_united(key: jm.Key):
    mesh, schemes = rough_sphere(4000), ("keyed", "local")
    marked, info = jm.embed(mesh, MESSAGE, key, budget=2e-3, scheme=schemes)
    assert info.rms == pytest.approx(2e-3, rel=0.01)
    suspect = jm.attack(marked, "noise", 0.03, seed=0)
    blind = jm.detect(suspect, key=key, message=MESSAGE, scheme="local")
    informed = jm.detect(suspect, key=key, message=MESSAGE, original=mesh)
    both = jm.detect(suspect, key=key, message=MESSAGE, original=mesh, scheme=schemes)
    assert both.log10_p == pytest.approx(unite(jm.make_marker(mesh, key, bits=16), informed, [blind]).log10_p)
    by_marker = prepare(mesh, key, 8, schemes).detect(suspect, MESSAGE)
    assert by_marker.parts["local"].log10_p == pytest.approx(both.parts["local"].log10_p)
    assert both.evidence.log10_p_unfloored < min(one.evidence.log10_p_unfloored for one in (informed, blind))
    nats = -(informed.log10_p + blind.log10_p) * math.log(10)
    assert both.log10_p == pytest.approx(max(-77, (math.log1p(nats) - nats) / math.log(10)))
    assert jm.detect(marked, key=key, bits=8, scheme="local").message == MESSAGE
    assert jm.detect(marked, key=key, original=mesh, record=info.record).message == MESSAGE


@pytest.mark.slow
def test_the_order_of_blind_schemes_does_not_matter(key: jm.Key):
    """`local` is written last: it would not be read after `field` had moved the surface."""
    nonblind = jm.make_marker(rough_sphere(4000), key, bits=8)
    local = LocalScheme(steps=LocalScheme().steps[4:6])  # fewer are sooner written
    schemes = (local, FieldScheme(with_hint=False).fixed(0.025, 0.0008))
    markers = [CombinedMarker(nonblind, order) for order in (schemes, schemes[::-1])]
    one, other = (marker.embed(MESSAGE, 3e-3, read_back="never")[0] for marker in markers)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    assert jm.detect(one, key=key, bits=8, scheme=local).message == MESSAGE


def test_united_probabilities_hold():
    """Of two uniform probabilities, by counting."""
    chance = np.random.default_rng(0).random((200_000, 2))
    nats = -np.log(chance).sum(axis=1)
    united = np.exp(-nats) * (1 + nats)
    for level in (0.1, 0.01, 0.001):
        assert np.mean(united <= level) == pytest.approx(level, rel=0.25)


def test_refusals(shape: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match="Several marks in one mesh need one scheme"):
        jm.embed(shape, MESSAGE, key, scheme=("field", "local"))
    with pytest.raises(jm.JaxmarkError, match="can mark a mesh once"):
        jm.embed(shape, MESSAGE, key, scheme=("keyed", "local", "local"))
    with pytest.raises(jm.JaxmarkError, match="nothing to write in"):
        jm.embed(shape, MESSAGE, key, budget=1e-7, scheme="local")
    for faces in ([[0, 1, 5]], [[0, 1, -1]], [[0, 1, 2.5]]):
        with pytest.raises(jm.JaxmarkError, match=r"[Ff]aces? "):
            jm.detect(Mesh(np.eye(3), np.array(faces)), key=key)
    with pytest.raises(jm.JaxmarkError, match=r"array \[N, 3\]"):
        jm.detect(Mesh(np.zeros((3, 2)), np.array([[0, 1, 2]])), key=key)


@pytest.mark.slow
def test_commands_for_several_marks(shape: Mesh, tmp_path: Path, monkeypatch, capfd):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    jm.save_mesh(rough_sphere(9000), tmp_path / "model.ply")
    told = workshop.embed("--scheme", "keyed,local", "--budget", "0.002")
    assert told["scheme"] == "keyed,local"
    key = ("--key", "owner.key")
    blind = workshop.json("detect", "marked.ply", *key)
    assert (blind["message"], blind["scheme"]) == (CLI_MESSAGE, "local")
    both = workshop.json("detect", "marked.ply", *key, "--original", "model.ply", "--scheme", "keyed,local")
    assert both["message"] == CLI_MESSAGE
    assert any("'local', if it were the only one" in note for note in both["notes"])
    assert {"alignment", "message"} & {charge["choice"] for charge in both["parts"]["keyed"]["charges"]}
    said = workshop("detect", "marked.ply", *key, "--original", "model.ply", "--scheme", "keyed,local", "--charges")[1]
    assert said.count("charged in log10 p") == 3
    assert "not one of" in workshop.refused("embed", "model.ply", "x.ply", *key, "--scheme", "keyed,nothing")
    assert "read with the original" in workshop.refused("embed", "model.ply", "x.ply", *key, "--scheme", "field,keyed")
