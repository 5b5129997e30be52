"""A record binds all that reading uses: nobody can edit it, and its owner only pays for editing it."""

import dataclasses
import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.watermark.coding.keys import Choices, bind
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.ledger import figure
from jaxmark.watermark.record import SceneRecord, TimestampedCommitment, commit, load_record, make_commitment
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.geometry.test_imprint import COPIES
from tests.samples import bumpy_sphere

MESSAGE = b"ok"
PROFILE = (0.0, *(1.0,) * 20, 0.5, 0.5)


@pytest.fixture(scope="module")
def original() -> Mesh:
    return bumpy_sphere(3)


@pytest.fixture(scope="module")
def marked(original: Mesh, key: jm.Key) -> tuple[Mesh, jm.Record]:
    scheme = KeyedScheme(profile=PROFILE)
    mesh, info = jm.embed(original, MESSAGE, key, budget=jm.Budget(rms=2e-3, noise=0), scheme=scheme)
    return jm.attack(mesh, "noise", 0.002, seed=0), info.record


def edits(record: jm.Record) -> dict[str, jm.Record]:
    """The record with one field changed, each in turn."""
    other = {
        "scheme": "host",
        "bits": 24,
        "beta": record.beta * (1 + 1e-15),
        "original": "00" * 32,
        "parameters": {**record.parameters, "profile": (*PROFILE[:-1], np.nextafter(0.5, 1))},
        "version": 3,
        "message_commitment": "00" * 32,
        "imprint": {**record.imprint, "grid": 2 * record.imprint["grid"]},
        "code": "00" * 32,
    }
    changed = {name: dataclasses.replace(record, **{name: value}) for name, value in other.items()}
    for name in ("centre", "covariance", "order", "tags"):
        value = record.imprint[name][:-4] + "AAA=" if name == "tags" else [0.0] * len(record.imprint[name])
        value = "00" * 32 if name == "order" else value
        changed[f"imprint/{name}"] = dataclasses.replace(record, imprint={**record.imprint, name: value})
    changed["parameters/unknown"] = dataclasses.replace(record, parameters={**record.parameters, "more": 1})
    return changed


FIELDS = ["scheme", "bits", "beta", "original", "parameters", "version", "message_commitment", "imprint", "code"]
FIELDS += ["imprint/centre", "imprint/covariance", "imprint/order", "imprint/tags", "parameters/unknown"]


@pytest.mark.parametrize("field", FIELDS)
def test_every_edit_of_one_field_is_refused(marked, original: Mesh, key: jm.Key, field):
    suspect, record = marked
    with pytest.raises(jm.JaxmarkError, match="The record was edited"):
        jm.detect(suspect, original=original, key=key, record=edits(record)[field])
    assert edits(record)[field].digest() != record.digest()


def test_other_edits_are_refused_too(marked, original: Mesh, key: jm.Key, tmp_path):
    _, record = marked
    with pytest.raises(jm.JaxmarkError, match="fingerprint; identify"):
        jm.make_marker(original, key, record=dataclasses.replace(record, content="fingerprint"))
    with pytest.raises(jm.JaxmarkError, match="not the one that the record commits to"):
        jm.make_marker(original, key, record=dataclasses.replace(record, key="00" * 32))
    path = tmp_path / "record.json"
    for change in ({"more": 1}, {"told": None}, {"version": 1}, {"version": 3}, {"content": "poem"}):
        path.write_text(json.dumps(json.loads(record.to_json()) | change))
        with pytest.raises(jm.JaxmarkError, match="record"):
            jm.Record.load(path)
    path.write_text(record.to_json())
    assert jm.Record.load(path).digest() == record.digest()
    assert MESSAGE.hex() not in record.to_json()


def test_the_owner_gets_other_choices_for_other_parameters(marked, original: Mesh, key: jm.Key):
    """Who has the key can write any record, but the smallest change of it makes another mark."""
    suspect, record = marked
    edited = edits(record)["parameters"].sealed(key)
    assert jm.detect(suspect, original=original, key=key, record=record, message=MESSAGE).detected()
    edited = dataclasses.replace(edited, message_commitment="").sealed(key)
    assert jm.detect(suspect, original=original, key=key, record=edited, message=MESSAGE).log10_p > -6


