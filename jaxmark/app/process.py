"""How the process of a command ends by a signal."""

import signal
import sys
from types import FrameType
from typing import NoReturn

_ASK_AGAIN = 5  # seconds after which a process that was asked to end is asked again


def end_by_exception() -> None:
    """Let SIGTERM end this process by an exception, so that unfinished output files are removed."""
    signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """Raise SystemExit, and again after some seconds if the process is still running.

    Python discards exceptions in callbacks of its garbage collector, and JAX has such a callback.
    """
    if hasattr(signal, "alarm"):
        signal.signal(signal.SIGALRM, _end)
        signal.alarm(_ASK_AGAIN)
    sys.exit(128 + signal.SIGTERM)
