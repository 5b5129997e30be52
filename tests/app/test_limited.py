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


_HELD: list[bytes] = []


def _hold(size: int) -> int:
    """Take memory and keep it, in a worker; return how much it holds."""
    _HELD.append(bytes(size))
    return sum(map(len, _HELD))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory so")
def test_memory_of_earlier_calls_is_not_charged(worker: Worker):
    worker.end()
    assert worker.run(_hold, 200 * 2**20) == 200 * 2**20
    assert worker.run(_hold, 150 * 2**20) == 150 * 2**20, "a fresh process answers"
    with pytest.raises(JaxmarkError, match="more than 300 megabytes of memory"):
        worker.run(_hold, 400 * 2**20)


def test_a_repeated_call_has_the_time_that_is_left(monkeypatch: pytest.MonkeyPatch):
    """The processes are replaced by pipes: the used one dies late, and the fresh one does not answer."""
    running, waits = Worker(0.3, 300), list[float]()

    class Pipe:
        def __init__(self, dead: bool) -> None:
            self.dead = dead

        def send(self, call: object) -> None:
            pass

        def poll(self, seconds: float) -> bool:
            waits.append(seconds)
            time.sleep(0.2 if self.dead else 0)
            return self.dead

        def recv(self) -> None:
            raise EOFError

    def begin() -> None:
        running._connection, running._used = Pipe(dead=False), False  # type: ignore[assignment]

    monkeypatch.setattr(running, "begin", begin)
    monkeypatch.setattr(running, "end", lambda: None)
    begin()
    running._connection, running._used = Pipe(dead=True), True  # type: ignore[assignment]
    monkeypatch.setattr(running, "_process", object())
    with pytest.raises(JaxmarkError, match=r"more than 0\.3 seconds"):
        running.run(len, b"abc")
    assert waits[0] == pytest.approx(0.3, abs=0.05)
    assert waits[1] < 0.11


def test_a_killed_process_is_replaced(worker: Worker):
    with pytest.raises(JaxmarkError, match="was not read"):
        worker.run(os._exit, 1)
    assert worker.run(len, b"abc") == 3
