import dataclasses
import math
import pickle
from functools import partial

import jax
import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark import distortion
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.watermark.carriers import KeyedReader
from jaxmark.watermark.evidence import bounds, ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.markers import NonBlindMarker, unite
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from jaxmark.watermark.schemes.registry import get_nonblind, make_scheme
from tests.samples import bumpy_sphere, exact_sheet

MESSAGE = bytes.fromhex("0123456789abcdef")
SCHEMES = ["keyed", "host", "eigen"]


#: All schemes; `host` takes long to compile.
MOSTLY_QUICK = [pytest.param(name, marks=pytest.mark.slow if name == "host" else ()) for name in SCHEMES]


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    """2562 vertices: enough for 64 bits by each scheme."""
    return bumpy_sphere(4)


@pytest.mark.parametrize(
    ("scheme", "dtype"),
    [
        ("keyed", "float32"),
        ("keyed", "float64"),
        pytest.param("host", "float32", marks=pytest.mark.slow),
        pytest.param("eigen", "float32", marks=pytest.mark.slow),
    ],
    indirect=["dtype"],
)
def test_round_trip_within_the_budget(sphere: Mesh, key: jm.Key, scheme, dtype):
    marked, info = jm.embed(sphere, MESSAGE, key, budget=7e-4, scheme=scheme)
    length = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    shift = np.linalg.norm(marked.vertices - sphere.vertices, axis=1) / length
    assert np.sqrt(np.mean(shift**2)) == pytest.approx(7e-4, rel=1e-9)
    assert info.rms == pytest.approx(7e-4, rel=1e-9)
    assert info.max == pytest.approx(shift.max(), rel=1e-9)
    found = jm.detect(marked, original=sphere, key=key, scheme=scheme)
    assert found.message == MESSAGE
    assert found.detected()
    assert found.coverage == 1.0
    marker = jm.make_marker(sphere, key, bits=64, scheme=scheme)
    soft, code = marker.soft_decisions(marker.receive(marker.register(marked))), marker.codeword(MESSAGE)
    assert np.mean(soft * code) > 0.85 * np.sqrt(np.mean(soft**2))
    assert np.mean(found.scores * code) > 0.7  # of what mere correlations read, where they do
    claimed = jm.detect(marked, original=sphere, key=key, scheme=scheme, message=MESSAGE)
    assert claimed.log10_p < -6
    assert jm.detect(marked, original=sphere, key=key, scheme=scheme, message=b"somebody").notes
    assert jm.detect(marked, original=sphere, key=jm.new_key(), scheme=scheme, message=MESSAGE).log10_p > -6


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES)
def test_precisions_read_each_other(sphere: Mesh, key: jm.Key, scheme):
    marked, _ = jm.embed(sphere, MESSAGE, key, scheme=scheme)
    with jax.enable_x64(True):
        assert jm.detect(marked, original=sphere, key=key, scheme=scheme).message == MESSAGE
        doubly, _ = jm.embed(sphere, MESSAGE, key, scheme=scheme)
    assert jm.detect(doubly, original=sphere, key=key, scheme=scheme).message == MESSAGE
    np.testing.assert_allclose(doubly.vertices, marked.vertices, atol=1e-5)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_reading_back_means_the_message(sphere: Mesh, key: jm.Key, scheme):
    marker = jm.make_marker(sphere, key, bits=64, scheme=scheme)
    marked, _ = marker.embed(MESSAGE, 8e-4, read_back="never")
    assert marker.reads(marked, MESSAGE)
    assert not marker.reads(marked, b"somebody")
    assert not marker.reads(sphere, MESSAGE)
    with pytest.raises(jm.JaxmarkError, match="does not read back"):
        marker.check(sphere, MESSAGE)


def test_reading_back_decodes_jointly_where_plain_correlations_fail(sphere: Mesh, key: jm.Key, monkeypatch):
    marker = jm.make_marker(sphere, key, bits=64)
    marked, _ = marker.embed(MESSAGE, 8e-4, read_back="never")
    monkeypatch.setattr(KeyedReader, "read_quickly", lambda *_: np.zeros(marker.code_bits))
    assert marker.reads(marked, MESSAGE)


