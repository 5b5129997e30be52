"""Deposits, dossiers and hints from the command line: what they say, what they keep to themselves, what they refuse."""

import hashlib
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import make_original
from jaxmark.app import dossier
from jaxmark.app.output import power
from jaxmark.watermark.coding.keys import commitment
from jaxmark.watermark.record import TimestampedCommitment
from tests.app.test_cli import Workshop
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
KEY = jm.Key(bytes(range(32)))
DETECT = ("--original", "model.ply", "--key", "owner.key")
RECORD = ("--record", "marked.ply.jaxmark.json")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A marked mesh, its original, the original saved again, and the record."""
    folder = tmp_path_factory.mktemp("files")
    mesh = bumpy_sphere(3)
    jm.save_mesh(mesh, folder / "model.ply")
    marked, info = jm.embed(jm.load_mesh(folder / "model.ply"), b"ok", KEY, budget=jm.Budget(rms=2e-3, noise=0))
    jm.save_mesh(marked, folder / "marked.ply")
    jm.save_mesh(mesh._replace(vertices=1000 * mesh.vertices + 7), folder / "millimetres.stl")
    dented = np.where(mesh.vertices[:, :1] > 0.8, 1.01 * mesh.vertices, mesh.vertices)
    jm.save_mesh(mesh._replace(vertices=dented), folder / "dented.ply")
    (folder / "marked.ply.jaxmark.json").write_text(info.record.to_json())
    return folder


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd, files: Path) -> Workshop:
    made = Workshop(tmp_path, monkeypatch, capfd)
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    return made


def test_a_deposit_and_a_request_to_date_it_are_written(workshop: Workshop):
    Path("second.json").write_text(json.dumps(json.loads(Path(RECORD[1]).read_text()) | {"beta": 1.0}))
    told = workshop.json("commit", RECORD[1], "second.json", "--output", "all.json")
    deposit = TimestampedCommitment.load("all.json")
    assert told == {"root": deposit.root, "records": 2, "commitment": "all.json", "request": "all.json.tsq"}
    assert bytes.fromhex(deposit.root) in Path("all.json.tsq").read_bytes()
    assert jm.Record.load(RECORD[1]).digest() in deposit.digests
    # Nothing of what the records commit to, not even the commitments.
    text = Path("all.json").read_text()
    record = json.loads(Path(RECORD[1]).read_text())
    assert not [name for name in ("key", "original", "told", "code") if record[name] in text]
    said = workshop("commit", RECORD[1], "second.json", "--output", "again.json")[1]
    assert said == f"2 records → again.json, root {deposit.root}, request → again.json.tsq\n"
    for arguments, sentence in [
        (("model.ply", "--output", "o.json"), "not a record"),
        (("all.json", "--output", "o.json"), "not a record"),
        ((RECORD[1], "--output", RECORD[1]), "same file"),
        (("made.json.tsq", "--output", "made.json", "--overwrite"), "request and record 0 are the same file"),
        ((RECORD[1], "--output", "no/o.json"), "no"),
    ]:
        assert sentence in workshop.refused("commit", *arguments)


def test_a_dossier_shows_all_but_the_secret(workshop: Workshop):
    Path("second.json").write_text(json.dumps(json.loads(Path(RECORD[1]).read_text()) | {"beta": 1.0}))
    workshop.json("commit", RECORD[1], "second.json", "--output", "all.json")
    Path("secrets").mkdir()
    Path("owner.key").rename("secrets/mine.key")
    detect = ("detect", "marked.ply", "--original", "millimetres.stl", "--key", "secrets/mine.key", *RECORD)
    more = ("--commitment", "all.json", "--obtained", "a shop <b>& co</b>, 1 May", "--dossier", "case")
    told = workshop.json(*detect, *more)
    assert (told["detected"], told["estimate"]) == (True, False)
    assert told["caveats"] == told["notes"] == []
    assert told["message"] == b"ok".hex()
    assert told["version"] == 2
    assert told["suspect_sha256"] == hashlib.sha256(Path("marked.ply").read_bytes()).hexdigest()
    assert told["record_digest"] == jm.Record.load(RECORD[1]).digest()
    assert told["log10_p_timestamped"] == pytest.approx(told["log10_p"] + np.log10(2))
    first, *others = told["charges_timestamped"]
    assert others == told["charges"]
    assert (first["choice"], first["log10"]) == ("timestamped commitment", pytest.approx(np.log10(2)))
    assert told["log10_p"] < told["log10_p_uncommitted"] < -6
    assert told["dossier"] == "case"
    assert {path.name for path in Path("case").iterdir()} == {"dossier.html", "dossier.json"}

    page, facts = Path("case/dossier.html").read_text(), json.loads(Path("case/dossier.json").read_text())
    for secret in (KEY.hex(), KEY.hex().upper(), "mine.key", "secrets", str(workshop.folder)):
        assert secret not in page
        assert secret not in json.dumps(facts)
    for shown in (
        b"ok".hex(),
        told["suspect_sha256"],
        told["record_digest"],
        commitment(KEY),
        TimestampedCommitment.load("all.json").root,
    ):
        assert shown in page
        assert shown in json.dumps(facts)
    assert "a shop &lt;b&gt;&amp; co&lt;/b&gt;, 1 May" in page
    assert page.count("data:image/png;base64,") == 4
    for name in ("log10_p", "log10_p_uncommitted"):
        assert facts[name] == told[name]
        assert power(told[name]).removeprefix("10^") in page
    assert facts["commitment"]["log10_p"] == told["log10_p_timestamped"]
    assert facts["chance"] == f"at most once in 10^{math.floor(-told['log10_p_uncommitted'])} cases"  # without a date
    assert "Key, original, message and record were all fixed" in page
    words = facts["command"].split()
    assert words == ["jaxmark", *(word.replace("secrets/mine.key", "KEYFILE") for word in detect)]

    _, said, _ = workshop(*detect, "--commitment", "all.json")
    assert f"{power(told['log10_p'])} if key, original, message and record were fixed" in said
    assert f"{power(told['log10_p_uncommitted'])} even if they were chosen afterwards" in said
    assert f"{power(told['log10_p_timestamped'])} if the commitment is older than the suspect" in said


def test_there_is_no_dossier_of_less_than_a_proof(workshop: Workshop):
    told = workshop.json("detect", "marked.ply", *DETECT[2:], "--original", "dented.ply", *RECORD, status=3)
    assert (told["detected"], told["estimate"]) == (False, True)
    assert told["log10_p"] < -6
    assert "the original was edited" in told["caveats"][0]
    edited = ("detect", "marked.ply", *DETECT[2:], "--original", "dented.ply", *RECORD, "--dossier", "case")
    status, said, _ = workshop(*edited)
    assert status == 3
    assert said.startswith("estimate, not a proof: message 6f6b")
    assert "an estimate: the original was edited" in said
    assert "There is no dossier of an estimate" in said.splitlines()[-1]
    assert workshop.json(*edited, status=3)["dossier"] is None
    status, said, _ = workshop("detect", "model.ply", *DETECT, *RECORD, "--dossier", "case")
    assert status == 1
    assert said.startswith("nothing detected")
    assert "There is no dossier, because nothing was detected" in said
    workshop.json("commit", RECORD[1], "--output", "all.json")
    Path(RECORD[1]).write_text(json.dumps(json.loads(Path(RECORD[1]).read_text()) | {"beta": 1.0}))
    assert "was edited" in workshop.refused("detect", "marked.ply", *DETECT, *RECORD, "--commitment", "all.json")
    assert "not a commitment" in workshop.refused("detect", "marked.ply", *DETECT, *RECORD, "--commitment", RECORD[1])
    assert not Path("case").exists()


@pytest.mark.slow
def test_an_original_moved_against_the_mark_does_not_make_its_unmarked_mesh_detected(workshop: Workshop):
    """The owner moves the points that the mark moves most, so that the unmarked mesh differs as a marked one would."""
    original, marked = jm.load_mesh("model.ply"), jm.load_mesh("marked.ply")
    shift = np.asarray(marked.vertices, np.float64) - original.vertices
    order = np.argsort(-np.linalg.norm(shift, axis=1))
    detect = ("detect", "model.ply", "--original", "edited.ply", *DETECT[2:], *RECORD, "--text", "ok")

    def edit(share: float) -> jm.Mesh:
        moved, some = np.array(original.vertices, np.float64), order[: int(share * len(order))]
        moved[some] -= 0.5 * shift[some]
        jm.save_mesh(original._replace(vertices=moved), "edited.ply", like="model.ply")
        return jm.load_mesh("edited.ply")

    edited, record = edit(0.25), jm.Record.load(RECORD[1])
    found = workshop.json(*detect, status=3)
    assert (found["detected"], found["estimate"]) == (False, True)
    assert found["log10_p"] < -9  # the figure that the caveat accompanies
    assert not jm.detect(original, original=edited, key=KEY, record=record, message=b"ok").detected()
    edit(0.7)
    assert "not the mesh that the record was made for" in workshop.refused(*detect)


def test_a_claim_against_the_record_is_refused(workshop: Workshop):
    claim = ("detect", "marked.ply", *DETECT, "--message")
    assert "commits to another message" in workshop.refused(*claim, b"no".hex(), *RECORD)
    told = workshop.json(*claim, b"no".hex(), "--dossier", "case")
    facts = json.loads(Path("case/dossier.json").read_text())
    assert facts["command"].endswith("--bits 16 --scheme keyed --message CLAIMED")
    assert facts["notes"] == told["notes"]
    assert "in place of CLAIMED" in Path("case/dossier.html").read_text()
    assert told["message"] == b"ok".hex()
    assert "Another message of this key was decoded" in told["notes"][0]
    assert told["log10_p"] > workshop.json(*claim, b"ok".hex(), *RECORD)["log10_p"]


@pytest.mark.slow
def test_mistakes_are_said(workshop: Workshop):
    exchanged = ("detect", "model.ply", "--original", "marked.ply", "--key", "owner.key")
    assert "The files look exchanged" in workshop.json(*exchanged, "--bits", "16", status=1)["notes"][0]
    assert "exchange the two files" in workshop.refused(*exchanged, *RECORD)
    code, said, _ = workshop("detect", "marked.ply", *DETECT, "--bits", "24")
    assert code == 1
    assert "A message of 16 bits is readable with the scheme 'keyed'" in said
    itself = workshop.json("detect", "millimetres.stl", *DETECT, "--bits", "16", status=1)
    assert "same shape" in itself["notes"][0]


def test_how_copies_are_aligned_is_paid_for(workshop: Workshop):
    Path("names.txt").write_text("alice\nbob\n")
    copy, info = jm.fingerprint(jm.load_mesh("model.ply"), "bob", KEY, budget=2e-3)
    jm.save_mesh(copy, "copy.ply")
    Path("copy.json").write_text(info.record.to_json())
    who = ("identify", "copy.ply", *DETECT, "--recipients", "names.txt", "--record", "copy.json")
    usual, same = (workshop.json(*who, *how) for how in ((), ("--align", "same")))
    assert usual["accused"] == same["accused"] == ["bob"]
    least = [one["ranking"][0]["log10_p"] for one in (usual, same)]
    assert least[1] - least[0] == pytest.approx(np.log10(0.97 / 0.01))


def test_reports_show_the_points_where_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Points are numbered by position, vertices as in the file."""
    mesh = bumpy_sphere(2)
    original, dent = make_original(mesh), mesh.vertices.copy()
    dent[7] *= 1.02
    drawn = {}
    monkeypatch.setattr(dossier, "save_views", lambda panels, path: drawn.update({one.title: one for one in panels}))
    suspect = mesh._replace(vertices=dent)
    dossier.save_report(tmp_path, original, suspect, align(original, suspect))
    assert np.flatnonzero(drawn["Weight"].values == 0).tolist() == [7]  # so far off is masked
