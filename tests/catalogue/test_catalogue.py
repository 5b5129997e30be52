"""The catalogue as a file: what goes in comes out, by several processes, and whatever the file is."""

import hashlib
import io
import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from scipy.special import sph_harm_y

import jaxmark as jm
from jaxmark.catalogue import descriptors, export_catalogue, import_catalogue
from jaxmark.catalogue.retrieval import Index
from tests.app.test_cli import Workshop
from tests.samples import rough_sphere


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    return Workshop(tmp_path, monkeypatch, capfd)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """A folder with three originals, of which one is too small for any mark."""
    monkeypatch.chdir(tmp_path)
    for name, count in (("large", 700), ("other", 500), ("tiny", 12)):
        jm.save_mesh(rough_sphere(count, seed=count), f"{name}.ply")
    return tmp_path


def turned(mesh: jm.Mesh, scale: float = 3.0) -> jm.Mesh:
    """A mesh elsewhere, turned, mirrored and scaled."""
    matrix, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    return jm.Mesh(mesh.vertices @ (matrix * np.sign(-np.linalg.det(matrix))) * scale + 7, mesh.faces)


@pytest.mark.parametrize("degree", [0, 1, 5, 12])
def test_harmonics_span_those_of_scipy(degree: int):
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = descriptors.real_harmonics(directions, 12)[:, degree**2 : (degree + 1) ** 2]
    angles = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    theirs = np.stack([np.asarray(sph_harm_y(degree, order, *angles)) for order in range(degree + 1)], axis=1)
    theirs = np.concatenate(
        [np.real(theirs[:, :1]), np.sqrt(2) * np.real(theirs[:, 1:]), np.sqrt(2) * np.imag(theirs[:, 1:])], 1
    )
    np.testing.assert_allclose(found @ found.T, theirs @ theirs.T, atol=1e-12)  # the same space, orthonormal


def test_descriptors_do_not_change_with_the_pose():
    mesh, other = rough_sphere(700), rough_sphere(700, seed=1)
    seen = [descriptors.spread(one) for one in (mesh, turned(mesh), other)]
    first, moved, another = (descriptors.whole(one) for one in seen if one is not None)
    assert np.abs(first - moved).sum() < 0.2 * np.abs(first - another).sum()


def test_points_are_spread_by_area():
    """A closed surface's points have its centre and covariance, computed exactly by `trimesh`."""
    import trimesh

    mesh = rough_sphere(300)
    seen = descriptors.spread(mesh)
    assert seen is not None
    solid = trimesh.Trimesh(*mesh, process=False)
    centre = solid.triangles_center.T @ solid.area_faces / solid.area
    np.testing.assert_allclose(seen.points.mean(axis=0), centre, atol=1e-3)
    assert seen.area == pytest.approx(solid.area)


def test_what_is_added_is_listed_shown_checked_and_removed(folder: Path):
    with jm.Catalogue("shop.db") as catalogue:
        added = [catalogue.add(f"{name}.ply") for name in ("large", "other", "tiny")]
        assert [one.status for one in added] == ["added"] * 3
        before = Path("shop.db").read_bytes()
        assert catalogue.add("large.ply").status == "known"
        assert Path("shop.db").read_bytes() == before
        listed = catalogue.originals()
        assert [entry.vertices for entry in listed] == [700, 500, 12]
        assert listed[0].content == hashlib.sha256(Path("large.ply").read_bytes()).hexdigest()
        assert all(problem is None for _, problem in catalogue.check())
        picture = matplotlib.image.imread(io.BytesIO(catalogue.thumbnail(1)))
        assert picture.shape[:2] == (96, 96)
        assert 0.2 < (picture < 1).mean() < 0.9
        Path("other.ply").write_bytes(Path("tiny.ply").read_bytes())
        Path("tiny.ply").unlink()
        problems = [problem for _, problem in catalogue.check()]
        assert [problem and problem.split()[-1] for problem in problems] == [None, "changed", "missing"]
        catalogue.remove("2")
        assert [entry.id for entry in catalogue.originals()] == [1, 3]
        assert catalogue.add("other.ply").status == "moved"  # the tiny one, whose file was deleted
        assert catalogue.show("tiny.ply" if Path("tiny.ply").exists() else "other.ply")["id"] == 3


def test_records_and_copies_belong_to_their_originals(folder: Path, key: jm.Key):
    mesh = jm.load_mesh("large.ply")
    _, info = jm.embed(mesh, b"", key)
    with jm.Catalogue("shop.db") as catalogue:
        with pytest.raises(jm.JaxmarkError, match="original is not in the catalogue"):
            catalogue.add_record(info.record)
        catalogue.add("large.ply")
        assert [catalogue.add_record(info.record)[0].status for _ in range(2)] == ["added", "known"]
        with pytest.raises(jm.JaxmarkError, match="without which its copies cannot be traced"):
            catalogue.remove("1")
        shown = catalogue.show("1")
        assert shown["shapes"][0]["records"][0]["digest"] == info.record.digest()
        catalogue.remove("1", records=True)
        assert not catalogue.originals()
    assert bytes(key) not in Path("shop.db").read_bytes()
    assert bytes(key).hex().encode() not in Path("shop.db").read_bytes()


