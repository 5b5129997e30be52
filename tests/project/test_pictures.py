"""The pictures of the documents are those that their sources draw, and small."""

import importlib
import re
from pathlib import Path
from types import ModuleType

import pytest

from tests import ROOT

FOLDER = ROOT / "docs" / "pictures"
OTHERS = ("visibility_", "growth.png")  # drawn of meshes that are not in the project, see `Makefile` and docs/speed.md


@pytest.fixture
def front(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "pictures")
    return importlib.import_module("front")


@pytest.fixture
def drawn(front: ModuleType) -> ModuleType:
    return importlib.import_module("common.drawn")


def test_pictures_are_what_their_sources_draw(front: ModuleType, drawn: ModuleType):
    before = drawn.known()
    assert front.PICTURES.keys() <= before.keys()
    assert before.keys() == {path.name for path in FOLDER.glob("*.png")}
    stale = [name for name, hashes in before.items() if hashes != drawn.hashes(name)]
    assert not stale, (
        f"draw {', '.join(stale)} anew: make pictures, and make looks for those of docs/results/visibility.md"
    )


def test_what_has_changed_is_seen(drawn: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    names = ("gallery_01.png", "visibility_box.png", "demo.png")
    before = {name: drawn.hashes(name) for name in names}
    monkeypatch.setattr(drawn, "FOLDER", tmp_path)
    for name in names:
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes() + b"\0")
        assert drawn.hashes(name)["picture"] != before[name]["picture"]
        assert drawn.hashes(name)["sources"] == before[name]["sources"]
    assert len({hashes["sources"] for hashes in (*before.values(), drawn.hashes("gallery_02.png"))}) == 4


def test_every_notebook_has_a_thumbnail(front: ModuleType):
    notebooks = sorted(path.name[:2] for path in (ROOT / "notebooks").glob("*.py"))
    assert [name[:2] for name in front.SHOWN] == notebooks


def test_pictures_are_small_and_no_other_is_there(front: ModuleType, drawn: ModuleType):
    for path in FOLDER.glob("*.png"):
        assert path.name in front.PICTURES or path.name.startswith(OTHERS)
        assert path.stat().st_size <= drawn.MOST_BYTES


def test_pictures_that_pages_show_exist():
    shown = 0
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)|^ *:img-top: (\S+)", page.read_text(), re.MULTILINE):
            shown += 1
            assert (page.parent / "".join(target)).is_file(), f"{page}: {target}"
    assert shown >= 20
