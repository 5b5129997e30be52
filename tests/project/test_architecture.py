"""The order of packages that CONTRIBUTING.md gives, and the pictures of them, are those of the code."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import jaxmark as jm
from tests.project import data_flow
from tests.project.architecture import FIGURE, MAP, PACKAGE, draw, imports, modules, packages, table, written

MOST_ROOMS = 16  # at the top of the package
FILTERING = {"errors", "seeds", "geometry", "spectral"}  # what a filter needs


AGAIN = "write it again: python -m tests.project.architecture"


def named_rooms(text: str) -> list[str]:
    """The packages in the first column of the table, row by row."""
    rows = re.findall(r"^\| (`[^|]*`) \|", text, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`(\w+)/?`", row)]


def backward(order: list[str], found: dict[str, set[str]]) -> list[str]:
    """Imports of what stands later in an order."""
    place = {name: number for number, name in enumerate(order)}
    return [
        f"{package} imports {other}"
        for package, others in found.items()
        for other in sorted(others)
        if place[other] > place[package]
    ]


def test_the_table_names_every_room_once():
    named = named_rooms(MAP.read_text())
    assert sorted(named) == sorted(packages())
    assert len(named) <= MOST_ROOMS


def test_imports_flow_down_the_table():
    found = packages()
    assert found["evaluation"] >= {"attacks", "watermark", "plot"}
    assert not backward(named_rooms(MAP.read_text()), found)


def test_filtering_knows_nothing_of_the_watermark():
    assert packages()["spectral"] | packages()["geometry"] <= FILTERING


def test_an_import_against_the_flow_is_seen():
    source = "def late():\n    from jaxmark.app.cli import main\n    from jaxmark import geometry\n"
    assert set(imports(source)) == {"app", "geometry"}
    assert backward(["geometry", "spectral", "app"], {"spectral": set(imports(source))}) == ["spectral imports app"]


def test_filters_come_alone():
    """Whoever filters loads neither the watermark nor what it needs."""
    late = "trimesh jaxopt click jaxmark.watermark jaxmark.files jaxmark.alignment"
    code = f"import sys, jaxmark.spectral; print(*(set({late.split()}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_package_shows_its_rooms_and_what_is_used_every_day():
    shown = dir(jm)
    assert {"spectral", "watermark", "attacks", "distortion", "plot", "embed", "detect"} <= set(shown)
    assert all(hasattr(jm, name) for name in shown)
    assert len(set(shown) - set(packages())) <= 25


def test_the_figure_is_drawn_from_the_imports():
    assert FIGURE.read_text() == draw(packages()), AGAIN


def test_the_table_has_all_modules_with_their_first_lines():
    text = MAP.read_text()
    assert text == written(text, table(packages())), AGAIN
    private = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"}
    assert len(re.findall(r"^\| (· )?`", text, re.MULTILINE)) >= len(private)


def test_modules_in_the_picture_of_the_data_exist():
    assert data_flow.FIGURE.read_text() == data_flow.draw(), AGAIN
    picture = ElementTree.parse(data_flow.FIGURE)
    texts = [text for text in picture.iter("{http://www.w3.org/2000/svg}text") if text.get("class") == "modules"]
    named = {name for text in texts for name in (text.text or "").split()}
    assert len(named) >= 30
    assert named <= modules()


def test_no_module_is_hidden_by_a_function_of_its_name():
    """A function that a package shows takes the name of a public module from whoever imports the package."""
    for face in PACKAGE.rglob("__init__.py"):
        shown = set(re.findall(r"import \w+ as (\w+)$", face.read_text(), re.MULTILINE))
        public = {path.stem for path in face.parent.glob("*.py")}
        assert not shown & public, face
