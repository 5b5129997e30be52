"""Names that a stranger chose, of files, meshes and recipients, reach the terminal as escapes only."""

import re
import unicodedata
from pathlib import Path

import pytest
import trimesh

import jaxmark as jm
from jaxmark.app import find_commands, output, printable
from jaxmark.app.progress import Progress
from jaxmark.catalogue import Match, Verdict
from jaxmark.watermark.coding.keys import commitment
from jaxmark.watermark.record import Record
from tests.app.test_cli import Workshop
from tests.app.test_progress import Terminal
from tests.samples import bumpy_sphere, rough_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
# A line of its own, the title and the colour of the terminal, a C1 control, text from right to left, an invisible
# character, another kind of line end, and a byte that is not UTF-8.
HOSTILE = "a\nFORGED: detected\x1b]0;title\x07\x1b[31m\x9b1m\u202egnp\u200b\u2028FORGED\r"
RAW = HOSTILE + "\udcff"


def assert_harmless(text: str) -> None:
    for char in text.replace("\n", ""):
        assert unicodedata.category(char) not in ("Cc", "Cf", "Cs", "Zl", "Zp"), ascii(text)
    assert not re.search("^FORGED", text, re.MULTILINE), ascii(text)


class Shell:
    """The command line, every output of which must be harmless."""

    def __init__(self, workshop: Workshop) -> None:
        self.workshop = workshop
        self.texts: list[str] = []

    def __call__(self, *arguments: object, status: int = 0, silent: bool = False) -> str:
        code, out, err = self.workshop(*arguments)
        assert code == status, (arguments, out, err)
        for text in (out, err):
            assert_harmless(text)
        assert silent or "FORGED" in out + err, (arguments, out, err)  # the name is shown
        return out + err


@pytest.fixture
def shell(tmp_path, monkeypatch, capfd) -> Shell:
    return Shell(Workshop(tmp_path, monkeypatch, capfd))


def test_characters_are_escaped_as_python_does() -> None:
    assert printable.printable('Grüße → "é" 3 % 漢字 \\') == 'Grüße → "é" 3 % 漢字 \\'
    assert printable.printable("a\nb\x1b\u202e\U000e0001\udcff") == r"a\nb\x1b\u202e\U000e0001\udcff"


def test_everything_is_printed_in_one_place() -> None:
    folder = Path(output.__file__).parent
    printing = re.compile(r"\b(echo|secho|print|style)\(|\.write\(|sys\.std(out|err)\.")
    found = {path.name for path in folder.glob("*.py") if printing.search(path.read_text(encoding="utf-8"))}
    assert found == {"output.py", "options.py", "progress.py", "start.py"}  # options.py asks for a terminal


def test_progress_is_harmless() -> None:
    terminal = Terminal()
    progress = Progress(terminal)
    progress.doing(f"reading {HOSTILE}")
    for line in terminal.shown():
        assert_harmless(line)


def hostile_files() -> tuple[str, str]:
    """Write a mesh, a record, and a file that is no mesh, and return the names of the first two."""
    mesh, record = f"{HOSTILE}.ply", f"{HOSTILE}.jaxmark.json"
    trimesh.Trimesh(*bumpy_sphere(1), process=False).export(mesh, file_type="ply")
    Path(record).write_text(Record("keyed", 64, 0.1, "00" * 32, commitment(jm.Key(bytes(32)))).to_json())
    Path(f"{RAW}.ply").write_text("ply")
    return mesh, record


def test_file_names_are_harmless(shell: Shell) -> None:
    mesh, record = hostile_files()
    mark = ("--key", "owner.key", "--message", "c0ff")
    shell("keygen", f"{HOSTILE}.key")
    Path(f"{HOSTILE}.key").chmod(0o644)
    shell("embed", mesh, f"new-{HOSTILE}.ply", "--key", f"{HOSTILE}.key", "--message", "c0ff", status=2)
    shell("embed", f"{HOSTILE}.obj", "out.obj", *mark, status=2)
    shell("embed", f"{RAW}.ply", "out.ply", *mark, status=2)
    shell("embed", mesh, mesh, *mark, status=2)
    shell("embed", "model.ply", mesh, *mark, status=2)
    shell("embed", "model.ply", "out.ply", *mark, "--scheme", HOSTILE, status=2)
    shell("embed", "model.ply", "out.ply", "--key", f"{RAW}.key", "--message", "c0ff", status=2)
    shell("detect", mesh, "--original", f"{RAW}.ply", "--key", "owner.key", status=2)
    shell("detect", mesh, "--original", mesh, "--key", "owner.key", "--record", f"{RAW}.ply", status=2)
    shell("identify", mesh, "--original", mesh, "--recipients", f"{RAW}.txt", "--key", "owner.key", status=2)
    shell("commit", record, "--output", f"{HOSTILE}.commitment")
    shell("commit", record, "--output", f"{HOSTILE}.commitment", status=2)
    shell("attack", mesh, f"attacked-{HOSTILE}.ply", "noise", "0.1")
    shell("attack", mesh, f"attacked-{HOSTILE}.ply", HOSTILE, "0.1", status=2)
    shell("capacity", f"{RAW}.ply", status=2)
    shell("study", f"{RAW}.toml", status=2)
    shell(HOSTILE, status=2)
    shell("embed", f"--{HOSTILE}", status=2)