def test_what_is_exported_is_imported_once(folder: Path, key: jm.Key):
    _, info = jm.embed(jm.load_mesh("large.ply"), b"", key)
    with jm.Catalogue("shop.db") as catalogue, jm.Catalogue("other.db") as other:
        for name in ("large", "tiny"):
            catalogue.add(f"{name}.ply", copy=name == "tiny")
        catalogue.add_record(info.record)
        catalogue.record_verdict("00", "suspect.ply", {"named": False})
        assert export_catalogue(catalogue, "all.jsonl") == (2, 1, 0, 1)
        assert import_catalogue(other, "all.jsonl") == (2, 1, 0, 1)
        assert import_catalogue(other, "all.jsonl") == (0, 0, 0, 0)
        export_catalogue(other, "again.jsonl")
        assert Path("again.jsonl").read_text() == Path("all.jsonl").read_text()
        Path("tiny.ply").unlink()
        np.testing.assert_array_equal(other.load(2).vertices, rough_sphere(12, 12).vertices.astype(np.float32))
        lines = Path("all.jsonl").read_text().splitlines()
        Path("cut.jsonl").write_text("\n".join([*lines[:2], lines[2][:99], *lines[3:]]))
        with pytest.raises(jm.JaxmarkError, match="line 3: it is damaged"), jm.Catalogue("third.db") as third:
            import_catalogue(third, "cut.jsonl")
        for kept, sentence in (
            (lines[:-1], f"it was cut after line {len(lines) - 1}"),
            (lines[:1], "it was cut after line 1"),
            ([*lines[:1], *lines[2:]], "its original is neither in the export nor in the catalogue"),
            ([*lines[:2], *lines[3:]], "other rows than were exported"),
            ([line for line in lines if not line.startswith('{"key"')], "its key is neither"),
            ([*lines, lines[1]], "other rows than were exported"),
        ):
            Path("cut.jsonl").write_text("\n".join(kept))
            with pytest.raises(jm.JaxmarkError, match=sentence), jm.Catalogue("third.db") as third:
                import_catalogue(third, "cut.jsonl")
        with jm.Catalogue("third.db") as third:
            assert not third.originals()


def test_exports_of_the_first_version_are_imported(folder: Path):
    """They do not end with the number of their rows."""
    with jm.Catalogue("shop.db") as catalogue, jm.Catalogue("other.db") as other:
        catalogue.add("large.ply")
        export_catalogue(catalogue, "all.jsonl")
        lines = Path("all.jsonl").read_text().splitlines()
        Path("old.jsonl").write_text("\n".join([lines[0].replace('"version": 2', '"version": 1'), *lines[1:-1]]))
        assert import_catalogue(other, "old.jsonl").originals == 1


def test_a_damaged_copy_in_the_catalogue_is_named(folder: Path):
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add("tiny.ply", copy=True)
        catalogue.database.run("UPDATE originals SET copy = x'00'")
        Path("tiny.ply").unlink()
        with pytest.raises(jm.JaxmarkError, match=r"the copy of .*tiny\.ply in the catalogue .*shop\.db"):
            catalogue.load(1)


def test_a_catalogue_without_a_change_leaves_no_file(folder: Path):
    with jm.Catalogue("new.db") as catalogue, jm.Catalogue("new.db") as other:
        with pytest.raises(jm.JaxmarkError, match=r"absent\.ply"):
            catalogue.add("absent.ply")
        assert catalogue.originals() == []
        assert not Path("new.db").exists()
        assert other.add("tiny.ply").status == "added"
        assert [Path(entry.path).name for entry in catalogue.originals()] == ["tiny.ply"]
        assert catalogue.add("tiny.ply").status == "known"


def test_a_query_may_be_left_after_the_catalogue_is_closed(folder: Path):
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add("tiny.ply")
        rows = catalogue.database.each("SELECT 1 UNION SELECT 2")
        next(rows)
    del rows


