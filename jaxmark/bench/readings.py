"""Readings of a benchmark: calibrated detection, paired methods, and comparison with readings that were published."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import csv
import io
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxmark.bench.calibration import RATE, Calibration, calibrate
from jaxmark.bench.method import Method
from jaxmark.bench.paired import Paired, compare_paired
from jaxmark.bench.tasks import MARK, UNMARKED, Task
from jaxmark.bench.tracks import get_track
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file, write_atomically

_MAX_BIT_ERROR_DIFFERENCE = 0.1  # share of wrong bits by which two readings of a message may differ and still agree
_CELL, _RULES = (*Task._fields, "copy"), ("read", "bit_errors", "detected")
Reading = Mapping[str, Any]
Published = Mapping[tuple[str, ...], Mapping[str, str]]  # readings, by cell and copy


@dataclass(frozen=True)
class Suspect:
    """A marked suspect, and its reading with the key that marked it."""

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
        """The rows with their tasks."""
        return [(Task(*row["cell"]), row) for row in self.rows]

    @property
    def seconds(self) -> float:
        """The time of all tasks, one after the other."""
        return sum(row.get("seconds", 0.0) for row in self.rows)

    def projected(self, meshes: int, samples: int) -> float:
        """Project the seconds of numbers of meshes like these and of samples, one task after the other."""
        return self.seconds * meshes * samples / len({(task.mesh, task.seed) for task, _ in self.tasks})

    @cached_property
    def suspects(self) -> list[Suspect]:
        """The marked suspects read with their own key; a mesh that could not be marked or attacked counts as one."""
        suspects = []
        for task, row in self.tasks:
            if task.attack == MARK or task.source != task.method:
                continue
            own = [one for one in row["readings"] if one["own"]]
            if not own:
                nothing = {"read": False, "bit_errors": 0.5, "score": None, "log10_p": 0.0, "note": row.get("note", "")}
                own = [{**nothing, "copy": copy} for copy in range(get_track(task.track).lines[task.attack].copies)]
            suspects += [Suspect(task, row.get("costs", {}), one) for one in own]
        return suspects

    @cached_property
    def marks(self) -> set[Task]:
        """The marks that could be made within their limits."""
        return {task for task, row in self.tasks if task.attack == MARK and "strength" in row}

    @cached_property
    def calibrations(self) -> dict[tuple[str, int], Calibration]:
        """The calibration of each reader, by method and payload."""
        nulls: dict[tuple[str, int], dict[str, list[tuple[float, float | None]]]] = defaultdict(
            lambda: defaultdict(list)
        )
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
        """The kind of null that a suspect is for keys that did not mark it."""
        if task.source == UNMARKED:
            if task.limits:
                return "unmarked, with the mark's key"
            return "unmarked" if task.attack == "none" else "unmarked, attacked"
        if task.source == task.method:
            return "another key's mark"
        return "another method's mark" if task.source in self.methods else "another mesh"

    def succeeds(self, one: Suspect, rule: str = "detected") -> bool:
        """Whether a suspect's score is above its reader's calibrated threshold, or by `"read"` its message exact."""
        if rule == "read":
            return one.reading["read"]
        found = self.calibrations.get((one.task.method, one.task.payload))
        return found is not None and one.score > found.threshold.value

    def paired(
        self, first: str, second: str, track: str, rule: str = "detected", attacks: Sequence[str] = ()
    ) -> Paired:
        """Compare two methods on all meshes, samples, limits and attacks of a track that both have.

        Interval and p assume independent suspects. After one attack, of many meshes, they are; after many attacks of
        few meshes they describe these suspects only.

        Args:
            first: a method's name, or its name in cells, where two have the same.
            second: another one.
            track: the track.
            rule: `"detected"` at the calibrated threshold, or `"read"`, the exact message.
            attacks: after these; by default after all.

        Raises:
            JaxmarkError: if they share none, or a name is not that of one method.
        """
        first, second = self._label(first), self._label(second)
        won: dict[str, dict[tuple[Any, ...], bool]] = {first: {}, second: {}}
        for one in self.suspects:
            wanted = one.task.track == track and (not attacks or one.task.attack in attacks)
            if one.task.method in won and wanted:
                place = (*one.task._replace(method="", source=""), one.reading.get("copy", 0))
                won[one.task.method][place] = self.succeeds(one, rule)
        shared = sorted(won[first].keys() & won[second].keys())
        if not shared:
            raise JaxmarkError(f"{first!r} and {second!r} have no suspect in common in the track {track}.")
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
        fields = [*_CELL, "own", "read", "bit_errors", "score", "log10_p", "seconds", "note"]
        rows = ({**task._asdict(), **one} for task, row in self.tasks for one in row.get("readings", []))
        _write_csv(path, fields, rows, "\r\n")


def _score(reading: Reading) -> float:
    return -math.inf if reading["score"] is None else reading["score"]


def _write_csv(
    path: str | os.PathLike[str], fields: Sequence[str], rows: Iterable[Mapping[str, Any]], line_end: str
) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, fields, lineterminator=line_end)
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode())


class Repetition(NamedTuple):
    """The readings that a run shares with a published one."""

    shared: int  # readings that both have
    differences: tuple[str, ...]  # a line for each that disagrees


def save_readings(results: BenchResults, path: str | os.PathLike[str]) -> None:
    """Write the readings of marked suspects with their own keys as comma-separated values, to publish them.

    Raises:
        JaxmarkError: if it cannot be written.
    """
    _write_csv(path, [*_CELL, *_RULES], _published(results), "\n")


def load_published(path: str | os.PathLike[str]) -> Published:
    """Load readings that `save_readings` wrote.

    Raises:
        JaxmarkError: if the file cannot be read, or is of another form.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_file(path).decode())))
        published = {tuple(row[name] for name in _CELL): {rule: row[rule] for rule in _RULES} for row in rows}
        if (
            published
            and len(published) == len(rows)
            and all(0 <= float(one["bit_errors"]) <= 1 for one in published.values())
        ):
            return published
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError, csv.Error):
        pass
    raise JaxmarkError(
        f"{os.fspath(path)} holds no readings of a benchmark, one a line, with a share of wrong bits: give the"
        " readings.csv of one."
    )


