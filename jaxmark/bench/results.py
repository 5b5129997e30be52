"""The rows of a benchmark: suspects and readings, calibrated thresholds, and pairs of methods."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import csv
import io
import math
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxmark.bench.calibration import RATE, Calibration, calibrate
from jaxmark.bench.leagues import get_league
from jaxmark.bench.method import Method
from jaxmark.bench.paired import Paired, compare_paired
from jaxmark.bench.work import MARK, UNMARKED, Task
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import write_atomically

_WRONG, _OTHERS = "another key's mark", "another method's mark"
_PLAIN, _ATTACKED, _ANOTHER = "unmarked", "unmarked, attacked", "another mesh"
_UNUSED = "unmarked, with the mark's key"
Reading = Mapping[str, Any]
Null = tuple[float, float | None]  # a score, and log10 of the probability that is proven


@dataclass(frozen=True)
class Suspect:
    """A suspect, and what the reader said of it with the key that marked it, if one did."""

    task: Task
    costs: Mapping[str, float | None]
    reading: Reading

    @property
    def score(self) -> float:
        """The reader's score; minus infinity where it refused."""
        return _score(self.reading)


@dataclass(frozen=True, eq=False)
class BenchResults:
    """The rows of a benchmark, as `jaxmark.bench.benchmark.run` returns them."""

    methods: Mapping[str, Method]  # by their names in cells
    rows: tuple[dict[str, Any], ...]
    skipped: Mapping[str, str]  # attacks that need what is not installed, and why
    rate: float = RATE  # of false positives, at which a mark counts as detected

    @cached_property
    def tasks(self) -> list[tuple[Task, dict[str, Any]]]:
        """The rows with their cells."""
        return [(Task(*row["cell"]), row) for row in self.rows]

    @property
    def seconds(self) -> float:
        """How long all cells took, one after the other."""
        return sum(row.get("seconds", 0.0) for row in self.rows)

    def projected(self, meshes: int, seeds: int) -> float:
        """How many seconds as many meshes like these and seeds would take, one cell after the other."""
        return self.seconds * meshes * seeds / len({(task.mesh, task.seed) for task, _ in self.tasks})

    @cached_property
    def suspects(self) -> list[Suspect]:
        """The marked suspects read with their own key; a mesh that could not be marked or attacked counts as one."""
        found = []
        for task, row in self.tasks:
            if task.attack == MARK or task.source != task.method:
                continue
            mine = [one for one in row["readings"] if one["own"]]
            if not mine:
                nothing = {"read": False, "bit_errors": 0.5, "score": None, "log10_p": 0.0, "note": row.get("note", "")}
                mine = [{**nothing, "copy": copy} for copy in range(get_league(task.league).lines[task.attack].copies)]
            found += [Suspect(task, row.get("costs", {}), one) for one in mine]
        return found

    @cached_property
    def marks(self) -> set[Task]:
        """The marks that could be made within their limits."""
        return {task for task, row in self.tasks if task.attack == MARK and "strength" in row}

    @cached_property
    def calibrations(self) -> dict[tuple[str, int], Calibration]:
        """What counting says of each reader, by method and payload."""
        nulls: dict[tuple[str, int], dict[str, list[Null]]] = defaultdict(lambda: defaultdict(list))
        for task, row in self.tasks:
            for one in row.get("readings", []):
                if not one["own"]:
                    nulls[task.method, task.payload][self._kind(task)].append((_score(one), one["log10_p"]))
        marks: dict[tuple[str, int], list[float]] = defaultdict(list)
        for one in self.suspects:
            marks[one.task.method, one.task.payload].append(one.score)
        return {
            key: calibrate(self.methods[key[0]], kinds, np.array(marks[key], float), self.rate)
            for key, kinds in nulls.items()
        }

    def _kind(self, task: Task) -> str:
        """What kind of null a suspect is, whose readings are not with the key that marked it."""
        if task.source == UNMARKED:
            if task.limits:
                return _UNUSED
            return _PLAIN if task.attack == "none" else _ATTACKED
        if task.source == task.method:
            return _WRONG
        return _OTHERS if task.source in self.methods else _ANOTHER

    def succeeds(self, one: Suspect, rule: str = "detected") -> bool:
        """Whether a suspect's score is above its reader's calibrated threshold, or by `"read"` its message exact."""
        if rule == "read":
            return one.reading["read"]
        found = self.calibrations.get((one.task.method, one.task.payload))
        return found is not None and one.score > found.threshold.value

    def paired(
        self, first: str, second: str, league: str, rule: str = "detected", attacks: Sequence[str] = ()
    ) -> Paired:
        """Compare two methods on all meshes, seeds, limits and attacks of a league that both have.

        Interval and p take suspects for independent. After one attack, of many meshes, they are; after many attacks of
        few meshes they say how these suspects differ, and not how others would.

        Args:
            first: a method's name, or its name in cells, where two have the same.
            second: another one.
            league: the league.
            rule: `"detected"` at the calibrated threshold, or `"read"`, the exact message.
            attacks: after these; by default after all.

        Raises:
            JaxmarkError: if they share none, or a name is not that of one method.
        """
        first, second = self._label(first), self._label(second)
        won: dict[str, dict[tuple[Any, ...], bool]] = {first: {}, second: {}}
        for one in self.suspects:
            wanted = one.task.league == league and (not attacks or one.task.attack in attacks)
            if one.task.method in won and wanted:
                place = (*one.task._replace(method="", source=""), one.reading.get("copy", 0))
                won[one.task.method][place] = self.succeeds(one, rule)
        shared = sorted(won[first].keys() & won[second].keys())
        if not shared:
            raise JaxmarkError(f"{first!r} and {second!r} have no suspect in common in the league {league}.")
        return compare_paired([won[first][one] for one in shared], [won[second][one] for one in shared])

    def _label(self, name: str) -> str:
        """The name in cells of a method."""
        labels = [label for label, method in self.methods.items() if name in (label, method.name)]
        if len(labels) != 1:
            count = "more than one" if labels else "no"
            raise JaxmarkError(f"There is {count} method {name!r} in {', '.join(self.methods)}.")
        return labels[0]

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


def _score(reading: Reading) -> float:
    return -math.inf if reading["score"] is None else reading["score"]