def test_what_correlations_read_is_not_decoded_jointly_and_is_paid_for(sphere: Mesh, key: jm.Key, monkeypatch):
    marker = jm.make_marker(sphere, key, bits=64)
    marked, _ = marker.embed(MESSAGE, 8e-4, read_back="never")
    flat = bounds.log10_p_tag(28)
    monkeypatch.setattr(bounds, "log10_p_score", lambda *_: 0.0)  # what the tag alone proves is left
    with monkeypatch.context() as without:
        without.setattr(NonBlindMarker, "soft_decisions", None)
        quick = marker.detect(marked)
    monkeypatch.setattr(KeyedReader, "correlate", lambda *_: np.zeros(marker.code_bits))
    slow = marker.detect(marked)
    assert quick.message == slow.message == MESSAGE
    paid = flat + math.log10(3) - math.log10(0.97)  # three proofs, and the usual way to align
    assert quick.log10_p == pytest.approx(paid - math.log10(0.03))
    assert slow.log10_p == pytest.approx(paid - math.log10(0.97))


def test_golden_displacement(key: jm.Key):
    """Held within a tolerance, for ever: the same mark on the same mesh."""
    mesh = exact_sheet(20)
    for scheme, message, golden in [
        (
            KeyedScheme(hiding=False),
            b"\xc0",
            [[35.54, 5.6, -13.101], [-9.46, 3.277, -7.756], [3.14, 19.241, -12.517], [18.833, 11.017, -13.563]],
        ),
        (
            KeyedScheme(direction="normals"),
            b"\xc0",
            [[8.556, 7.762, -18.164], [0.802, 0.624, 4.384], [-0.182, -1.225, -3.372], [6.89, 1.826, 25.776]],
        ),
        (
            KeyedScheme(passband="narrow", hiding=False),
            b"\xc0",
            [[29.006, -8.459, -15.871], [-3.116, -7.197, 7.82], [23.682, 3.948, 19.709], [0.086, 4.778, 2.17]],
        ),
        (
            KeyedScheme(direction="normals", passband="narrow"),
            b"\xc0",
            [[8.617, 7.818, -18.295], [3.866, 3.008, 21.121], [1.101, 7.392, 20.353], [5.586, 1.481, 20.897]],
        ),
        (
            HostScheme(bands=64),
            b"\xc0\xff\xee",
            [[-89.082, -27.801, -7.191], [-2.366, 0.935, -1.696], [26.648, -34.817, 15.422], [-9.928, 1.983, 21.067]],
        ),
        (
            EigenScheme(pairs=32),
            b"\xc0\xff\xee",
            [[6.397, -12.153, 5.439], [3.347, -10.355, -7.451], [11.272, -2.998, -28.597], [26.783, -1.374, -1.441]],
        ),
    ]:
        marker = jm.make_marker(mesh, key, bits=8 * len(message), scheme=scheme)
        marked, _ = marker.embed(message, jm.Budget(rms=8e-4, noise=0.0))
        shift = 1e3 * (marked.vertices - mesh.vertices)[[0, 50, 100, 150]]
        np.testing.assert_allclose(shift, golden, atol=0.02)


@pytest.mark.parametrize("scheme", MOSTLY_QUICK)
def test_a_mark_far_from_the_origin_and_at_any_scale(key: jm.Key, scheme):
    sphere = bumpy_sphere(4)
    for factor, offset in ((1e-20, 0.0), (1e20, 0.0), (1.0, 1e6)):
        mesh = make_mesh(factor * sphere.vertices + offset, sphere.faces)
        marked, info = jm.embed(mesh, MESSAGE, key, scheme=scheme, budget=8e-4)
        assert info.rms == pytest.approx(8e-4, rel=1e-6)
        assert jm.detect(marked, original=mesh, key=key, scheme=scheme).message == MESSAGE


@pytest.mark.slow
def test_copies_move_together_and_isolated_vertices_stay(sphere: Mesh, key: jm.Key):
    soup = make_mesh(
        np.vstack([sphere.vertices[sphere.faces].reshape(-1, 3), [[7.0, 7, 7]]]),
        np.arange(3 * len(sphere.faces)).reshape(-1, 3),
    )
    marked, info = jm.embed(soup, MESSAGE, key)
    np.testing.assert_array_equal(marked.vertices[-1], [7, 7, 7])
    points: dict[tuple, tuple] = {}
    for before, after in zip(soup.vertices, marked.vertices, strict=True):
        assert points.setdefault(tuple(before), tuple(after)) == tuple(after)
    assert len(points) == len(sphere.vertices) + 1
    assert len(set(points.values())) == len(points)
    shift = (np.array(list(points.values())) - np.array(list(points)))[:-1]  # the last is the isolated vertex
    length = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    assert np.sqrt((shift**2).sum(1).mean()) / length == pytest.approx(info.rms, rel=1e-9)
    # Copies that an attack moved apart are averaged: each corner of the soup gets noise of its own.
    noise = 5e-4 * length * np.random.default_rng(0).uniform(-1, 1, soup.vertices.shape)
    assert jm.detect(marked._replace(vertices=marked.vertices + noise), original=soup, key=key).message == MESSAGE