def hold_against(results: BenchResults, published: Published) -> Repetition:
    """Compare a run with a published one of any other extent, reading by reading.

    Readings disagree where the exact message is read in one of them only, or the shares of wrong bits differ by more
    than 0.1; of methods without a message, where a mark is detected in one of them only.

    Args:
        results: the run.
        published: see `load_published`.
    """
    shared, differences = 0, []
    for row in _published(results):
        if (other := published.get(tuple(row[name] for name in _CELL))) is None:
            continue
        shared += 1
        rule = "read" if results.methods[row["method"]].bits else "detected"
        apart = abs(float(row["bit_errors"]) - float(other["bit_errors"]))
        if row[rule] != other[rule] or apart > _MAX_BIT_ERROR_DIFFERENCE:
            place = ", ".join(row[name] for name in ("method", "payload", "track", "limits", "mesh", "seed", "attack"))
            differences.append(
                f"{place}: {rule} {row[rule]} here, {other[rule]} there; wrong bits {row['bit_errors']} here,"
                f" {other['bit_errors']} there"
            )
    return Repetition(shared, tuple(differences))


def _published(results: BenchResults) -> Iterator[dict[str, str]]:
    for one in results.suspects:
        yield {
            **{name: str(value) for name, value in one.task._asdict().items()},
            "copy": str(one.reading.get("copy", 0)),
            "read": str(int(one.reading["read"])),
            "bit_errors": f"{one.reading['bit_errors']:.3g}",
            "detected": str(int(results.succeeds(one))),
        }
