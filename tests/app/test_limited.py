"""The worker process: what exceeds a limit ends alone, and the next call is answered."""

import os
import sys
import time
from collections.abc import Iterator

import pytest

from jaxmark.app.limited import Worker
from jaxmark.errors import JaxmarkError

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    running = Worker(120, 300)
    yield running
    running.end()


def _refuse(text: str) -> None:
    raise JaxmarkError(text)


def test_values_and_exceptions_come_back(worker: Worker):
    process = worker.run(os.getpid)
    assert process != os.getpid()
    with pytest.raises(JaxmarkError, match=r"^No mesh\.$"):
        worker.run(_refuse, "No mesh.")
    with pytest.raises(RuntimeError, match="ValueError: invalid literal"):
        worker.run(int, "x")
    assert worker.run(os.getpid) == process


def test_a_late_call_ends_alone(worker: Worker, monkeypatch: pytest.MonkeyPatch):
    process = worker.run(os.getpid)
    monkeypatch.setattr(worker, "_seconds", 0.5)
    with pytest.raises(JaxmarkError, match=r"more than 0\.5 seconds, .*command line\.$"):
        worker.run(time.sleep, 60)
    monkeypatch.undo()
    assert worker.run(os.getpid) != process


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory so")
def test_memory_is_limited(worker: Worker):
    assert len(worker.run(bytes, 100 * 2**20)) == 100 * 2**20
    with pytest.raises(JaxmarkError, match="more than 300 megabytes of memory"):
        worker.run(bytes, 400 * 2**20)
    assert worker.run(len, b"abc") == 3


def test_a_killed_process_is_replaced(worker: Worker):
    with pytest.raises(JaxmarkError, match="was not read"):
        worker.run(os._exit, 1)
    assert worker.run(len, b"abc") == 3
