"""Which of several originals a suspect is, and whose copy."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app.find_commands import describe
from jaxmark.catalogue import Finder, Match, Verdict
from jaxmark.catalogue.descriptors import centred
from jaxmark.catalogue.identification import split
from jaxmark.catalogue.landmarks import KEPT, MOST, LandmarkIndex, landmarks
from jaxmark.catalogue.partial_registration import Part, fit_whole
from jaxmark.geometry.mesh import compact
from jaxmark.watermark.coding.keys import commitment
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
    marked = {number: jm.embed(originals[number], MESSAGE, key, budget=0.004)[0] for number in (1, 3)}
    return Shop(folder / "shop.db", originals, key, marked)


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
    estimate = Match("b.ply", "", "", "whole", 1, 0.0, log10_p=-60.0, caveats=("the original was edited",))
    both, alone = (Verdict("", matches, 2).as_json() for matches in ((named, estimate), (estimate,)))
    assert (both["original"], both["log10_p"], both["log10_p_uncommitted"], both["caveats"]) == ("a.ply", -8, -1, ())
    assert (alone["named"], alone["log10_p"], alone["caveats"]) == (False, -60, ("the original was edited",))


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
    assert "3.obj could not be read: The vertices" in describe(Verdict("", (refused,), 1), 1e-6)


def test_nobody_is_named_without_the_key_or_the_mark(shop: Shop):
    assert named(shop, shop.marked[1], jm.Key(bytes(32)), depth=1)[0] == []
    found, verdict = named(shop, shop.originals[1], depth=1)
    assert found == []
    assert verdict.matches[0].log10_p == 0
    assert Path(verdict.matches[0].original).stem == "1"


def test_small_meshes_of_a_file_are_left_out():
    small, large = rough_sphere(12), rough_sphere(60)
    many = {str(number): small._replace(vertices=(1 + number) * np.asarray(small.vertices)) for number in range(40)}
    assert [piece.name for piece in split({**many, "large": large})] == ["large"]
    assert split(many) == []
    assert [piece.name for piece in split({"only": small})] == ["only"]


@pytest.mark.long
def test_both_models_of_a_merged_file_are_named(shop: Shop):
    merged = joined(shop.marked[3], shop.originals[0], shop.marked[1])
    pieces = split({"": merged})
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


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    return Workshop(tmp_path, monkeypatch, capfd)


@pytest.mark.long
def test_copies_are_issued_and_traced(workshop: Workshop):
    """The whole job on the command line: two recipients, a leak, and what is kept."""
    jm.save_mesh(rough_sphere(SIZE, 7), "other.ply")
    shop = ("--key", "owner.key", "--catalogue", "shop.db")
    workshop("catalogue", "add", "other.ply", "--catalogue", "shop.db")
    for name in ("alice", "bob", "alice"):
        told = workshop.json("mark-for", name, "model.ply", *shop)
        assert told["marked"] == f"model-{name}.ply"
    assert "--output" in workshop.refused("mark-for", "../eve", "model.ply", *shop)
    assert "the original" in workshop.refused("mark-for", "eve", "model.ply", *shop, "--output", "model.ply")
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
    jm.Catalogue("empty.db").close()
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