def test_a_record_does_not_decide_how_much_is_computed(original: Mesh, key: jm.Key):
    record = jm.make_marker(original, key, bits=16).embed(MESSAGE, jm.Budget(rms=2e-3, noise=0))[1].record
    for bands in (0, 513, 10**9):
        huge = dataclasses.replace(record, parameters={**record.parameters, "bands": bands}).sealed(key)
        with pytest.raises(jm.JaxmarkError, match="1 to 512 bands"):
            jm.make_marker(original, key, record=huge)


def test_choices_are_bound_to_everything(key: jm.Key):
    fixed = {"content": "message", "scheme": "keyed", "parameters": {"bands": 64, "profile": (0.5, 1.0)}, "bits": 64}
    base = bind(key, b"g" * 32, fixed).signs("signs", 4096).astype(int)
    others = [bind(key, b"h" * 32, fixed), bind(key, b"g" * 32, fixed | {"order": "00"})]
    for name, value in {"content": "fingerprint", "scheme": "host", "bits": 72, "more": 0}.items():
        others.append(bind(key, b"g" * 32, fixed | {name: value}))
    others.append(bind(key, b"g" * 32, fixed | {"parameters": {"bands": 64, "profile": (0.5, 1.0 + 2**-52)}}))
    for other in others:
        assert abs(base @ other.signs("signs", 4096)) < 6 * 64  # 6 standard deviations
    listed = fixed | {"parameters": {"profile": [0.5, 1.0], "bands": 64}}  # as JSON has it
    np.testing.assert_array_equal(bind(key, b"g" * 32, listed).signs("signs", 4096), base)
    with pytest.raises(jm.JaxmarkError, match="bound to"):
        bind(key, b"g" * 32, fixed | {"bits": float("nan")})


@pytest.mark.parametrize("name", ["float32", "turned and reordered", "unwelded"])
def test_an_original_that_was_saved_again_will_do(marked, original: Mesh, key: jm.Key, name):
    suspect, record = marked
    exact = jm.detect(suspect, original=original, key=key, record=record)
    found = jm.detect(suspect, original=COPIES[name](original), key=key, record=record)
    assert found.message == exact.message == MESSAGE
    assert found.log10_p == pytest.approx(exact.log10_p, rel=0.1)
    assert found.evidence.caveats == ()


def test_what_is_presented_is_never_read_with(marked, original: Mesh, key: jm.Key):
    """An original moved against the mark, within the tolerance, reads as the exact one does, bit for bit."""
    suspect, record = marked
    markers = [jm.make_marker(one, key, record=record) for one in (original, COPIES["six digits"](original))]
    one, other = (marker.original for marker in markers)
    assert one.geometry == other.geometry
    np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(one.signal, other.signal)
    assert markers[0].detect(suspect).log10_p == markers[1].detect(suspect).log10_p


