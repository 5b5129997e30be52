"""The results of a benchmark: calibrated detection, paired comparisons, and comparison with published readings."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

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
from jaxmark.errors import JaxmarkError, require
from jaxmark.files.atomic import read_file, write_atomically

_MAX_BIT_ERROR_DIFFERENCE = 0.1  # largest difference of the fractions of wrong bits of two readings that agree
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
        """The reader's score; minus infinity if the reader refused the suspect."""
        return _score(self.reading)


@dataclass(frozen=True, eq=False)
class BenchResults:
    """The results of a benchmark, as `jaxmark.bench.benchmark.run` returns them."""

    methods: Mapping[str, Method]  # by their names in cells
    rows: tuple[dict[str, Any], ...]
    skipped: Mapping[str, str]  # skipped attacks, and the packages that they need
    rate: float = RATE  # false-positive rate at which a mark counts as detected

    @cached_property
    def tasks(self) -> list[tuple[Task, dict[str, Any]]]:
        """The rows with their tasks."""
        return [(Task(*row["cell"]), row) for row in self.rows]

    @property
    def seconds(self) -> float:
        """The total time of all tasks, in seconds of one process."""
        return sum(row.get("seconds", 0.0) for row in self.rows)

    def projected(self, meshes: int, samples: int) -> float:
        """Project the total time, in seconds of one process, to other numbers of similar meshes and of samples."""
        return self.seconds * meshes * samples / len({(task.mesh, task.seed) for task, _ in self.tasks})

    @cached_property
    def suspects(self) -> list[Suspect]:
        """The marked suspects, read with their own key.

        A mesh that could not be marked or attacked counts as a suspect in which nothing was detected.
        """
        suspects = []
        for task, row in self.tasks:
            if task.attack == MARK or task.source != task.method:
                continue
            own = [reading for reading in row["readings"] if reading["own"]]
            if not own:
                nothing = {"read": False, "bit_errors": 0.5, "score": None, "log10_p": 0.0, "note": row.get("note", "")}
                own = [{**nothing, "copy": copy} for copy in range(get_track(task.track).lines[task.attack].copies)]
            suspects += [Suspect(task, row.get("costs", {}), reading) for reading in own]
        return suspects

    @cached_property
    def marks(self) -> set[Task]:
        """The tasks of all marks that could be made within their limits."""
        return {task for task, row in self.tasks if task.attack == MARK and "strength" in row}

    @cached_property
    def calibrations(self) -> dict[tuple[str, int], Calibration]:
        """The calibration of each reader, by method and payload."""
        nulls: dict[tuple[str, int], dict[str, list[tuple[float, float | None]]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for task, row in self.tasks:
            for reading in row.get("readings", []):
                if not reading["own"]:
                    nulls[task.method, task.payload][self._kind(task)].append((_score(reading), reading["log10_p"]))
        marks: dict[tuple[str, int], list[float]] = defaultdict(list)
        for suspect in self.suspects:
            marks[suspect.task.method, suspect.task.payload].append(suspect.score)
        return {
            key: calibrate(self.methods[key[0]], kinds, np.array(marks[key], float), self.rate)
            for key, kinds in nulls.items()
        }

    def _kind(self, task: Task) -> str:
        """Return the kind of null of a suspect, for keys that did not mark it."""
        if task.source == UNMARKED:
            if task.limits:
                return "unmarked, with the mark's key"
            return "unmarked" if task.attack == "none" else "unmarked, attacked"
        if task.source == task.method:
            return "another key's mark"
        return "another method's mark" if task.source in self.methods else "another mesh"

    def succeeds(self, one: Suspect, rule: str = "detected") -> bool:
        """Whether a suspect's score exceeds the threshold; by the rule `"read"`, whether its exact message is read."""
        if rule == "read":
            return one.reading["read"]
        calibration = self.calibrations.get((one.task.method, one.task.payload))
        return calibration is not None and one.score > calibration.threshold.value

    def paired(
        self, first: str, second: str, track: str, rule: str = "detected", attacks: Sequence[str] = ()
    ) -> Paired:
        """Compare two methods on the meshes, samples, limits and attacks of a track that both have in common.

        Interval and p-value assume independent suspects. Many meshes after one attack are independent. For few meshes
        after many attacks, interval and p-value only describe these suspects.

        Args:
            first: a method's name; or its name in cells, if two methods have the same name.
            second: the name of the other method.
            track: the track.
            rule: `"detected"` at the calibrated threshold, or `"read"`, the exact message.
            attacks: the attacks to compare after; by default all.

        Raises:
            JaxmarkError: if the methods have no suspect in common, or a name does not determine one method.
        """
        first, second = self._label(first), self._label(second)
        successes: dict[str, dict[tuple[Any, ...], bool]] = {first: {}, second: {}}
        for suspect in self.suspects:
            task = suspect.task
            if task.method in successes and task.track == track and (not attacks or task.attack in attacks):
                place = (*task._replace(method="", source=""), suspect.reading.get("copy", 0))
                successes[task.method][place] = self.succeeds(suspect, rule)
        shared = sorted(successes[first].keys() & successes[second].keys())
        if not shared:
            raise JaxmarkError(f"{first!r} and {second!r} have no suspect in common in the track {track}.")
        return compare_paired(
            [successes[first][place] for place in shared], [successes[second][place] for place in shared]
        )

    def _label(self, name: str) -> str:
        """Return a method's name in cells."""
        labels = [label for label, method in self.methods.items() if name in (label, method.name)]
        if len(labels) != 1:
            count = "more than one" if labels else "no"
            raise JaxmarkError(f"There is {count} method {name!r} in {', '.join(self.methods)}.")
        return labels[0]

    def frame(self) -> Any:
        """Return the readings of marked suspects with their own key as a `pandas.DataFrame`. Needs the extra `study`.

        Columns are the fields of `Task`, those of the reading, and `detected` at the calibrated threshold.

        Raises:
            JaxmarkError: if pandas is missing.
        """
        rows = [{**one.task._asdict(), **one.reading, "detected": self.succeeds(one)} for one in self.suspects]
        return require("pandas", "study").DataFrame(rows)

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write all readings as comma-separated values.

        Raises:
            JaxmarkError: if the file cannot be written.
        """
        fields = [*_CELL, "own", "read", "bit_errors", "score", "log10_p", "seconds", "note"]
        rows = ({**task._asdict(), **reading} for task, row in self.tasks for reading in row.get("readings", []))
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
    """The comparison of a run with a published run."""

    shared: int  # number of readings that both runs have
    differences: tuple[str, ...]  # a line for each reading that differs


def save_readings(results: BenchResults, path: str | os.PathLike[str]) -> None:
    """Write the readings of marked suspects with their own keys as comma-separated values, for publication.

    Raises:
        JaxmarkError: if the file cannot be written.
    """
    _write_csv(path, [*_CELL, *_RULES], _published(results), "\n")


def load_published(path: str | os.PathLike[str]) -> Published:
    """Load readings that `save_readings` wrote.

    Raises:
        JaxmarkError: if the file cannot be read, or has another format.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_file(path).decode())))
        published = {tuple(row[name] for name in _CELL): {rule: row[rule] for rule in _RULES} for row in rows}
        if (
            published
            and len(published) == len(rows)
            and all(0 <= float(reading["bit_errors"]) <= 1 for reading in published.values())
        ):
            return published
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError, csv.Error):
        pass
    raise JaxmarkError(
        f"{os.fspath(path)} holds no readings of a benchmark; give a file readings.csv that a run has written."
    )


