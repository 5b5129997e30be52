"""Which meshes of a file are read without an original, and what that costs."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app import read_files
from jaxmark.files import limits
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.record import SceneRecord, make_commitment
from tests.samples import rough_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
KEY = jm.Key(bytes(range(32)))
LOG10_P = -20.0


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of points of the meshes that are read, each with the same evidence."""
    points: list[int] = []

    def read_blind(mesh: Mesh, *_: object, **__: object) -> Detection:
        points.append(len(mesh.vertices))
        evidence = Evidence(LOG10_P, LOG10_P, LOG10_P, LOG10_P)
        return Detection(b"8 bytes!", evidence, None, np.zeros(1), None, "local")

    monkeypatch.setattr(read_files, "read_blind", read_blind)
    monkeypatch.setattr(read_files, "detection_values", lambda detection, *_: {"detection": detection})
    monkeypatch.setattr(read_files, "detection_lines", lambda *_, **__: "")
    return points


def file_of(folder: Path, sizes: list[int]) -> Path:
    """An OBJ file of spheres of so many points, named by their sizes."""
    lines, first = [], 1
    for size in sizes:
        mesh = rough_sphere(size)
        lines += [f"o {size}", *("v {} {} {}".format(*row) for row in np.asarray(mesh.vertices))]
        lines += ["f {} {} {}".format(*row) for row in np.asarray(mesh.faces) + first]
        first += size
    (folder / "scene.obj").write_text("\n".join(lines))
    return folder / "scene.obj"


def detection(file: Path, *meshes: str) -> Detection:
    reader = read_files.FileReader(KEY, 64, None, meshes=meshes)
    return reader.read(file, None).values["detection"]


def test_the_largest_meshes_are_read_and_all_are_charged(tmp_path: Path, read: list[int]):
    sizes = [*range(40, 60), *range(100, 111)]
    found = detection(file_of(tmp_path, sizes))
    assert read == [*range(110, 110 - limits.BLIND_MESHES, -1)]
    assert "Only the 8 largest of 11 meshes were read" in found.notes[0]
    assert found.log10_p == pytest.approx(LOG10_P + math.log10(11))


def test_selected_meshes_are_charged_as_all_that_could_be_selected(tmp_path: Path, read: list[int]):
    found = detection(file_of(tmp_path, [*range(40, 60), *range(100, 111)]), "101")
    assert read == [101]
    assert not any("largest" in note for note in found.notes)
    assert found.log10_p == pytest.approx(LOG10_P + math.log10(11))


def test_equal_meshes_are_read_and_charged_once(tmp_path: Path, read: list[int]):
    file = file_of(tmp_path, [100, 101, 100, 101, 100])
    for meshes, expected in (((), [101, 100]), (("100 #2", "100"), [100])):
        read.clear()
        assert detection(file, *meshes).log10_p == pytest.approx(LOG10_P + math.log10(2))
        assert read == expected


def test_meshes_that_are_too_small_are_refused_unread(tmp_path: Path, read: list[int]):
    file = file_of(tmp_path, [40, 50, 100])
    assert detection(file).log10_p == LOG10_P
    for meshes in (["40"], ["40", "50"]):
        with pytest.raises(jm.JaxmarkError, match="needs a mesh of 100 points or more"):
            detection(file, *meshes)
    with pytest.raises(jm.JaxmarkError, match="needs a mesh of 100 points or more, and there is none; give --original"):
        detection(file_of(tmp_path, [40]))
    assert read == [100]


@pytest.mark.parametrize(
    ("schemes", "has_record", "advice"),
    [
        ((), False, "read only with --original. .* marks of 'field' are then read only with its hint"),
        (("field",), False, "marks of 'field' are then read only with its hint"),
        (("rooted",), False, None),
        ((), True, "Only the mark of the record was looked for"),
    ],
)
def test_where_nothing_was_found_another_reading_is_advised(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    schemes: tuple[str, ...],
    has_record: bool,
    advice: str | None,
):
    """With a record, the reading without it, and the reverse, but only where it may find more."""
    nothing = Detection(None, Evidence(), None, np.zeros(1), None, "field")
    entry = SimpleNamespace(scheme="field", digest=lambda: "0")
    record = SimpleNamespace(meshes={"": entry}, caveats=lambda _: (), **vars(entry))
    monkeypatch.setattr(read_files, "read_blind", lambda *_, **__: nothing)
    monkeypatch.setattr(read_files, "load_record", lambda _: record)
    monkeypatch.setattr(read_files, "detection_values", lambda detection, *_: {"notes": detection.notes})
    reader = read_files.FileReader(KEY, 64, None, schemes=schemes)
    notes = reader.read(file_of(tmp_path, [100]), None, tmp_path if has_record else None).values["notes"]
    assert len(notes) == (advice is not None)
    assert advice is None or re.search(advice, notes[0])


def test_a_suspect_is_refused_before_the_original_is_prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(read_files, "make_marker", lambda *_, **__: pytest.fail("The original was prepared."))
    reader = read_files.FileReader(KEY, 64, None)
    with pytest.raises(jm.JaxmarkError, match=r"Cannot read .*missing\.obj"):
        reader.read(tmp_path / "missing.obj", file_of(tmp_path, [100]))


def test_what_records_say_is_checked_before_meshes_are_read(tmp_path: Path):
    _, info = jm.watermark.embed_scene({"a": rough_sphere(400)}, b"", KEY, budget=2e-3)
    (tmp_path / "record.json").write_text(info.record.to_json())
    other = make_commitment(["0" * 64])
    with pytest.raises(jm.JaxmarkError, match="not in the commitment"):
        read_files.FileReader(KEY, None, None, commitment=other).read(
            tmp_path / "absent.obj", tmp_path / "absent.obj", tmp_path / "record.json"
        )


def test_a_record_without_a_code_gives_no_dossier(tmp_path: Path):
    mesh = rough_sphere(800)
    marked, info = jm.watermark.embed_scene({"a": mesh}, b"", KEY, budget=2e-3)
    for name, one in (("original", mesh), ("marked", marked["a"])):
        jm.save_mesh(one, tmp_path / f"{name}.ply")
    meshes = {"mesh": info.record.meshes["a"]}
    (tmp_path / "record.json").write_text(SceneRecord(meshes).to_json())
    files = (tmp_path / "marked.ply", tmp_path / "original.ply", tmp_path / "record.json")
    outcome = read_files.FileReader(KEY, None, None).read(*files, dossier=tmp_path / "case")
    assert (outcome.values["detected"], outcome.values["estimate"], outcome.values["dossier"]) == (False, True, None)
    assert "There is no dossier of an estimate: the record of the scene has no code" in outcome.lines[-1]
    assert not (tmp_path / "case").exists()