def test_the_order_of_an_original_is_no_choice(original: Mesh, key: jm.Key):
    """Whoever could turn the corners of a soup when the suspect is known would choose what is compared with what."""
    faces = np.asarray(original.faces)
    corners = np.arange(faces.size).reshape(-1, 3)
    soup = make_mesh(np.asarray(original.vertices)[faces].reshape(-1, 3), corners)
    marker = jm.make_marker(soup, key, bits=16)
    marked, info = marker.embed(MESSAGE, jm.Budget(rms=2e-3, noise=0))
    best = (corners // 3 * 3 + (np.arange(3) + np.random.default_rng(0).integers(3, size=(len(faces), 1))) % 3).ravel()
    crafted = make_mesh(np.asarray(soup.vertices)[best], corners)
    turned = jm.make_marker(crafted, key, record=info.record)
    np.testing.assert_array_equal(turned.original.positions, marker.original.positions)
    assert not turned.original.in_order
    # In whatever order the file is, the same points are compared.
    found = turned.detect(marked)
    assert found.message == MESSAGE
    assert found.registration.method != "same"
    with pytest.raises(jm.JaxmarkError, match="order of vertices in the original's file differs"):
        turned.detect(marked, align="same")
    # Without the record, another order has other choices.
    assert jm.make_marker(crafted, key, bits=16).choices.context != marker.choices.context
    assert jm.detect(marked, original=crafted, key=key, message=MESSAGE).log10_p > -6


def test_an_edited_original_gives_an_estimate_and_others_are_refused(marked, original: Mesh, key: jm.Key):
    suspect, record = marked
    dented = np.where(original.vertices[:, :1] > 0.8, 1.01 * original.vertices, original.vertices)
    found = jm.detect(suspect, original=Mesh(dented, original.faces), key=key, record=record, message=MESSAGE)
    assert found.detected(allow_estimate=True)
    assert not found.detected()
    assert "the original was edited" in found.evidence.caveats[0]
    with pytest.raises(jm.JaxmarkError, match="was edited since it was marked"):
        jm.make_marker(Mesh(dented, original.faces), key, record=record).embed(MESSAGE)
    with pytest.raises(jm.JaxmarkError, match="looks like the marked file"):
        jm.detect(suspect, original=suspect, key=key, record=record)
    with pytest.raises(jm.JaxmarkError, match="their shapes differ by"):
        jm.detect(suspect, original=bumpy_sphere(3, seed=5), key=key, record=record)


def test_the_record_commits_to_the_message(marked, original: Mesh, key: jm.Key):
    suspect, record = marked
    with pytest.raises(jm.JaxmarkError, match="commits to another message"):
        jm.detect(suspect, original=original, key=key, record=record, message=b"no")
    # A message that the record committed to counts as claimed, without paying for all others.
    without = jm.detect(
        suspect, original=original, key=key, record=dataclasses.replace(record, message_commitment="").sealed(key)
    )
    assert jm.detect(suspect, original=original, key=key, record=record).log10_p < without.log10_p
    choices = Choices(key, b"c" * 32)
    assert commit(b"a", choices) != commit(b"b", choices) != commit(b"b", Choices(key, b"d" * 32))


def test_who_dates_nothing_pays_for_all_messages(marked, original: Mesh, key: jm.Key):
    """The best message can be decoded in one go, however many there are, and a record can be made for it."""
    suspect, record = marked
    noisy = jm.attack(suspect, "noise", 0.005, seed=1)
    for claimed in (MESSAGE, None):
        found = jm.detect(noisy, original=original, key=key, record=record, message=claimed)
        assert -70 < found.log10_p < -30
        assert found.evidence.log10_p_uncommitted == pytest.approx(found.log10_p + (16 + 64) * np.log10(2), abs=0.2)


def test_weights_detectors_and_schemes_of_ones_own_make_no_proof(marked, original: Mesh, key: jm.Key):
    suspect, record = marked
    weights = np.ones(len(original.vertices))
    assert jm.detect(suspect, original=original, key=key, record=record, weights=weights).evidence.caveats
    from jaxmark.watermark.reading.detectors import correlate

    assert jm.make_marker(original, key, record=record, detector=correlate).caveats


def test_deposits_date_records(marked, original: Mesh, key: jm.Key, tmp_path: Path):
    _, record = marked
    others = [f"{number:064x}" for number in range(6)]
    deposit = make_commitment([*others, record.digest(), others[0]])
    assert len(deposit.digests) == 7

    def charged(dated: TimestampedCommitment, one: jm.Record, *, claimed: bool) -> float:
        return figure(-20.0, dated.charges(one, claimed=claimed))

    assert charged(deposit, record, claimed=True) == pytest.approx(-20 + np.log10(7))
    first = dataclasses.replace(record, message_commitment="")
    dated = make_commitment([first.digest()])
    assert charged(dated, first, claimed=True) == pytest.approx(-20 + 16 * np.log10(2)), "it commits to none"
    assert charged(dated, first, claimed=False) == -20
    scene = SceneRecord({"a": first, "b": first})
    dated = make_commitment([scene.digest()])
    assert charged(dated, scene, claimed=True) == pytest.approx(-20 + 16 * np.log10(2)), "one message for all"
    with pytest.raises(jm.JaxmarkError, match="not in the commitment"):
        charged(make_commitment(others), record, claimed=True)
    path = tmp_path / "deposit.json"
    path.write_text(deposit.to_json())
    assert TimestampedCommitment.load(path) == deposit
    roots = {make_commitment(others[:count]).root for count in range(1, 7)} | {deposit.root}
    assert len(roots) == 7
    for text in ("", "[]", "{}", deposit.to_json().replace(deposit.root, "00" * 32), '{"digests": ["x"]}'):
        path.write_text(text)
        with pytest.raises(jm.JaxmarkError, match="not a commitment"):
            TimestampedCommitment.load(path)
    with pytest.raises(jm.JaxmarkError, match="cannot be read"):
        TimestampedCommitment.load(tmp_path / "absent")
    for bad in ([], ["xy"], ["0" * 63]):
        with pytest.raises(jm.JaxmarkError, match="at least one record digest"):
            make_commitment(bad)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("bits", -1000),
        ("bits", 12),
        ("bits", 0),
        ("bits", 2**40),
        ("beta", math.nan),
        ("beta", math.inf),
        ("beta", -1e-3),
        ("original", "ab"),
        ("key", ""),
        ("key", "é" * 64),
        ("message_commitment", "0" * 63),
        ("code", "Z" * 64),
    ],
)
def test_fields_of_records_have_ranges(marked, field: str, value, tmp_path: Path):
    _, record = marked
    with pytest.raises(jm.JaxmarkError, match=field):
        dataclasses.replace(record, **{field: value})
    data = json.loads(record.to_json())
    (tmp_path / "a.json").write_text(json.dumps({**data, {"message_commitment": "told"}.get(field, field): value}))
    with pytest.raises(jm.JaxmarkError, match=r"a\.json"):
        load_record(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("grid", 0.0),
        ("grid", 10**400),
        ("centre", [0.0, 0.0]),
        ("centre", [10**400, 0, 0]),
        ("tags", ""),
        ("order", "00"),
    ],
)
def test_imprints_have_ranges(marked, original: Mesh, key: jm.Key, field: str, value):
    _, record = marked
    forged = dataclasses.replace(record, imprint={**record.imprint, field: value}).sealed(key)
    with pytest.raises(jm.JaxmarkError, match="imprint"):
        jm.make_marker(original, key, record=forged)


