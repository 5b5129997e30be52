"""What the documents say is run."""

import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

import jaxmark as jm
from jaxmark import cli
from tests.samples import bumpy_sphere

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    trimesh.Trimesh(*bumpy_sphere(4), process=False).export("model.ply")
    Path("names.txt").write_text("alice\nbob\n")
    Path("models").mkdir()
    shutil.copy("model.ply", "models")
    Path("study.toml").write_text('seeds = 1\n[meshes]\nmodel = "model.ply"\n[attacks]\nnoise = [0.005]\n')
    return tmp_path


def test_python_blocks_of_the_readme_run(folder: Path, unchecked, capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) >= 2
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert names["found"].message == bytes.fromhex("0123456789abcdef")
    assert "0123456789abcdef" in capsys.readouterr().out
    assert (names["scores"] > 0).tolist() == [True, False, False, True]
    assert sorted(one.recipient for one in names["accused"] if one.log10_p < -6) == ["alice", "bob"]
    assert [rate["read"] for rate in names["results"].rates() if rate["control"] == "marked"] == [2, 2]
    assert names["gradient"].shape == names["x"].shape


def test_python_block_of_the_page_on_robustness_runs(unchecked, capsys):
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "robustness.md").read_text(), re.DOTALL)
    names: dict = {"mesh": bumpy_sphere(4), "key": jm.Key(bytes(32))}
    exec(compile(block, "robustness.md", "exec"), names)
    assert names["curve"].success.all()


@pytest.mark.slow
def test_shell_lines_of_the_readme_run(folder: Path, unchecked, monkeypatch, capsys):
    lines = re.findall(r"^    (jaxmark .*)$", README, re.MULTILINE)
    assert len(lines) >= 8
    for line in lines:
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        with pytest.raises(SystemExit) as end:
            sys.exit(cli.main())
        assert end.value.code in (0, None), (line, capsys.readouterr())


def test_make_targets_of_the_readme_exist():
    targets = set(re.findall(r"^    make (\w+)", README, re.MULTILINE))
    assert targets == {"demo", "test"}
    for target in targets:
        subprocess.run(["make", "-n", target], cwd=ROOT, check=True, capture_output=True)


def test_tests_that_the_page_on_the_paper_names_exist():
    named = re.findall(r"`tests/(\w+\.py)::(\w+)`", (ROOT / "docs" / "paper.md").read_text())
    assert len(named) >= 20
    for file, test in named:
        assert re.search(rf"^def {test}\(", (ROOT / "tests" / file).read_text(), re.MULTILINE), f"{file}::{test}"


def test_names_that_the_page_on_the_paper_gives_exist():
    named = set(re.findall(r"`(jaxmark(?:\.\w+)+)", (ROOT / "docs" / "paper.md").read_text()))
    assert len(named) >= 20
    for name in named:
        pkgutil.resolve_name(name)


@pytest.mark.slow
def test_payloads_of_the_readme_are_carried():
    mesh, key = bumpy_sphere(4), jm.Key(bytes(32))
    for scheme, bits in (("host", 192), ("eigen", 96)):
        assert re.search(rf"\b{bits} bits \(`{scheme}`\)", README)
        marked, _ = jm.embed(mesh, bytes(range(bits // 8)), key, scheme=scheme)
        assert jm.detect(marked, original=mesh, key=key, scheme=scheme, bits=bits).detected()
