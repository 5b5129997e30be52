"""A benchmark held against one that was published: where the same cell reads otherwise."""

import csv
import io
import os
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from jaxmark.bench.results import BenchResults
from jaxmark.bench.work import Task
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file, write_atomically

BITS = 0.1  # share of wrong bits by which two readings of a message may differ and still agree
_FIELDS = (*Task._fields, "copy", "read", "bit_errors", "detected")
_NAMES, _RULES = (*Task._fields, "copy"), ("read", "bit_errors", "detected")


class Repetition(NamedTuple):
    """What a run has in common with a published one."""

    shared: int  # readings that both have
    differences: tuple[str, ...]  # a line for each that disagrees


def save_readings(results: BenchResults, path: str | os.PathLike[str]) -> None:
    """Write what was read of each marked suspect with its own key, as values with commas between, to publish it.

    Raises:
        JaxmarkError: if it cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, _FIELDS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(_lines(results))
    write_atomically(path, text.getvalue().encode())


Published = Mapping[tuple[str, ...], Mapping[str, str]]  # what was read, by cell and copy


def load_published(path: str | os.PathLike[str]) -> Published:
    """Load readings that `save_readings` wrote.

    Raises:
        JaxmarkError: if the file cannot be read, or is of another form.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_file(path).decode())))
        published = {tuple(row[name] for name in _NAMES): {rule: row[rule] for rule in _RULES} for row in rows}
        sound = all(0 <= float(one["bit_errors"]) <= 1 for one in published.values())
    except OSError as error:
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError, csv.Error):
        published, rows, sound = {}, [], False
    if not published or len(published) < len(rows) or not sound:
        raise JaxmarkError(
            f"{os.fspath(path)} holds no readings of a benchmark, one a line, with a share of wrong bits: give the"
            " readings.csv of one."
        )
    return published


def hold_against(results: BenchResults, published: Published) -> Repetition:
    """Compare a run with a published one of any other extent, reading by reading.

    Readings disagree where the exact message is read in one of them only, or wrong bits differ by more than `BITS`; of
    methods without a message, where one is detected and the other not.

    Args:
        results: the run.
        published: see `load_published`.
    """
    shared, said = 0, []
    for row in _lines(results):
        if (other := published.get(tuple(row[name] for name in _NAMES))) is None:
            continue
        shared += 1
        rule = "read" if results.methods[row["method"]].bits else "detected"
        apart = abs(float(row["bit_errors"]) - float(other["bit_errors"]))
        if row[rule] != other[rule] or apart > BITS:
            place = ", ".join(row[name] for name in ("method", "payload", "league", "limits", "mesh", "seed", "attack"))
            said.append(
                f"{place}: {rule} {row[rule]} here, {other[rule]} there; wrong bits {row['bit_errors']} here,"
                f" {other['bit_errors']} there"
            )
    return Repetition(shared, tuple(said))


def _lines(results: BenchResults) -> Iterator[dict[str, str]]:
    for one in results.suspects:
        yield {
            **{name: str(value) for name, value in one.task._asdict().items()},
            "copy": str(one.reading.get("copy", 0)),
            "read": str(int(one.reading["read"])),
            "bit_errors": f"{one.reading['bit_errors']:.3g}",
            "detected": str(int(results.succeeds(one))),
        }