@pytest.mark.parametrize(
    ("name", "second"), [("told", '"00"'), ("bits", "8"), ("format", '"x"'), ("grid", "1.0"), ("profile", "[]")]
)
def test_records_that_give_a_name_two_values_are_refused(marked, tmp_path: Path, name: str, second: str):
    """Other programs may read the first of them."""
    text = marked[1].to_json()
    assert text.count(f'"{name}":') == 1
    (tmp_path / "a.json").write_text(text.replace(f'"{name}":', f'"{name}": {second}, "{name}":'))
    with pytest.raises(jm.JaxmarkError, match=r"a\.json is damaged or forged: a name in it has two values"):
        load_record(tmp_path / "a.json")


def test_records_nested_too_deeply_are_refused(marked, tmp_path: Path):
    data = json.loads(marked[1].to_json())
    for _ in range(900):
        data["imprint"] = {"imprint": data["imprint"]}
    (tmp_path / "a.json").write_text(json.dumps(data))
    with pytest.raises(jm.JaxmarkError, match="nested too deeply"):
        load_record(tmp_path / "a.json")


def test_isolated_vertices_and_empty_faces_of_a_reordered_original_change_nothing(marked, original: Mesh, key: jm.Key):
    _, record = marked
    order = np.random.default_rng(3).permutation(len(original.vertices))
    other = jm.make_mesh(original.vertices[order], np.argsort(order)[original.faces])
    more = jm.make_mesh(
        np.vstack([other.vertices, [[0.1, 0.2, 0.3], [0.5, 0.1, 0.0]]]),
        np.vstack([other.faces, [[0, 400, 400], [642, 642, 642]]]),
    )
    one, two = (jm.make_marker(mesh, key, record=record).original for mesh in (other, more))
    assert one.geometry == two.geometry
    assert not one.in_order
    assert not two.in_order
    np.testing.assert_array_equal(one.marked_order.vertices, two.marked_order.vertices)
    np.testing.assert_array_equal(one.marked_order.faces, two.marked_order.faces)
    np.testing.assert_array_equal(one.positions, two.positions)


