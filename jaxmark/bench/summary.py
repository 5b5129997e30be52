"""Summary of a benchmark: for each method its calibration, its rates after every attack, and its scores."""

import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from jaxmark.bench.calibration import Calibration, count
from jaxmark.bench.method import Method
from jaxmark.bench.readings import BenchResults, Suspect
from jaxmark.bench.robustness_curves import Point, score
from jaxmark.bench.tasks import COSTS, MARK, Task
from jaxmark.bench.tracks import get_track
from jaxmark.files.atomic import write_atomically

NOT_VALIDATED = "not validated"
_ROC_POINTS = 50


@lru_cache(maxsize=1)  # tables, page and JSON are of the same entries, whose intervals take minutes on large runs
def entries(results: BenchResults) -> dict[str, dict[str, Any]]:
    """Return an entry for each method that JSON can hold, by its name, or where two have one by its name in cells."""
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
    """Convert suspects to points of a curve, by the rule `"detected"` or `"read"`."""
    return [
        Point(task.mesh, task.seed, task.attack, one.costs, results.succeeds(one, rule), task.mark in results.marks)
        for one in some
        for task in [one.task]
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
                "tracks": {track: _track(results, of_league) for track, of_league in _by("track", of_payload).items()},
            }
            for payload, of_payload in sorted(_by("payload", mine).items())
        },
    }


def _by(field: str, suspects: Sequence[Suspect]) -> dict[Any, list[Suspect]]:
    """Group suspects by a field of their tasks."""
    groups = defaultdict(list)
    for one in suspects:
        groups[getattr(one.task, field)].append(one)
    return groups


def _calibration(found: Calibration | None) -> dict[str, Any] | None:
    if found is None:
        return None
    step = max(len(found.points) // _ROC_POINTS, 1)
    return {
        "threshold": _finite(found.threshold.value),
        "rate": found.threshold.rate,
        "rate_low": found.threshold.low,
        "rate_high": found.threshold.high,
        "nulls": {kind: one._asdict() for kind, one in found.kinds.items()},
        "roc_area": found.area,
        "roc": [list(point) for point in [*found.points[:-1:step], found.points[-1]]],
        "own_threshold": None if found.own is None else {**found.own._asdict(), "stated": found.stated},
        "bound": [level._asdict() for level in found.bound],
        "verdicts": found.verdicts,
    }


def _track(results: BenchResults, some: Sequence[Suspect]) -> dict[str, Any]:
    scores = {rule: score(points(results, some, rule)) for rule in ("detected", "read")}
    return {
        "scores": {rule: None if one is None else one._asdict() for rule, one in scores.items()},
        "limits": {
            name: {"marks": _marks(results, under[0].task), "attacks": _attacks(results, under)}
            for name, under in _by("limits", some).items()
        },
    }


def _marks(results: BenchResults, like: Task) -> dict[str, Any]:
    """Summarise the marks under the same limits: means over meshes and samples."""
    rows = [row for task, row in results.tasks if task.attack == MARK and task[:4] == like[:4]]
    made = [row for row in rows if "strength" in row]
    return {
        "made": len(made),
        "tried": len(rows),
        "seconds": _mean(row["seconds"] for row in rows),
        **{name: _mean(row["moved"][name] for row in made) for name in ("rms", *COSTS)},
        "notes": sorted({row["note"] for row in rows if "note" in row}),
    }


def _attacks(results: BenchResults, some: Sequence[Suspect]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    track, families = get_track(some[0].task.track), defaultdict(list)
    place = list(track.limits).index(some[0].task.limits)
    for attack, here in _by("attack", some).items():
        line = track.lines[attack]
        published = {name: rates[place] for name in ("cho", "wang") if (rates := getattr(line, name)) is not None}
        found[attack] = {**_rates(results, here), "published_bit_errors": published}
        if line.family:
            families[line.family] += here
    for family, many in families.items():
        # An attacker who sees the reader's answer takes the suspect of the lowest score of each mark.
        of_marks = [group for of_mesh in _by("mesh", many).values() for group in _by("seed", of_mesh).values()]
        worst = [min(group, key=lambda one: (one.reading["read"], one.score)) for group in of_marks]
        found[f"{family}: the best of all"] = _rates(results, worst)
    return found


def _rates(results: BenchResults, here: Sequence[Suspect]) -> dict[str, Any]:
    def counted(rule: str) -> dict[str, Any]:
        found = count([results.succeeds(one, rule) for one in here])
        return {rule: found.hits, f"{rule}_low": found.low, f"{rule}_high": found.high}

    def median(name: str) -> float | None:
        known = [one.reading[name] for one in here if one.reading.get(name) is not None]
        return float(np.median(known)) if known else None

    return {
        "trials": len(here),
        **counted("read"),
        **counted("detected"),
        "bit_errors": float(np.mean([one.reading["bit_errors"] for one in here])),
        "score": _finite(float(np.median([one.score for one in here]))),
        "log10_p": median("log10_p"),
        "seconds": median("seconds"),
        "costs": {name: _mean(one.costs.get(name) for one in here) for name in COSTS},
        "notes": sorted({one.reading["note"] for one in here if one.reading.get("note")}),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
