"""What the documents say is run."""

import contextlib
import doctest
import inspect
import io
import itertools
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.app import cli
from jaxmark.bench.tracks import PROTOCOL
from tests import ROOT
from tests.samples import bumpy_sphere

PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for folder in (ROOT, *(ROOT / "docs" / name for name in ("", "how-to", "reference", "results")))
    for path in sorted(folder.glob("*.md"))
}
README = PAGES["README.md"]
WITH_LIBIGL = ("docs/tutorial.md", "docs/submeshes.md", "docs/how-to/extend.md", "docs/how-to/benchmark.md")
MARKS = dict.fromkeys(
    (*WITH_LIBIGL, "docs/filters.md", *(f"docs/how-to/{name}.md" for name in ("catalogue", "files", "pictures"))),
    pytest.mark.slow,
)
MARKS |= dict.fromkeys(("docs/blind.md", "docs/how-to/strength.md"), pytest.mark.long)  # which tune
# These have tests of their own.
APART = (
    "README.md",
    "docs/robustness.md",
    "docs/how-to/arrays.md",
    "docs/how-to/features.md",
    "docs/how-to/recipients.md",
    "docs/how-to/study.md",
)
COMMANDS = {"README.md": 4, "docs/reference/command_line.md": 19}
SAMPLED = re.compile(r"^ *```python\n(.*?)^ *```\n(?:\n```text\n(.*?)^```)?", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"-?\d+(\.\d+)?")
FENCE = re.compile(r"^( *)```(\w+)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    trimesh.Trimesh(*bumpy_sphere(4), process=False).export("model.ply")
    Path("names.txt").write_text("alice\nbob\n")
    Path("models").mkdir()
    shutil.copy("model.ply", "models")
    Path("study.toml").write_text('samples = 1\n[meshes]\nmodel = "model.ply"\n[attacks]\nnoise = [0.005]\n')
    return tmp_path


def blocks(page: str, language: str) -> list[str]:
    """The blocks of a language, without the indent of a list that they stand in."""
    return [textwrap.dedent(text) for _, kind, text in FENCE.findall(PAGES[page]) if kind == language]


def run(page: str) -> dict:
    """Run the Python blocks of a page in one namespace, in which a mesh and a key are there; new keys are fixed ones.

    Text that follows a block at once is a sample of what it prints, with other numbers.
    """
    names: dict = {"mesh": bumpy_sphere(4), "key": jm.Key(bytes(32))}
    keys = (jm.Key(bytes([number] * 32)) for number in itertools.count())
    for block, sample in SAMPLED.findall(PAGES[page]):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), mock.patch.object(jm, "new_key", side_effect=keys):
            exec(compile(textwrap.dedent(block), page, "exec"), names)
        print(printed.getvalue())
        if sample:
            assert NUMBER.sub("#", printed.getvalue()) == NUMBER.sub("#", sample), page
    return names


@pytest.mark.slow
def test_both_halves_of_the_readme_run(folder: Path, unchecked, capsys):
    assert len(blocks("README.md", "python")) >= 2
    names = run("README.md")
    assert names["detection"].message == b"jaxmark!"
    assert str(b"jaxmark!") in capsys.readouterr().out
    # The energy is a quadratic form of the gains: its gradient at some gains, times these, is twice the energy there.
    gains = np.ones(16, np.float32)
    assert names["gradient"].shape == (16,)
    np.testing.assert_allclose(names["gradient"] @ gains, 2 * names["energy"](gains), rtol=1e-5)


@pytest.mark.slow
def test_python_block_on_arrays_runs(unchecked):
    names = run("docs/how-to/arrays.md")
    assert (names["scores"] > 0).tolist() == [True, False, False, True]
    assert names["gradient"].shape == names["x"].shape


@pytest.mark.slow
def test_python_block_on_recipients_runs(unchecked, capsys):
    accused = run("docs/how-to/recipients.md")["accused"]
    assert sorted(one.recipient for one in accused if one.log10_p < -6) == ["alice", "bob"]


@pytest.mark.long
def test_python_blocks_on_studies_run(folder: Path, unchecked, capsys):
    names = run("docs/how-to/study.md")
    assert [rate["read"] for rate in names["results"].rates() if rate["control"] == "marked"] == [2, 2]


