"""The subpackages, their modules and imports, read from the code; run it to write table and figures again."""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from tests import ROOT
from tests.project import data_flow

PACKAGE = ROOT / "jaxmark"
MAP = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- modules: written by `python -m tests.project.architecture` -->\n", "<!-- end of modules -->\n"
FIGURE = ROOT / "docs" / "architecture.svg"
WIDE, HIGH, ACROSS, DOWN = 120, 30, 150, 66  # of a box, and from one to the next


def modules() -> set[str]:
    """Names of all modules and folders of the package, without the underscores of private ones."""
    return {path.stem.lstrip("_") for path in PACKAGE.rglob("*.py")} | {path.name for path in PACKAGE.rglob("*/")}


@cache
def packages() -> dict[str, set[str]]:
    """For each module or folder at the top of the package, what it imports of the others."""
    found: dict[str, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        package = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if not package.startswith("_"):
            found.setdefault(package, set()).update(set(imports(path.read_text())) - {package})
    return {package: others & found.keys() for package, others in found.items()}


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


def floors(found: Mapping[str, set[str]]) -> list[list[str]]:
    """The packages, floor by floor: each above all that it imports."""
    floor: dict[str, int] = {}
    for package in sorted(found, key=lambda package: len(below(found, package))):
        floor[package] = max((floor[other] + 1 for other in below(found, package)), default=0)
    heights = range(max(floor.values()) + 1)
    return [sorted(package for package in found if floor[package] == height) for height in heights]


def below(found: Mapping[str, set[str]], package: str) -> set[str]:
    """All packages that a package rests on."""
    return set().union(*({other} | below(found, other) for other in found[package]))


def table(found: Mapping[str, set[str]]) -> str:
    """The packages and their modules, with the first lines of their docstrings; a package imports from those above."""
    rows = ["| package or module | what it is |", "|---|---|"]
    for package in (package for floor in floors(found) for package in floor):
        folder = PACKAGE / package
        if not folder.is_dir():
            rows.append(f"| `{package}` | {_first_line(folder.with_suffix('.py'))} |")
            continue
        rows.append(f"| `{package}/` | **{_first_line(folder / '__init__.py')}** |")
        for path in sorted(folder.rglob("*.py"), key=lambda path: path.relative_to(folder).parts):
            name = path.relative_to(folder).with_suffix("").as_posix().removesuffix("__init__")
            if name and (line := _first_line(path)):
                rows.append(f"| · `{name}` | {line} |")
    return "\n".join([*rows, ""])


def written(text: str, rows: str) -> str:
    """A page with its table of modules written again."""
    before, rest = text.split(BEGIN)
    return before + BEGIN + rows + END + rest.split(END)[1]


@cache
def _first_line(path: Path) -> str:
    """First line of a module's docstring, without the full stop; empty if it has none."""
    said = ast.get_docstring(ast.parse(path.read_text())) or ""
    return said.partition("\n")[0].removesuffix(".").replace("|", "\\|")


def draw(found: Mapping[str, set[str]]) -> str:
    """An SVG of the packages, each above all that it imports; an import that others imply has no arrow."""
    rows = floors(found)
    widest = max(map(len, rows))
    place = {
        package: (ACROSS * (column + (widest - len(row) + 1) / 2), DOWN * (len(rows) - number - 0.5))
        for number, row in enumerate(rows)
        for column, package in enumerate(row)
    }
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {ACROSS * widest} {DOWN * len(rows)}"'
        ' font-family="monospace" font-size="13" text-anchor="middle">',
        '<defs><marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 z" fill="#4a6fa5"/></marker></defs>',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for package, others in sorted(found.items()):
        x, y = place[package]
        for other in sorted(others - set().union(*(below(found, one) for one in others))):
            to, down = place[other]
            lines.append(
                f'<line x1="{x:g}" y1="{y + HIGH / 2:g}" x2="{to:g}" y2="{down - HIGH / 2:g}" stroke="#4a6fa5"'
                ' marker-end="url(#head)"/>'
            )
    for package, (x, y) in sorted(place.items()):
        lines.append(
            f'<rect x="{x - WIDE / 2:g}" y="{y - HIGH / 2:g}" width="{WIDE}" height="{HIGH}" rx="5" fill="#eef3fa"'
            f' stroke="#4a6fa5"/><text x="{x:g}" y="{y + 4:g}">{package}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    FIGURE.write_text(draw(packages()))
    data_flow.FIGURE.write_text(data_flow.draw())
    MAP.write_text(written(MAP.read_text(), table(packages())))
