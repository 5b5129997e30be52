"""Marks that are read without the original."""

import dataclasses
import math
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.app import mark_files
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.geometry.surfaces import surface_moments, volume_moments
from jaxmark.spectral.graphs import from_mesh
from jaxmark.watermark import EmbedInfo, FieldScheme
from jaxmark.watermark.blind import field, reading, writing
from jaxmark.watermark.blind.anchors import look, place, see
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.field import TURNS, unsmoothed
from jaxmark.watermark.blind.prediction import margin
from jaxmark.watermark.blind.reading import context
from jaxmark.watermark.blind.scheme import measure
from jaxmark.watermark.blind.search import moved
from jaxmark.watermark.blind.writing import Writer
from jaxmark.watermark.markers import BlindMarker, CombinedMarker, make_blind_marker
from jaxmark.watermark.perception.capacity import Survival
from tests.app.test_cli import MESSAGE as CLI_MESSAGE
from tests.app.test_cli import Workshop
from tests.samples import bumpy_sphere, rough_sphere, with_thin_faces
from tests.watermark.perception.test_budget import largest_stretch

MESSAGE = bytes.fromhex("c0ffee42")
WIDTH = 0.025
SCHEME = FieldScheme(widths=(WIDTH,), steps=FieldScheme().steps[6:10])  # fewer are sooner read
HOSTS = dataclasses.replace(SCHEME, widths=(2 * WIDTH,)).hosts
CHOICES = context(bytes(range(32)), 32, "field")


@pytest.fixture(scope="module")
def shape() -> Mesh:
    """A closed surface of 5,000 points that is 1, 0.75 and 0.55 as wide."""
    mesh = rough_sphere(5000)
    return mesh._replace(vertices=np.asarray(mesh.vertices) * [1, 0.75, 0.55])


@pytest.fixture(scope="module")
def marked(shape: Mesh) -> tuple[Mesh, EmbedInfo]:
    key = jm.Key(bytes(range(32)))
    return jm.embed(shape, MESSAGE, key, budget=6e-4, scheme=SCHEME)


def turned(mesh: Mesh, mirrored: bool = False) -> Mesh:
    """Somewhere else, turned, scaled, in another order; mirrored with its faces turned, so that they look outwards."""
    rng = np.random.default_rng(7)
    matrix = 3.7 * Rotation.random(random_state=3).as_matrix() @ np.diag([-1.0 if mirrored else 1.0, 1, 1])
    order = rng.permutation(len(mesh.vertices))
    place_of = np.argsort(order)
    faces = place_of[np.asarray(mesh.faces)][rng.permutation(len(mesh.faces))]
    return Mesh((np.asarray(mesh.vertices) @ matrix.T + [9, -5, 2])[order], faces[:, ::-1] if mirrored else faces)


