"""What a benchmark found, summed up: for each method its calibration, its rates after every attack, and its scores."""

import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from jaxmark.bench.calibration import Calibration, count
from jaxmark.bench.leagues import get_league
from jaxmark.bench.method import Method
from jaxmark.bench.quality import Point, score
from jaxmark.bench.results import BenchResults, Suspect
from jaxmark.bench.work import COSTS, MARK, Task
from jaxmark.files.atomic import write_atomically

NOT_VALIDATED = "not validated"
_ROC_POINTS = 50


@lru_cache(maxsize=1)  # tables, page and JSON are of the same entries, whose intervals take minutes on large runs
def entries(results: BenchResults) -> dict[str, dict[str, Any]]:
    """One entry a method, under its name, that JSON can hold; where two have one name, by their names in cells."""
    names = [method.name for method in results.methods.values()]
    return {
        method.name if names.count(method.name) == 1 else label: _entry(results, label, method)
        for label, method in results.methods.items()
    }


def save_entries(results: BenchResults, path: str | os.PathLike[str]) -> None:
    """Write the entries as JSON, the file whole or not at all.

    Raises:
        JaxmarkError: if it cannot be written.
    """
    write_atomically(path, json.dumps(entries(results), indent=1, allow_nan=False).encode())


def points(results: BenchResults, some: Iterable[Suspect], rule: str = "detected") -> list[Point]:
    """Suspects as points of a curve, by the rule `"detected"` or `"read"`."""
    return [
        Point(
            one.task.mesh,
            one.task.seed,
            one.task.attack,
            one.costs,
            results.succeeds(one, rule),
            one.task.mark in results.marks,
        )
        for one in some
    ]


def _entry(results: BenchResults, label: str, method: Method) -> dict[str, Any]:
    mine = [one for one in results.suspects if one.task.method == label]
    return {
        "blind": method.blind,
        "bits": method.bits,
        "strengths": list(method.strengths),
        "source": method.source,
        "validated": method.anchor or NOT_VALIDATED,
        "payloads": {
            str(payload): {
                "calibration": _calibration(results.calibrations.get((label, payload))),
                "leagues": dict(_leagues(results, [one for one in mine if one.task.payload == payload])),
            }
            for payload in sorted({one.task.payload for one in mine})
        },
    }


def _calibration(found: Calibration | None) -> dict[str, Any] | None:
    if found is None:
        return None
    every = max(len(found.points) // _ROC_POINTS, 1)
    return {
        "threshold": _finite(found.threshold.value),
        "rate": found.threshold.rate,
        "rate_low": found.threshold.low,
        "rate_high": found.threshold.high,
        "nulls": {kind: one._asdict() for kind, one in found.kinds.items()},
        "roc_area": found.area,
        "roc": [list(point) for point in [*found.points[:-1:every], found.points[-1]]],
        "own_threshold": None if found.own is None else {**found.own._asdict(), "stated": found.stated},
        "bound": [level._asdict() for level in found.bound],
        "verdicts": found.verdicts,
    }


def _leagues(results: BenchResults, mine: Sequence[Suspect]) -> Iterator[tuple[str, dict[str, Any]]]:
    for league in dict.fromkeys(one.task.league for one in mine):
        some = [one for one in mine if one.task.league == league]
        scores = {rule: score(points(results, some, rule)) for rule in ("detected", "read")}
        limits = {
            name: {
                "marks": _marks(results, some[0].task._replace(limits=name)),
                "attacks": dict(_attacks(results, [one for one in some if one.task.limits == name])),
            }
            for name in dict.fromkeys(one.task.limits for one in some)
        }
        yield (
            league,
            {
                "scores": {rule: None if one is None else one._asdict() for rule, one in scores.items()},
                "limits": limits,
            },
        )


def _marks(results: BenchResults, like: Task) -> dict[str, Any]:
    """What the marks themselves do under the same limits, the mean over meshes and seeds."""
    rows = [
        row
        for task, row in results.tasks
        if task.attack == MARK and task[:4] == like[:4] and task.source == like.method
    ]
    made = [row for row in rows if "strength" in row]
    return {
        "made": len(made),
        "tried": len(rows),
        "seconds": _mean(row["seconds"] for row in rows),
        **{name: _mean(row["moved"][name] for row in made) for name in ("rms", *COSTS)},
        "notes": sorted({row["note"] for row in rows if "note" in row}),
    }


def _attacks(results: BenchResults, some: Sequence[Suspect]) -> Iterator[tuple[str, dict[str, Any]]]:
    families: dict[str, list[Suspect]] = defaultdict(list)
    for attack in dict.fromkeys(one.task.attack for one in some):
        here = [one for one in some if one.task.attack == attack]
        league = get_league(here[0].task.league)
        line, place = league.lines[attack], list(league.limits).index(here[0].task.limits)
        published = {name: rates[place] for name in ("cho", "wang") if (rates := getattr(line, name)) is not None}
        yield attack, {**_rates(results, here), "published_bit_errors": published}
        if line.family:
            families[line.family] += here
    for family, many in families.items():
        yield f"{family}: the best of all", _rates(results, _worst(many))


def _worst(many: Iterable[Suspect]) -> list[Suspect]:
    """Of each mark, the suspect that an attacker would take who sees what the reader says."""
    found: dict[tuple[str, int], Suspect] = {}
    for one in many:
        key = one.task.mesh, one.task.seed
        if key not in found or (one.reading["read"], one.score) < (found[key].reading["read"], found[key].score):
            found[key] = one
    return list(found.values())


def _rates(results: BenchResults, here: Sequence[Suspect]) -> dict[str, Any]:
    read = count([one.reading["read"] for one in here])
    detected = count([results.succeeds(one) for one in here])
    p = [one.reading["log10_p"] for one in here if one.reading["log10_p"] is not None]
    seconds = [one.reading["seconds"] for one in here if "seconds" in one.reading]
    return {
        "trials": len(here),
        "read": read.hits,
        "read_low": read.low,
        "read_high": read.high,
        "detected": detected.hits,
        "detected_low": detected.low,
        "detected_high": detected.high,
        "bit_errors": float(np.mean([one.reading["bit_errors"] for one in here])),
        "score": _finite(float(np.median([one.score for one in here]))),
        "log10_p": float(np.median(p)) if p else None,
        "seconds": float(np.median(seconds)) if seconds else None,
        "costs": {name: _mean(one.costs.get(name) for one in here) for name in COSTS},
        "notes": sorted({one.reading["note"] for one in here if one.reading.get("note")}),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
