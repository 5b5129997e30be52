"""Readings of a study, and how often they succeed."""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.intervals import clopper_pearson

Control = Literal["marked", "unmarked", "wrong-key"]
LOG10_LEVEL = -6.0  # of the false-positive probability at which a reader detects
POINT = ("mesh", "scheme", "bits", "budget", "attack", "strength")  # what a study varies, but for seeds


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


def rates(rows: Iterable[Row], by: Sequence[str] = (*POINT, "control"), level: float = 0.95) -> list[dict[str, Any]]:
    """How often the message was read, and how often a mark was detected, with exact intervals.

    Args:
        rows: of a study.
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
    for row in rows:
        groups.setdefault(tuple(getattr(row, name) for name in by), []).append(row)
    found = []
    for values, group in groups.items():
        rate: dict[str, Any] = {**dict(zip(by, values, strict=True)), "trials": len(group)}
        for name in ("read", "detected"):
            rate[name] = sum(getattr(row, name) for row in group)
            interval = clopper_pearson(rate[name], len(group), level)
            rate[f"{name}_low"], rate[f"{name}_high"] = float(interval.low), float(interval.high)
        p = [row.log10_p for row in group]
        rate["bit_errors"] = float(np.mean([row.bit_errors for row in group]))
        rate |= {"log10_p": float(np.median(p)), "log10_p_least": min(p), "log10_p_largest": max(p)}
        found.append(rate)
    return found
