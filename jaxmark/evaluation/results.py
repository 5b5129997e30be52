"""Results of a study: rows, rates with their intervals, tables, files and pictures of them."""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxmark.evaluation import _rates as rates
from jaxmark.evaluation._rates import POINT, Control, Row
from jaxmark.evaluation.pictures.studies import Measure, curves
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.plot import Picture

_LABELS: dict[Control, str] = {"unmarked": "unmarked, detected", "wrong-key": "another key, detected"}


@dataclass(frozen=True)
class Results:
    """The readings of a study, as `Study.run` returns them."""

    rows: tuple[Row, ...]

    def frame(self) -> Any:
        """The rows as a `pandas.DataFrame`. Needs the extra `study`.

        Raises:
            JaxmarkError: if pandas is missing.
        """
        return require("pandas", "study").DataFrame(list(self.rows), columns=list(Row._fields))

    def rates(self, by: Sequence[str] = (*POINT, "control"), level: float = 0.95) -> list[dict[str, Any]]:
        """Count successes in groups of rows; see `jaxmark.evaluation.rates`."""
        return rates.rates(self.rows, by, level)

    def markdown(self) -> str:
        """The rates as a Markdown table with their controls, the totals of the controls, and every refusal."""
        cells: dict[tuple[Any, ...], dict[Control, dict[str, Any]]] = {}
        for rate in self.rates():
            cells.setdefault(tuple(rate[name] for name in POINT), {})[rate["control"]] = rate
        heads = [*POINT, "read", "95 %", "wrong bits", "log10 p, median", "without floor", *_LABELS.values()]
        lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for point, rate in cells.items():
            mark = rate["marked"]
            said = [f"{one:g}" if isinstance(one, float) else str(one) for one in point]
            said += [
                f"{mark['read']}/{mark['trials']}",
                f"{100 * mark['read_low']:.0f} - {100 * mark['read_high']:.0f}",
            ]
            said += [f"{100 * mark['bit_errors']:.1f} %", f"{mark['log10_p']:.1f}", f"{mark['log10_p_unfloored']:.1f}"]
            said += [f"{rate[name]['detected']}/{rate[name]['trials']}" for name in _LABELS]
            lines.append(f"| {' | '.join(said)} |")
        lines.append("")
        for rate in self.rates(["control"]):
            if rate["control"] != "marked":
                most = f"{100 * rate['detected_high']:.2g} %"
                lines.append(
                    f"{_LABELS[rate['control']]}: {rate['detected']}/{rate['trials']}, 95 % interval up to {most}  "
                )
        counts: dict[tuple[Any, ...], int] = {}
        for row in self.rows:
            if row.refusal and row.control != "wrong-key":
                case = (row.mesh, row.scheme, f"{row.attack} {row.strength:g}", row.control, row.refusal)
                counts[case] = counts.get(case, 0) + 1
        lines += ["", *(f"- {', '.join(case[:-1])}, {count} ×: {case[-1]}" for case, count in counts.items())]
        return "\n".join(lines).strip() + "\n"

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write all rows as comma-separated values, the file whole or not at all.

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