def test_moments_are_those_of_a_box():
    box = np.array([[x, y, z] for x in (5.0, 6) for y in (-1.0, 1) for z in (2.0, 5)])
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    faces = np.array([*sides, [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
    found = volume_moments(box[faces])
    np.testing.assert_allclose(found.mass, 6)
    np.testing.assert_allclose(found.centre, [5.5, 0, 3.5])
    np.testing.assert_allclose(found.covariance, np.diag([1, 4, 9]) / 12, atol=1e-12)
    np.testing.assert_allclose(volume_moments(box[faces[:, ::-1]]).mass, -6)
    surface = surface_moments(box[faces])
    np.testing.assert_allclose(surface.mass, 22)
    # Two faces each of area 6, 3 and 2, which lie at ±1/2, ±1, ±3/2 across their own axis.
    ends, inside = np.array([1, 4, 9]) / 4, np.array([1, 4, 9]) / 12
    share = 2 * np.array([6, 3, 2]) / 22
    np.testing.assert_allclose(np.diag(surface.covariance), share * ends + (1 - share) * inside)


def seen(mesh: Mesh, points: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells, values and which of them count, of a mesh in its own pose, or with points near to it."""
    placed = place(mesh)
    pieces, surface, anchors = see(placed.mesh, (WIDTH,), np.dtype(np.float32))[WIDTH]
    if points is not None:
        surface = pieces.of(jnp.asarray(points))
    nowhere = jnp.zeros(anchors.places.shape)
    shown = look(surface, anchors, nowhere, jnp.float32(WIDTH), jnp.float32(0))
    return anchors.cells, np.asarray(shown.values), np.asarray(shown.good)


def change_of_values(mesh: Mesh, copy: Mesh) -> float:
    """Median change of the values in a copy over their spread, for the turn that fits best."""
    cells, values, good = seen(mesh)
    here = dict(zip(map(tuple, cells[good].tolist()), values[good], strict=True))
    cells, values, good = seen(copy)
    best = np.inf
    for turn in TURNS:
        there = dict(zip(map(tuple, (cells[good] * turn).tolist()), values[good], strict=True))
        common = here.keys() & there.keys()
        if len(common) > 100:
            best = min(best, float(np.median([abs(here[cell] - there[cell]) for cell in common])))
    return best / float(np.std(list(here.values())))


@pytest.mark.parametrize("other", ["finer", "mirrored"])
def test_values_do_not_depend_on_the_meshing_nor_on_the_pose(shape: Mesh, other: str):
    """Of a subdivided or a mirrored copy somewhere else, up to the way that it looks along its axes."""
    copy = turned(jm.attack(shape, "midpoint", 1, seed=0)) if other == "finer" else turned(shape, True)
    assert change_of_values(shape, copy) < 0.02


@pytest.mark.parametrize(("other", "most"), [("finer", 4e-3), ("turned", 1e-4), ("mirrored", 1e-4)])
def test_values_of_coarse_surfaces_do_not_depend_on_how_they_are_cut(other: str, most: float):
    """Faces as wide as the narrow Gaussian are cut in the same way whatever the order of their corners."""
    coarse = jm.geometry.asteroid(1500)
    copy = jm.attack(coarse, "midpoint", 2, seed=0) if other == "finer" else turned(coarse, other == "mirrored")
    faces = np.asarray(copy.faces)
    rolled = np.where(np.arange(len(faces))[:, None] % 2, faces, np.roll(faces, 1, axis=1))
    assert change_of_values(coarse, copy._replace(faces=rolled)) < most


def test_values_do_not_depend_on_how_long_and_thin_faces_are_cut():
    around, along = 400, 12
    height, angle = np.meshgrid(np.linspace(0, 1, along), 2 * np.pi * np.arange(around) / around, indexing="ij")
    radius = 0.3 + 0.1 * height + 0.04 * np.sin(3 * angle + 4 * height)
    points = np.stack([radius * np.cos(angle), 0.8 * radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    below = np.arange((along - 1) * around).reshape(along - 1, around)
    quads = np.stack([below, np.roll(below, -1, axis=1), np.roll(below, -1, axis=1) + around, below + around], axis=-1)
    mesh = make_mesh(points, quads[..., [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    assert change_of_values(mesh, turned(jm.attack(mesh, "midpoint", 1, seed=0))) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(7))
def test_changes_of_pose_are_derivatives(shape: Mesh, axis: int):
    view = next(SCHEME.views(shape, CHOICES))[0]
    change = 1e-3 * np.eye(7)[axis]
    points = np.asarray(place(shape).mesh.vertices)
    # The suspect lies off by the inverse of the change, so that anchors see what they would after it.
    points = (points - np.cross(change[:3], points) - change[3:6]) * (1 - change[6])
    _, values, good = seen(shape, points)
    good = good & view.good
    before, there = np.asarray(view.values)[good], moved(view, change)[good]
    assert np.linalg.norm(there - values[good]) < 0.05 * np.linalg.norm(before - values[good])


@pytest.mark.slow
def test_the_displacement_gives_anchors_their_values_and_keeps_the_pose():
    fine = bumpy_sphere(5)
    original = make_original(fine._replace(vertices=np.asarray(fine.vertices) * [1, 0.75, 0.55]))
    host = HOSTS(original, CHOICES)[2 * WIDTH]
    wanted = host.values + 2e-4 * np.random.default_rng(0).uniform(-1, 1, len(host.values))
    shift = Writer(original, SCHEME, CHOICES).shift(host, wanted, 2)
    points = original.to_traced(original.positions + shift)
    values, pose = measure(host.shape, points)
    good = host.good > 0
    assert np.abs(np.asarray(values) - wanted)[good].max() < 1e-5
    np.testing.assert_allclose(pose, host.held, atol=1e-6)
    assert np.sqrt(np.mean(np.sum(shift**2, axis=1))) < 2e-4


def test_measuring_has_derivatives(shape: Mesh, dtype: np.dtype):
    """Along the normals, against differences."""
    original = make_original(shape)
    host = HOSTS(original, CHOICES)[2 * WIDTH]
    points = original.to_traced(original.positions)
    along = jnp.asarray(np.random.default_rng(0).normal(size=points.shape), dtype)

    def total(size: jax.Array) -> jax.Array:
        values, _ = measure(host.shape, points + size * along)
        return jnp.sum(jnp.where(host.good > 0, values, 0) ** 2)

    step = dtype.type(1e-4 if dtype == np.float32 else 1e-6)
    slope = jax.grad(total)(dtype.type(0))
    assert slope.dtype == dtype
    np.testing.assert_allclose(slope, (total(step) - total(-step)) / (2 * step), rtol=0.02)
    np.testing.assert_allclose(jax.jvp(total, (dtype.type(0),), (dtype.type(1),))[1], slope, rtol=1e-4)


def test_choices_of_cells(key: jm.Key):
    """Each cell has its own, uniform and independent as far as a thousand of them tell."""
    cells = np.array([[x, y, z] for x in range(-5, 5) for y in range(-5, 5) for z in range(-5, 5)])
    found = make_dither(CHOICES, "field", cells, 128)
    assert 0 <= found.offset.min() <= found.offset.max() < 0.5
    assert abs(found.offset.mean() - 0.25) < 0.02
    assert abs(found.sign.mean()) < 0.12
    assert abs(np.corrcoef(found.offset, found.sign)[0, 1]) < 0.12
    assert np.bincount(found.slot, minlength=128).max() < 25
    some = make_dither(CHOICES, "field", cells[::-1][:10], 128)
    np.testing.assert_array_equal(some.offset, found.offset[::-1][:10])
    assert not np.array_equal(make_dither(context(key, 64, "field"), "field", cells, 128).offset, found.offset)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_message_is_read_without_the_original(marked, key: jm.Key, mirrored: bool):
    mesh, info = marked
    assert info.rms == pytest.approx(6e-4, rel=0.01)
    found = jm.detect(turned(mesh, mirrored), key=key, bits=32, scheme=SCHEME)
    assert found.message == MESSAGE
    assert found.log10_p < -15
    assert found.registration.agreement > 0.6
    assert ("The suspect is the mirror image of the marked mesh." in found.notes) == mirrored


@pytest.mark.parametrize("attack", [("noise", 0.003), ("smoothing", 10), ("quantisation", 9), ("simplification", 0.5)])
def test_a_record_reads_what_was_attacked(marked, key: jm.Key, attack):
    mesh, info = marked
    found = jm.detect(jm.attack(mesh, *attack, seed=1), key=key, record=info.record)
    assert found.message == MESSAGE
    assert found.log10_p < -10


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_record_reads_a_part_in_any_pose(marked, key: jm.Key, mirrored: bool):
    """Turned, scaled and mirrored; the hint gives the pose, which is charged whether it was needed or not."""
    mesh, info = marked
    part = turned(jm.attack(mesh, "cropping", 0.3, seed=0), mirrored)
    found = jm.detect(part, key=key, record=info.record, message=MESSAGE)
    assert found.log10_p < -10
    assert any("hint" in note for note in found.notes)
    assert any("mirror image" in note for note in found.notes) == mirrored
    views = {charge.choice: charge.log10 for charge in found.evidence.charges}["view"]
    assert views == pytest.approx(np.log10(2 * (5 * 8 + 2 * 4 * 2 + 2 * 2)))


@pytest.mark.slow
def test_a_part_has_no_mark_that_was_not_made(shape: Mesh, marked, key: jm.Key):
    mesh, info = marked
    part = jm.attack(shape, "cropping", 0.3, seed=0)
    found = jm.detect(part, key=key, record=info.record, message=MESSAGE)
    assert found.log10_p > -2
    assert [note for note in found.notes if note.startswith("Landmarks of the record's hint fit")]
    without = dataclasses.replace(SCHEME.fixed(WIDTH, info.record.parameters["step"]), hint="")
    part = jm.attack(mesh, "cropping", 0.3, seed=0)
    assert reading.read(reading.register(part), key, 32, without, MESSAGE).log10_p > -2
    chosen = dataclasses.replace(without, hint=info.record.parameters["hint"])
    found = jm.detect(part, key=key, scheme=chosen, message=MESSAGE)
    assert found.evidence.caveats == ("the hint was chosen by the reader; give the record",)
    assert not found.detected()


def test_smoothing_is_undone_as_by_rounds(shape: Mesh):
    """The polynomial is x ← x + (y - sⁿx), eight times."""
    operator = from_mesh(shape)

    def smooth(points: jax.Array) -> jax.Array:
        for _ in range(10):
            points = points - 0.1 * operator.apply(points)
        return points

    start = jnp.asarray(np.asarray(shape.vertices) - np.mean(shape.vertices, axis=0), jnp.float32)
    rounds = start
    for _ in range(8):
        rounds = rounds + (start - smooth(rounds))
    found = np.asarray(unsmoothed(shape, 10).vertices) - np.mean(shape.vertices, axis=0)
    np.testing.assert_allclose(found, rounds, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("claimed", [None, MESSAGE])
def test_nothing_is_detected_where_nothing_is(shape: Mesh, marked, key: jm.Key, claimed):
    mesh, info = marked
    assert not jm.detect(shape, key=key, message=claimed, record=info.record).detected(1e-3)
    step = info.record.parameters["step"]
    assert not reading.read(reading.register(mesh), jm.Key(bytes(32)), 32, SCHEME.fixed(WIDTH, step), claimed).detected(
        1e-3
    )


@pytest.mark.long
def test_nothing_is_detected_in_any_way_of_looking(shape: Mesh, key: jm.Key):
    assert not jm.detect(shape, key=key).detected(1e-3)


@pytest.mark.long
def test_values_do_not_go_beyond_the_lattice(shape: Mesh, key: jm.Key):
    """With more budget than the largest step needs, less than the budget is used."""
    scheme = SCHEME.fixed(WIDTH, SCHEME.steps[0])
    marked, info = jm.embed(shape, MESSAGE, key, budget=2e-3, scheme=scheme)
    assert info.record.beta == 1
    assert info.rms < 1e-3
    assert jm.compare(shape, marked, ("rms",)).rms == pytest.approx(info.rms, rel=1e-3)
    assert jm.detect(marked, key=key, bits=32, scheme=scheme).registration.agreement > 0.95


def test_a_claimed_message_is_proven_or_refuted(marked, key: jm.Key):
    mesh, info = marked
    claimed = jm.detect(mesh, key=key, message=MESSAGE, scheme=SCHEME)
    read = jm.detect(mesh, key=key, bits=32, scheme=SCHEME)
    assert claimed.log10_p < read.log10_p
    other = jm.detect(mesh, key=key, message=bytes(4), scheme=SCHEME)
    assert other.message == MESSAGE
    assert other.notes
    with pytest.raises(jm.JaxmarkError, match="commits to another message"):
        jm.detect(mesh, key=key, record=info.record, message=bytes(4))


@pytest.mark.long
def test_presence_is_a_mark(shape: Mesh, key: jm.Key):
    mesh, info = jm.embed(shape, b"", key, budget=3e-4, scheme=SCHEME)
    assert info.record.content == "presence"
    found = jm.detect(turned(mesh), key=key, record=info.record)
    assert found.detected(1e-9)
    assert found.message is None


@pytest.mark.slow
def test_refusals(shape: Mesh, marked, key: jm.Key, sphere: Mesh, unchecked):
    ball = np.asarray(sphere.vertices) / np.linalg.norm(sphere.vertices, axis=1)[:, None]
    with pytest.raises(jm.JaxmarkError, match="pose cannot be found"):
        jm.embed(sphere._replace(vertices=ball), MESSAGE, key, scheme="field")
    with pytest.raises(jm.JaxmarkError, match="needs faces"):
        jm.embed(shape._replace(faces=np.zeros((0, 3), int)), MESSAGE, key, scheme="field")
    with pytest.raises(jm.JaxmarkError, match="nothing to write in"):
        jm.embed(shape, MESSAGE, key, budget=1e-6, scheme=SCHEME)
    with pytest.raises(jm.JaxmarkError, match="is read with the original"):
        jm.detect(shape, key=key, scheme="keyed")
    with pytest.raises(jm.JaxmarkError, match="without alignment"):
        jm.detect(shape, key=key, align="same")  # pyright: ignore
    record = dataclasses.replace(marked[1].record, parameters={"width": 0.025, "step": 1e9}).sealed(key)
    with pytest.raises(jm.JaxmarkError, match="no scheme 'field' has its width"):
        jm.detect(shape, key=key, record=record)


@pytest.mark.slow
def test_payloads_that_a_mesh_cannot_hold_are_refused_before_they_are_written(
    shape: Mesh, key: jm.Key, tmp_path: Path, monkeypatch
):
    anchors = make_blind_marker(shape, key, scheme=SCHEME).writer.hosts[WIDTH].size
    monkeypatch.setattr(Writer, "off", None)  # nothing is planned
    with pytest.raises(jm.JaxmarkError, match=f"at most {anchors} anchors .* too few for a message of 160 bits"):
        jm.embed(shape, bytes(20), key, scheme=SCHEME)
    source, budget = tmp_path / "shape.obj", jm.Budget.of(None)
    jm.save_mesh(shape, source)
    with pytest.raises(jm.JaxmarkError, match="too few for a message of 160 bits"):
        mark_files.mark_file(
            source,
            tmp_path / "out.obj",
            tmp_path / "out.json",
            key=key,
            message=bytes(20),
            budget=budget,
            scheme=SCHEME,
        )
    monkeypatch.undo()
    largest = (anchors - reading.TAG_BITS) // 8
    monkeypatch.setattr(writing, "_ROUNDS", None)  # nothing is written
    with pytest.raises(jm.JaxmarkError, match=rf"{anchors} anchors of this mesh hold about \d+ bits .* needs about"):
        jm.embed(shape, bytes(largest), key, budget=6e-4, scheme=SCHEME)


def test_a_record_does_not_decide_what_reading_costs(marked, key: jm.Key, monkeypatch):
    """Its owner can seal any payload; messages that the anchors cannot hold are not decoded."""
    rows: list[np.ndarray] = []

    def decode_any(soft: np.ndarray, *_: object) -> None:
        rows.append(soft)

    monkeypatch.setattr(reading, "decode_any", decode_any)
    monkeypatch.setattr(field, "_UNDONE_STEPS", (0,))
    suspect = reading.register(marked[0])
    for bits, decoded in ((32, True), (256, False), (2**15, False)):
        rows.clear()
        assert reading.read(suspect, key, bits, SCHEME).log10_p == 0
        assert any(soft.any() for soft in rows) == decoded
        assert sum(soft.nbytes for soft in rows) < 2**26
    with pytest.raises(jm.JaxmarkError, match="at most 32768 bits, got 65536"):
        jm.detect(marked[0], key=key, record=dataclasses.replace(marked[1].record, bits=2**16).sealed(key))


@pytest.mark.long
def test_capacity_is_what_embed_takes(shape: Mesh, key: jm.Key):
    bits = jm.capacity(shape, jm.Budget(rms=6e-4, noise=0.001), scheme=SCHEME)
    assert bits >= 32
    assert jm.capacity(shape, jm.Budget(rms=6e-4, noise=0.05), scheme=SCHEME) == 0
    message = bytes(range(bits // 8))
    marked, _ = jm.embed(shape, message, key, budget=jm.Budget(rms=6e-4, noise=0.001), scheme=SCHEME)
    assert jm.detect(jm.attack(marked, "noise", 0.001, seed=0), key=key, bits=bits, scheme=SCHEME).message == message


@pytest.mark.long
def test_commands_without_the_original(shape: Mesh, tmp_path: Path, monkeypatch, capfd):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    jm.save_mesh(turned(shape), tmp_path / "model.ply")
    told = workshop.embed("--scheme", "field")
    assert told["scheme"] == "field"
    assert told["survives"]["whole"] > 0
    key, record = ("--key", "owner.key"), ("--record", "marked.ply.jaxmark.json")
    found = workshop.json("detect", "marked.ply", *key, *record)
    assert found["message"] == CLI_MESSAGE
    assert found["scheme"] == "field"
    assert workshop("detect", "model.ply", *key, *record)[0] == 1
    assert "hint" in jm.Record.load(tmp_path / "marked.ply.jaxmark.json").parameters
    workshop.embed("--scheme", "field", "--no-hint", "--overwrite")
    assert jm.Record.load(tmp_path / "marked.ply.jaxmark.json").parameters.keys() == {"width", "step"}
    assert "leave out --no-hint" in workshop.refused(
        "embed", "model.ply", "other.ply", *key, "--message", CLI_MESSAGE, "--no-hint"
    )
    assert "give --original" in workshop.refused("detect", "marked.ply", *key, "--align", "same")
    assert "give --original" in workshop.refused("detect", "marked.ply", *key, "--scheme", "keyed")


def with_parts_inside_out(mesh: Mesh, share: float) -> Mesh:
    """With small balls far away, inside out, whose second moments are a share of the shape's own.

    Its pose would be many times as large as that of the shape alone.
    """
    ball, points = bumpy_sphere(1), np.asarray(mesh.vertices)
    own, one = (volume_moments(np.asarray(part.vertices)[np.asarray(part.faces)]) for part in (mesh, ball))
    faces, vertices = [np.asarray(mesh.faces)], [points]
    for axis, sign in product(range(3), (-1, 1)):
        size = np.cbrt(share * abs(own.mass) * own.covariance[axis, axis] / (2 * abs(one.mass) * 30**2))
        vertices.append(own.centre + size * np.asarray(ball.vertices) + 30 * sign * np.eye(3)[axis])
        faces.append(np.asarray(ball.faces)[:, ::-1] + sum(map(len, vertices[:-1])))
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


@pytest.mark.parametrize(("share", "said"), [(0.9, None), (0.99, "too large"), (1.02, "no volume")])
def test_shapes_made_to_be_huge_in_their_pose_are_refused(share: float, said: str | None):
    ball = bumpy_sphere(3)
    ball = ball._replace(vertices=ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True))
    with pytest.raises(jm.JaxmarkError, match=said) if said else nullcontext():
        see(place(with_parts_inside_out(ball, share)).mesh, (WIDTH,), np.dtype(np.float32))


@pytest.mark.slow
def test_a_part_that_one_scheme_refuses_does_not_hide_what_another_proves(shape: Mesh, key: jm.Key):
    marked, _ = jm.embed(shape, MESSAGE, key, budget=2e-3, scheme="local")
    suspect = with_parts_inside_out(marked, 1.1)
    alone = jm.detect(suspect, key=key, bits=32, scheme="local")
    found = jm.detect(suspect, key=key, bits=32)
    assert found.message == MESSAGE
    assert found.log10_p == pytest.approx(alone.log10_p, abs=1e-6)
    with pytest.raises(jm.JaxmarkError, match="volume"):
        jm.detect(suspect, key=key, bits=32, scheme="field")


@pytest.mark.slow
def test_what_is_too_rough_when_smoothing_is_undone_is_left_out(shape: Mesh):
    rough = jm.attack(shape, "noise", 0.2, seed=0)
    undone = {view.undone for group in SCHEME.views(rough, CHOICES) for view in group}
    assert 0 in undone
    assert not undone >= {0, 10, 30, 50}


@pytest.mark.long
def test_tuning_chooses_what_the_worst_attack_leaves_most_of(shape: Mesh):
    ways = (("noise", 0.003), lambda mesh, seed: turned(mesh))
    scheme = dataclasses.replace(SCHEME, widths=(WIDTH, 0.018))
    tuned = jm.evaluation.tune_blind(shape, ways, 6e-4, seed=0, bits=32, scheme=scheme)
    assert tuned.surplus.shape == (len(tuned.choices), 2)
    chosen = tuned.choices.index((*tuned.scheme.widths, *tuned.scheme.steps))
    assert tuned.worst == tuned.surplus[chosen].min() > 0
    narrow = np.array([width == 0.018 for width, _ in tuned.choices])
    assert tuned.surplus[narrow][0, 0] < tuned.surplus[narrow][1, 0]  # larger steps survive more noise
    assert (tuned.surplus[:, 1] > 0.9 * tuned.surplus[:, 0]).all()  # another pose and order costs next to nothing
    marked, _ = jm.embed(shape, MESSAGE, jm.Key(bytes(32)), budget=6e-4, scheme=tuned.scheme)
    assert jm.detect(jm.attack(marked, "noise", 0.003, seed=0), key=jm.Key(bytes(32)), bits=32).message == MESSAGE


def test_information_of_few_good_and_of_many_weak_values():
    """Its mean is ρ² nats where ρ is small, and one bit where nothing is off."""
    assert margin(100_000, 0.02, 0).surplus == pytest.approx(40, rel=0.01)
    assert margin(100_000, 0.02, 0).deviation == pytest.approx(math.sqrt(80 + 1), rel=0.01)
    assert margin(200, 1.0, 200).surplus == pytest.approx(0, abs=5)
    assert margin(200, 1.0, 150).sure > 5
    assert margin(200, 0.5, 150).surplus < 0


def test_tuning_refuses_informed_schemes(shape: Mesh):
    with pytest.raises(jm.JaxmarkError, match="there is tune"):
        jm.evaluation.tune_blind(shape, [("noise", 0.003)], seed=0, scheme="keyed")


@pytest.fixture(scope="module")
def thin() -> BlindMarker:
    """Marks the presence in a mesh with thin faces, whose angles change far more than others."""
    mesh = with_thin_faces(bumpy_sphere(3))
    mesh = mesh._replace(vertices=np.asarray(mesh.vertices) * [1, 0.75, 0.55])
    return make_blind_marker(mesh, bytes(range(32)), bits=0, scheme=FieldScheme(widths=(WIDTH,)))


TIGHT = "The limit of dame, 0.006, allows only "


@pytest.mark.slow
def test_a_limit_that_a_few_faces_make_tight_is_named(thin):
    assert not thin.write(b"", 1e-3)[1].notes
    info = thin.write(b"", jm.Budget(limits={"dame": 0.006}))[1]
    (note,) = info.notes
    assert note.startswith(TIGHT)
    faces = {int(part.split()[0]) for part in note.split("others: ")[1].split(", ")}
    assert {0, 2} <= faces
    # A limit that allows no mark at all is named in the refusal.
    with pytest.raises(jm.JaxmarkError, match=r"nothing to write in.*The limit of dame, 0\.001, allows only .* \(by "):
        thin.write(b"", jm.Budget(limits={"dame": 0.001}))


@pytest.mark.slow
def test_a_reading_that_detects_nothing_says_nothing_of_the_pose():
    scheme = FieldScheme(widths=(0.018,), steps=FieldScheme().steps[4:8])
    # A key for which the likeliest view of chance is mirrored and was smoothed.
    found = jm.detect(bumpy_sphere(4), key=bytes([3]) * 32, message=b"mine", scheme=scheme)
    assert not found.detected(allow_estimate=True)
    assert found.notes == ()


@pytest.mark.slow
def test_a_mark_that_does_not_read_back_is_refused_with_the_limit(thin, monkeypatch):
    monkeypatch.setattr(BlindMarker, "reads", lambda *_: False)
    with pytest.raises(jm.JaxmarkError, match=f"does not read back.*{TIGHT}"):
        thin.embed(b"", jm.Budget(limits={"dame": 0.006}))


@pytest.mark.slow
def test_the_command_prints_the_limit(thin, tmp_path, monkeypatch):
    monkeypatch.setattr(mark_files, "prepare", lambda *_, **__: thin)
    monkeypatch.setattr(BlindMarker, "measure_survival", lambda *_, **__: Survival(0.02, 0.01))
    source, out = tmp_path / "thin.obj", tmp_path / "out.obj"
    jm.save_mesh(thin.original.mesh, source)
    budget = jm.Budget(limits={"dame": 0.006})
    options = {"key": thin.key, "message": b"", "budget": budget, "scheme": "field"}
    outcome = mark_files.mark_file(source, out, tmp_path / "out.json", **options)
    assert outcome.values["notes"][0].startswith(TIGHT)
    assert any(line.startswith(TIGHT) for line in outcome.lines)


@pytest.mark.slow
def test_several_marks_name_the_limit_as_well(thin):
    limits = {largest_stretch: 0.2}
    marker = CombinedMarker(jm.make_marker(thin.original.mesh, thin.key, bits=0), (thin.scheme,))
    (note,) = marker.embed(b"", jm.Budget(limits=limits), read_back="never")[1].notes
    assert note.startswith("The limit of largest_stretch, 0.2, allows only ")


@pytest.mark.parametrize(
    ("claim", "sign", "fields"),
    [
        (MESSAGE, 1, (MESSAGE, MESSAGE, None)),
        (bytes(4), 1, (MESSAGE, bytes(4), None)),
        (None, 1, (MESSAGE, None, None)),
        (MESSAGE, 0, (None, MESSAGE, None)),
        (None, 0, (None, None, None)),
    ],
)
def test_a_blind_detection_has_its_claim(monkeypatch, claim, sign, fields):
    """A suspect whose values fit the message, or nothing."""
    word = sign * reading.codeword(MESSAGE, CHOICES)
    view = SimpleNamespace(pose=None, width=WIDTH, undone=0, by_hint=False, mirrored=[False], values=np.zeros(1))
    phases = reading.Phases(view, 0, 1e-3, np.zeros(7), 0.0, word, *[len(word)] * 3)  # pyright: ignore[reportArgumentType]
    claimed = reading._Claim(CHOICES, 32, claim, None)
    found = reading._weigh([phases], SCHEME, claimed, 1, 0, 1.0)
    assert (found.message, found.claimed, found.recorded) == fields
    assert found.premises == "key, message and options"
    assert (found.log10_p < -6) == (sign == 1)


@pytest.mark.parametrize("omitted", [1.0, 2.5])
def test_tags_of_omitted_widths_and_steps_are_charged(omitted: float):
    """They may have been compared before, by whoever left them out."""
    word = np.sign(np.random.default_rng(0).normal(size=512))
    word[:480] = reading.codeword(MESSAGE, CHOICES)[:480]
    view = SimpleNamespace(pose=None, width=WIDTH, undone=0, by_hint=False, mirrored=[False], values=np.zeros(1))
    phases = reading.Phases(view, 0, 1e-3, np.zeros(7), 0.0, 1e-3 * word, 512, 512, 512.0)  # pyright: ignore
    claimed = reading._Claim(CHOICES, 32, None, None)
    found = reading._weigh([phases], SCHEME, claimed, 1, 2, omitted)
    assert found.message == MESSAGE
    charges = {charge.choice: charge.log10 for charge in found.evidence.charges}
    assert charges["tag rank"] == pytest.approx(math.log10(math.ceil(omitted * 3)))


def test_a_marker_refuses_claims_of_another_size(shape: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match="bits"):
        make_blind_marker(shape, key, bits=32, scheme=SCHEME).detect(shape, bytes(11))
