"""Names of outputs, which are refused before any work is done."""

import os
from pathlib import Path

from jaxmark.errors import JaxmarkError


def check_suffix(source: Path, target: Path) -> None:
    """Refuse an output of another format than its source."""
    if source.suffix.lower() != target.suffix.lower():
        raise JaxmarkError(f"{target} must have the suffix of {source}, whose bytes it takes over.")


def check_distinct(**files: Path) -> None:
    """Refuse two names for one file, which would write over an input."""
    seen: dict[str, str] = {}
    for name, path in files.items():
        other = seen.setdefault(os.path.realpath(path), name)
        if other != name:
            raise JaxmarkError(f"{other} and {name} are the same file, {path}; give another name.")
