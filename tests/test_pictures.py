"""The pictures of the documents are those that their sources draw, and small."""

import importlib
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "pictures"
OTHERS = ("visibility_", "growth.png")  # drawn of meshes that are not in the project


@pytest.fixture
def front(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "pictures")
    return importlib.import_module("front")


def test_pictures_are_what_their_sources_draw(front: ModuleType):
    drawn = json.loads(front.DRAWN.read_text())
    assert drawn.keys() == front.PICTURES.keys()
    stale = [name for name, hashes in drawn.items() if hashes != front.hashes(name)]
    assert not stale, f"draw {', '.join(stale)} anew: make pictures"


def test_what_has_changed_is_seen(front: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    before = front.hashes("gallery_01.png")
    monkeypatch.setattr(front, "FOLDER", tmp_path)
    (tmp_path / "gallery_01.png").write_bytes((FOLDER / "gallery_01.png").read_bytes() + b"\0")
    assert front.hashes("gallery_01.png")["picture"] != before["picture"]
    assert front.hashes("gallery_01.png")["sources"] == before["sources"]
    assert front.hashes("gallery_02.png")["sources"] != before["sources"]


def test_every_notebook_has_a_thumbnail(front: ModuleType):
    notebooks = sorted(path.name[:2] for path in (ROOT / "notebooks").glob("*.py"))
    assert [name[:2] for name in front.SHOWN] == notebooks


def test_pictures_are_small_and_no_other_is_there(front: ModuleType):
    for path in FOLDER.glob("*.png"):
        if path.name.startswith(OTHERS):
            continue
        assert path.name in front.PICTURES
        assert path.stat().st_size <= 150_000


def test_pictures_that_pages_show_exist():
    shown = 0
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)|^ *:img-top: (\S+)", page.read_text(), re.MULTILINE):
            shown += 1
            assert (page.parent / "".join(target)).is_file(), f"{page}: {target}"
    assert shown >= 20