def hold_against(results: BenchResults, published: Published) -> Repetition:
    """Compare a run with a published run, reading by reading; the runs may have different meshes and methods.

    Two readings differ if the exact message is read in one of them only, or if the fractions of wrong bits differ by
    more than 0.1. For methods without a message, they differ if a mark is detected in one of them only.

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
        difference = abs(float(row["bit_errors"]) - float(other["bit_errors"]))
        if row[rule] != other[rule] or difference > _MAX_BIT_ERROR_DIFFERENCE:
            place = ", ".join(row[name] for name in ("method", "payload", "track", "limits", "mesh", "seed", "attack"))
            differences.append(
                f"{place}: {rule} {row[rule]}, published {other[rule]}; wrong bits {row['bit_errors']}, published"
                f" {other['bit_errors']}"
            )
    return Repetition(shared, tuple(differences))


def _published(results: BenchResults) -> Iterator[dict[str, str]]:
    for suspect in results.suspects:
        yield {
            **{name: str(value) for name, value in suspect.task._asdict().items()},
            "copy": str(suspect.reading.get("copy", 0)),
            "read": str(int(suspect.reading["read"])),
            "bit_errors": f"{suspect.reading['bit_errors']:.3g}",
            "detected": str(int(results.succeeds(suspect))),
        }
