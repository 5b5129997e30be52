"""How a command ends when it is asked to by a signal."""

import signal
import sys
from types import FrameType
from typing import NoReturn

_ASK_AGAIN = 5  # seconds until a process that was asked to end is asked again


def end_by_exception() -> None:
    """Let SIGTERM end this process as by an exception, after which no draft is left."""
    signal.signal(signal.SIGTERM, _end)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """End as by an exception.

    Python drops an exception in callbacks of its garbage collector, as JAX has one: the alarm asks again.
    """
    if hasattr(signal, "alarm"):
        signal.signal(signal.SIGALRM, _end)
        signal.alarm(_ASK_AGAIN)
    sys.exit(128 + signal.SIGTERM)
