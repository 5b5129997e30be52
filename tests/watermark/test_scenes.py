"""Files of several meshes: each is marked alone, and what they prove together is no more than they do."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.alignment.pairing import pair
from jaxmark.app.read_files import FileReader
from jaxmark.errors import AlignmentError
from jaxmark.files import load_scene
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark import everyday
from jaxmark.watermark.everyday import detect_scene, embed_scene
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, united_score, weigh
from jaxmark.watermark.evidence.ledger import is_charged_along_a_path
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.nonblind import claims_of
from jaxmark.watermark.record import SceneRecord, load_record
from tests.app.test_cli import Workshop
from tests.samples import bumpy_sphere

MESSAGE = b"ok"
NAMES = ("left", "right", "third")
BUDGET = 2e-4


def moved(mesh: Mesh, matrix: np.ndarray, noise: float = 0.0, seed: int = 0) -> Mesh:
    vertices = np.asarray(mesh.vertices) @ matrix.T + 5
    return mesh._replace(vertices=vertices + noise * np.random.default_rng(seed).normal(size=vertices.shape))


TURN = np.array([[0, -2.0, 0], [2, 0, 0], [0, 0, 2]])


@pytest.fixture(scope="module")
def originals() -> dict[str, Mesh]:
    return {name: bumpy_sphere(3, seed) for seed, name in enumerate(NAMES)}


@pytest.fixture(scope="module")
def marked(originals, key: jm.Key):
    small = bumpy_sphere(0)  # twelve points carry nothing
    return embed_scene({**originals, "small": small, "again": originals["left"]}, MESSAGE, key, budget=BUDGET)


def test_what_cannot_carry_is_named(marked):
    meshes, info = marked
    assert list(meshes) == [*NAMES, "again"] == list(info.record.meshes)
    assert list(info.skipped) == ["small"]
    for one in info.meshes.values():
        assert one.rms == pytest.approx(BUDGET, rel=1e-3)


def test_a_scene_of_other_shapes_is_no_refusal_of_its_file(key: jm.Key, tmp_path: Path):
    """Nothing is detected in a scene that can be read, but of which no mesh resembles one of the original."""
    originals = {name: bumpy_sphere(2, seed) for seed, name in enumerate(NAMES)}
    flat = {
        name: Mesh(mesh.vertices * [1, 1, 0.01 * (1 + n)], mesh.faces[:-1])
        for n, (name, mesh) in enumerate((f"flat {name}", mesh) for name, mesh in originals.items())
    }
    with pytest.raises(AlignmentError, match="None of the 3 meshes could be compared: 'left': No mesh of the suspect"):
        detect_scene(flat, originals=originals, key=key, bits=0)
    for name, meshes in (("original.glb", originals), ("suspect.glb", flat)):
        scene = trimesh.Scene({name: trimesh.Trimesh(*mesh, process=False) for name, mesh in meshes.items()})
        scene.export(tmp_path / name)
    outcome = FileReader(key, 0, None).read(tmp_path / "suspect.glb", tmp_path / "original.glb")
    assert (outcome.status, outcome.values["detected"]) == (1, False)
    assert outcome.lines[0].startswith("nothing detected: None of the 3 meshes could be compared")
    with pytest.raises(jm.JaxmarkError, match="Cannot read"):
        FileReader(key, 0, None).read(tmp_path / "missing.glb", tmp_path / "original.glb")


def read(marked, originals, key: jm.Key, noise: float, **options) -> Detection:
    meshes, info = marked
    record = SceneRecord({name: info.record.meshes[name] for name in NAMES}).sealed(key)
    # In another order, under other names, turned and scaled.
    suspects = {f"object {name}": moved(meshes[name], TURN, noise) for name in reversed(NAMES)}
    return detect_scene(suspects, originals=originals, key=key, record=record, **options)


def test_together_they_prove_more_than_the_best_alone(marked, originals, key: jm.Key):
    found = read(marked, originals, key, 0.006, message=MESSAGE)
    assert found.skipped == {}
    best = min(one.log10_p for one in found.parts.values())
    assert best > -60
    assert found.log10_p < best - 5
    assert found.evidence.log10_p_unfloored == found.log10_p
    assert found.detected()
    # By Hoeffding's bound for the sum of scores over their norms, which have variances of at most 1 each.
    ratios = [np.sqrt(-2 * np.log(10) * (one.log10_p - 0.5)) for one in found.parts.values()]
    assert found.log10_p >= -(np.sum(ratios) ** 2) / 3 / 2 / np.log(10) - 3


def test_a_claim_that_a_record_of_the_scene_refutes_is_refused(marked, originals, key: jm.Key):
    meshes, info = marked
    both = {name: originals[name] for name in ("left", "right")}
    record = SceneRecord({name: info.record.meshes[name] for name in both}).sealed(key)
    with pytest.raises(jm.JaxmarkError, match="commits to another message"):
        detect_scene(meshes, originals=both, key=key, record=record, message=b"no")


def test_picking_meshes_is_charged(marked, originals, key: jm.Key):
    every = read(marked, originals, key, 0.006, message=MESSAGE)
    assert every.evidence.charges[0] == ledger.SELECTION.charge("all")
    two = read(marked, originals, key, 0.006, message=MESSAGE, names=NAMES[:2])
    assert list(two.parts) == list(NAMES[:2])
    # 3 % for all sets that could be picked, 1/4 of it for those of two, of which there are three.
    spent = [charge.log10 for charge in two.evidence.charges[:2]]
    assert sum(spent) == pytest.approx(-np.log10(0.03 / 4 / 3))
    for found in (every, two, *every.parts.values()):
        assert is_charged_along_a_path(found.evidence.charges)
    one = read(marked, originals, key, 0.006, message=MESSAGE, names=NAMES[:1])
    # Among all, it is charged for the evidence of one mesh among three, and for the order of two more originals.
    among = every.parts[NAMES[0]].log10_p + np.log10(0.97 * 0.97**2 / 2 / 3)
    assert one.log10_p == pytest.approx(among - np.log10(0.03 / 2 / 3))
    for wrong, whose in (("small", "original"), ("again", "original")):
        with pytest.raises(jm.JaxmarkError, match=f"{whose} has no mesh '{wrong}'"):
            read(marked, originals, key, 0.0, names=[wrong])


@pytest.mark.parametrize("count", range(2, 8))
def test_the_shares_of_all_sets_add_up_to_no_more_than_the_budget(count: int):
    spent = sum(
        math.comb(count, read) * 10 ** -sum(charge.log10 for charge in ledger.selection(read, count))
        for read in range(1, count + 1)
    )
    assert 0.97 < spent <= 1


def test_a_damaged_original_does_not_choose_the_meshes(marked, originals, key: jm.Key):
    """Otherwise whoever presents it could leave out the meshes that disagree with the suspect."""
    wrong = {**originals, "right": bumpy_sphere(3, 17)}
    with pytest.raises(jm.JaxmarkError, match="'right' of the original cannot be read"):
        read(marked, wrong, key, 0.0)
    assert read(marked, wrong, key, 0.0, names=["left", "third"]).detected()


def test_presenting_an_original_so_that_it_is_not_found_is_charged_and_keeps_its_caveat(originals, key: jm.Key):
    """Otherwise, whoever presents originals in another order, or damages them, chooses the meshes that are united."""
    rng = np.random.default_rng(5)
    scene = {name: mesh._replace(faces=rng.permutation(mesh.faces)) for name, mesh in originals.items()}
    meshes, info = embed_scene(scene, MESSAGE, key, budget=BUDGET)
    long = {f"long {name}": mesh._replace(vertices=mesh.vertices * [1, 1, 3]) for name, mesh in meshes.items()}
    order = rng.permutation(len(scene["left"].vertices))
    other = Mesh(scene["left"].vertices[order], np.argsort(order)[scene["left"].faces])
    found = detect_scene(long, originals={**scene, "left": other}, key=key, record=info.record)
    assert "left" in found.skipped
    charges = {charge.choice: charge for charge in found.evidence.charges}
    assert charges["order of the original (record)"].log10 >= -np.log10(0.03) - 2 * np.log10(0.97) - 1e-9
    dented = scene["left"].vertices * np.where(scene["left"].vertices[:, :1] > 0.3, 1.05, 1.0)
    edited = Mesh(dented[order], other.faces)
    found = detect_scene(long, originals={**scene, "left": edited}, key=key, record=info.record)
    assert any("edited" in caveat for caveat in found.evidence.caveats)
    assert not found.detected()


def test_meshes_chosen_by_their_scores_prove_nothing_uncommitted():
    """A forger tries 1,200 variants of an original, and unites those that happen to agree with the suspect."""
    scores = np.sort(np.random.default_rng(0).normal(size=1200))[-299:]
    score = united_score(scores.tolist(), [1.0] * 299, [1.0] * 299)
    forged = weigh([(score, 1.0)], bits=16, fixed=True, meshes=299)
    assert forged.log10_p < -70, "the attack works against what must be fixed beforehand"
    assert forged.log10_p_uncommitted == 0.0
    assert weigh([(score, 1.0)], bits=16, fixed=True).log10_p_uncommitted < -30, "what one forgery is charged"


def test_each_reads_alone(marked, originals, key: jm.Key):
    meshes, info = marked
    for name in NAMES:
        found = jm.detect(meshes[name], original=originals[name], key=key, record=info.record.meshes[name])
        assert found.message == MESSAGE
        assert found.detected()


def test_equal_meshes_count_once(marked, originals, key: jm.Key, monkeypatch):
    meshes, info = marked
    np.testing.assert_array_equal(meshes["again"].vertices, meshes["left"].vertices)
    twice = dict.fromkeys(("left", "again"), originals["left"])
    record = SceneRecord({name: info.record.meshes[name] for name in twice}).sealed(key)
    prepared = []
    monkeypatch.setattr(
        everyday, "make_marker", lambda mesh, *rest, **_: prepared.append(mesh) or make_marker(mesh, *rest, **_)
    )
    found = detect_scene({name: meshes[name] for name in twice}, originals=twice, key=key, record=record)
    assert len(prepared) == 1
    assert found.skipped == {"left": everyday.EQUALS_ANOTHER}
    alone = jm.detect(meshes["left"], original=originals["left"], key=key, record=record.meshes["left"])
    assert list(found.parts) == ["again"], "the first by name"
    # All meshes were read, the evidence is that of one among two, and the order of each original is a choice. That of
    # blind marks beside the record's is none.
    charged = alone.log10_p - np.log10(0.97) - 2 * np.log10(0.97) + np.log10(2 * 2) + np.log10(0.97)
    assert found.log10_p == pytest.approx(charged)
    turned = dataclasses.replace(record, meshes=dict(reversed(record.meshes.items())))
    again = detect_scene({name: meshes[name] for name in twice}, originals=twice, key=key, record=turned)
    assert turned.digest() == record.digest()
    assert again.log10_p == found.log10_p, "a digest does not cover the order of the meshes"


def test_equal_meshes_are_marked_once(sphere: Mesh, key: jm.Key, monkeypatch):
    prepared = []

    def refuse(mesh: Mesh, *_: object, **__: object):
        prepared.append(mesh)
        raise jm.JaxmarkError("Not now.")

    monkeypatch.setattr(everyday, "prepare", refuse)
    scene = {"a": sphere, "b": sphere._replace(faces=sphere.faces[::-1]), "c": Mesh(*map(np.copy, sphere))}
    with pytest.raises(jm.JaxmarkError, match="'a': Not now; 'b': Not now; 'c': Not now"):
        embed_scene(scene, MESSAGE, key)
    assert [id(mesh) for mesh in prepared] == [id(scene["a"]), id(scene["b"])]


@pytest.mark.long
def test_sums_over_keys_have_the_variance_that_the_bound_assumes(originals, key: jm.Key):
    suspects = {name: moved(mesh, np.eye(3), 0.01, seed) for seed, (name, mesh) in enumerate(originals.items())}
    markers = {name: jm.make_marker(mesh, key, bits=16) for name, mesh in originals.items()}
    aligned = {name: markers[name].register(suspects[name]) for name in NAMES}
    sums = []
    for number in range(16):
        others = {name: jm.make_marker(originals[name], jm.Key(bytes([number]) * 32), bits=16) for name in NAMES}
        claims = [claims_of(others[name], others[name].receive(aligned[name]), b"ok")[0] for name in NAMES]
        sums.append(
            united_score(*zip(*claims, strict=True), [float(np.sum(aligned[name].weights > 0)) for name in NAMES])
        )
    assert 0.4 < np.std(sums) < 1.6  # 16 numbers of variance 1: within 3.4 standard errors
    assert np.abs(sums).max() < 4


@pytest.mark.parametrize("claimed", [None, MESSAGE])
def test_what_is_not_marked_is_not_detected(marked, originals, key: jm.Key, claimed):
    _, info = marked
    record = SceneRecord({name: info.record.meshes[name] for name in NAMES}).sealed(key)
    suspects = {name: moved(mesh, np.eye(3), 0.005) for name, mesh in originals.items()}
    found = detect_scene(suspects, originals=originals, key=key, record=record, message=claimed)
    assert not found.detected(0.01)


def test_a_record_of_which_meshes_were_left_out_proves_nothing(marked, originals, key: jm.Key, tmp_path: Path):
    """Whoever leaves meshes out chooses those that happen to agree with the suspect."""
    meshes, info = marked
    fewer = dataclasses.replace(info.record, meshes={name: info.record.meshes[name] for name in NAMES})
    (tmp_path / "record.json").write_text(fewer.to_json())
    with pytest.raises(jm.JaxmarkError, match="The record of the scene was edited"):
        detect_scene(meshes, originals=originals, key=key, record=load_record(tmp_path / "record.json"))
    scene = json.loads(fewer.to_json())
    del scene["code"]
    (tmp_path / "record.json").write_text(json.dumps(scene | {"version": 1}))
    found = detect_scene(meshes, originals=originals, key=key, record=load_record(tmp_path / "record.json"))
    assert (found.detected(), found.detected(allow_estimate=True)) == (False, True)
    assert "meshes may have been left out" in found.evidence.caveats[0]


def test_records_of_files(marked, tmp_path: Path):
    record = marked[1].record
    (tmp_path / "a.json").write_text(record.to_json())
    again = load_record(tmp_path / "a.json")
    assert again.to_json() == record.to_json()
    assert again.digest() == record.digest()
    data = json.loads(record.to_json())
    for change in (
        {"meshes": {}},
        {"version": 9},
        {"version": True},
        {"version": 1},
        {"x": 0},
        {"meshes": {"left": {**data["meshes"]["left"], "bits": "x"}}},
    ):
        (tmp_path / "b.json").write_text(json.dumps({**data, **change}))
        with pytest.raises(jm.JaxmarkError, match="record"):
            load_record(tmp_path / "b.json")


def test_names_that_look_like_those_of_the_record_are_its_meshes(marked, key: jm.Key, tmp_path: Path):
    """Programs compose accents in different ways when they save a file."""
    shapes = [bumpy_sphere(3, 7), bumpy_sphere(3, 8)]
    written, info = embed_scene(dict(zip(("\u00e9", "other"), shapes, strict=True)), MESSAGE, key, budget=BUDGET)
    decomposed = dict(zip(("e\u0301", "other"), shapes, strict=True))
    found = detect_scene(written, originals=decomposed, key=key, record=info.record)
    assert (found.message, sorted(found.parts)) == (MESSAGE, ["other", "\u00e9"])
    (tmp_path / "original.obj").write_text(_obj(decomposed))
    (tmp_path / "marked.obj").write_text(_obj(written))
    (tmp_path / "record.json").write_text(info.record.to_json())
    files = (tmp_path / "marked.obj", tmp_path / "original.obj", tmp_path / "record.json")
    for meshes in ((), ("e\u0301",), ("\u00e9",)):
        assert FileReader(key, None, None, meshes=meshes).read(*files).values["message"] == MESSAGE.hex()
    other = SceneRecord({"absent": info.record.meshes["\u00e9"], **info.record.meshes}).to_json()
    (tmp_path / "record.json").write_text(other)
    with pytest.raises(jm.JaxmarkError, match="lacks the mesh 'absent' of the record"):
        FileReader(key, None, None).read(*files)


def _obj(meshes: dict[str, Mesh]) -> str:
    """The text of an OBJ file with these objects."""
    lines, first = [], 1
    for name, mesh in meshes.items():
        lines += [f"o {name}", *("v {!r} {!r} {!r}".format(*row) for row in np.asarray(mesh.vertices).tolist())]
        lines += ["f {} {} {}".format(*row) for row in np.asarray(mesh.faces) + first]
        first += len(mesh.vertices)
    return "\n".join(lines)


def test_pairs(originals):
    turned = {name: moved(mesh, TURN) for name, mesh in originals.items()}
    # By connectivity, whatever the names say.
    assert pair(originals, {"right": turned["left"], "left": turned["right"]}) == {**{"left": "right", "right": "left"}}
    # By shape, where it is another connectivity.
    other = {name: bumpy_sphere(4, seed) for seed, name in enumerate(NAMES)}
    stretched = originals["right"]._replace(vertices=np.asarray(originals["right"].vertices) * [1, 1, 5])
    shuffled = {"x": moved(stretched, TURN)._replace(faces=stretched.faces[::-1]), "y": other["left"]}
    assert pair({"long": stretched, "round": originals["left"]}, shuffled) == {"long": "x", "round": "y"}
    assert pair(originals, {"only": other["left"]}) == dict.fromkeys(NAMES, "only")


def test_meshes_of_one_connectivity_are_paired_by_shape(sphere: Mesh):
    """As rocks made from one template are, whatever the names and the order say."""
    rocks = {
        name: sphere._replace(vertices=np.asarray(sphere.vertices) * [1, 1, size])
        for name, size in zip("abc", (1, 2, 3), strict=True)
    }
    turned = {name: moved(mesh, TURN) for name, mesh in rocks.items()}
    assert pair(rocks, {"c": turned["a"], "x": turned["c"], "a": turned["b"]}) == {"a": "c", "b": "a", "c": "x"}
    # Names tell equal shapes apart.
    equal = {name: moved(rocks["a"], TURN, 0.001 * place) for place, name in enumerate("abc")}
    assert pair(dict.fromkeys("abc", rocks["a"]), equal) == dict(zip("abc", "abc", strict=True))


def exported(folder: Path, meshes: dict[str, Mesh], name: str) -> Path:
    scene = trimesh.Scene({name: trimesh.Trimesh(*mesh, process=False) for name, mesh in meshes.items()})
    scene.export(folder / name)
    return folder / name


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_commands_on_a_file_of_several_meshes(tmp_path, monkeypatch, capfd, originals):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    exported(tmp_path, {"left": originals["left"], "small": bumpy_sphere(0), "right": originals["right"]}, "a.glb")
    message = ("--key", "owner.key", "--message", "c0ff")
    told = workshop.json("embed", "a.glb", "b.glb", *message)
    assert list(told["meshes"]) == ["left", "right"]
    assert list(told["skipped"]) == ["small"]
    assert all(one["survives"]["whole"] > one["survives"]["half"] > 0 for one in told["meshes"].values())
    workshop.json("attack", "b.glb", "c.glb", "noise", "0.002")
    read = ("--original", "a.glb", "--key", "owner.key", "--record", "b.glb.jaxmark.json")
    found = workshop.json("detect", "c.glb", *read)
    assert found["message"] == "c0ff"
    assert all(one["detected"] for one in found["parts"].values())
    assert workshop.json("detect", "b.glb", *read, "--mesh", "right")["message"] == "c0ff"
    assert workshop.json("detect", "a.glb", *read, status=1)["parts"].keys() == found["parts"].keys()
    assert "no mesh 'wrong'" in workshop.refused("embed", "a.glb", "d.glb", *message, "--mesh", "wrong")
    picked = workshop.json("embed", "a.glb", "e.glb", *message, "--mesh", "left")
    assert list(picked["meshes"]) == ["left"]
    before, after = load_scene("a.glb").meshes, load_scene("e.glb").meshes
    np.testing.assert_array_equal(before["right"].vertices, after["right"].vertices)
    assert "faces" in workshop.refused("attack", "b.glb", "f.glb", "midpoint", "1")
    deposit = workshop.json("commit", "b.glb.jaxmark.json", "--output", "d.json")
    assert deposit["records"] == 1
    assert workshop.json("detect", "b.glb", *read, "--commitment", "d.json")["log10_p_timestamped"] < -6


@pytest.mark.usefixtures("unchecked")
def test_objects_of_an_obj_file(tmp_path, monkeypatch, capfd, originals):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    text, base = "", 1
    for name in ("left", "right"):
        vertices, faces = (np.asarray(part) for part in originals[name])
        text += f"o {name}\n" + "".join("v {!r} {!r} {!r}\n".format(*row) for row in vertices.tolist())
        text += "".join("f {} {} {}\n".format(*row) for row in (faces + base).tolist())
        base += len(vertices)
    Path("a.obj").write_text(text)
    told = workshop.json("embed", "a.obj", "b.obj", "--key", "owner.key", "--message", "c0ff")
    assert list(told["meshes"]) == ["left", "right"]
    # Saved by another program, which keeps no names, as one mesh in two pieces.
    trimesh.load("b.obj", process=False, force="mesh").export("c.ply")
    read = ("--original", "a.obj", "--key", "owner.key", "--record", "b.obj.jaxmark.json")
    assert workshop.json("detect", "b.obj", *read)["message"] == "c0ff"
    assert workshop.json("detect", "c.ply", *read)["message"] == "c0ff"
