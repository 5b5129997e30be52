"""What commands print, and the keys that they read."""

import json
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from jaxmark.app.progress import Progress
from jaxmark.watermark.coding.keys import Key, load_key


def _begin_progress(context: click.Context, quiet: bool) -> None:
    """Let a command tell people at a terminal what it is doing, until it ends."""
    context.obj = Progress(None if quiet or not sys.stderr.isatty() else sys.stderr)
    context.call_on_close(context.obj.clear)


QUIET = click.option(
    "--quiet",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _, quiet: _begin_progress(context, quiet),
    help="Say nothing of what is being done; nothing is said anyway where standard error is no terminal.",
)


JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON on standard output.")


def progress() -> Progress:
    """The progress of the command that is running; one that says nothing for a command that takes no time."""
    context = click.get_current_context(silent=True)
    return (context and context.obj) or Progress(None)


def say(line: str, err: bool = True) -> None:
    """Say something beside the answer, mostly on standard error."""
    progress().clear()
    click.echo(line, err=err)


def read_key(path: Path) -> Key:
    """Load a key, and say so if others may read it.

    Raises:
        JaxmarkError: see `load_key`.
    """
    key = load_key(path)
    if os.name == "posix" and path.stat().st_mode & 0o077:
        say(f"jaxmark: the key file {path} may be read by others; chmod 600 {path} keeps it yours.")
    return key


def answer(as_json: bool, values: Mapping[str, Any], text: str) -> None:
    """Print an answer: its values as one line of JSON, or its text."""
    progress().clear()
    try:
        click.echo(json.dumps(_finite(values), allow_nan=False) if as_json else text)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone. The work is done, and the exit status still tells its outcome.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _finite(value: Any) -> Any:
    """Replace numbers that JSON does not have by None."""
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
