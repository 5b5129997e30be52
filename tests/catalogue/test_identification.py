"""Which of several originals a suspect is, and whose copy."""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app.find_commands import describe
from jaxmark.catalogue import Finder, Match, Verdict, identification
from jaxmark.catalogue.descriptors import centred
from jaxmark.catalogue.identification import _Comparison
from jaxmark.catalogue.landmarks import KEPT, MOST, LandmarkIndex, landmarks
from jaxmark.catalogue.partial_registration import Part, fit_whole
from jaxmark.catalogue.pieces import split
from jaxmark.files import Scene
from jaxmark.geometry.mesh import compact
from jaxmark.watermark.coding.keys import commitment
from jaxmark.watermark.record import Record
from tests.app.test_cli import Workshop
from tests.samples import rough_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
SIZE, COUNT = 900, 5
MESSAGE = b"shop"


class Shop(NamedTuple):
    """A catalogue, its originals, and marked copies of two of them."""

    file: Path
    originals: list[jm.Mesh]
    key: jm.Key
    marked: dict[int, jm.Mesh]
    records: dict[int, Record]


def joined(*meshes: jm.Mesh) -> jm.Mesh:
    """Meshes beside each other in one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    shifts = [5.0 * np.array([place, 0, 0]) for place in range(len(meshes))]
    vertices = np.concatenate([mesh.vertices + shift for mesh, shift in zip(meshes, shifts, strict=True)])
    return jm.Mesh(vertices, np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=False)]))


def posed(mesh: jm.Mesh) -> jm.Mesh:
    """Turned, shrunk and elsewhere, with vertices and faces in another order."""
    random = np.random.default_rng(3)
    matrix, _ = np.linalg.qr(random.normal(size=(3, 3)))
    order = random.permutation(len(mesh.vertices))
    place = np.argsort(order)
    vertices = (np.asarray(mesh.vertices) @ matrix * np.sign(np.linalg.det(matrix)) * 0.3 - 2)[order]
    return jm.Mesh(vertices, place[np.asarray(mesh.faces)][random.permutation(len(mesh.faces))])


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Shop:
    """Five originals, of which two were marked with a message."""
    folder, key = tmp_path_factory.mktemp("shop"), jm.Key(bytes(range(32)))
    originals = [rough_sphere(SIZE, seed) for seed in range(COUNT)]
    with jm.Catalogue(folder / "shop.db") as catalogue:
        for number, mesh in enumerate(originals):
            jm.save_mesh(mesh, folder / f"{number}.obj")
            catalogue.add(folder / f"{number}.obj")
    made = {number: jm.embed(originals[number], MESSAGE, key, budget=0.004) for number in (1, 3)}
    marked, records = {number: made[number][0] for number in made}, {number: made[number][1].record for number in made}
    return Shop(folder / "shop.db", originals, key, marked, records)


def named(shop: Shop, suspect: jm.Mesh, *keys: jm.Key, **options) -> tuple[list[str], jm.catalogue.Verdict]:
    with jm.Catalogue(shop.file, read_only=True) as catalogue:
        verdict = catalogue.find(suspect, keys or [shop.key], bits=8 * len(MESSAGE), **options)
    return [Path(match.original).stem for match in verdict.named], verdict


def test_a_suspect_in_any_pose_is_named_with_its_message(shop: Shop):
    other = jm.Key(bytes(32))
    found, verdict = named(shop, jm.attack(posed(shop.marked[3]), "noise", 0.002, seed=0), other, shop.key)
    assert found == ["3"]
    answer = verdict.as_json()
    assert (answer["message"], answer["recipient"]) == (MESSAGE.hex(), None)
    # All originals with both keys are paid for, beside what detection with this original alone would prove.
    assert verdict.readings == 2 * COUNT
    alone = jm.detect(
        jm.attack(posed(shop.marked[3]), "noise", 0.002, seed=0), original=shop.originals[3], key=shop.key, bits=32
    )
    assert verdict.named[0].log10_p == pytest.approx(max(alone.log10_p, -77) + math.log10(2 * COUNT), abs=1e-6)
    assert verdict.named[0].key == commitment(shop.key)


def test_a_verdict_has_the_figures_of_the_original_that_it_names():
    named = Match("a.ply", "", "", "whole", 1, 0.0, named=True, log10_p=-8.0, log10_p_uncommitted=-1.0)
    caveats = ("the original was edited",)
    estimate = Match("b.ply", "", "", "whole", 1, 0.0, estimate=True, log10_p=-60.0, caveats=caveats)
    both, alone = (Verdict("", matches, 2).as_json() for matches in ((named, estimate), (estimate,)))
    assert (both["original"], both["log10_p"], both["log10_p_uncommitted"], both["caveats"]) == ("a.ply", -8, -1, ())
    assert (alone["named"], alone["log10_p"], alone["caveats"]) == (False, -60, caveats)
    assert (both["estimate"], alone["estimate"]) == (False, True)


def test_a_proof_is_preferred_to_an_estimate_and_to_nothing():
    """A record that reads nothing contradicts no record, and an estimate may have any figure."""
    mesh, match = rough_sphere(60), Match("a.ply", "", "", "whole", 1, 0.0)
    proof, estimate = match._replace(named=True, log10_p=-8.0), match._replace(estimate=True, log10_p=-60.0)
    proof_of_another_message = _Comparison(proof, mesh, mesh, 1, agrees=False)
    readings = [_Comparison(match, mesh, mesh, 1), _Comparison(estimate, mesh, mesh, 1), proof_of_another_message]
    assert min(readings, key=lambda reading: reading.order) is proof_of_another_message
    assert min(readings[:2], key=lambda reading: reading.order).match.estimate


def test_an_estimate_names_no_original_and_accuses_nobody(workshop: Workshop, monkeypatch):
    match = Match(
        "model.ply", "", "", "whole", 1, 0.0, estimate=True, estimates=("bob",), log10_p=-60.0, caveats=("c",)
    )
    monkeypatch.setattr(Finder, "find", lambda finder, suspect: Verdict("00", (match,), 1))
    shop = ("--key", "owner.key", "--catalogue", "shop.db")
    with jm.Catalogue("shop.db") as catalogue, catalogue.database.writing():
        pass
    found = workshop.json("catalogue", "find", "model.ply", *shop, status=3)
    assert (found["named"], found["estimate"], found["original"]) == (False, True, None)
    found = workshop.json("identify", "model.ply", *shop, status=3)
    assert (found["accused"], found["estimates"]) == ([], ["bob"])
    for command in (("catalogue", "find"), ("identify",)):
        status, said, _ = workshop(*command, "model.ply", *shop)
        assert status == 3
        assert said == "estimate, not a proof: model.ply, 0 % of it: copy for bob; probability about 10^-60.0: c\n"
    Path("suspects").mkdir()
    Path("model.ply").rename("suspects/model.ply")
    jm.save_mesh(rough_sphere(60), "original.obj")
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add("original.obj")
    status, said, _ = workshop("catalogue", "find", "suspects", *shop, "--output", "found.jsonl")
    assert status == 3
    assert said.endswith("model.ply: estimate, not a proof: no original is named: c\n")


def test_other_ways_of_aligning_are_charged(shop: Shop):
    suspect = jm.attack(shop.marked[3], "noise", 0.02, seed=0)
    auto, same = (named(shop, suspect, align=align)[1] for align in ("auto", "same"))
    assert -70 < auto.named[0].log10_p < -10  # not at the floor, so that what is paid shows
    assert same.named[0].log10_p == pytest.approx(auto.named[0].log10_p + math.log10(0.97 / 0.01), abs=1e-6)
    first, second = (sum(charge.log10 for charge in found.named[0].charges) for found in (auto, same))
    assert second - first == pytest.approx(math.log10(0.97 / 0.01), abs=1e-6)
    (original,) = (charge for charge in auto.named[0].charges if charge.taken == "original")
    assert original.log10 == pytest.approx(math.log10(auto.readings))
    refused = Match("3.obj", "", "", "landmarks", 1, 0.0, refused="The vertices are in another order.")
    assert "3.obj could not be read: The vertices are in another order." in describe(Verdict("", (refused,), 1), 1e-6)


def test_nobody_is_named_without_the_key_or_the_mark(shop: Shop):
    assert named(shop, shop.marked[1], jm.Key(bytes(32)), depth=1)[0] == []
    found, verdict = named(shop, shop.originals[1], depth=1)
    assert found == []
    assert verdict.matches[0].log10_p == 0
    assert Path(verdict.matches[0].original).stem == "1"


def test_small_meshes_of_a_file_are_left_out():
    small, large = rough_sphere(12), rough_sphere(60)
    many = {str(number): small._replace(vertices=(1 + number) * np.asarray(small.vertices)) for number in range(40)}
    pieces, (left_out,) = split({**many, "large": large})
    assert [piece.name for piece in pieces] == ["large"]
    assert (left_out.number, left_out.names) == (40, ("0", "1", "2", "3", "4"))
    pieces, left = split(many)
    assert pieces == []
    first, second = describe(Verdict("", (), 0, left), 1e-6)
    assert first.endswith("no mesh of the suspect is large enough to be searched")
    assert second.startswith("not searched: 40 pieces ('0', '1', '2', '3', '4', …): in a file of several meshes")
    assert "50 faces or more; to search one of them, save it as a file of its own" in second
    pieces, left = split({"only": small})
    assert ([piece.name for piece in pieces], left) == (["only"], ())


def test_no_more_than_32_pieces_are_searched():
    mesh = rough_sphere(60)
    pieces, (left_out,) = split(
        {str(n): mesh._replace(vertices=(1 + n) * np.asarray(mesh.vertices)) for n in range(40)}
    )
    assert (len(pieces), left_out.number) == (32, 8)


@pytest.mark.slow
def test_many_pieces_that_resemble_nothing_cost_little_more_than_one(shop: Shop, monkeypatch):
    """Readings, and searches for the poses of parts, are counted; the piece that resembles an original comes first."""
    calls: list[str] = []

    def read(finder: Finder, pair: _Comparison, *rest: object) -> _Comparison:
        calls.append(pair.match.piece)
        return pair.refused("it cannot be aligned")

    monkeypatch.setattr(Finder, "_detect", read)
    monkeypatch.setattr(Finder, "fitting", lambda finder, piece, likely: calls.append("part") or likely)
    boxes = [jm.Mesh(rough_sphere(60).vertices * [1, 1, 2 + n], rough_sphere(60).faces) for n in range(10)]
    strange = {f"strange{number}": mesh for number, mesh in enumerate(boxes)}
    monkeypatch.setattr(identification, "meshes_of", lambda path: Scene({**strange, "alike": alike}, {}))
    monkeypatch.setattr(identification, "file_hash", lambda path: "00")
    alike = jm.attack(shop.originals[2], "simplification", 0.5, seed=0)
    with jm.Catalogue(shop.file, read_only=True) as catalogue:
        verdict = Finder(catalogue, [shop.key], depth=2).find("scene.glb")
    assert calls[0] == "alike"
    assert len(calls) == 3 * 2 + 4
    assert verdict.readings == 11 * COUNT  # all pieces are charged, also those that were left out
    (left_out,) = verdict.left_out
    assert left_out.number >= 8
    assert "to search one of them" in describe(verdict, 1e-6)[-1]
    assert verdict.as_json()["left_out"][0]["number"] == left_out.number


@pytest.mark.long
def test_both_models_of_a_merged_file_are_named(shop: Shop):
    merged = joined(shop.marked[3], shop.originals[0], shop.marked[1])
    pieces, _ = split({"": merged})
    assert [piece.name for piece in pieces] == ["", "#1", "#2", "#3"]
    found, verdict = named(shop, merged, depth=1)
    assert sorted(found) == ["1", "3"]
    assert verdict.readings == 4 * COUNT


@pytest.mark.slow
def test_half_of_a_model_is_named_and_grafted_halves_too(shop: Shop):
    half = compact(jm.attack(shop.marked[3], "cropping", 0.5, seed=0))
    assert named(shop, half)[0] == ["3"]
    grafted = joined(half, compact(jm.attack(shop.marked[1], "cropping", 0.4, seed=1)))
    assert sorted(named(shop, grafted)[0]) == ["1", "3"]


def test_records_bind_and_are_paid_for(shop: Shop, tmp_path: Path):
    mesh = shop.originals[0]
    jm.save_mesh(mesh, tmp_path / "0.obj")
    marked, info = jm.embed(mesh, MESSAGE, shop.key, budget=0.004)
    with jm.Catalogue(tmp_path / "own.db") as catalogue:
        catalogue.add(tmp_path / "0.obj")
        for message in (b"abcd", b"efgh"):
            catalogue.add_record(jm.embed(mesh, message, shop.key, budget=0.004)[1].record)
        catalogue.add_record(info.record)
        verdict = catalogue.find(marked, [shop.key])
        assert verdict.readings == 3
        assert (verdict.named[0].message, verdict.named[0].record) == (MESSAGE.hex(), info.record.digest())


def test_a_record_that_is_refused_hides_no_other_evidence(shop: Shop, tmp_path: Path):
    """Records that anybody can forge, alone and beside a genuine one; and records that are damaged in the file."""
    mesh, genuine = shop.originals[3], shop.records[3]
    suspect = jm.attack(shop.marked[3], "noise", 0.02, seed=0)  # read far from the floor of log10 p
    forged = [replace(genuine, beta=2 * genuine.beta, code=code) for code in ("00" * 32, "11" * 32, "22" * 32)]
    damaged = {forged[1].digest(): forged[1].to_json().replace("11" * 32, "ö"), forged[2].digest(): "{"}
    jm.save_mesh(mesh, tmp_path / "3.obj")
    with jm.Catalogue(tmp_path / "own.db") as catalogue:
        catalogue.add(tmp_path / "3.obj")
        for record in forged:
            catalogue.add_record(record)
        with catalogue.database.writing():
            for digest, text in damaged.items():
                catalogue.database.run("UPDATE records SET json = ? WHERE digest = ?", text, digest)
        for records, used in ((forged, None), ([*forged, genuine], genuine)):
            if used is not None:
                catalogue.add_record(used)
            alone = jm.detect(suspect, original=mesh, key=shop.key, record=used, bits=8 * len(MESSAGE)).log10_p
            verdict = catalogue.find(suspect, [shop.key], bits=8 * len(MESSAGE))
            (match,) = verdict.named
            assert match.message == MESSAGE.hex()
            assert match.record == (None if used is None else used.digest())
            assert verdict.readings == len(records)
            beside = 0.0 if used is None else math.log10(0.97)  # a catalogue looks for no blind marks beside
            assert match.log10_p == pytest.approx(alone + beside + math.log10(len(records)), abs=1e-6)
            refused = {one.record: one.refused for one in verdict.matches if one.refused is not None}
            assert set(refused) == {record.digest() for record in forged}
            reasons = ("was edited", "code out of range", "not a record")
            for record, reason in zip(forged, reasons, strict=True):
                assert reason in (refused[record.digest()] or "")
            shown = [entry["record"] for entry in verdict.as_json()["matches"] if entry["refused"]]
            assert set(shown) == set(refused)
            first, *others = describe(verdict, 1e-6)
            assert MESSAGE.hex() in first
            assert len(others) == len(forged)
            assert any(
                f"record {forged[0].digest()[:16]}, could not be read: The record was edited" in x for x in others
            )


@pytest.mark.long
def test_a_refused_record_of_a_copy_hides_no_other_recipient(shop: Shop, tmp_path: Path):
    mesh = rough_sphere(2500, 8)
    jm.save_mesh(mesh, tmp_path / "8.obj")
    copy, info = jm.fingerprint(mesh, "bob", shop.key, budget=0.004)
    forged = replace(info.record, beta=2 * info.record.beta)
    with jm.Catalogue(tmp_path / "own.db") as catalogue:
        catalogue.add(tmp_path / "8.obj")
        catalogue.add_copy(forged, "alice", "00" * 32)
        catalogue.add_copy(info.record, "bob", "11" * 32)
        options = {"only_recipients": True, "align": "same", "depth": 1}
        verdict = Finder(catalogue, [shop.key], **options).find(copy)
        assert [match.accused for match in verdict.named] == [("bob",)]
        assert [match.record for match in verdict.matches if match.refused] == [forged.digest()]
        # A copy of another mesh, as only a hostile export contains it.
        jm.save_mesh(shop.originals[0], tmp_path / "0.obj")
        catalogue.add(tmp_path / "0.obj")
        with catalogue.database.writing():
            catalogue.database.run("UPDATE copies SET shape = 2 WHERE recipient = 'alice'")
        verdict = Finder(catalogue, [shop.key], **options).find(shop.originals[0])
        assert [match.refused for match in verdict.matches if Path(match.original).name == "0.obj"] == [
            "It is the record of the copy for alice, but of another original or key."
        ]


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    return Workshop(tmp_path, monkeypatch, capfd)


@pytest.mark.long
def test_copies_are_issued_and_traced(workshop: Workshop):
    """The whole job on the command line: two recipients, a leak, and what is kept."""
    jm.save_mesh(rough_sphere(SIZE, 7), "other.ply")
    shop = ("--key", "owner.key", "--catalogue", "shop.db")
    workshop("catalogue", "add", "other.ply", "--catalogue", "shop.db")
    for name, *again in (("alice",), ("bob",), ("alice", "--overwrite")):
        told = workshop.json("mark-for", name, "model.ply", *shop, *again)
        assert told["marked"] == f"model-{name}.ply"
    assert "exists" in workshop.refused("mark-for", "alice", "model.ply", *shop)
    assert list(Path().glob("old-*")) == []  # the same copy has the same record
    assert "--output" in workshop.refused("mark-for", "../eve", "model.ply", *shop)
    assert "same file" in workshop.refused("mark-for", "eve", "model.ply", *shop, "--output", "model.ply")
    assert "copy for alice" in workshop.json("catalogue", "add", "model-alice.ply", *shop[2:], status=2)["refused"]
    shown = workshop.json("catalogue", "show", "model.ply", *shop[2:])
    assert [one["recipient"] for one in shown["shapes"][0]["copies"]] == ["alice", "bob"]
    workshop("attack", "model-bob.ply", "leaked.ply", "noise", 0.001)
    found = workshop.json("catalogue", "find", "leaked.ply", *shop)
    assert (found["recipient"], Path(found["original"]).name) == ("bob", "model.ply")
    assert found["readings"] == 3  # two originals, and one list of recipients
    by_order = workshop.json("catalogue", "find", "leaked.ply", *shop, "--align", "same")
    assert by_order["recipient"] == "bob"
    assert by_order["log10_p"] > found["log10_p"] + 1.9  # another way than "auto" costs two decades
    assert workshop.json("identify", "leaked.ply", *shop)["accused"] == ["bob"]
    assert workshop.json("identify", "other.ply", *shop, status=1)["accused"] == []
    assert "--recipients" in workshop.refused("identify", "leaked.ply", "--key", "owner.key")
    with jm.Catalogue("shop.db", read_only=True) as catalogue:
        verdicts = list(catalogue.verdicts())
    assert [one["result"]["recipient"] for one in verdicts] == ["bob", "bob", "bob", None]
    assert verdicts[0]["suspect"] == found["suspect_sha256"]
    assert bytes(range(32)).hex() not in str(verdicts)


def test_what_cannot_be_sought_is_refused(shop: Shop, workshop: Workshop):
    with jm.Catalogue(shop.file, read_only=True) as catalogue:
        for options, said in (
            ({"keys": []}, "key"),
            ({"alpha": 2.0}, "alpha"),
            ({"depth": 0}, "at"),
            ({"align": "by eye"}, "by eye"),
        ):
            with pytest.raises(jm.JaxmarkError, match=said):
                Finder(catalogue, **({"keys": [shop.key]} | options))
    find = ("catalogue", "find", "model.ply", "--key", "owner.key", "--catalogue")
    assert "There is no catalogue" in workshop.refused(*find, "none.db")
    with jm.Catalogue("empty.db") as empty, empty.database.writing():
        pass
    assert "is empty" in workshop(*find, "empty.db")[2]


def test_landmarks_tell_near_duplicates_of_one_meshing_apart():
    """The same vertices and faces, a little stretched each; whatever becomes of pose, order, hand and most of it."""
    mesh = rough_sphere(SIZE)
    stretched = [jm.Mesh(mesh.vertices * [1, 1, factor], mesh.faces) for factor in (0.97, 1.0, 1.03)]
    kept = [landmarks(one)[:MOST].astype(KEPT) for one in (*stretched, rough_sphere(SIZE, 1))]
    index = LandmarkIndex(kept)
    cut = compact(jm.Mesh(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0.2]))
    mirrored = jm.Mesh(cut.vertices * [1, -1, 1], cut.faces[:, ::-1])
    noisy = jm.attack(posed(mirrored), "noise", 0.005, seed=0)
    off = index.off(landmarks(noisy))
    assert sorted(off, key=off.__getitem__)[0] == 1
    assert set(off) == {0, 1, 2}
    assert index.off(landmarks(rough_sphere(SIZE, 2))) == {}
    # A scene of two models shows the landmarks of both.
    assert set(index.off(landmarks(joined(mesh, rough_sphere(SIZE, 1))))) == {0, 1, 2, 3}
    assert index.off(landmarks(jm.Mesh(mesh.vertices, mesh.faces[:0]))) == LandmarkIndex([]).off(landmarks(mesh)) == {}


def test_a_part_fits_the_original_that_it_was_cut_from(shop: Shop):
    """Among near duplicates: the same shape, stretched a little."""
    mesh = shop.originals[2]
    stretched = [jm.Mesh(mesh.vertices * [1, 1, factor], mesh.faces) for factor in (0.9, 1.0, 1.1, 1.2)]
    half = posed(compact(jm.Mesh(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0])))
    part = Part(half)
    poses = [placed.pose for placed in part.place([stretched[3]])]
    off = part.fit({number: centred(one)[0] for number, one in enumerate(stretched)}, dict.fromkeys(range(4), poses))
    assert min(off, key=off.__getitem__) == 1
    whole = fit_whole(posed(mesh), [centred(one)[0] for one in stretched])
    assert np.argmin(whole) == 1