def test_python_block_of_the_page_on_robustness_runs(unchecked, capsys):
    assert run("docs/robustness.md")["curve"].success.all()


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=MARKS.get(page, ())) for page in PAGES if blocks(page, "python") and page not in APART],
)
def test_python_blocks_of_other_pages_run(page: str, folder: Path, unchecked, capsys):
    if page in WITH_LIBIGL:
        pytest.importorskip("igl")
    run(page)


def said(argv: list[str], monkeypatch, capsys) -> str:
    """What a command says that must end well."""
    monkeypatch.setattr(sys, "argv", argv)
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        sys.exit(cli.main())
    found = capsys.readouterr()
    assert end.value.code in (0, None), (argv, found)
    return found.out


@pytest.mark.long  # which tests/first_mark.py runs, too, but for those that come after a first reading
@pytest.mark.parametrize("page", COMMANDS)
def test_shell_lines_run(page: str, folder: Path, unchecked, monkeypatch, capsys):
    lines = re.findall(r"^    (jaxmark .*)$", PAGES[page], re.MULTILINE)
    assert len(lines) >= COMMANDS[page]
    for line in lines:
        said(shlex.split(line), monkeypatch, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if "$ jaxmark " in "".join(blocks(page, "console"))])
def test_shell_lines_of_other_pages_say_what_is_shown(page: str, folder: Path, unchecked, monkeypatch, capsys):
    """Three dots stand for anything."""
    for block in blocks(page, "console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, shown = part.split("\n", 1)
            found = said(shlex.split(line), monkeypatch, capsys)
            assert doctest.OutputChecker().check_output(shown.rstrip() + "\n", found, doctest.ELLIPSIS), (line, found)


def test_consoles_have_nothing_else_than_lines_that_are_run():
    lines = [line for page in PAGES for block in blocks(page, "console") for line in block.splitlines()]
    commands = {line.split()[1] for line in lines if line.startswith("$ ")}
    assert commands == {"jaxmark", "pip"}
    assert [line for line in lines if line.startswith("$ pip")] == ["$ pip install '.[all]'"]


def test_make_targets_of_the_readme_exist():
    targets = set(re.findall(r"^    make (\w+)", README, re.MULTILINE))
    assert targets == {"demo", "test"}
    for target in (*targets, "docs"):
        subprocess.run(["make", "-n", target], cwd=ROOT, check=True, capture_output=True)


def test_make_help_lists_all_targets():
    (targets,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    said = subprocess.run(
        ["make", "--no-print-directory", "help"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    assert [line.split()[0] for line in said.splitlines()] == targets.split()
    assert all(len(line.split()) >= 3 for line in said.splitlines())


def test_notebooks_are_listed():
    there = sorted(path.stem for path in (ROOT / "notebooks").glob("*.py"))
    for line in (r":link: notebooks/(\w+)", r"notebooks/(\w+)", r"- \{download\}`\w+\.ipynb <notebooks/(\w+)\.ipynb>`"):
        assert re.findall(f"^{line}$", PAGES["docs/notebooks.md"], re.MULTILINE) == there


@pytest.mark.parametrize("notebook", sorted((ROOT / "notebooks").glob("*.py")), ids=lambda path: path.stem)
def test_notebooks_open_as_they_are_and_save_what_they_draw(notebook: Path):
    text = notebook.read_text()
    assert text.startswith("# ---\n# jupyter:\n")
    assert "#     name: python3\n" in text.partition("# %%")[0]
    assert '"pip", "install"' in text
    assert "sample_mesh" not in text  # which needs an extra
    assert "asteroid(" in text
    drawn = re.findall(
        r"^(?:plot\.|pictures\.|results\.)?(?:draw|show|responses|spectra|strengths|band_visibility|plot|success|p_values|roc)\(",
        text,
        re.M,
    )
    assert len(re.findall(r'\)\.save\("\d\d_\w+\.(?:png|html)"\)$', text, re.M)) >= max(1, len(drawn))


def test_samples_follow_all_that_the_tutorial_prints():
    printing = [sample for block, sample in SAMPLED.findall(PAGES["docs/tutorial.md"]) if "print(" in block]
    assert len(printing) >= 6
    assert all(printing)


def test_tests_that_pages_name_exist():
    named = {named for text in PAGES.values() for named in re.findall(r"`tests/([\w/]+\.py)::(\w+)`", text)}
    assert len(named) >= 20
    for file, test in named:
        assert re.search(rf"^def {test}\(", (ROOT / "tests" / file).read_text(), re.MULTILINE), f"{file}::{test}"


def test_names_that_pages_give_exist():
    named = {name for text in PAGES.values() for name in re.findall(r"`((?:jaxmark|jm)(?:\.\w+)+)", text)}
    assert len(named) >= 20
    for name in named:
        pkgutil.resolve_name(re.sub(r"^jm\b", "jaxmark", name))


def test_enemies_that_the_page_on_security_names_exist():
    rows = re.findall(r"^\|.*\|.*\| (`.*) \|$", PAGES["docs/security.md"], re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert len(named) >= 8
    assert all(hasattr(jm.adversaries, name) for name in named), named


def test_programs_that_pages_name_exist():
    named = {name for text in PAGES.values() for name in re.findall(r"\b(?:benchmarks|tests)(?:/\w+)+\.py\b", text)}
    assert len(named) >= 20
    for name in named:
        assert (ROOT / name).is_file(), name


def anchors(text: str) -> set[str]:
    """What GitHub and MyST call the headings of a page in links."""
    headings = re.findall(r"^#+ +(.*)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def dead_links(pages: dict[str, str]) -> list[str]:
    """Relative links to files or headings that are not there."""
    dead = []
    for page, text in pages.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text)):
            path, _, anchor = target.partition("#")
            there = (ROOT / page).parent / path if path else ROOT / page
            if re.match(r"\w+:", target):
                continue
            other = pages.get(os.path.relpath(there, ROOT))
            if not (other or there.exists()) or (anchor and anchor not in anchors(other or "")):
                dead.append(f"{page}: {target}")
    return dead


def test_no_relative_link_is_dead():
    assert not dead_links(PAGES)
    assert sum(text.count("](") for text in PAGES.values()) >= 20


def test_a_dead_link_is_seen():
    text = "# A b, c\n[a](nowhere.md) [b](#a-b-c) [c](#other) [d](README.md#limits) [e](https://x.y)"
    assert dead_links({**PAGES, "docs/x.md": text}) == [
        f"docs/x.md: {at}" for at in ("nowhere.md", "#other", "README.md#limits")
    ]
    assert not dead_links({**PAGES, "docs/x.md": "[d](../README.md#limits)"})


def reference(heading: str) -> set[str]:
    """What the tables of the reference list below a heading."""
    _, _, text = PAGES["docs/reference/index.md"].partition(f"\n## {heading}\n")
    return set(re.findall(r"^ {3}~?(jaxmark\.[\w.]+)$", text.partition("\n## ")[0], re.MULTILINE))


@pytest.mark.parametrize(
    ("heading", "shown"), [("Everyday names", [jm]), ("Filters", [jm.spectral, jm.spectral.bands])]
)
def test_the_reference_lists_all_names(heading: str, shown: list):
    names = {name for package in shown for name, value in inspect.getmembers(package) if not inspect.ismodule(value)}
    listed = {name.rpartition(".")[2] for name in reference(heading)}
    assert listed == {name for name in names if name[0] != "_"}


def test_the_reference_has_all_rooms():
    packages = {f"jaxmark.{package.name}" for package in pkgutil.iter_modules(jm.__path__) if package.name[0] != "_"}
    assert reference("Subpackages") == packages


def test_published_rates_are_those_of_the_protocol():
    rate = r"([\d.]+) / ([\d.]+)"
    rows = re.findall(rf"^\| ([\w-]+) \| (\S+) \| {rate} \| {rate} \|", PAGES["docs/comparison.md"], re.MULTILINE)
    shown = {f"{kind} {strength}": tuple(map(float, rates)) for kind, strength, *rates in rows}
    assert shown == {name: (*line.cho, *line.wang) for name, line in PROTOCOL.items() if line.cho and line.wang}


@pytest.mark.slow
def test_payloads_that_are_stated_are_carried():
    mesh, key = bumpy_sphere(4), jm.Key(bytes(32))
    for scheme, bits in (("host", 192), ("eigen", 96)):
        assert re.search(rf"\b{bits} bits \(`{scheme}`\)", PAGES["docs/how_it_works.md"])
        marked, _ = jm.embed(mesh, bytes(range(bits // 8)), key, scheme=scheme)
        assert jm.detect(marked, original=mesh, key=key, scheme=scheme, bits=bits).detected()


def test_everyday_names_have_a_page_under_these_names():
    shown = re.findall(r"^\.\. auto\w+:: jaxmark\.(\w+)$", PAGES["docs/reference/everyday.md"], re.MULTILINE)
    assert sorted(shown) == sorted(name.rpartition(".")[2] for name in reference("Everyday names"))
