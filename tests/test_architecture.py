"""The order of modules that CONTRIBUTING.md gives, and the picture of them, are those of the code."""

import ast
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxmark"


def modules() -> set[str]:
    """Public modules and subpackages, by name."""
    files = {path.stem for path in PACKAGE.glob("*.py")}
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    return {name for name in files | folders if not name.startswith("_")}


def table(text: str) -> list[str]:
    """The first column of the table of modules, row by row."""
    rows = re.findall(r"^\| (`[^|]*`) \|", text, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`(\w+)/?`", row)]


def imports(source: str) -> Iterator[str]:
    """Modules right below jaxmark that a source imports, anywhere in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            dotted = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not followed here"
            dotted = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name.split(".")[1] for name in dotted if name.startswith("jaxmark."))


def backward(order: list[str], found: dict[str, set[str]]) -> list[str]:
    """Imports of what stands later in an order."""
    place = {name: number for number, name in enumerate(order)}
    return [
        f"{module} imports {other}"
        for module, others in found.items()
        for other in sorted(others - {module})
        if place[other] > place[module]
    ]


def test_the_table_names_every_module_once():
    named = table((ROOT / "CONTRIBUTING.md").read_text())
    assert sorted(named) == sorted(modules())


def test_imports_flow_down_the_table():
    found: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        module = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if module in modules():
            found.setdefault(module, set()).update(set(imports(path.read_text())) & modules())
    assert found["marking"] >= {"alignment", "keys", "schemes"}
    assert not backward(table((ROOT / "CONTRIBUTING.md").read_text()), found)


def test_an_import_against_the_flow_is_seen():
    source = "def late():\n    from jaxmark.cli import main\n    from jaxmark import mesh\n"
    assert set(imports(source)) == {"cli", "mesh"}
    assert backward(["mesh", "laplacian", "cli"], {"laplacian": set(imports(source))}) == ["laplacian imports cli"]


def test_modules_in_the_picture_exist():
    picture = ElementTree.parse(ROOT / "docs" / "architecture.svg")
    texts = [text for text in picture.iter("{http://www.w3.org/2000/svg}text") if text.get("class") == "modules"]
    named = {name for text in texts for name in (text.text or "").split()}
    assert len(named) >= 30
    assert named <= modules()
