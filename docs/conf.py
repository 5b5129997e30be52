"""How `make docs` builds these pages: API from docstrings, links checked, nothing public without a docstring.

Nothing is loaded from outside, neither by the build nor by the pages: formulas are set by a MathJax that is shipped
with them. The notebooks in `docs/notebooks` were run before, by `make notebooks`, and are shown as they are.
"""

import ast
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util import logging

project = "jaxmark"
author = "The jaxmark authors"
html_title = "jaxmark"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build"]
nb_execution_mode = "off"
nb_merge_streams = True
nb_output_stderr = "remove"  # what XLA says of itself
templates_path = ["_templates"]
_ROOT = Path(__file__).parents[1]
# Pages of packages describe what they show of their private modules.
autosummary_context = {
    "packages": [".".join(path.parent.relative_to(_ROOT).parts) for path in _ROOT.glob("jaxmark/**/__init__.py")]
}
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
smartquotes = False  # two hyphens are an option

myst_enable_extensions = ["dollarmath", "colon_fence"]
copybutton_prompt_text = "$ "
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "undoc-members": True, "member-order": "bysource", "no-value": True}
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # `add_fields` has them
python_maximum_signature_line_length = 88

# In docstrings backticks are names, which become links where there is something to link to.
default_role = "py:obj"
# Links written in a page and full names must lead somewhere; annotations may name what is documented nowhere.
nitpicky = True
nitpick_ignore_regex = [
    ("py:(class|obj|data|exc)", r"(?!jaxmark\.)[\s\S]*"),
    ("py:class", r"jaxmark\.adversaries\.keyless\._Assumptions"),  # keyword arguments, which `make_attack` describes
]

_DOCUMENTED = {"module", "class", "exception", "function", "method", "property"}
_logger = logging.getLogger(__name__)


def demand_docstring(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Warn, and so fail the build, where something public has no docstring of its own."""
    text = "\n".join(lines).strip()
    made = what == "class" and text.startswith(f"{name.rpartition('.')[2]}(")  # by NamedTuple or dataclass
    module = getattr(getattr(obj, "fget", obj), "__module__", name)  # of a property, its getter's
    if what in _DOCUMENTED and (not text or made) and name.startswith(_home(module)):
        _logger.warning("%s %s has no docstring", what, name)


def escape_markup(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Take docstrings as plain text in which backticks alone are markup: |x| is an absolute value."""
    parts = re.split(r"(``[^`]*``|`[^`]*`)", "\n".join(lines))
    plain = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    # Letters may follow a name without a space.
    plain = [plain[0], *(re.sub(r"^(?=\w)", r"\\ ", part) for part in plain[1:])]
    names = [*parts[1::2], ""]
    lines[:] = "".join(a + b for a, b in zip(plain, names, strict=True)).split("\n")


def add_fields(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Document the fields of a class by the comments behind them, or with their types, where its docstring does."""
    described = _fields(obj) if what == "class" else {}
    if "Attributes:" in lines:
        for place, line in enumerate(lines):
            field, colon, text = line.strip().partition(": ")
            if colon and field in described and line.startswith("    ") and line[4] != " ":
                lines[place] = f"    {field}: {described[field]}; {text}"
    elif described:
        lines += ["", "Attributes:", *(f"    {field}: {comment}" for field, comment in described.items()), ""]


def list_face(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Let the page of a package begin with what can be imported from it, and where each of that is described."""
    if what != "module" or not (shown := _face(obj)):
        return
    links, data = [], []
    for shown_name, module in shown.items():
        value, place = getattr(obj, shown_name), f"{_home(module)}.{shown_name}"
        if inspect.ismethod(value):  # of one object that a package shows; described in its class
            place = f"{value.__module__}.{value.__qualname__}"
        comment = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", shown_name))
        linked = inspect.isclass(value) or inspect.isroutine(value) or inspect.ismodule(value) or comment
        links.append(f"`~{place}`" if linked else f"``{shown_name}``")
        if comment and module != _home(module):
            data += [f".. py:data:: {shown_name}", "", *(f"   {line}" for line in comment), ""]
    lines += [f"Import from here: {', '.join(links)}.", "", *data]


def skip_member(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """A name is described where it is defined, or in the package of its private module; a field, with its class."""
    described = inspect.isroutine(obj) or inspect.isclass(obj)
    if what == "module":
        return True if described and _home(obj.__module__ or "") != app.env.temp_data["autodoc:module"] else None
    described = described or inspect.isdatadescriptor(obj)
    return True if not described or type(obj).__name__ == "_tuplegetter" else None


def sign_as_written(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Show signatures as the source has them: an evaluated annotation spells out every alias."""
    definition = _definition(inspect.unwrap(obj))
    if isinstance(definition, ast.FunctionDef):
        if what == "method" and not isinstance(inspect.unwrap(obj), staticmethod):
            definition.args.args = definition.args.args[1:]
        return f"({ast.unparse(definition.args)})", definition.returns and ast.unparse(definition.returns)
    if isinstance(definition, ast.ClassDef) and (fields := _fields(obj)):
        return f"({', '.join(name for name, text in fields.items() if 'ClassVar' not in text)})", None
    return signature, returns


def _home(module: str) -> str:
    """The public place of what a module defines: a private module's is the package that shows it."""
    package, _, own = module.rpartition(".")
    return package if own.startswith("_") else module


def _face(package: Any) -> dict[str, str]:
    """The names that a package shows, each with the module that it imports it from."""
    tree = ast.parse("\n".join(_source(package))) if hasattr(package, "__path__") else ast.Module([], [])
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module]
    return {
        one.name: node.module or ""
        for node in imports
        for one in node.names
        if one.asname == one.name  # as itself
    }


def _fields(record: type) -> dict[str, str]:
    """The public fields of a class, each with its type, its default and the comment on its line."""
    definition, lines = _definition(record), _source(record)
    found = {}
    for node in definition.body if isinstance(definition, ast.ClassDef) else []:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id[0] != "_":
            comment = lines[(node.end_lineno or node.lineno) - 1][node.end_col_offset or 0 :].partition("# ")[2]
            default = f" = {ast.unparse(node.value)}" if node.value else ""
            found[node.target.id] = f"``{ast.unparse(node.annotation)}{default}``" + (f"; {comment}" if comment else "")
    return found


def _definition(obj: Any) -> ast.stmt | None:
    lines = _source(obj)
    return ast.parse("\n".join(lines)).body[0] if lines else None


def _source(obj: Any) -> list[str]:
    try:
        return textwrap.dedent(inspect.getsource(obj)).splitlines()
    except (OSError, TypeError):
        return []


def setup(app: Sphinx) -> None:
    """Before napoleon (500) turns sections into fields."""
    for place, hook in enumerate([demand_docstring, add_fields, escape_markup, list_face]):
        app.connect("autodoc-process-docstring", hook, priority=100 + place)
    app.connect("autodoc-process-signature", sign_as_written)
    app.connect("autodoc-skip-member", skip_member)
