"""Results of a study: a row for each reading, rates with their intervals, and files of them."""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically

Control = Literal["marked", "unmarked", "wrong-key"]
LOG10_LEVEL = -6.0  # of the false-positive probability at which a reader detects
POINT = ("mesh", "scheme", "bits", "budget", "attack", "strength")  # what a study varies, but for seeds
_NAMES: dict[Control, str] = {"unmarked": "unmarked, detected", "wrong-key": "another key, detected"}


class Row(NamedTuple):
    """One reading of a suspect."""

    mesh: str
    scheme: str
    bits: int  # payload
    budget: str
    attack: str
    strength: float
    unit: str  # of the strength
    seed: int  # of key, message and attack
    control: Control  # the mark read with its key, what is no mark read with that key, or the mark read with another
    read: bool  # the exact message, and its tag fits
    wrong: bool  # another message, whose tag fits
    bit_errors: float  # share of the message's bits that are wrong in the best guess; 1/2 where there is none
    log10_p: float  # bound on the false-positive probability, the message unknown
    detected: bool  # log10_p is at most `LOG10_LEVEL`
    refusal: str  # why there was nothing to read, a sentence; empty where there was
    seconds: float  # that reading took, and the alignment with it unless the row before had it
    rms: float  # of the mark, over the diagonal; 0 where there is none


@dataclass(frozen=True)
class Results:
    """What `Study.run` has read."""

    rows: tuple[Row, ...]

    def frame(self) -> Any:
        """The rows as a `pandas.DataFrame`. Needs the extra `study`.

        Raises:
            JaxmarkError: if pandas is missing.
        """
        return require("pandas", "study").DataFrame(list(self.rows), columns=list(Row._fields))

    def rates(self, by: Sequence[str] = (*POINT, "control"), level: float = 0.95) -> list[dict[str, Any]]:
        """How often the message was read, and how often a mark was detected, with exact intervals.

        Args:
            by: fields of `Row` by which rows are grouped; the others are pooled.
            level: of the intervals, in (0, 1); see `clopper_pearson`.

        Returns:
            For each group its fields of `by`; `trials`; `read` with `read_low` and `read_high`, `detected` with
            `detected_low` and `detected_high`: counts, and bounds on their rates; the mean of `bit_errors`; median,
            least and largest `log10_p`.

        Raises:
            JaxmarkError: if there is no such field, or the level is out of range.
        """
        if unknown := [name for name in by if name not in Row._fields]:
            raise JaxmarkError(f"A row has no field {unknown[0]!r}; there are {', '.join(Row._fields)}.")
        groups: dict[tuple[Any, ...], list[Row]] = {}
        for row in self.rows:
            groups.setdefault(tuple(getattr(row, name) for name in by), []).append(row)
        found = []
        for values, rows in groups.items():
            rate: dict[str, Any] = {**dict(zip(by, values, strict=True)), "trials": len(rows)}
            for name in ("read", "detected"):
                rate[name] = sum(getattr(row, name) for row in rows)
                rate[f"{name}_low"], rate[f"{name}_high"] = clopper_pearson(rate[name], len(rows), level)
            p = [row.log10_p for row in rows]
            rate["bit_errors"] = float(np.mean([row.bit_errors for row in rows]))
            rate |= {"log10_p": float(np.median(p)), "log10_p_least": min(p), "log10_p_largest": max(p)}
            found.append(rate)
        return found

    def markdown(self) -> str:
        """The rates as a table, the controls beside them and in all, and every refusal."""
        cells: dict[tuple[Any, ...], dict[Control, dict[str, Any]]] = {}
        for rate in self.rates():
            cells.setdefault(tuple(rate[name] for name in POINT), {})[rate["control"]] = rate
        heads = [*POINT, "read", "95 %", "wrong bits", "log10 p, median", *_NAMES.values()]
        lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for point, rate in cells.items():
            mark = rate["marked"]
            said = [f"{one:g}" if isinstance(one, float) else str(one) for one in point]
            said += [
                f"{mark['read']}/{mark['trials']}",
                f"{100 * mark['read_low']:.0f} - {100 * mark['read_high']:.0f}",
            ]
            said += [f"{100 * mark['bit_errors']:.1f} %", f"{mark['log10_p']:.1f}"]
            said += [f"{rate[name]['detected']}/{rate[name]['trials']}" for name in _NAMES]
            lines.append(f"| {' | '.join(said)} |")
        lines.append("")
        for rate in self.rates(["control"]):
            if rate["control"] != "marked":
                most = f"{100 * rate['detected_high']:.2g} %"
                lines.append(
                    f"{_NAMES[rate['control']]}: {rate['detected']}/{rate['trials']}, 95 % interval up to {most}  "
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

    def plot(self, path: str | os.PathLike[str], of: Literal["read", "log10_p"] = "read") -> None:
        """Draw a panel for each attack and a line for each scheme over the strengths; see `curves.save_curves`.

        Needs the extra `plot`.
        """
        from jaxmark.curves import save_curves

        save_curves(self, path, of)


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a rate, which covers it with at least this probability whatever it is.

    Clopper, Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial", Biometrika 26,
    1934.

    Raises:
        JaxmarkError: if the level is not in (0, 1).
    """
    from scipy.stats import binomtest  # takes long to import

    if not 0 < level < 1:
        raise JaxmarkError(f"The level of an interval is in (0, 1), got {level:g}.")
    low, high = binomtest(successes, trials).proportion_ci(level, method="exact")
    return float(low), float(high)