def test_a_suspect_is_not_welded_by_its_own_positions(sphere: Mesh, key: jm.Key):
    """Coarse quantisation makes vertices coincide; the original's weld map decides."""
    marked, _ = jm.embed(sphere, b"\x5a", key, budget=5e-3)
    coarse = jm.attack(marked, "quantisation", 5, seed=0)
    assert len(np.unique(coarse.vertices, axis=0)) < len(sphere.vertices)
    assert jm.detect(coarse, original=sphere, key=key, bits=8, message=b"\x5a").detected()


def test_moving_the_suspect_changes_nothing(sphere: Mesh, key: jm.Key):
    marked, _ = jm.embed(sphere, MESSAGE, key)
    moved = marked._replace(vertices=marked.vertices + np.array([3.0, -2.0, 1.0]))
    assert jm.detect(moved, original=sphere, key=key).message == MESSAGE


def test_an_unmoved_suspect_is_no_evidence(sphere: Mesh, key: jm.Key):
    for message in (None, MESSAGE):
        found = jm.detect(sphere, original=sphere, key=key, message=message)
        assert found.log10_p == 0.0
        assert found.message is None
        np.testing.assert_array_equal(found.scores, 0)


@pytest.mark.slow
def test_hard_graph_is_marked(key: jm.Key):
    """Several components, a boundary, an edge with three faces, degenerate and duplicate faces, isolated vertices."""
    a, b = bumpy_sphere(4), bumpy_sphere(2, seed=1)
    vertices = np.vstack([a.vertices, b.vertices + 4, [[0.0, 0, 0], [1, 1, 1]]])
    faces = np.vstack([a.faces[:-30], a.faces[:2], [[0, 0, 1], [5, 5, 5], [3, 77, 200]], b.faces + len(a.vertices)])
    mesh = make_mesh(vertices, faces)
    for scheme in SCHEMES:
        marked, _ = jm.embed(mesh, MESSAGE, key, scheme=scheme)
        assert jm.detect(marked, original=mesh, key=key, scheme=scheme).message == MESSAGE


@pytest.mark.slow
def test_vertices_that_no_face_uses_neither_move_nor_count(sphere: Mesh, key: jm.Key):
    far = np.random.default_rng(0).normal(size=(5000, 3)) + 1e5
    mesh = make_mesh(np.vstack([sphere.vertices, far]), sphere.faces)
    marked, info = jm.embed(mesh, MESSAGE, key, budget=8e-4)
    length = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    shift = np.linalg.norm(marked.vertices - mesh.vertices, axis=1) / length
    np.testing.assert_array_equal(shift[2562:], 0)
    assert np.sqrt(np.mean(shift[:2562] ** 2)) == pytest.approx(8e-4, rel=1e-6)
    assert info.rms == pytest.approx(8e-4, rel=1e-9)
    assert distortion.displacement_size(mesh, marked).rms == pytest.approx(8e-4, rel=1e-9)
    thrown = marked._replace(vertices=np.where(np.arange(len(shift))[:, None] < 2562, marked.vertices, 1e200))
    assert jm.detect(thrown, original=mesh, key=key).message == MESSAGE


def test_a_claim_is_refuted_by_another_message(sphere: Mesh, key: jm.Key):
    marked, _ = jm.embed(sphere, MESSAGE, key)
    near = bytes([MESSAGE[0] ^ 1]) + MESSAGE[1:]
    found = jm.detect(marked, original=sphere, key=key, message=near)
    assert found.message == MESSAGE
    # That the key's mark is there stays proven, by the message that reads.
    read = jm.detect(marked, original=sphere, key=key)
    assert read.log10_p < found.log10_p < -6
    assert "Another message of this key was decoded than the one claimed" in found.notes[0]


