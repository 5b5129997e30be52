"""Summary of a benchmark: the calibration, the rates after every attack, and the scores of each method."""

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


@lru_cache(maxsize=1)  # tables, page and JSON use the same entries, whose intervals take minutes for large runs
def entries(results: BenchResults) -> dict[str, dict[str, Any]]:
    """Return an entry of JSON values for each method, by its name; methods with equal names by their names in cells."""
    names = [method.name for method in results.methods.values()]
    return {
        method.name if names.count(method.name) == 1 else label: _entry(results, label, method)
        for label, method in results.methods.items()
    }


def save_entries(results: BenchResults, path: str | os.PathLike[str]) -> None:
    """Write the entries as JSON, atomically.

    Raises:
        JaxmarkError: if the file cannot be written.
    """
    write_atomically(path, json.dumps(entries(results), indent=1, allow_nan=False).encode())


def points(results: BenchResults, some: Iterable[Suspect], rule: str = "detected") -> list[Point]:
    """Convert suspects to points of a robustness curve; success is by the rule `"detected"` or `"read"`."""
    return [
        Point(
            task.mesh,
            task.seed,
            task.attack,
            suspect.costs,
            results.succeeds(suspect, rule),
            task.mark in results.marks,
        )
        for suspect in some
        for task in [suspect.task]
    ]


def _entry(results: BenchResults, label: str, method: Method) -> dict[str, Any]:
    of_method = [suspect for suspect in results.suspects if suspect.task.method == label]
    return {
        "blind": method.blind,
        "bits": method.bits,
        "strengths": list(method.strengths),
        "source": method.source,
        "validated": method.anchor or NOT_VALIDATED,
        "payloads": {
            str(payload): {
                "calibration": _calibration(results.calibrations.get((label, payload))),
                "tracks": {track: _track(results, of_track) for track, of_track in _by("track", of_payload).items()},
            }
            for payload, of_payload in sorted(_by("payload", of_method).items())
        },
    }


def _by(field: str, suspects: Sequence[Suspect]) -> dict[Any, list[Suspect]]:
    """Group suspects by a field of their tasks."""
    groups = defaultdict(list)
    for suspect in suspects:
        groups[getattr(suspect.task, field)].append(suspect)
    return groups


def _calibration(calibration: Calibration | None) -> dict[str, Any] | None:
    if calibration is None:
        return None
    own, step = calibration.own, max(len(calibration.points) // _ROC_POINTS, 1)
    return {
        "threshold": _finite(calibration.threshold.value),
        "rate": calibration.threshold.rate,
        "rate_low": calibration.threshold.low,
        "rate_high": calibration.threshold.high,
        "nulls": {kind: hits._asdict() for kind, hits in calibration.kinds.items()},
        "roc_area": calibration.area,
        "roc": [list(point) for point in [*calibration.points[:-1:step], calibration.points[-1]]],
        "own_threshold": None if own is None else {**own._asdict(), "stated": calibration.stated},
        "bound": [level._asdict() for level in calibration.bound],
        "verdicts": calibration.verdicts,
    }


def _track(results: BenchResults, some: Sequence[Suspect]) -> dict[str, Any]:
    scores = {rule: score(points(results, some, rule)) for rule in ("detected", "read")}
    return {
        "scores": {rule: None if value is None else value._asdict() for rule, value in scores.items()},
        "limits": {
            name: {"marks": _marks(results, under[0].task), "attacks": _attacks(results, under)}
            for name, under in _by("limits", some).items()
        },
    }


def _marks(results: BenchResults, like: Task) -> dict[str, Any]:
    """Summarise the marks under the same limits as a task: means over meshes and samples."""
    rows = [row for task, row in results.tasks if task.attack == MARK and task[:4] == like[:4]]
    marked = [row for row in rows if "strength" in row]
    return {
        "made": len(marked),
        "tried": len(rows),
        "seconds": _mean(row["seconds"] for row in rows),
        **{name: _mean(row["moved"][name] for row in marked) for name in ("rms", *COSTS)},
        "notes": sorted({row["note"] for row in rows if "note" in row}),
    }


def _attacks(results: BenchResults, some: Sequence[Suspect]) -> dict[str, dict[str, Any]]:
    rates: dict[str, dict[str, Any]] = {}
    track, families = get_track(some[0].task.track), defaultdict(list)
    place = list(track.limits).index(some[0].task.limits)
    for attack, attacked in _by("attack", some).items():
        line = track.lines[attack]
        published = {name: pair[place] for name in ("cho", "wang") if (pair := getattr(line, name)) is not None}
        rates[attack] = {**_rates(results, attacked), "published_bit_errors": published}
        if line.family:
            families[line.family] += attacked
    for family, of_family in families.items():
        # An attacker who sees the reader's output chooses, for each mark, the suspect with the lowest score.
        of_marks = [group for of_mesh in _by("mesh", of_family).values() for group in _by("seed", of_mesh).values()]
        worst = [min(group, key=lambda suspect: (suspect.reading["read"], suspect.score)) for group in of_marks]
        rates[f"{family}: the best of all"] = _rates(results, worst)
    return rates


def _rates(results: BenchResults, suspects: Sequence[Suspect]) -> dict[str, Any]:
    def counted(rule: str) -> dict[str, Any]:
        successes = count([results.succeeds(suspect, rule) for suspect in suspects])
        return {rule: successes.hits, f"{rule}_low": successes.low, f"{rule}_high": successes.high}

    def median(name: str) -> float | None:
        values = [suspect.reading[name] for suspect in suspects if suspect.reading.get(name) is not None]
        return float(np.median(values)) if values else None

    return {
        "trials": len(suspects),
        **counted("read"),
        **counted("detected"),
        "bit_errors": float(np.mean([suspect.reading["bit_errors"] for suspect in suspects])),
        "score": _finite(float(np.median([suspect.score for suspect in suspects]))),
        "log10_p": median("log10_p"),
        "seconds": median("seconds"),
        "costs": {name: _mean(suspect.costs.get(name) for suspect in suspects) for name in COSTS},
        "notes": sorted({suspect.reading["note"] for suspect in suspects if suspect.reading.get("note")}),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
