"""What the gate tries is what pyproject.toml promises."""

import tomllib

from packaging.requirements import Requirement
from packaging.version import Version

from tests import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def versions(lines: list[str], operator: str) -> dict[str, list[Version]]:
    """Of each requirement, what stands behind an operator."""
    read = [Requirement(line) for line in lines]
    return {one.name: [Version(at.version) for at in one.specifier if at.operator == operator] for one in read}


def test_oldest_versions_are_the_lower_bounds():
    pinned = [line for line in (ROOT / "tests" / "oldest.txt").read_text().splitlines() if not line.startswith("#")]
    bounds = versions(PROJECT["dependencies"], ">=")
    assert all(len(bound) == 1 for bound in bounds.values())
    assert versions(pinned, "==") == bounds


def test_every_optional_part_is_in_all_or_named_as_not():
    """As the README has it: all but `peers` and `docs`, and what developers need."""
    extras = PROJECT["optional-dependencies"]
    (every,) = (Requirement(line) for line in extras["all"])
    assert every.extras == set(extras) - {"all", "dev", "docs", "peers"}
