"""The progress of a command: one line on the terminal, which the next line replaces."""

import shutil
from collections.abc import Callable
from typing import TextIO

import click
import jax

from jaxmark.app.printable import printable

Doing = Callable[[str], None]  # progress callback, called with a description of each step that begins

# Events of JAX: a program is requested, and it was found in the cache, so that it need not be compiled.
_REQUESTED, _FOUND = "/jax/compilation_cache/compile_requests_use_cache", "/jax/compilation_cache/cache_hits"
_START_OF_LINE, _ERASE = "\r", "\x1b[K"


def quietly(what: str) -> None:
    """Ignore the description of a step: a progress callback that shows nothing."""


class Progress:
    """A line that shows the current step and how many programs were compiled in it; without a stream, nothing."""

    def __init__(self, stream: TextIO | None) -> None:
        """Begin with an empty line.

        Args:
            stream: a terminal; None to show nothing.
        """
        self._stream, self._step, self._compiled = stream, "", 0
        if stream is not None:
            jax.monitoring.register_event_listener(self._on_event)

    def doing(self, what: str) -> None:
        """Show the description of the step that begins now."""
        self._step, self._compiled = what, 0
        self._draw(what)

    def clear(self) -> None:
        """Remove the line, before other output or at the end of the command."""
        if self._step:
            self.doing("")

    def _on_event(self, event: str, **details: str | int) -> None:
        """Count the programs that JAX compiles."""
        if not self._step:
            return
        if event == _REQUESTED:
            self._compiled += 1
            self._draw(f"{self._step}: compiling program {self._compiled}")
        elif event == _FOUND:
            self._compiled -= 1
            self._draw(self._step)

    def _draw(self, line: str) -> None:
        if self._stream is not None:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write(f"{_START_OF_LINE}{printable(line)[:width]}{_ERASE}")
            self._stream.flush()


def current() -> Progress:
    """Return the progress of the running command; commands without the option --quiet show no progress."""
    context = click.get_current_context(silent=True)
    return (context and context.obj) or Progress(None)
