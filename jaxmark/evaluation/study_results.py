"""Results of a study: rows, rates with their intervals, tables, files and pictures of them."""

import csv
import io
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxmark.errors import require
from jaxmark.evaluation import _rates as rates
from jaxmark.evaluation._rates import POINT, Control, Row
from jaxmark.evaluation.pictures import Measure, curves
from jaxmark.files.atomic import write_atomically
from jaxmark.plot.figures import Picture, write_page

_LABELS: dict[Control, str] = {"unmarked": "unmarked, detected", "wrong-key": "another key, detected"}
_NO_TRIALS = {"detected": 0, "trials": 0}
# Columns whose unit is not evident; the mark and the attack have lengths in one unit.
_HEADS = {"budget": "budget, RMS over the diagonal or limits"}
_LENGTHS = ("mark, RMS over the diagonal", "strength over the diagonal")
_SHOWN: dict[Measure, str] = {"read": "What was read", "log10_p_unfloored": "Evidence"}


@dataclass(frozen=True)
class Results:
    """The readings of a study, as `Study.run` returns them."""

    rows: tuple[Row, ...]

    def frame(self) -> Any:
        """Return the rows as a `pandas.DataFrame`. Needs the extra `study`.

        Raises:
            JaxmarkError: if pandas is missing.
        """
        return require("pandas", "study").DataFrame(list(self.rows), columns=list(Row._fields))

    def rates(self, by: Sequence[str] = (*POINT, "control"), level: float = 0.95) -> list[dict[str, Any]]:
        """Count successes in groups of rows; see `jaxmark.evaluation.rates`."""
        return rates.rates(self.rows, by, level)

    def markdown(self) -> str:
        """Return the rates as a Markdown table, with the controls, their totals, and every refusal."""
        heads, lines = self._table()
        text = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(line)} |" for line in lines)]
        text += ["", *(f"{said}  " for said in self._controls()), "", *(f"- {said}" for said in self._refusals())]
        return "\n".join(text).strip() + "\n"

    def _table(self) -> tuple[list[str], list[list[str]]]:
        """Return the column heads and the lines of a table of all points."""
        cells: dict[tuple[Any, ...], dict[Control, dict[str, Any]]] = {}
        for rate in rates.rates(self._counted):
            cells.setdefault(tuple(rate[name] for name in POINT), {})[rate["control"]] = rate
        heads = [*(_HEADS.get(name, name) for name in POINT), *_LENGTHS]
        heads += ["read", "95 %", "wrong bits", "log10 p, median", "without floor", *_LABELS.values()]
        lines = []
        for point, rate in cells.items():
            mark = rate["marked"]
            line = [f"{one:g}" if isinstance(one, float) else " ".join(str(one).split()) for one in point]
            line += [f"{mark['rms']:.2g}", "-" if mark["length"] is None else f"{mark['length']:.2g}"]
            low, high = 100 * mark["read_low"], 100 * mark["read_high"]
            line += [f"{mark['read']}/{mark['trials']}", f"{low:.0f} - {high:.0f}"]
            line += [f"{100 * mark['bit_errors']:.1f} %", f"{mark['log10_p']:.1f}", f"{mark['log10_p_unfloored']:.1f}"]
            controls = [rate.get(name, _NO_TRIALS) for name in _LABELS]
            lines.append(line + [f"{control['detected']}/{control['trials']}" for control in controls])
        return heads, lines

    @property
    def _counted(self) -> list[Row]:
        """All rows but those of controls that were not read, which say nothing about false positives."""
        return [row for row in self.rows if row.control == "marked" or not row.refusal]

    def _controls(self) -> list[str]:
        """Return the total of each control that was read."""
        return [
            f"{_LABELS[rate['control']]}: {rate['detected']}/{rate['trials']}, "
            f"95 % interval up to {100 * rate['detected_high']:.3g} %"
            for rate in rates.rates(self._counted, ["control"])
            if rate["control"] != "marked"
        ]

    def _refusals(self) -> list[str]:
        """Every refusal, with its count."""
        counts = Counter(
            (row.mesh, row.scheme, f"{row.attack} {row.strength:g}", row.control, row.refusal)
            for row in self.rows
            if row.refusal and row.control != "wrong-key"
        )
        said = (f"{', '.join(case[:-1])}, {count} ×: {case[-1]}" for case, count in counts.items())
        return [" ".join(line.split()) for line in said]

    def save_page(self, path: str | os.PathLike[str], title: str = "What a mark survives") -> None:
        """Write an HTML page with pictures, table, controls and refusals, without external resources. Needs `plot`.

        Raises:
            JaxmarkError: if matplotlib or Jinja2 is missing, or the page cannot be written.
        """
        require("jinja2", "plot")
        heads, lines = self._table()
        write_page(
            path,
            title,
            {name: self.plot(of) for of, name in _SHOWN.items()},
            alt=", over the strength of each attack",
            tables=[{"title": "All points", "note": "", "heads": heads, "lines": lines}],
            notes=self._controls(),
            refusals=self._refusals(),
            nowrap=True,
        )

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write all rows as comma-separated values, atomically.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(Row._fields)
        writer.writerows(self.rows)
        write_atomically(path, text.getvalue().encode())

    def plot(self, of: Measure = "read") -> Picture:
        """Plot a line for each scheme over the strengths of each attack; see `pictures.curves`."""
        return curves(self.rows, of)