def test_claiming_the_recorded_message_costs_what_reading_it_does(marked, original: Mesh, key: jm.Key):
    suspect, record = marked
    found = [jm.detect(suspect, original=original, key=key, record=record, message=one) for one in (None, MESSAGE)]
    assert [charge.log10 for charge in found[1].evidence.charges if charge.choice == "proof"] == [np.log10(3)]
    assert found[0].log10_p == found[1].log10_p


def test_the_records_of_a_scene_agree(marked, tmp_path: Path):
    _, record = marked
    others = {
        "bits": dataclasses.replace(record, bits=24),
        "scheme": dataclasses.replace(record, scheme="host"),
        "content": dataclasses.replace(record, content="fingerprint"),
        "key": dataclasses.replace(record, key="0" * 64),
        "commits to a message": dataclasses.replace(record, message_commitment=""),
    }
    scene = json.loads(SceneRecord({"a": record, "b": record}).to_json())
    for wrong, other in others.items():
        for pair in ({"a": record, "b": other}, {"a": other, "b": record}):
            with pytest.raises(jm.JaxmarkError, match=wrong):
                SceneRecord(pair)
            scene["meshes"] = {name: json.loads(part.to_json()) for name, part in pair.items()}
            (tmp_path / "scene.json").write_text(json.dumps(scene))
            with pytest.raises(jm.JaxmarkError, match=r"scene\.json"):
                load_record(tmp_path / "scene.json")


def test_a_reordered_original_is_charged_and_all_orders_read_alike(marked, original: Mesh, key: jm.Key):
    suspect, record = marked
    noisy = jm.attack(suspect, "noise", 0.002, seed=0)
    usual = jm.detect(noisy, original=original, key=key, record=record)
    assert ledger.ORDER.charge("marked") in usual.evidence.charges
    found = []
    for seed in range(2):
        order = np.random.default_rng(seed).permutation(len(original.vertices))
        place = np.argsort(order)
        other = jm.make_mesh(original.vertices[order], np.roll(place[original.faces], seed, axis=1)[::-1])
        found.append(jm.detect(noisy, original=other, key=key, record=record))
        assert ledger.ORDER.charge("another") in found[-1].evidence.charges
    assert found[0].log10_p == found[1].log10_p
    without = jm.detect(noisy, original=original, key=key, bits=16)
    assert "order of the original (record)" not in {charge.choice for charge in without.evidence.charges}


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is absent")
def test_openssl_reads_the_request_for_a_date(tmp_path: Path):
    deposit = make_commitment(["ab" * 32])
    (tmp_path / "request.tsq").write_bytes(deposit.timestamp_request())
    command = ["openssl", "ts", "-query", "-in", "request.tsq", "-text"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    shown = "".join(re.findall(r"- (.*?)   ", said)).replace(" ", "").replace("-", "")
    assert shown == deposit.root
    assert "Hash Algorithm: sha256" in said
    assert "Certificate required: yes" in said


def test_isolated_vertices_in_the_marked_order_do_not_choose_a_partner(original: Mesh, key: jm.Key):
    """The hashes do not cover where they are."""
    lonely = jm.make_mesh(np.vstack([original.vertices, [[0.1, 0.2, 0.3]]]), original.faces)
    marker = jm.make_marker(lonely, key, bits=16)
    record = marker.write(marker.codeword(MESSAGE), 2e-3, content=MESSAGE)[1].record
    away = jm.make_mesh(np.vstack([original.vertices, [[150.0, 7.0, 3.0]]]), original.faces)
    found = [jm.make_marker(mesh, key, record=record).original for mesh in (lonely, away)]
    assert all(one.in_order for one in found)
    np.testing.assert_array_equal(found[0].marked_order.vertices, found[1].marked_order.vertices)
