"""Pages, docstrings and messages use standard terms: words and openings that the project gave up stay away."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import ROOT

#: A word that was given up, and the term that replaced it.
GIVEN_UP = {
    r"mesh(?:ed|ings?) anew|other meshings?": "remeshed, remeshing",
    r"beside (?:the|its|their) originals?": "non-blind, with the original",
    r"paid for|pays? for|the other hand": "significance budget, charged; reflection",
    r"undated|\bdeposit(?:s|ed)?\b": "uncommitted, timestamped commitment",
    r"brought back to": "registered to, aligned with",
    r"held against": "validated against, compared with",
    r"\b(?:is|are|be) told\b|\btold apart\b": "reported, given, distinguished",
    r"soft values?": "soft decision",
    r"\bleagues?\b": "track",
    r"\bdoubts?\b": "caveat",
    r"\b(?:by|for|from|of|to|with) who\b|nobody's|somebody's?": "an adversary, the owner, a recipient",
    r"\bglances?\b|\bhears?\b": "reads, decodes",
    r"remarking": "re-watermarking",
    r"\brooms\b": "subpackages",
}
OPENINGS = ("What", "Who", "Whoever", "Whose", "Of", "So", "As", "Which", "Where")  # of a docstring
NAMES_THAT_STAY = re.compile(r"jaxmark-deposit|jaxmark/deposit|`[^`]*`|```.*?```", re.DOTALL)

PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
PAGES = [path for path in PAGES if not {"_build", "notebooks", "api"} & set(path.parts)]
SOURCES = sorted((ROOT / "jaxmark").rglob("*.py"))


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """The docstrings of a module, with their lines."""
    for node in ast.walk(ast.parse(path.read_text())):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and (text := ast.get_docstring(node)):
            yield node.body[0].lineno, text


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """What a file says to readers: a page by lines; of a module its comments and all strings with a space."""
    if path.suffix != ".py":
        yield from enumerate(NAMES_THAT_STAY.sub(blank, path.read_text()).splitlines(), 1)
        return
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        text = NAMES_THAT_STAY.sub("", token.string)
        if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and " " in text):
            yield token.start[0], text


def blank(match: re.Match[str]) -> str:
    """Nothing, over as many lines."""
    return "\n" * match.group().count("\n")


@pytest.mark.parametrize("folder", ["pages", "jaxmark"])
def test_words_that_were_given_up_stay_away(folder: str):
    pattern = re.compile("|".join(f"(?P<w{number}>{word})" for number, word in enumerate(GIVEN_UP)), re.IGNORECASE)
    instead = list(GIVEN_UP.values())
    found = [
        f"{path.relative_to(ROOT)}:{line}: {match.group()!r}: write {instead[int((match.lastgroup or 'w0')[1:])]}"
        for path in (PAGES if folder == "pages" else SOURCES)
        for line, text in texts(path)
        for match in pattern.finditer(text)
        if path.name != "CHANGELOG.md" or "|" not in text  # tables of renames name what is gone
    ]
    assert not found, "\n".join(found)


def test_docstrings_begin_with_a_verb_or_a_noun():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in SOURCES
        for line, text in docstrings(path)
        if text.split(maxsplit=1)[0] in OPENINGS
    ]
    assert not found, "\n".join(found)


def test_both_kinds_are_seen(tmp_path: Path):
    module, page = tmp_path / "module.py", tmp_path / "page.md"
    module.write_text('"""What is told."""\n\nX = "paid for"  # `paid for` beside the original\n')
    page.write_text("```text\nundated\n```\nIt is meshed anew, `undated`.\n")
    assert list(docstrings(module)) == [(1, "What is told.")]
    assert [line for line, text in texts(module) if "paid for" in text or "original" in text] == [3, 3]
    assert [text.strip() for _, text in texts(page) if text.strip()] == ["It is meshed anew, ."]