def test_the_mean_of_two_copies_shows_both(sphere: Mesh, key: jm.Key):
    """One message refutes the claim of the other, but not that the mark is there; "both" is an estimate."""
    marker = jm.make_marker(sphere, key, bits=16)
    copies = [marker.embed(message, 2e-3)[0] for message in (b"ab", b"cd")]
    mean = sphere._replace(vertices=(0.55 * copies[0].vertices + 0.45 * copies[1].vertices))
    found = marker.detect(mean, b"cd")
    assert found.message == b"ab"
    assert found.detected()
    both = float(found.notes[0].partition("log10 p about ")[2].split()[0])
    assert both < -3
    absent = marker.detect(copies[0], b"cd")
    assert float(absent.notes[0].partition("log10 p about ")[2].split()[0]) > -3


def test_a_vertex_thrown_away_is_masked(sphere: Mesh, key: jm.Key):
    marked, _ = jm.embed(sphere, MESSAGE, key)
    thrown = marked._replace(vertices=marked.vertices.copy())
    thrown.vertices[7, 1] = 1e60
    found = jm.detect(thrown, original=sphere, key=key)
    assert found.message == MESSAGE
    assert found.coverage == pytest.approx(1 - 1 / len(sphere.vertices))


def test_a_used_marker_is_stored_and_writes_the_same(sphere: Mesh, key: jm.Key):
    marker = jm.make_marker(sphere, key, bits=48, scheme="host")
    marked, info = marker.embed(b"stored")
    again, same = pickle.loads(pickle.dumps(marker)).embed(b"stored")
    np.testing.assert_array_equal(again.vertices, marked.vertices)
    assert same.record == info.record


@pytest.mark.parametrize("name", ["field", "local", "rooted"])
def test_blind_marks_are_not_read_with_the_original(name, sphere: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match=f"scheme '{name}' are read without the original: leave it out"):
        jm.make_marker(sphere, key, scheme=name)


