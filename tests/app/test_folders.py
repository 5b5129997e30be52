"""Files of a folder, worked on by several processes."""

import multiprocessing
import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import jaxmark as jm
from jaxmark.app.folders import each
from jaxmark.app.output import FileOutcome, Status

FILES = [Path(f"{name}.ply") for name in "abcdef"]


@dataclass
class Count:
    """Counts what it was given, and refuses one file."""

    _seen: list[str] = field(default_factory=list)

    def __call__(self, file: Path) -> FileOutcome:
        if file.stem == "c":
            raise jm.JaxmarkError(f"{file} is not to my liking.")
        self._seen.append(file.stem)
        return FileOutcome({"worker": os.getpid(), "seen": len(self._seen)}, (file.stem,))


def die(file: Path) -> FileOutcome:
    """As a process does that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)
    return FileOutcome({}, ())


def wait(file: Path) -> FileOutcome:
    """Leave a draft while it works, as jobs do, which is removed whatever ends it."""
    if file.stem == "f":
        return FileOutcome({}, ())
    draft = file.with_suffix(".draft")
    try:
        draft.touch()
        time.sleep(60)
    finally:
        draft.unlink()
    return FileOutcome({}, ())


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    """Files of different sizes, the largest last."""
    found = [tmp_path / name for name in FILES]
    for size, file in enumerate(found):
        file.write_bytes(bytes(size))
    return found


@pytest.mark.slow
def test_several_workers_report_each_file(files):
    told = dict(each(files, Count(), workers=2))
    assert {file.stem for file in told} == set("abcdef")
    refused = {"refused": f"{files[2]} is not to my liking."}
    assert told.pop(files[2]) == FileOutcome(refused, (text_of_c(files),), Status.REFUSED)
    # Each worker keeps what it has prepared, and counts on from file to file.
    by_worker: dict[int, list[int]] = {}
    for one in told.values():
        by_worker.setdefault(one.values["worker"], []).append(one.values["seen"])
    assert os.getpid() not in by_worker
    assert all(sorted(seen) == list(range(1, len(seen) + 1)) for seen in by_worker.values())
    alone = Count()
    assert [(file.stem, *one.lines) for file, one in each(files, alone)] == [
        (file.stem, text_of_c(files) if file.stem == "c" else file.stem) for file in files
    ]


def text_of_c(files: list[Path]) -> str:
    return f"refused. {files[2]} is not to my liking."


@pytest.mark.slow
def test_a_worker_that_is_killed_is_told_of(files):
    with pytest.raises(jm.JaxmarkError, match=r"A worker was killed.*fewer --workers"):
        list(each(files, die, workers=2))
    assert_nobody_is_left()


@pytest.mark.slow
def test_whoever_stops_early_leaves_no_process_and_no_draft(files):
    told = each(files, wait, workers=2)
    assert next(told)[0] == files[-1]
    while not list(files[0].parent.glob("*.draft")):
        time.sleep(0.05)
    told.close()
    assert_nobody_is_left()
    assert not list(files[0].parent.glob("*.draft"))


def assert_nobody_is_left() -> None:
    until = time.monotonic() + 20
    while multiprocessing.active_children() and time.monotonic() < until:
        time.sleep(0.05)
    assert not multiprocessing.active_children()