def test_file_names_in_a_catalogue_are_harmless(shell: Shell) -> None:
    mesh, record = hostile_files()
    Path(f"{HOSTILE}.list").write_text("a\x1bFORGED.ply\n")
    where = ("--catalogue", f"{HOSTILE}.db")
    shell("catalogue", "add", mesh, *where)
    shell("catalogue", "add", mesh, f"{RAW}.ply", record, "model.ply", *where, status=2)
    shell("catalogue", "list", *where)
    shell("catalogue", "show", "1", *where)
    shell("catalogue", "export", f"{HOSTILE}.jsonl", *where)
    shell("catalogue", "export", f"{HOSTILE}.jsonl", *where, status=2)
    shell("catalogue", "import", f"{HOSTILE}.jsonl", *where)
    shell("catalogue", "import", f"{RAW}.ply", *where, status=2)
    shell("catalogue", "find", f"{RAW}.ply", *where, "--key", "owner.key", status=2)
    find = ("catalogue", "find", "--list", f"{HOSTILE}.list", *where, "--key", "owner.key")
    shell(*find, "--output", f"{HOSTILE}.out", status=2)
    shell("mark-for", HOSTILE, "model.ply", *where, "--key", "owner.key", status=2)
    Path(mesh).unlink()
    shell("catalogue", "check", *where, status=1)
    shell("catalogue", "remove", "1", *where)
    shell("catalogue", "show", HOSTILE, *where, status=2)
    shell("catalogue", "list", "--catalogue", f"{RAW}.db", status=2)


def test_a_folder_of_hostile_names_is_harmless(shell: Shell) -> None:
    Path(HOSTILE).mkdir()
    Path(HOSTILE, f"{HOSTILE}.ply").write_text("ply")
    shell("embed", HOSTILE, "out", "--key", "owner.key", "--message", "c0ff", status=2)
    shell("detect", HOSTILE, "--original", HOSTILE, "--key", "owner.key", status=2)
    shell("embed", HOSTILE, "owner.key", "--key", "owner.key", "--message", "c0ff", silent=True, status=2)


def test_mesh_names_and_recipients_are_harmless(shell: Shell) -> None:
    meshes = {HOSTILE: bumpy_sphere(1), f"second {HOSTILE}": bumpy_sphere(1, seed=1)}
    scene = trimesh.Scene({name: trimesh.Trimesh(*mesh, process=False) for name, mesh in meshes.items()})
    scene.export("scene.glb")
    assert HOSTILE in jm.files.load_scene("scene.glb").meshes
    mark = ("embed", "scene.glb", "out.glb", "--key", "owner.key", "--message", "c0ff" * 8)
    shell(*mark, status=2)
    shell(*mark, "--mesh", "none", status=2)
    shell(*mark, "--mesh", HOSTILE, status=2, silent=True)
    shell("catalogue", "add", "scene.glb", "--catalogue", "shop.db", silent=True)
    shell("catalogue", "show", "1", "--catalogue", "shop.db")
    match = Match(HOSTILE, HOSTILE, HOSTILE, "whole", 1, 0.0, named=True, log10_p=-9.0, notes=(HOSTILE,))
    refused = match._replace(named=False, refused=HOSTILE, log10_p=0.0)
    matches = (
        (match._replace(accused=(HOSTILE, "bob"), recipient=HOSTILE), refused),
        (match._replace(message=HOSTILE.encode(errors="replace").hex()),),
        (match._replace(named=False, caveats=(HOSTILE,)), refused),
    )
    for some in matches:
        lines = find_commands.describe(Verdict("", some, 2), 1e-6)
        assert_harmless("\n".join(map(printable.printable, lines)))


@pytest.mark.slow
def test_marking_a_scene_is_harmless(shell: Shell) -> None:
    meshes = {HOSTILE: rough_sphere(900), f"second {HOSTILE}": rough_sphere(900, 1), f"tiny {HOSTILE}": bumpy_sphere(0)}
    scene = trimesh.Scene({name: trimesh.Trimesh(*mesh, process=False) for name, mesh in meshes.items()})
    scene.export("scene.glb")
    shell("embed", "scene.glb", f"{HOSTILE}.glb", "--key", "owner.key", "--message", "c0ff")
    read = ("--original", "scene.glb", "--key", "owner.key", "--record", f"{HOSTILE}.glb.jaxmark.json")
    shell("detect", f"{HOSTILE}.glb", *read, "--charges")
    shell("detect", f"{HOSTILE}.glb", *read, "--mesh", "none", status=2)


def test_pages_insert_names_as_text_only() -> None:
    package = Path(jm.__file__).parent
    pages = [path for path in package.rglob("*") if path.suffix in (".html", ".js")]
    assert {"catalogue.js", "catalogue.html", "dossier.html"} <= {path.name for path in pages}
    markup = re.compile(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|\|\s*safe\b|autoescape false")
    assert [path.name for path in pages if markup.search(path.read_text(encoding="utf-8"))] == []
