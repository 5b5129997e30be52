"""Tables in Markdown, and the files that are written with them."""

import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

Row = dict[str, Any]

#: Prints progress, away from the tables.
say = partial(print, file=sys.stderr, flush=True)


def line(*cells: object) -> str:
    """One line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*names: object) -> str:
    """A table's first two lines."""
    return f"{line(*names)}\n{'|---' * len(names)}|"


def table(rows: Sequence[Row]) -> str:
    """A whole table: a column for each key, empty where a row has none."""
    names = list(dict.fromkeys(name for row in rows for name in row))

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}"
        return f"{value:,}" if isinstance(value, int) else str(value)

    lines = [names, ["---"] * len(names), *([cell(row.get(name, "")) for name in names] for row in rows)]
    return "\n".join(line(*cells) for cells in lines)


def evidence(log10_p: float, unfloored: float) -> str:
    """log10 p, and in square brackets what it is without its floor at -77, where that is less."""
    further = f" [{unfloored:.0f}]" if round(unfloored) < round(log10_p) else ""
    return f"{log10_p:.0f}{further}"


def save(folder: Path, name: str, text: str, data: Any) -> None:
    """Leave a report as Markdown, and all figures as JSON, in a folder that is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text)
    save_json(folder / f"{name}.json", data)


def save_json(path: Path, data: Any) -> None:
    """Write figures as JSON."""
    path.write_text(json.dumps(data, indent=1))