def test_record_binds_and_remembers(sphere: Mesh, key: jm.Key, tmp_path):
    scheme = HostScheme(bands=128, damping="lanczos")
    marked, info = jm.embed(sphere, b"record", key, scheme=scheme)
    path = tmp_path / "record.json"
    path.write_text(info.record.to_json())
    assert key.hex() not in path.read_text()
    assert b"record".hex() not in path.read_text()
    record = jm.Record.load(path)
    assert record == info.record
    assert jm.detect(marked, original=sphere, key=key, record=record).message == b"record"
    for change, sentence in [
        ({"key": jm.new_key()}, "key is not the one"),
        ({"original": marked}, "not the mesh that the record"),
        ({"bits": 64}, "The record is of a payload of 48 bits"),
        ({"message": b"longer than that"}, "the payload is 48"),
        ({"scheme": EigenScheme()}, "record, whose scheme is 'host'"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.detect(marked, **{"original": sphere, "key": key, "record": record, **change})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        "not json",
        '{"format": "jaxmark-record", "version": 99}',
        '{"format": "jaxmark-record", "version": 1, "scheme": 3}',
    ],
)
def test_damaged_records_are_refused(tmp_path, text):
    path = tmp_path / "record.json"
    path.write_text(text)
    with pytest.raises(jm.JaxmarkError, match="record"):
        jm.Record.load(path)
    with pytest.raises(jm.JaxmarkError, match="cannot be read"):
        jm.Record.load(tmp_path / "absent")


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh, key: jm.Key):
    tiny = make_mesh(np.vstack([np.eye(3), [[0, 0, 0]]]), np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    nan = sphere._replace(vertices=np.where(sphere.vertices > 1, np.nan, sphere.vertices))
    for mesh, message, options, sentence in [
        (tiny, MESSAGE, {}, "code bits, too few for any message"),
        (
            bumpy_sphere(2),
            MESSAGE,
            {"budget": jm.Budget(noise=0.005)},
            r"\(162 points\) carries no message .* Use a presence mark",
        ),
        (bumpy_sphere(1), MESSAGE, {"scheme": "eigen"}, r"\(42 points\) cannot carry a message of 64 bits"),
        (nan, MESSAGE, {}, "not a finite number"),
        (sphere, MESSAGE, {"budget": 0}, "budget"),
        (sphere, MESSAGE, {"budget": float("nan")}, "budget"),
        (sphere, MESSAGE, {"budget": jm.Budget(rms=1e-300, noise=0)}, "lost in the rounding"),
        (sphere, "text", {}, "A message is bytes, got str"),
        (sphere, MESSAGE, {"scheme": "magic"}, "keyed, host, eigen"),
        (sphere, bytes(60), {"scheme": "host"}, "at most 224 bits"),
        (sphere, MESSAGE, {"budget": jm.Budget(rms=1e-4, noise=0.005)}, r"budget of at least 0\.000"),
        (sphere._replace(vertices=0 * sphere.vertices), MESSAGE, {}, "diagonal"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.embed(mesh, message, key, **options)
    with pytest.raises(jm.JaxmarkError, match="noise"):
        jm.Budget(noise=-1.0)
    for bad in (b"short", 32, "x" * 32):
        with pytest.raises(jm.JaxmarkError, match="32 bytes"):
            jm.embed(sphere, MESSAGE, bad)  # type: ignore[arg-type]
    other = bumpy_sphere(2)
    for suspect, align, sentence in (
        (other, "auto", "could not be aligned"),
        (other, "same", "does not share"),
        (sphere._replace(faces=sphere.faces[::-1]), "same", "does not share"),
    ):
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.detect(suspect, original=sphere, key=key, align=align)
    with pytest.raises(jm.JaxmarkError, match="multiple of 8"):
        jm.detect(sphere, original=sphere, key=key, bits=7)
    jm.embed(bumpy_sphere(2), b"", key, budget=jm.Budget(noise=0.005))  # the presence mark that is advised


def test_schemes_are_data():
    for scheme in (KeyedScheme(direction="normals"), HostScheme(), EigenScheme(pairs=10)):
        again = make_scheme(scheme.name, dataclasses.asdict(scheme))
        assert again == scheme
    # Records from before pass bands were tapered do not say so.
    assert make_scheme("keyed", {"bands": 64}) == KeyedScheme(passband="narrow", hiding=False)
    assert get_nonblind("keyed") == KeyedScheme(passband="tapered", hiding=True)
    for parameters in ({"bands": "many"}, {"colour": 1}):
        with pytest.raises(jm.JaxmarkError, match="takes the parameters bands"):
            make_scheme("host", parameters)


def test_narrow_bands_stay_where_old_marks_have_them(sphere: Mesh):
    """Also where 31 % of the bands is not 20/64 of them."""
    original = make_original(sphere)
    for bands, passing in {32: 10, 64: 20, 256: 79, 400: 124}.items():
        assert KeyedScheme(bands=bands, passband="narrow").layout(original, 8).passing == passing


def test_displacements_are_relative_to_the_diagonal(sphere: Mesh):
    moved = sphere._replace(vertices=sphere.vertices.copy())
    moved.vertices[3] += [0.3, 0.4, 0]
    length = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    found = distortion.displacement_size(sphere, moved)
    assert found.max == pytest.approx(0.5 / length)
    assert found.rms == pytest.approx(0.5 / length / np.sqrt(len(sphere.vertices)))


def test_distortions_have_finite_gradients_at_zero(dtype):
    zero = jax.numpy.zeros((5, 3), dtype)
    for metric in (distortion.rms, distortion.maximum):
        np.testing.assert_array_equal(jax.grad(lambda d, m=metric: m(d))(zero), 0)
        one = zero.at[2, 1].set(3.0)
        assert metric(one).dtype == dtype
    assert float(distortion.maximum(one)) == 3.0
    assert float(distortion.rms(one)) == pytest.approx(3 / np.sqrt(5))


def test_a_record_is_of_the_scheme_that_wrote_it(sphere: Mesh, key: jm.Key, tmp_path):
    """Also once its tuples have been through JSON, and where it lacks what schemes had not then."""
    scheme, path = KeyedScheme(profile=(1.0, 0.5) * 10), tmp_path / "record.json"
    record = jm.make_marker(sphere, key, bits=48, scheme=scheme).embed(b"record")[1].record
    path.write_text(record.to_json())
    make = partial(jm.make_marker, sphere, key)
    assert make(record=jm.Record.load(path), scheme=scheme).scheme == scheme
    parameters = {name: value for name, value in record.parameters.items() if name != "passband"}
    old = dataclasses.replace(record, parameters=parameters).sealed(key)
    narrow = dataclasses.replace(scheme, passband="narrow")
    assert make(record=old, scheme=narrow).scheme == make(record=old).scheme == narrow
    with pytest.raises(jm.JaxmarkError, match="record is of the scheme 'keyed'"):
        make(record=old, scheme=scheme)


def test_trained_strengths_make_a_scheme(sphere: Mesh, key: jm.Key):
    """As many as the carrier has bands, from an array; the record has them, and reading needs nothing else."""
    usual = NonBlindMarker.make(make_original(sphere), key, KeyedScheme(), 16)
    bands = len(usual.carrier.host.coefficients)  # pyright: ignore[reportAttributeAccessIssue]
    scheme = KeyedScheme().with_profile(jax.numpy.linspace(1, 0.1, bands))
    marked, info = jm.embed(sphere, b"ok", key, budget=jm.Budget(rms=8e-4, noise=0), scheme=scheme)
    carrier = jm.make_marker(sphere, key, record=info.record).carrier
    np.testing.assert_allclose(carrier.profile, np.linspace(1, 0.1, bands), rtol=1e-6)  # pyright: ignore
    assert len(carrier.host.coefficients) == bands  # pyright: ignore[reportAttributeAccessIssue]
    assert jm.detect(marked, original=sphere, key=key, record=info.record).message == b"ok"
    for wrong in (np.ones(65), np.ones((2, 3)), np.array([]), np.array([1, np.nan]), np.array([1, -1]), np.zeros(3)):
        with pytest.raises(jm.JaxmarkError, match="A profile is"):
            scheme.with_profile(wrong)


@pytest.mark.slow
def test_a_remeshed_suspect_of_a_shape_that_is_its_own_mirror_image(key: jm.Key):
    """Its surface does not tell whether it was mirrored: both ways are read, and paid for."""
    ball = trimesh.creation.icosphere(4)
    x, y, z = ball.vertices.T
    radius = 1 + 0.15 * np.sin(4 * y) + 0.1 * np.cos(3 * z + 1) + 0.2 * x**2 * np.sin(5 * z) + 0.02 * np.cos(9 * y + z)
    mesh = make_mesh(ball.vertices * radius[:, None], ball.faces)
    marker = jm.make_marker(mesh, key, bits=16)
    suspect = jm.attack(marker.embed(b"ok", 2e-3)[0], "midpoint", 1, seed=0)
    mirrored = make_mesh(np.asarray(suspect.vertices) * [-1, 1, 1], np.asarray(suspect.faces)[:, ::-1])
    plain, other = marker.detect(suspect), marker.detect(mirrored)
    assert plain.message == other.message == b"ok"
    assert plain.registration.pose.mirrors != other.registration.pose.mirrors
    assert other.log10_p == pytest.approx(plain.log10_p, rel=0.1)


def test_marks_of_different_messages_are_not_united(sphere: Mesh, key: jm.Key):
    def found(scheme: str, message: bytes | None, log10_p: float, claimed: bytes | None = None) -> Detection:
        evidence = Evidence(log10_p, log10_p, log10_p)
        return Detection(message, evidence, None, np.zeros(1), None, scheme, claimed=claimed)

    _, info = jm.embed(sphere, b"ok", key, budget=2e-3)
    mark = jm.make_marker(sphere, key, record=info.record)
    keyed, local = found("keyed", b"ok", -20.0), found("local", b"no", -10.0)
    both = unite(mark, keyed, [local])
    assert both.log10_p == unite(mark, keyed, [found("local", None, 0.0)]).log10_p > -20
    assert (both.message, both.scheme) == (b"ok", "keyed")
    assert "'local' has another message, and is not counted" in both.notes[-1]
    assert unite(mark, keyed, [local._replace(message=b"ok")]).log10_p < -25

    # The claim is what the evidence is about, even if it was not decoded.
    claim = found("keyed", None, -5.0, claimed=b"ok")
    assert unite(mark, claim, [local._replace(claimed=b"ok")]).message is None
    assert unite(mark, claim, [found("local", b"ok", -10.0, claimed=b"ok")]).message == b"ok"

    alone = unite(mark, found("keyed", None, 0.0), [local])
    assert (alone.message, alone.scheme, alone.recorded) == (b"no", "local", False)
    assert ledger.MARKS_MESSAGE.charge("another") in alone.evidence.charges
    assert alone.evidence.charges[0] == ledger.BESIDE.charge("local")
    assert unite(mark, keyed, []).evidence.charges[0] == ledger.BESIDE.charge("none")
    assert ledger.is_charged_along_a_path(alone.evidence.charges)
    assert "another message than the one in the record" in alone.notes[-1]
