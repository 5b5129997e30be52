"""The command line's contract, on files made on the spot."""

import json
import re
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.app import cli
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
MESSAGE = "0123456789abcdef"


def loaded(name: str) -> trimesh.Trimesh:
    """A mesh as another program reads it."""
    mesh = trimesh.load(name, process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


class Workshop:
    """A folder with an original and a key, and the command line run inside."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
        self.folder, self._monkeypatch, self._capfd = folder, monkeypatch, capfd
        monkeypatch.chdir(folder)
        trimesh.Trimesh(*bumpy_sphere(4), process=False).export(folder / "model.ply")
        jm.watermark.save_key(jm.Key(bytes(range(32))), folder / "owner.key")

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        self._monkeypatch.setattr(sys, "argv", ["jaxmark", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            sys.exit(cli.main())
        out, err = self._capfd.readouterr()
        return int(end.value.code or 0), out, err

    def json(self, *arguments: object, status: int = 0) -> dict:
        code, out, err = self(*arguments, "--json")
        assert code == status, err

        def refuse(constant: str):
            raise AssertionError(f"{constant} is not strict JSON")

        assert out.count("\n") == 1
        return json.loads(out, parse_constant=refuse)

    def refused(self, *arguments: object) -> str:
        before = {path: path.read_bytes() for path in self.folder.rglob("*") if path.is_file()}
        code, out, err = self(*arguments)
        assert code == 2
        assert out == ""
        assert re.fullmatch(r"jaxmark: [^\n]+\n", err), err
        assert "Traceback" not in err
        assert {path: path.read_bytes() for path in self.folder.rglob("*") if path.is_file()} == before
        return err

    def embed(self, *more: object) -> dict:
        return self.json("embed", "model.ply", "marked.ply", "--key", "owner.key", "--message", MESSAGE, *more)


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    return Workshop(tmp_path, monkeypatch, capfd)


DETECT = ("--original", "model.ply", "--key", "owner.key")


@pytest.mark.parametrize(
    "scheme", ["keyed", pytest.param("host", marks=pytest.mark.slow), pytest.param("eigen", marks=pytest.mark.slow)]
)
def test_the_main_job(workshop: Workshop, scheme):
    told = workshop.embed("--scheme", scheme, "--budget", "0.0008")
    assert told["bits"] == 64
    assert told["scheme"] == scheme
    assert told["record"] == "marked.ply.jaxmark.json"
    assert told["rms"] == pytest.approx(8e-4, rel=1e-3)
    before, after = (loaded(name) for name in ("model.ply", "marked.ply"))
    shift = np.linalg.norm(after.vertices - before.vertices, axis=1) / np.linalg.norm(np.ptp(before.vertices, axis=0))
    assert told["rms"] == pytest.approx(np.sqrt(np.mean(shift**2)), rel=1e-6)
    assert told["max"] == pytest.approx(shift.max(), rel=1e-6)

    attacked = workshop.json("attack", "marked.ply", "suspect.ply", "noise", "0.0005", "--seed", "3")
    assert attacked["rms"] > 0
    for options in (["--record", told["record"]], ["--scheme", scheme]):
        found = workshop.json("detect", "suspect.ply", *DETECT, *options)
        assert found["detected"] is True
        assert found["message"] == MESSAGE
        assert len(found["scores"]) >= 92
        assert found["coverage"] == 1.0
        assert found["log10_p"] <= -6
        assert found["log10_p_gaussian"] <= found["log10_p"] or scheme != "keyed"
        assert found["log10_p_unfloored"] <= found["log10_p"]
    claimed = workshop.json("detect", "suspect.ply", *DETECT, "--scheme", scheme, "--message", MESSAGE)
    assert claimed["detected"] is True
    compared = workshop.json("compare", "model.ply", "marked.ply")
    assert (compared["rms"], compared["max"]) == pytest.approx((told["rms"], told["max"]), rel=1e-12)


def test_an_attack_that_changes_faces_writes_a_new_file(workshop: Workshop):
    told = workshop.json("attack", "model.ply", "flipped.ply", "edge-flips", "0.05")
    assert told["rms"] is None
    before, after = (loaded(name) for name in ("model.ply", "flipped.ply"))
    np.testing.assert_allclose(after.vertices, before.vertices, rtol=1e-6)
    same = {tuple(edge) for edge in before.edges_unique} & {tuple(edge) for edge in after.edges_unique}
    assert len(same) == pytest.approx(0.95 * len(before.edges_unique), abs=1)
    assert len(after.edges_unique) == len(before.edges_unique)
    assert (told["vertices"], told["faces"]) == (len(before.vertices), len(before.faces))


def test_attacks_one_after_the_other(workshop: Workshop):
    told = workshop.json("attack", "model.ply", "both.ply", "smoothing", "3", "noise", "0.01", "--seed", "4")
    assert told["attacks"] == [["smoothing", 3.0], ["noise", 0.01]]
    before, both = (jm.load_mesh(name) for name in ("model.ply", "both.ply"))
    expected = jm.adversaries.chain(before, [("smoothing", 3), ("noise", 0.01)], seed=4)
    np.testing.assert_allclose(both.vertices, expected.vertices, rtol=1e-6)
    assert told["rms"] == pytest.approx(jm.distortion.displacement_size(before, expected).rms, rel=1e-4)


@pytest.mark.parametrize(("kind", "strength", "times"), [("midpoint", "1", 4), ("reordering", "1", 1)])
def test_an_attack_that_makes_other_vertices_tells_no_distance(kind, strength, times, workshop: Workshop):
    told = workshop.json("attack", "model.ply", "other.ply", kind, strength)
    assert told["rms"] is told["max"] is None
    before, after = (loaded(name) for name in ("model.ply", "other.ply"))
    assert len(after.faces) == times * len(before.faces)
    said = workshop("attack", "model.ply", "another.ply", kind, strength)[1]
    assert f"a mesh of {len(after.vertices)} vertices and {len(after.faces)} faces" in said


@pytest.mark.slow
def test_capacity_is_what_embed_takes(workshop: Workshop):
    budget = ("--budget", "0.0008")
    bits = workshop.json("capacity", "model.ply", *budget)["bits"]
    assert 64 <= bits < 1000
    for size, status in ((bits, 0), (bits + 8, 2)):
        code, _, err = workshop(
            *("embed", "model.ply", f"full-{size}.ply", "--key", "owner.key", "--json"),
            *("--message", "5a" * (size // 8), *budget, "--noise", "0.005"),
        )
        assert code == status, err
    assert f"at most {bits} bits" in err
    assert workshop.json("capacity", "model.ply", "--budget", "0.0004")["bits"] < bits
    assert workshop.json("capacity", "model.ply", *budget, "--noise", "0.01")["bits"] < bits


@pytest.mark.slow
def test_copies_are_traced(workshop: Workshop):
    Path("names.txt").write_text("alice\nbob\n\ncarol\n")
    told = workshop.json("embed", "model.ply", "copy.ply", "--key", "owner.key", "--recipient", "bob")
    assert told["content"] == "fingerprint"
    who = ("--original", "model.ply", "--key", "owner.key", "--recipients", "names.txt")
    found = workshop.json("identify", "copy.ply", *who, "--record", told["record"])
    assert found["accused"] == ["bob"]
    assert found["recipients"] == 3
    assert found["ranking"][0]["recipient"] == "bob"
    assert workshop.json("identify", "model.ply", *who, status=1)["accused"] == []
    original = jm.load_mesh("model.ply")
    dented = np.where(original.vertices[:, :1] > 0.8, 1.01 * original.vertices, original.vertices)
    jm.save_mesh(original._replace(vertices=dented), "dented.ply", like="model.ply")
    edited = ("--original", "dented.ply", *who[2:], "--record", told["record"])
    found = workshop.json("identify", "copy.ply", *edited, status=3)
    assert (found["accused"], found["estimates"]) == ([], ["bob"])
    status, said, _ = workshop("identify", "copy.ply", *edited)
    assert status == 3
    assert said.startswith("estimate, not a proof: bob: score")
    Path("nobody.txt").write_text("\n")
    for arguments, sentence in [
        (("identify", "copy.ply", *who[:-1], "nobody.txt"), "contains no recipient"),
        (("identify", "copy.ply", *who, "--alpha", "0"), "alpha"),
        (("identify", "copy.ply", *who[:-1], "absent.txt"), "absent.txt"),
        (("detect", "copy.ply", *DETECT, "--record", told["record"]), "identify reads it"),
        (("embed", "model.ply", "o.ply", "--key", "owner.key"), "one of --message, --text, --presence and --recipient"),
        (("embed", "model.ply", "o.ply", "--key", "owner.key", "--recipient", "x", "--scheme", "host"), "keyed"),
    ]:
        assert re.search(sentence, workshop.refused(*arguments))


@pytest.mark.slow
def test_nothing_found_is_status_1(workshop: Workshop):
    workshop.embed()
    workshop.json("keygen", "other.key")
    for suspect, key, options in [
        ("marked.ply", "other.key", []),
        ("marked.ply", "owner.key", ["--bits", "32"]),
        ("marked.ply", "owner.key", ["--alpha", "1e-80"]),
    ]:
        found = workshop.json("detect", suspect, "--original", "model.ply", "--key", key, *options, status=1)
        assert found["detected"] is False
        assert found["log10_p"] <= 0
        assert ("give that by --bits" in str(found)) == (key == "other.key")
    assert workshop.json("detect", "model.ply", *DETECT, status=1)["log10_p"] == 0
    code, out, _ = workshop("detect", "model.ply", *DETECT)
    assert code == 1
    assert "nothing detected" in out


def test_refusals_are_one_sentence_and_leave_nothing(workshop: Workshop):
    workshop.embed()
    Path("broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    Path("notes.txt").write_text("x")
    Path("folder.ply").mkdir()
    Path("loop.ply").symlink_to("loop.ply")
    Path("bad.key").write_text("not a key")
    record = json.loads(Path("marked.ply.jaxmark.json").read_text())
    Path("other.json").write_text(json.dumps({**record, "original": "00"}))
    mark = ("--key", "owner.key", "--message", MESSAGE)
    copy = ("model.ply", "--output", "o.ply")
    Path("list.json").write_text('{"a": 1}')
    for arguments, sentence in [
        (("keygen", "owner.key"), "never overwritten"),
        (("embed", "absent.ply", "out.ply", *mark), "absent.ply"),
        (("embed", "broken.ply", "out.ply", *mark), "broken.ply"),
        (("embed", "notes.txt", "out.txt", *mark), "notes.txt"),
        (("embed", "model.ply", "out.obj", *mark), "^jaxmark: out.obj must have the suffix of model.ply"),
        (("embed", "model.ply", "folder.ply", *mark), "folder.ply is a folder"),
        (("embed", "loop.ply", "out.ply", *mark), "loop.ply"),
        (("attack", "model.ply", "out.off", "noise", "1"), "^jaxmark: out.off must have the suffix of model.ply"),
        (("embed", "model.ply", "model.ply", *mark), "same file"),
        (("embed", "model.ply", "no/where.ply", *mark), "folder no"),
        (("embed", "model.ply", "out.ply", *mark, "--record", "no/where.json"), "no"),
        (("detect", "absent.ply", *DETECT, "--report", "model.ply"), "model.ply is a file; name a folder"),
        (("detect", "absent.ply", *DETECT, "--scheme", "local"), "read without the original; leave out --original"),
        (("detect", "absent.ply", "--key", "owner.key", "--scheme", "local", "--report", "r"), "blind marks have none"),
        (("detect", "absent.ply", "--key", "owner.key", "--report", "r"), "give --original; otherwise, leave them out"),
        (("embed", "model.ply", "out.ply", *mark, "--record", "broken.ply", "--overwrite"), "broken.ply is no record"),
        (("embed", "model.ply", "out.ply", *mark, "--budget", "1e-9", "--noise", "0"), "numbers are .* apart"),
        (("embed", "model.ply", "out.ply", *mark, "--budget", "nan"), "budget"),
        (("embed", "model.ply", "out.ply", *mark, "--scheme", "magic"), "magic"),
        (("embed", "model.ply", "out.ply", "--key", "owner.key", "--message", "xyz"), "hexadecimal"),
        (
            ("embed", "model.ply", "out.ply", *mark, "--budget", "2e-4", "--noise", "0.005"),
            "carries no message at a budget of 0.0002, .*budget of at least 0.000",
        ),
        (("embed", "model.ply", "out.ply", *mark, "--noise", "-1"), "noise"),
        (("embed", "model.ply", "out.ply", "--key", "owner.key", "--message", "00" * 600), "at most"),
        (("capacity", "model.ply", "--coverage", "2"), "coverage"),
        (("embed", "model.ply", "out.ply", "--key", "bad.key", "--message", MESSAGE), "no key file"),
        (("embed", "model.ply", "out.ply", "--message", MESSAGE), "--key"),
        (
            ("detect", "marked.ply", "--original", "marked.ply", "--key", "owner.key", "--record", record_name()),
            "record",
        ),
        (("detect", "marked.ply", *DETECT, "--record", "other.json"), "record"),
        (("detect", "marked.ply", *DETECT, "--record", "notes.txt"), "not a record"),
        (("detect", "absent.ply", *DETECT, "--alpha", "2"), "alpha"),
        (("detect", "marked.ply", *DETECT, "--bits", "7"), "multiple of 8"),
        (("detect", "marked.ply", *DETECT, "--record", record_name(), "--scheme", "eigen"), "contradicts"),
        (("detect", "marked.ply", *DETECT, "--record", record_name(), "--scheme", "field"), "contradicts the record"),
        (("detect", "marked.ply", *DETECT, "--record", record_name(), "--presence"), "bits, not of a presence mark"),
        (("detect", "marked.ply", "--key", "owner.key", "--record", record_name()), "with the original; give --orig"),
        (("attack", "model.ply", "out.ply", "noise", "-1"), "number from 0 to .*, got -1"),
        (("catalogue", "import", "model.ply", "--catalogue", "new.db"), "it is not text"),
        (("attack", "model.ply", "out.ply", "melting", "1"), "melting"),
        (("attack", "model.ply", "out.ply", "smoothing", "1.5"), "whole number"),
        (("attack", "model.ply", "out.ply", "noise", "x"), "'x'"),
        (("attack", "model.ply", "out.ply", "noise", "1e308"), "from 0 to 1e[+]30, got 1e[+]308"),
        (("attack", "model.ply", "out.ply", "noise", "0.1", "smoothing"), "smoothing has no strength; .*: steps"),
        (("nonsense",), "nonsense"),
        (
            ("mark-for", "eve", *copy, "--key", "owner.key", "--catalogue", "o.ply.jaxmark.json"),
            "catalogue and record",
        ),
        (
            ("mark-for", "eve", *copy, "--key", "o.ply.jaxmark.json", "--catalogue", "c.db"),
            "key and record are",
        ),
        (("mark-for", "eve", "no.ply", "--output", "o.ply", "--key", "owner.key", "--catalogue", "c.db"), "no.ply"),
        (("mark-for", "eve", "broken.ply", "--output", "o.ply", "--key", "owner.key", "--catalogue", "c.db"), "broken"),
        (("detect", "marked.ply", *DETECT, "--record", record_name(), "--mesh", "x"), "leave out --mesh"),
        (("embed", "model.ply", "out.ply", *mark, "--record", "list.json", "--overwrite"), "list.json is no record"),
    ]:
        assert re.search(sentence, workshop.refused(*arguments))


def test_a_link_among_marked_files_replaces_no_original(workshop: Workshop):
    """Whoever links to the originals that need no mark would otherwise lose them."""
    for folder in ("models", "marked"):
        Path(folder).mkdir()
    Path("models/a.ply").write_bytes(before := Path("model.ply").read_bytes())
    Path("marked/a.ply").symlink_to("../models/a.ply")
    status, said, _ = workshop("embed", "models", "marked", "--key", "owner.key", "--message", MESSAGE, "--overwrite")
    assert status == 2
    assert "marked/a.ply is the original; give another name" in said
    assert Path("models/a.ply").read_bytes() == before


def record_name() -> str:
    return "marked.ply.jaxmark.json"


@pytest.mark.slow
def test_other_connectivity_is_read_where_it_can_be(workshop: Workshop):
    workshop.embed()
    marked = jm.load_mesh("marked.ply")
    vertices, faces = trimesh.remesh.subdivide(np.asarray(marked.vertices), np.asarray(marked.faces))
    turn = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]
    trimesh.Trimesh(30 * vertices @ turn.T + 7, faces, process=False).export("finer.obj", digits=12)
    told = workshop.json("detect", "finer.obj", *DETECT, "--report", "seen")
    assert told["message"] == MESSAGE
    registration = told["registration"]
    assert registration["method"] == "surface"
    np.testing.assert_allclose(np.array(registration["pose"]["matrix"]) @ turn * 30, np.eye(3), atol=2e-3)
    assert 0 < registration["residual"] < 1e-3
    assert registration["seconds"] > 0
    assert Path("seen/alignment.png").read_bytes().startswith(b"\x89PNG")
    assert workshop.json("detect", "marked.ply", *DETECT, "--align", "same")["registration"]["method"] == "same"
    assert "does not share" in workshop.refused("detect", "finer.obj", *DETECT, "--align", "same")


@pytest.mark.slow
def test_nothing_is_detected_in_a_mesh_of_another_shape(workshop: Workshop):
    trimesh.Trimesh(*bumpy_sphere(2), process=False).export("small.ply")
    assert workshop.json("detect", "small.ply", *DETECT, status=1)["detected"] is False
    status, said, _ = workshop("detect", "small.ply", *DETECT)
    assert (status, said[:50]) == (1, "nothing detected: The suspect could not be aligned")
    Path("names.txt").write_text("alice\n")
    identify = ("identify", "small.ply", "--original", "model.ply", "--key", "owner.key", "--recipients", "names.txt")
    assert "could not be aligned" in workshop.json(*identify, status=1)["notes"][0]


def test_key_files_are_private_and_keys_never_shown(workshop: Workshop):
    told = workshop.json("keygen", "new.key")
    path = Path("new.key")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    secret = path.read_text().strip()
    assert len(secret) == 64
    assert secret not in json.dumps(told)
    workshop.embed()
    owner = Path("owner.key").read_text().strip()
    for arguments in (
        ("embed", "model.ply", "m2.ply", "--key", "owner.key", "--message", MESSAGE),
        ("detect", "marked.ply", *DETECT),
    ):
        _, out, err = workshop(*arguments)
        assert owner not in out + err
    assert owner not in Path("marked.ply.jaxmark.json").read_text()


def test_existing_files_are_refused(workshop: Workshop):
    refusal = "jaxmark: {} exists; give another name, or replace it by --overwrite.\n"
    for name in ("marked.ply", "other.ply.jaxmark.json"):
        Path(name).write_text("there already")
        marked = name.removesuffix(".jaxmark.json")
        mark = ("model.ply", marked, "--key", "owner.key", "--message", MESSAGE)
        assert workshop.refused("embed", *mark) == refusal.format(name)
    for name, bits in (("first.json", 64), ("second.json", 32)):
        Path(name).write_text(jm.Record("keyed", bits, 0.1, "00" * 32, "11" * 32).to_json())
    commit = ("--output", "commitment.json")
    workshop.json("commit", "first.json", *commit)
    before = Path("commitment.json").read_bytes()
    assert workshop.refused("commit", "second.json", *commit) == refusal.format("commitment.json.tsq")
    workshop.json("commit", "second.json", *commit, "--overwrite")
    assert Path("old-1-commitment.json").read_bytes() == before != Path("commitment.json").read_bytes()
    with jm.Catalogue("shop.db") as shop, shop.database.writing():
        pass
    export = ("catalogue", "export", "first.json", "--catalogue", "shop.db")
    assert workshop.refused(*export) == refusal.format("first.json")
    assert workshop.json(*export, "--overwrite")["originals"] == 0


@pytest.mark.slow
def test_overwriting_keeps_the_record_of_the_replaced_copy(workshop: Workshop):
    record, other = "marked.ply.jaxmark.json", "c0ffee00c0ffee00"
    workshop.embed()
    first = Path(record).read_bytes()
    again = ("embed", "model.ply", "marked.ply", "--key", "owner.key", "--message", other, "--overwrite")
    assert Path(workshop.json(*again)["old_record"]).samefile(f"old-1-{record}")
    assert Path(f"old-1-{record}").read_bytes() == first
    assert workshop.json("detect", "marked.ply", *DETECT, "--record", record)["message"] == other
    assert {path.name for path in Path().iterdir()} == {
        *("model.ply", "owner.key", "marked.ply", record, f"old-1-{record}")
    }


def test_help_teaches_and_units_are_stated(workshop: Workshop):
    for command in (
        [],
        ["keygen"],
        ["embed"],
        ["detect"],
        ["attack"],
        ["compare"],
        ["capacity"],
        ["identify"],
        ["commit"],
        ["study"],
        ["demo"],
    ):
        code, out, _ = workshop(*command, "--help")
        assert code == 0
        assert len(out.splitlines()) > 5
    assert "bits per coordinate" in workshop("attack", "--help")[1]
    code, out, _ = workshop("--version")
    assert code == 0
    assert re.search(r"\d+\.\d+", out)


def test_module_and_script_are_the_same_program(tmp_path):
    module = subprocess.run(
        [sys.executable, "-m", "jaxmark", "detect", "a.ply", "--original", "b.ply", "--key", "k"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert module.returncode == 2
    assert module.stdout == ""
    assert module.stderr.startswith("jaxmark: ")
    assert module.stderr.count("\n") == 1


@pytest.mark.long
def test_a_closed_pipe_does_not_change_the_status(workshop: Workshop):
    workshop.embed()
    for suspect, status in (("marked.ply", 0), ("model.ply", 1)):
        command = f"{sys.executable} -m jaxmark detect {suspect} {' '.join(DETECT)} | head -c0; exit ${{PIPESTATUS[0]}}"
        assert subprocess.run(["bash", "-c", command], capture_output=True, check=False).returncode == status


def test_an_interrupted_write_leaves_no_output(workshop: Workshop, monkeypatch):
    monkeypatch.setattr(
        "jaxmark.app.mark_files.write_atomically", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left"))
    )
    assert "No space left" in workshop.refused(
        "embed", "model.ply", "out.ply", "--key", "owner.key", "--message", MESSAGE
    )


@pytest.mark.long
def test_demo_leaves_tables_and_pictures(workshop: Workshop, monkeypatch):
    # A key that a scheme cannot use is said to be refused; here is one that all schemes take.
    keys = (jm.Key(bytes([first, *bytes(31)])) for first in range(99))
    monkeypatch.setattr("jaxmark.app.demo.new_key", lambda: next(keys))
    monkeypatch.setattr("jaxmark.app.demo.os.urandom", lambda size: bytes(range(size)))
    told = workshop.json("demo", "model.ply", "--output", "shown")
    assert {row["scheme"] for row in told["rows"]} == {"keyed", "host", "eigen"}
    unattacked = [row for row in told["rows"] if row["attack"] == "none"]
    assert all(row["message_read"] for row in unattacked)
    assert any(not row["message_read"] for row in told["rows"])  # losses are printed as losses
    controls = [row for row in told["rows"] if row["control"] != "marked"]
    assert [row["control"] for row in controls] == 3 * ["unmarked", "wrong-key"]
    assert not any(row["message_read"] or row["detected"] for row in controls)
    assert told["verdict"][0].startswith("The scheme 'keyed' read the message from ")
    assert (
        told["verdict"][-1] == "In 6 controls, without a mark or with a wrong key, nothing was detected, as expected."
    )
    meshes = {name: loaded(f"shown/marked-{name}.ply").vertices for name in ("keyed", "host", "eigen")}
    moved = [np.linalg.norm(mesh - loaded("model.ply").vertices) for mesh in meshes.values()]
    assert moved == pytest.approx([moved[0]] * 3, rel=0.01)  # all at one displacement
    names = {path.name for path in Path("shown").iterdir()}
    assert {"table.md", "mark.png", "attacked.png", "marked-keyed.ply", "marked-keyed.ply.jaxmark.json"} <= names
    for picture in ("mark.png", "attacked.png"):
        assert Path("shown", picture).read_bytes().startswith(b"\x89PNG")