def test_catalogues_of_the_first_version_are_brought_up(folder: Path):
    """Their originals have no landmarks: they are described again when their files are added again."""
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add("large.ply")
        export_catalogue(catalogue, "all.jsonl")
        held = catalogue.database.rows("SELECT landmarks FROM shapes")[0]["landmarks"]
        assert len(held) == 20 * 256
        catalogue.database.run("ALTER TABLE shapes DROP COLUMN landmarks")
        catalogue.database.run("UPDATE shapes SET described = 1")
        catalogue.database.run("PRAGMA user_version = 1")
    lines = [json.loads(line) for line in Path("all.jsonl").read_text().splitlines()]
    for shape in lines[1]["original"]["shapes"]:
        del shape["landmarks"]
        shape["described"] = 1
    Path("old.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with jm.Catalogue("shop.db") as catalogue, jm.Catalogue("other.db") as other:
        assert import_catalogue(other, "old.jsonl").originals == 1
        for one in (catalogue, other):
            assert one.database.rows("SELECT landmarks FROM shapes")[0]["landmarks"] == b""
            with pytest.raises(jm.JaxmarkError, match="add their files again"):
                Index(one.database)
            assert one.add("large.ply").status == "known"
            assert one.database.rows("SELECT landmarks FROM shapes")[0]["landmarks"] == held


ADDING = "import sys, jaxmark as jm\nwith jm.Catalogue('shop.db') as c:\n for f in sys.argv[1:]: print(c.add(f).status)"


@pytest.mark.slow
def test_two_processes_add_the_same_files_once(folder: Path):
    command = [sys.executable, "-c", ADDING, "large.ply", "other.ply", "tiny.ply"]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [run.communicate()[0].split() for run in runs]
    assert all(run.returncode == 0 for run in runs)
    assert sorted(status for one in said for status in one) == ["added"] * 3 + ["known"] * 3
    with jm.Catalogue("shop.db", read_only=True) as catalogue:
        assert len(catalogue.originals()) == 3
        assert not catalogue.database.problems()


def test_what_is_no_catalogue_is_refused(folder: Path):
    Path("text.db").write_text("no database " * 100)
    with closing(sqlite3.connect("foreign.db")) as foreign, foreign:
        foreign.execute("CREATE TABLE things (x)")
    foreign.close()
    with jm.Catalogue("late.db") as late, late.database.writing():
        late.database.run("PRAGMA user_version = 99")
    with jm.Catalogue("damaged.db") as damaged, damaged.database.writing():
        pass
    data = bytearray(Path("damaged.db").read_bytes())
    data[4096 : len(data)] = os.urandom(len(data) - 4096)
    Path("damaged.db").write_bytes(data)
    refusals = {
        "text.db": "no catalogue",
        "foreign.db": "another program",
        "late.db": "later",
        "nowhere/a.db": "folder",
    }
    for name, reason in refusals.items():
        with pytest.raises(jm.JaxmarkError, match=reason):
            jm.Catalogue(name)
    with pytest.raises(jm.JaxmarkError, match="no catalogue, or is damaged"), jm.Catalogue("damaged.db") as damaged:
        damaged.originals()
    with pytest.raises(jm.JaxmarkError, match="There is no catalogue"):
        jm.Catalogue("none.db", read_only=True)
    with jm.Catalogue("good.db") as good:
        good.add("tiny.ply")
    with jm.Catalogue("good.db", read_only=True) as good, pytest.raises(jm.JaxmarkError, match="reading only"):
        good.add("large.ply")


def test_commands_answer_for_programs(workshop: Workshop, unchecked):
    jm.save_mesh(rough_sphere(12), "-odd.ply")
    where = ("--catalogue", "shop.db")
    told = workshop.json("catalogue", "add", "model.ply", *where)
    assert (told["status"], told["id"]) == ("added", 1)
    assert workshop.json("catalogue", "add", "model.ply", *where)["status"] == "known"
    assert workshop("catalogue", "add", *where, "--", "-odd.ply")[0] == 0
    status, out, _ = workshop("catalogue", "add", "owner.key", "model.ply", *where, "--json")
    assert status == 2
    assert ["refused" in json.loads(line) for line in out.splitlines()] == [True, False]
    assert workshop("catalogue", "list", *where)[1].count("\n") == 2
    assert workshop.json("catalogue", "show", "model.ply", *where)["vertices"] == 2562
    assert workshop.json("catalogue", "export", "all.jsonl", *where)["originals"] == 2
    assert workshop.json("catalogue", "import", "all.jsonl", "--catalogue", "new.db")["originals"] == 2
    assert workshop("catalogue", "check", *where)[0] == 0
    Path("-odd.ply").unlink()
    assert workshop("catalogue", "check", *where)[0] == 1
    assert workshop.json("catalogue", "remove", "2", *where)["id"] == 2
    for refused in (("show", "7"), ("remove", "nothing"), ("import", "owner.key"), ("import", "none.jsonl")):
        assert workshop("catalogue", *refused, *where)[0] == 2
    assert workshop("catalogue", "list", "--catalogue", "mistyped.db")[0] == 2
    assert not Path("mistyped.db").exists()


@pytest.mark.slow
def test_processes_that_are_killed_leave_nothing_half_done(folder: Path, key: jm.Key):
    for number in range(3):
        jm.save_mesh(rough_sphere(100, seed=number), f"{number}.obj")
    _, info = jm.embed(jm.load_mesh("large.ply"), b"", key)
    jm.save_mesh(jm.load_mesh("large.ply"), "0.obj")
    Path("record.json").write_text(info.record.to_json())
    program = Path(__file__).with_name("killed.py")
    done = subprocess.run([sys.executable, program, "25"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("50 processes killed")
