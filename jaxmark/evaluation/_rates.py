"""The readings of a study, and the rates at which they succeed."""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmark.confidence import clopper_pearson
from jaxmark.errors import JaxmarkError

Control = Literal["marked", "unmarked", "wrong-key"]
LOG10_LEVEL = -6.0  # log10 of the largest false-positive probability of a detection
POINT = ("mesh", "scheme", "bits", "budget", "attack", "strength")  # the fields that a study varies, except seeds


class Row(NamedTuple):
    """One reading of a suspect."""

    mesh: str
    scheme: str
    bits: int  # size of the payload
    budget: float | str  # a number if it is an RMS displacement over the diagonal alone, else its name
    attack: str
    strength: float
    unit: str  # unit of the strength
    seed: int  # seed of key, message and attack
    control: Control  # the mark with its key; or the unmarked mesh with that key, or the mark with another key
    read: bool  # whether the exact message was read, and its tag matches
    wrong: bool  # whether another message was read, whose tag matches
    bit_errors: float  # share of the message's bits that are wrong in the best guess; 1/2 if there is no guess
    log10_p: float  # log10 of a bound on the false-positive probability, with the message unknown
    log10_p_unfloored: float  # the same without its floor at -77, see `Detection`
    detected: bool  # whether log10_p is at most `LOG10_LEVEL`
    refusal: str  # a sentence that says why nothing could be read; empty otherwise
    seconds: float  # duration of the reading, with the alignment unless the row before includes it
    rms: float  # RMS displacement by the mark over the diagonal; 0 without a mark
    length: float | None = None  # the strength as a fraction of the mesh's diagonal; None if it is no length


def rates(rows: Iterable[Row], by: Sequence[str] = (*POINT, "control"), level: float = 0.95) -> list[dict[str, Any]]:
    """Count how often the message was read and how often a mark was detected, with exact intervals.

    Args:
        rows: the rows of a study.
        by: fields of `Row` by which rows are grouped; the others are pooled, except for `control`: marked meshes and
            controls are always apart.
        level: confidence level of the intervals, in (0, 1); see `clopper_pearson`.

    Returns:
        For each group its fields of `by`, and its `control`; the number of `trials`; the counts `read` and `detected`,
        with the bounds `read_low`, `read_high`, `detected_low` and `detected_high` on their rates; the mean of
        `bit_errors`, `rms` and `length` (None if a strength is no length); the median `log10_p`, with `log10_p_least`
        and `log10_p_largest`; and the same of `log10_p_unfloored`.

    Raises:
        JaxmarkError: if there is no such field, or the level is out of range.
    """
    if unknown := [name for name in by if name not in Row._fields]:
        raise JaxmarkError(f"A row has no field {unknown[0]!r}; there are {', '.join(Row._fields)}.")
    by = (*by, *(() if "control" in by else ("control",)))
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(getattr(row, name) for name in by), []).append(row)
    return [{**dict(zip(by, values, strict=True)), **_rate(group, level)} for values, group in groups.items()]


def _rate(rows: list[Row], level: float) -> dict[str, Any]:
    rate: dict[str, Any] = {"trials": len(rows)}
    for name in ("read", "detected"):
        rate[name] = sum(getattr(row, name) for row in rows)
        interval = clopper_pearson(rate[name], len(rows), level)
        rate |= {f"{name}_low": float(interval.low), f"{name}_high": float(interval.high)}
    rate |= {name: float(np.mean([getattr(row, name) for row in rows])) for name in ("bit_errors", "rms")}
    lengths = [row.length for row in rows if row.length is not None]
    rate["length"] = float(np.mean(lengths)) if lengths else None
    for name in ("log10_p", "log10_p_unfloored"):
        p = [getattr(row, name) for row in rows]
        rate |= {name: float(np.median(p)), f"{name}_least": min(p), f"{name}_largest": max(p)}
    return rate
