"""Options and arguments that several commands share."""

import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, get_args

import click

from jaxmark.alignment.result import Align
from jaxmark.app.output import say
from jaxmark.app.progress import Progress
from jaxmark.errors import JaxmarkError
from jaxmark.files.source import concerning
from jaxmark.files.typed import decode, normalise, normalise_names
from jaxmark.watermark.coding.keys import Key, load_key
from jaxmark.watermark.perception.budget import VISIBILITY, Budget
from jaxmark.watermark.schemes.registry import NAMES, split

FILE = click.Path(path_type=Path)
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON on standard output.")
KEY = click.option("--key", "key_file", type=FILE, required=True, help="Key file, from `jaxmark keygen`.")
KEYS = click.option(
    "--key", "key_files", type=FILE, multiple=True, required=True, help="Key file. Repeat the option for several keys."
)
MESHES = click.option(
    "--mesh",
    "meshes",
    multiple=True,
    help="Name of a mesh to use, in a file of several meshes. Repeat the option for several meshes.  [default: all]",
)
OVERWRITE = click.option(
    "--overwrite",
    is_flag=True,
    help="Replace output files that exist. A replaced record is kept next to the new one, as old-1-….",
)
WORKERS = click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="For a folder: number of parallel processes; each needs its own memory.",
)
ALPHA = click.option(
    "--alpha",
    type=float,
    default=1e-6,
    show_default=True,
    help="Largest false-positive probability that counts as proof.",
)
ALIGN = click.option(
    "--align",
    type=click.Choice(get_args(Align)),
    default="auto",
    show_default=True,
    help="How SUSPECT is registered. same: the vertices have the same order; similarity, affine: by the surface, up to"
    " such a map; auto: the first way that fits.",
)


def _begin_progress(context: click.Context, quiet: bool) -> None:
    """Show the progress of a command on standard error, if that is a terminal, until the command ends."""
    context.obj = Progress(None if quiet or not sys.stderr.isatty() else sys.stderr)
    context.call_on_close(context.obj.clear)


QUIET = click.option(
    "--quiet",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _, quiet: _begin_progress(context, quiet),
    help="Do not show progress. Progress is only shown if standard error is a terminal.",
)


class Schemes(click.ParamType):
    """The name of a scheme, or several names separated by commas: a non-blind scheme and blind ones."""

    name = "scheme"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Convert comma-separated names to a tuple."""
        names: tuple[str, ...] = value if isinstance(value, tuple) else tuple(value.split(","))
        if unknown := [name for name in names if name not in NAMES]:
            self.fail(f"{unknown[0]!r} is not one of {', '.join(map(repr, NAMES))}.", param, ctx)
        if len(names) > 1:
            split(names)  # raises an error if these schemes cannot be combined
        return names


class _Hexadecimal(click.ParamType):
    name = "hex"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> bytes:
        if isinstance(value, bytes):
            return value
        try:
            message = bytes.fromhex(value)
        except ValueError:
            message = b""
        if not message:
            self.fail(
                f"{value!r} is not a message: give an even number of hexadecimal digits, e.g. c0ffee42.", param, ctx
            )
        return message


class _Text(click.ParamType):
    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> bytes:
        if isinstance(value, bytes):
            return value
        value = normalise(value)
        if not value:
            self.fail("the message is empty; for a mark without a message use --presence.", param, ctx)
        return value.encode()


class _Limit(click.ParamType):
    name = "name=value"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        name, _, number = value.partition("=")
        try:
            return name, float(number)
        except ValueError:
            self.fail(f"{value!r} is not a limit: give a metric and a number, e.g. dame=0.008.", param, ctx)


def message_options(message: str, text: str, presence: str) -> Callable[[Callable], Callable]:
    """Make the options --message, --text and --presence.

    The command gets the message as `message`, which is bytes or None, and the flag as `presence`.

    Args:
        message: help for the message as hexadecimal digits.
        text: help for the message as text.
        presence: help for a mark without a message.
    """

    def decorate(command: Callable) -> Callable:
        @click.option("--message", "digits", type=_Hexadecimal(), help=message)
        @click.option("--text", type=_Text(), help=text)
        @click.option("--presence", is_flag=True, help=presence)
        @wraps(command)
        def wrapped(*args: Any, digits: bytes | None, text: bytes | None, **options: Any) -> Any:
            if digits is not None and text is not None:
                raise JaxmarkError("Give either --message or --text.")
            return command(*args, message=text if digits is None else digits, **options)

        return wrapped

    return decorate


def budget_options(*, limits: bool = True, noise: float | None = None, noise_help: str = "") -> Callable:
    """Make the options for a distortion budget; the command gets it as `budget`.

    Args:
        limits: whether there is the option --limit, for limits on metrics.
        noise: the default of --noise, the noise that the message must survive.
        noise_help: help for --noise; without it there is no such option.
    """

    def decorate(command: Callable) -> Callable:
        @wraps(command)
        def wrapped(
            *args: Any,
            rms: float | None,
            visibility: Any,
            limits: tuple[tuple[str, float], ...] = (),
            noise: float | None = None,
            **options: Any,
        ) -> Any:
            tightest: dict[str, float] = {}
            for metric, most in limits:
                tightest[metric] = min(most, tightest.get(metric, most))
            return command(*args, budget=Budget(rms, visibility, tightest or None, noise), **options)

        decorated = wrapped
        if noise_help:
            option = click.option("--noise", type=float, default=noise, show_default=noise is not None, help=noise_help)
            decorated = option(decorated)
        default = "without --budget and --limit" if limits else "without --budget"
        decorated = click.option(
            "--visibility",
            type=click.Choice(list(VISIBILITY)),
            help=f"How visible the mark may be.  [default, {default}: hidden]",
        )(decorated)
        if limits:
            decorated = click.option(
                "--limit",
                "limits",
                type=_Limit(),
                multiple=True,
                help="Upper limit on a metric of `jaxmark compare`, such as dame=0.008. Repeat the option for several.",
            )(decorated)
        return click.option(
            "--budget",
            "rms",
            type=float,
            help="RMS displacement of the vertices, relative to the diagonal of the bounding box.",
        )(decorated)

    return decorate


def read_recipients(path: Path) -> list[str]:
    """Read identifiers of recipients, one per line; empty lines are skipped.

    Raises:
        JaxmarkError: if the file is not text in UTF-8 or contains no identifier; see also `normalise_names`.
    """
    with concerning(path):
        lines = decode(path.read_bytes()).splitlines()
        if names := normalise_names(line for line in lines if normalise(line)):
            return names
    raise JaxmarkError(f"{path} contains no recipient; write one identifier per line.")


def read_key(path: Path) -> Key:
    """Load a key, and print a warning if other users may read its file.

    Raises:
        JaxmarkError: see `load_key`.
    """
    key = load_key(path)
    if os.name == "posix" and path.stat().st_mode & 0o077:
        say(f"jaxmark: other users may read the key file {path}; prevent this by: chmod 600 {path}")
    return key
