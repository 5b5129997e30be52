"""Marks in files whose numbers are coarse: rounded as the file will, read back, and then decided."""

from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app import mark_files
from jaxmark.app.mark_files import mark_file
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.perception.capacity import Survival
from jaxmark.watermark.record import load_record
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
BUDGET = jm.Budget(rms=2e-3)  # of a diagonal of about 3.5


def objects(path: Path, decimals: int, *meshes: Mesh) -> Path:
    """An OBJ file with one object for each mesh."""
    text, base = "", 1
    for name, (vertices, faces) in zip("abc", meshes, strict=False):
        text += f"o {name}\n" + "".join(f"v {' '.join(f'{x:.{decimals}f}' for x in row)}\n" for row in vertices)
        text += "".join("f {} {} {}\n".format(*row) for row in np.asarray(faces) + base)
        base += len(vertices)
    path.write_text(text)
    return path


def marked(source: Path, key: Key) -> mark_files.FileOutcome:
    """Mark a file, presence only."""
    out = source.with_name(f"marked-{source.name}")
    return mark_file(source, out, out.with_suffix(".json"), key=key, message=b"", budget=BUDGET)


def test_numbers_coarser_than_the_mark_are_read_back(tmp_path: Path, key: Key):
    source = objects(tmp_path / "coarse.obj", 2, bumpy_sphere(3))
    outcome = marked(source, key)
    note, excess = outcome.values["notes"]
    assert note.startswith("rounding to the numbers of the file changes the displacement by ")
    assert excess.startswith("after rounding to the numbers of the file, the RMS displacement is ")
    assert outcome.lines[-2:] == (note, excess)
    written = jm.load_mesh(tmp_path / "marked-coarse.obj")
    rms = jm.distortion.compare(jm.load_mesh(source), written, ["rms"]).rms
    assert excess.endswith(f"displacement is {rms:.3g}, above {BUDGET.rms:.3g}")
    found = jm.detect(jm.load_mesh(tmp_path / "marked-coarse.obj"), original=jm.load_mesh(source), key=key, message=b"")
    assert found.detected()
    with pytest.raises(JaxmarkError, match=r"0\.1 apart, so that rounding takes .* % of that; write its"):
        marked(objects(tmp_path / "coarser.obj", 1, bumpy_sphere(3)), key)


def test_meshes_whose_marks_do_not_survive_rounding_are_left_unchanged(tmp_path: Path, key: Key, monkeypatch):
    source = objects(tmp_path / "two.obj", 6, bumpy_sphere(2), bumpy_sphere(3))
    losing: set[int] = {162}  # vertices of the first

    def survival(marker: jm.watermark.NonBlindMarker, suspect: Mesh, *_: object) -> Survival | None:
        return None if len(suspect.vertices) in losing else Survival(0.02, 0.01)

    monkeypatch.setattr(jm.watermark.NonBlindMarker, "measure_survival", survival)
    outcome = marked(source, key)
    assert list(outcome.values["meshes"]) == ["b"]
    assert "cannot be read after rounding" in outcome.values["skipped"]["a"]
    before, after = (jm.files.load_scene(tmp_path / name).meshes for name in ("two.obj", "marked-two.obj"))
    np.testing.assert_array_equal(before["a"].vertices, after["a"].vertices)
    assert not np.array_equal(before["b"].vertices, after["b"].vertices)
    assert list(load_record(tmp_path / "marked-two.json").meshes) == ["b"]


def test_equal_meshes_get_equal_marks_that_are_measured_once(tmp_path: Path, key: Key, monkeypatch):
    source = objects(tmp_path / "twins.obj", 6, *[bumpy_sphere(3)] * 3)
    measured = []

    def survival(marker: jm.watermark.NonBlindMarker, suspect: Mesh, *_: object) -> Survival:
        measured.append(suspect)
        return Survival(0.02, 0.01)

    monkeypatch.setattr(jm.watermark.NonBlindMarker, "measure_survival", survival)
    assert list(marked(source, key).values["meshes"]) == ["a", "b", "c"]
    assert len(measured) == 1
    first, *others = jm.files.load_scene(tmp_path / "marked-twins.obj").meshes.values()
    for other in others:
        np.testing.assert_array_equal(other.vertices, first.vertices)
