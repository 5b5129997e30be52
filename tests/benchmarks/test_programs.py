"""The benchmarks as programs: one folder a question, nothing imported but what they share, run wherever they lie."""

import ast
import importlib
import runpy
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.bench.parametric import SHAPES
from tests import ROOT
from tests.samples import bumpy_sphere

BENCHMARKS = ROOT / "benchmarks"
GROUPS = ("speed", "robustness", "security", "theory", "pictures")
PROGRAMS = sorted(path for group in GROUPS for path in (BENCHMARKS / group).glob("*.py"))
SHARED = sorted((BENCHMARKS / "common").glob("*.py"))
NAMES = [path.stem for path in PROGRAMS]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The benchmarks somewhere else, without the rest of the project."""
    return shutil.copytree(BENCHMARKS, tmp_path / "elsewhere", ignore=shutil.ignore_patterns("__pycache__"))


@pytest.fixture
def afresh() -> Iterator[None]:
    """Run the test without modules of benchmarks that others have imported, and forget its own."""

    def forget() -> None:
        for name in [name for name in sys.modules if name.partition(".")[0] in ("common", *NAMES)]:
            del sys.modules[name]

    forget()
    yield
    forget()


def imported(path: Path) -> set[str]:
    """The first parts of the names of modules that a file imports, wherever in it."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "." for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.partition(".")[0] for name in names}


def test_every_program_lies_in_a_group():
    assert len(PROGRAMS) >= 16
    assert len(set(NAMES)) == len(NAMES)
    assert sorted(BENCHMARKS.rglob("*.py")) == sorted([*PROGRAMS, *SHARED])
    for path in PROGRAMS:
        assert 'if __name__ == "__main__":' in path.read_text(), path


def test_programs_import_no_program():
    for path in [*PROGRAMS, *SHARED]:
        # A program may import itself, so that workers find its functions by its name.
        assert not imported(path) & {*NAMES} - {path.stem}, path


def test_programs_reach_what_they_share_in_one_way():
    way = "\n\nsys.path.insert(0, str(Path(__file__).resolve().parents[1]))\nfrom common."
    for path in PROGRAMS:
        assert path.read_text().count(way) == 1, path
        assert path.read_text().count("sys.path") == 1, path


def test_every_shared_module_is_used():
    texts = [path.read_text() for path in [*PROGRAMS, *SHARED]]
    for module in SHARED:
        used = any(f"\nfrom common.{module.stem} import" in text for text in texts)
        assert used or module.stem == "__init__", module


@pytest.mark.parametrize("program", PROGRAMS, ids=NAMES)
def test_help_is_shown_from_a_copy(program: Path, copy: Path, afresh, monkeypatch, capsys):
    there = copy / program.relative_to(BENCHMARKS)
    monkeypatch.chdir(copy.parent)
    monkeypatch.syspath_prepend(there.parent)  # as Python does for a program
    monkeypatch.setattr(sys, "argv", [str(there), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(there), run_name="__main__")
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert f"python benchmarks/{program.relative_to(BENCHMARKS).as_posix()}" in shown
    assert Path(sys.modules["common"].__file__ or "").parent == copy / "common"


def test_shapes_are_closed_and_of_the_size_asked_for():
    volumes = {"box": 0.28, "cylinder": np.pi * 0.16, "sphere": np.pi / 6, "torus": 2 * np.pi**2 * 0.4 * 0.15**2}
    for name, make in SHAPES.items():
        surface = trimesh.Trimesh(*make(4_000), process=False)
        assert len(surface.vertices) == pytest.approx(4_000, rel=0.02), name
        assert surface.is_winding_consistent, name
        assert surface.area_faces.min() > 0, name
        assert surface.is_watertight == (name not in ("corrugated", "body")), name
        if name in volumes:
            assert surface.volume == pytest.approx(volumes[name], rel=0.01), name


@pytest.mark.slow
def test_a_stage_is_measured_in_a_process_from_a_copy(copy: Path, afresh, monkeypatch):
    monkeypatch.syspath_prepend(copy)
    stages = importlib.import_module("common.stages")
    (row,) = stages.apart(bumpy_sphere(1), ["load"])
    assert row["first call, s"] > 0, row


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(["security/forging.py", "--keys", "1", "--bands", "64", "--tries", "50"], marks=pytest.mark.long),
        pytest.param(["robustness/originals.py"], marks=pytest.mark.slow),
    ],
    ids=["forging", "originals"],
)
def test_a_small_run_ends_well(program: list[str], tmp_path: Path):
    mesh = tmp_path / "bumpy.obj"
    jm.save_mesh(bumpy_sphere(4), mesh)
    command = [sys.executable, BENCHMARKS / program[0], mesh, *program[1:]]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    if program[0].endswith("originals.py"):
        counts = [row.split(" | ")[1:3] for row in ended.stdout.splitlines()[-12:]]
        assert counts == [["1/1", "1/1"]] * 12, ended.stdout
