"""What a command is doing, for people who wait: one line on a terminal, which the next one replaces."""

import shutil
from collections.abc import Callable
from typing import TextIO

import click
import jax

Doing = Callable[[str], None]  # is told what begins now

# JAX says so when a program is about to be compiled, and when it was found among the kept ones instead.
_COMPILING, _FOUND = "/jax/compilation_cache/compile_requests_use_cache", "/jax/compilation_cache/cache_hits"
_START_OF_LINE, _ERASE = "\r", "\x1b[K"


def quietly(what: str) -> None:
    """Say nothing."""


class Progress:
    """A line that says what is being done, and how many programs were compiled for it; nothing without a stream."""

    def __init__(self, stream: TextIO | None) -> None:
        """Begin without a line.

        Args:
            stream: a terminal; None to say nothing.
        """
        self._stream, self._what, self._compiled = stream, "", 0
        if stream is not None:
            jax.monitoring.register_event_listener(self._on_event)

    def doing(self, what: str) -> None:
        """Say what begins now."""
        self._what, self._compiled = what, 0
        self._draw(what)

    def clear(self) -> None:
        """Remove the line, before something else is printed or when the work ends."""
        if self._what:
            self.doing("")

    def _on_event(self, event: str, **details: str | int) -> None:
        """Hear from JAX."""
        if not self._what:
            return
        if event == _COMPILING:
            self._compiled += 1
            self._draw(f"{self._what}: compiling program {self._compiled}")
        elif event == _FOUND:
            self._compiled -= 1
            self._draw(self._what)

    def _draw(self, line: str) -> None:
        if self._stream is not None:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write(f"{_START_OF_LINE}{line[:width]}{_ERASE}")
            self._stream.flush()


def current() -> Progress:
    """The progress of the command that is running; one that says nothing for a command that takes no time."""
    context = click.get_current_context(silent=True)
    return (context and context.obj) or Progress(None)
