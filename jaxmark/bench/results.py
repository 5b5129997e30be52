"""What a benchmark found: for each method its calibration, its rates after every attack, and its scores."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import csv
import io
import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxmark.bench.calibration import RATE, Calibration, calibrate, count
from jaxmark.bench.leagues import get_league
from jaxmark.bench.method import Method
from jaxmark.bench.paired import Paired, compare_paired
from jaxmark.bench.quality import Point, score
from jaxmark.bench.work import MARK, UNMARKED, Task
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import write_atomically

_WRONG, _OTHERS, _PLAIN, _ATTACKED = "another key's mark", "another method's mark", "unmarked", "unmarked, attacked"
Reading = Mapping[str, Any]
Null = tuple[float, float | None]  # a score, and log10 of the probability that is proven


@dataclass(frozen=True)
class Suspect:
    """A suspect, and what the reader said of it with the key that marked it, if one did."""

    task: Task
    costs: Mapping[str, float | None]
    reading: Reading


@dataclass(frozen=True)
class BenchResults:
    """The rows of a benchmark, as `jaxmark.bench.run` returns them."""

    methods: Mapping[str, Method]  # by their names in cells
    rows: tuple[dict[str, Any], ...]
    skipped: Mapping[str, str]  # attacks that need what is not installed, and why
    rate: float = RATE  # of false positives, at which a mark counts as detected

    @cached_property
    def tasks(self) -> list[tuple[Task, dict[str, Any]]]:
        """The rows with their cells."""
        return [(Task(*row["cell"]), row) for row in self.rows]

    @cached_property
    def suspects(self) -> list[Suspect]:
        """The marked suspects read with their own key; a mesh that could not be marked or attacked counts as one."""
        found = []
        for task, row in self.tasks:
            if task.attack == MARK or task.source != task.method:
                continue
            mine = [one for one in row["readings"] if one["own"]]
            nothing = {"read": False, "bit_errors": 0.5, "score": None, "log10_p": 0.0, "note": row.get("note", "")}
            found += [Suspect(task, row.get("costs", {}), one) for one in mine or [nothing]]
        return found

    @cached_property
    def calibrations(self) -> dict[tuple[str, int], Calibration]:
        """What counting says of each reader, by method and payload."""
        nulls: dict[tuple[str, int], dict[str, list[Null]]] = defaultdict(lambda: defaultdict(list))
        for task, row in self.tasks:
            for one in row.get("readings", []):
                if not one["own"]:
                    nulls[task.method, task.payload][_kind(task)].append((_score(one), one["log10_p"]))
        marks: dict[tuple[str, int], list[float]] = defaultdict(list)
        for one in self.suspects:
            marks[one.task.method, one.task.payload].append(_score(one.reading))
        return {
            key: calibrate(self.methods[key[0]], kinds, np.array(marks[key], float), self.rate)
            for key, kinds in nulls.items()
        }

    def detected(self, one: Suspect) -> bool:
        """Whether a suspect's score is above the calibrated threshold of its reader."""
        found = self.calibrations.get((one.task.method, one.task.payload))
        return found is not None and _score(one.reading) > found.threshold.value

    def entries(self) -> dict[str, dict[str, Any]]:
        """One entry a method, under its name, that JSON can hold; where two have one name, by their names in cells."""
        names = [method.name for method in self.methods.values()]
        return {
            method.name if names.count(method.name) == 1 else label: self._entry(label, method)
            for label, method in self.methods.items()
        }

    def _entry(self, label: str, method: Method) -> dict[str, Any]:
        mine = [one for one in self.suspects if one.task.method == label]
        payloads = sorted({one.task.payload for one in mine})
        return {
            "blind": method.blind,
            "bits": method.bits,
            "strengths": list(method.strengths),
            "source": method.source,
            "validated": method.anchor or "not validated",
            "payloads": {
                str(payload): {
                    "calibration": self._calibration(label, payload),
                    "leagues": dict(self._leagues([one for one in mine if one.task.payload == payload])),
                }
                for payload in payloads
            },
        }

    def _calibration(self, label: str, payload: int) -> dict[str, Any] | None:
        found = self.calibrations.get((label, payload))
        if found is None:
            return None
        every = max(len(found.points) // 50, 1)
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

    def _leagues(self, mine: Sequence[Suspect]) -> Iterator[tuple[str, dict[str, Any]]]:
        for league in dict.fromkeys(one.task.league for one in mine):
            some = [one for one in mine if one.task.league == league]
            points = {
                rule: [Point(one.task.mesh, one.task.seed, one.task.attack, one.costs, won(one)) for one in some]
                for rule, won in (("detected", self.detected), ("read", lambda one: one.reading["read"]))
            }
            scores = {rule: score(many) for rule, many in points.items()}
            yield (
                league,
                {
                    "scores": {rule: None if one is None else one._asdict() for rule, one in scores.items()},
                    "limits": {
                        limits: {
                            "marks": self._marks(some[0].task, limits),
                            "attacks": dict(self._attacks([one for one in some if one.task.limits == limits])),
                        }
                        for limits in dict.fromkeys(one.task.limits for one in some)
                    },
                },
            )

    def _marks(self, like: Task, limits: str) -> dict[str, Any]:
        """What the marks themselves do, the mean over meshes and seeds."""
        rows = [
            row
            for task, row in self.tasks
            if task.attack == MARK
            and (task.method, task.payload, task.league, task.limits)
            == (like.method, like.payload, like.league, limits)
        ]
        made = [row for row in rows if "strength" in row]
        names = made[0]["moved"] if made else {}
        return {
            "made": len(made),
            "tried": len(rows),
            "seconds": float(np.mean([row["seconds"] for row in rows])) if rows else None,
            **{name: _mean(row["moved"][name] for row in made) for name in names},
            "notes": sorted({row["note"] for row in rows if "note" in row}),
        }

    def _attacks(self, some: Sequence[Suspect]) -> Iterator[tuple[str, dict[str, Any]]]:
        for attack in dict.fromkeys(one.task.attack for one in some):
            here = [one for one in some if one.task.attack == attack]
            line = get_league(here[0].task.league).lines[attack]
            place = list(get_league(here[0].task.league).limits).index(here[0].task.limits)
            published = {name: rates[place] for name in ("cho", "wang") if (rates := getattr(line, name)) is not None}
            yield attack, {**self._rates(here), "published_bit_errors": published}
        families: dict[str, list[Suspect]] = defaultdict(list)
        for one in some:
            if family := get_league(one.task.league).lines[one.task.attack].family:
                families[family].append(one)
        for family, many in families.items():
            yield f"{family}: the best of all", self._rates(self._worst(many))

    def _worst(self, many: Iterable[Suspect]) -> list[Suspect]:
        """Of each mark, the suspect that an attacker would take who sees what the reader says."""
        found: dict[tuple[str, int], Suspect] = {}
        for one in many:
            key = one.task.mesh, one.task.seed
            if key not in found or _survives(one) < _survives(found[key]):
                found[key] = one
        return list(found.values())

    def _rates(self, here: Sequence[Suspect]) -> dict[str, Any]:
        read, detected = count([one.reading["read"] for one in here]), count([self.detected(one) for one in here])
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
            "score": _finite(float(np.median([_score(one.reading) for one in here]))),
            "log10_p": float(np.median(p)) if p else None,
            "seconds": float(np.median(seconds)) if seconds else None,
            "costs": {name: _mean(one.costs.get(name) for one in here) for name in ("mrms", "dame", "msdm2")},
            "notes": sorted({one.reading["note"] for one in here if one.reading.get("note")}),
        }

    def paired(self, first: str, second: str, league: str, rule: str = "detected") -> Paired:
        """Compare two methods on all meshes, seeds, limits and attacks of a league that both have.

        Args:
            first: a method's name in cells.
            second: another one.
            league: the league.
            rule: `"detected"` at the calibrated threshold, or `"read"`, the exact message.

        Raises:
            JaxmarkError: if they share none.
        """
        won: dict[str, dict[tuple[Any, ...], bool]] = {first: {}, second: {}}
        for one in self.suspects:
            if one.task.method in won and one.task.league == league:
                place = (*one.task._replace(method="", source=""), one.reading.get("copy", 0))
                won[one.task.method][place] = self.detected(one) if rule == "detected" else one.reading["read"]
        shared = sorted(won[first].keys() & won[second].keys())
        if not shared:
            raise JaxmarkError(f"{first!r} and {second!r} have no suspect in common in the league {league}.")
        return compare_paired([won[first][one] for one in shared], [won[second][one] for one in shared])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the entries as JSON, the file whole or not at all.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, json.dumps(self.entries(), indent=1, allow_nan=False).encode())

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write every reading as comma-separated values.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        text = io.StringIO()
        fields = [*Task._fields, "copy", "own", "read", "bit_errors", "score", "log10_p", "seconds", "note"]
        writer = csv.DictWriter(text, fields)
        writer.writeheader()
        for task, row in self.tasks:
            for one in row.get("readings", []):
                writer.writerow({**task._asdict(), **one})
        write_atomically(path, text.getvalue().encode())


def _kind(task: Task) -> str:
    """What kind of null a suspect is, whose readings are not with the key that marked it."""
    if task.source == UNMARKED:
        return _PLAIN if task.attack == "none" else _ATTACKED
    return _WRONG if task.source == task.method else _OTHERS


def _score(reading: Reading) -> float:
    return -math.inf if reading["score"] is None else reading["score"]


def _survives(one: Suspect) -> tuple[bool, float]:
    return one.reading["read"], _score(one.reading)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
