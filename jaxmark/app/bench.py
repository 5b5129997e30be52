"""The benchmark of the field as a command."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import shlex
import sys
import time
from pathlib import Path

import click

from jaxmark.app.answering import QUIET, answer, progress, say
from jaxmark.app.catalogue import JSON
from jaxmark.bench import page
from jaxmark.bench.benchmark import KEYS, run
from jaxmark.bench.calibration import RATE
from jaxmark.bench.leagues import LEAGUES
from jaxmark.bench.methods import METHODS
from jaxmark.bench.results import BenchResults
from jaxmark.bench.tables import tables
from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically

_PATH = click.Path(path_type=Path)


class ManyValues(click.Command):
    """A command whose options that may be repeated take all values up to the next option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat the option before each of its values, as click has it."""
        many = {name for one in self.params if getattr(one, "multiple", False) for name in one.opts}
        found, option = [], ""
        for number, arg in enumerate(args):
            if arg == "--":
                found += args[number:]
                break
            if arg.startswith("-") and arg != "-":
                option = arg if arg in many else ""
                found += [] if option else [arg]
            else:
                found += [option, arg] if option else [arg]
        return super().parse_args(ctx, found)


@click.command(name="bench", cls=ManyValues)
@click.argument("meshes", nargs=-1, type=_PATH, metavar="MESH...")
@click.option(
    "--methods", multiple=True, default=["keyed"], help=f"Names: {', '.join(METHODS)}; or files, as --method."
)
@click.option(
    "--method", "own", multiple=True, type=_PATH, help="A Python or TOML file that declares a method of your own."
)
@click.option("--league", "leagues", multiple=True, type=click.Choice(list(LEAGUES)), default=["smi2010"])
@click.option("--attacks", multiple=True, help="Attacks of the league, or the first words of some.  [default: all]")
@click.option("--limits", multiple=True, help="Sets of limits of the league.  [default: all]")
@click.option("--payloads", multiple=True, type=click.IntRange(1), default=[64], help="Bits of a message.")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="Keys, messages and attacks.")
@click.option(
    "--keys", type=click.IntRange(1), default=KEYS, show_default=True, help="Keys for each suspect without a mark."
)
@click.option(
    "--rate", type=click.FloatRange(0, 1, True, True), default=RATE, show_default=True, help="Of false positives."
)
@click.option("--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processes.  [default: all cores]")
@click.option("--output", type=_PATH, required=True, help="Folder for the results.")
@QUIET
@JSON
def bench_command(
    meshes: tuple[Path, ...],
    methods: tuple[str, ...],
    own: tuple[Path, ...],
    leagues: tuple[str, ...],
    attacks: tuple[str, ...],
    limits: tuple[str, ...],
    payloads: tuple[int, ...],
    seeds: int,
    keys: int,
    rate: float,
    workers: int,
    output: Path,
    as_json: bool,
) -> None:
    """Measure watermarking methods on meshes as papers do: what they survive, and how often they err.

    Every method marks every MESH as strongly as one set of limits allows, and is read after every attack of a league;
    its score is calibrated on suspects that have no mark. Options that may be repeated take all values up to the next
    option. OUTPUT gets results.json, with an entry for each method, results.md, readings.csv, and with the extra `plot`
    page.html; the same command goes on where it was ended, and a wider one takes over what both have.
    """
    start = time.time()
    output.mkdir(parents=True, exist_ok=True)
    found = run(
        meshes,
        output,
        methods=[*methods, *own],
        leagues=leagues,
        attacks=attacks,
        limits=limits,
        payloads=payloads,
        seeds=seeds,
        keys=keys,
        rate=rate,
        workers=workers,
        say=progress().doing,
    )
    about = f"`{_command()}`, {_machine()}, jaxmark {importlib.metadata.version('jaxmark')}."
    _write(found, output, about)
    write_atomically(
        output / "run.json",
        json.dumps({"command": _command(), "machine": _machine(), "seconds": round(time.time() - start, 1)}).encode(),
    )
    first, second, *_ = tables(found)
    answer(as_json, {"output": str(output), "methods": found.entries()}, f"{first.markdown()}\n\n{second.markdown()}")


def _write(found: BenchResults, output: Path, about: str) -> None:
    """All files but the cells."""
    title = "What watermarks of meshes survive"
    found.save(output / "results.json")
    found.save_csv(output / "readings.csv")
    write_atomically(output / "results.md", page.markdown(found, title, about).encode())
    if importlib.util.find_spec("pyarrow") and importlib.util.find_spec("pandas"):
        require("pandas", "study").read_csv(output / "readings.csv").to_parquet(output / "readings.parquet")
    try:
        page.save_page(found, output / "page.html", title, about)
    except JaxmarkError as error:
        say(f"No page: {error}")


def _command() -> str:
    return shlex.join(["jaxmark", *sys.argv[1:]])


def _machine() -> str:
    return f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}, Python {platform.python_version()}"
