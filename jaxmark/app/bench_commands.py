"""The benchmark of the field as commands."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import shlex
import sys
import time
from functools import partial
from pathlib import Path

import click

from jaxmark.app.options import JSON, QUIET
from jaxmark.app.output import answer, say
from jaxmark.app.process import keep_programs, release_programs
from jaxmark.app.progress import current
from jaxmark.bench import page
from jaxmark.bench._equal_visibility import SHARES, equal_visibility
from jaxmark.bench.benchmark import KEYS, run
from jaxmark.bench.calibration import RATE
from jaxmark.bench.corpus import make_corpus
from jaxmark.bench.method import METHODS
from jaxmark.bench.readings import BenchResults, hold_against, load_published, save_readings
from jaxmark.bench.summary import entries, save_entries
from jaxmark.bench.tables import tables
from jaxmark.bench.tracks import TRACKS
from jaxmark.errors import JaxmarkError, require
from jaxmark.evaluation.cells import processes
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
                if option and (number + 1 == len(args) or args[number + 1].startswith("--")):
                    raise click.BadOptionUsage(option, f"Option {option!r} needs a value.", ctx)
                found += [] if option else [arg]
            else:
                found += [option, arg] if option else [arg]
        return super().parse_args(ctx, found)


MESHES = click.argument("meshes", nargs=-1, type=_PATH, metavar="MESH...", required=True)
METHODS_OPTION = click.option(
    "--methods", multiple=True, help=f"Names: {', '.join(METHODS)}; or files, as --method.  [default: keyed]"
)
OWN = click.option(
    "--method", "own", multiple=True, type=_PATH, help="A Python or TOML file that declares a method of your own."
)
SAMPLES = click.option(
    "--samples", type=click.IntRange(1), default=1, show_default=True, help="Number of keys, messages and attacks."
)
WORKERS = click.option(
    "--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processes.  [default: all cores]"
)
OUTPUT = click.option("--output", type=_PATH, required=True, help="Folder for the results.")


@click.command(name="bench", cls=ManyValues)
@MESHES
@METHODS_OPTION
@OWN
@click.option(
    "--track",
    "tracks",
    multiple=True,
    type=click.Choice(list(TRACKS)),
    help="Attacks and limits.  [default: smi2010]",
)
@click.option("--attacks", multiple=True, help="Attacks of the track, or the first words of some.  [default: all]")
@click.option("--limits", multiple=True, help="Sets of limits of the track.  [default: all]")
@click.option("--payloads", multiple=True, type=click.IntRange(1), help="Bits of a message.  [default: 64]")
@SAMPLES
@click.option("--others", multiple=True, type=_PATH, help="Further meshes, read unmarked in place of each MESH.")
@click.option(
    "--keys", type=click.IntRange(1), default=KEYS, show_default=True, help="Keys for each suspect without a mark."
)
@click.option(
    "--rate", type=click.FloatRange(0, 1, True, True), default=RATE, show_default=True, help="Of false positives."
)
@WORKERS
@click.option("--against", type=_PATH, help="Published readings, as readings.csv: say where this run disagrees.")
@OUTPUT
@QUIET
@JSON
def bench_command(
    meshes: tuple[Path, ...],
    methods: tuple[str, ...],
    own: tuple[Path, ...],
    tracks: tuple[str, ...],
    attacks: tuple[str, ...],
    limits: tuple[str, ...],
    payloads: tuple[int, ...],
    samples: int,
    others: tuple[Path, ...],
    keys: int,
    rate: float,
    workers: int,
    against: Path | None,
    output: Path,
    as_json: bool,
) -> None:
    """Measure watermarking methods on meshes as papers do: what they survive, and how often they err.

    Every method marks every MESH as strongly as one set of limits allows, and is read after every attack of a track;
    its score is calibrated on suspects that have no mark. Options that may be repeated take all values up to the next
    option. The folder gets results.json, with an entry for each method, results.md, readings.csv (of marks, to
    publish), all_readings.csv (of nulls, too), and with the extra `plot` page.html. The same command goes on where it
    was ended, and a wider one takes over what both have. With --against, the exit status is 1 where readings disagree
    or none is published.
    """
    start = time.time()
    published = None if against is None else load_published(against)
    found = run(
        meshes,
        output,
        methods=[*methods, *own] or ["keyed"],
        tracks=tracks or ("smi2010",),
        attacks=attacks,
        limits=limits,
        payloads=payloads or (64,),
        samples=samples,
        others=others,
        keys=keys,
        rate=rate,
        workers=processes(workers, keep_programs),  # in its own process a program that an attack calls may crash
        after=release_programs,
        say=current().doing,
    )
    repeated = hold_against(found, published) if published is not None else None
    hours, projected = found.seconds / 3600, found.projected(8, 5) / 3600
    about = (
        f"`{_command()}`, jaxmark {importlib.metadata.version('jaxmark')}, {_machine()}: {hours:.2g} hours of work for"
        f" one process. 8 meshes and 5 seeds would take {projected:.2g}."
    )
    _write(found, output, about)
    spent = {"command": _command(), "machine": _machine(), "seconds": round(time.time() - start, 1)}
    spent |= {"hours_of_one_process": hours, "hours_for_8_meshes_and_5_seeds": projected}
    write_atomically(output / "run.json", json.dumps(spent).encode())
    said = "\n\n".join(table.markdown() for table in tables(found)[:2])
    if repeated is not None:
        lines = [f"{repeated.shared} readings are published, {len(repeated.differences)} disagree:"]
        said += "\n\n" + "\n".join([*lines, *repeated.differences])
    values = {} if repeated is None else {"repeated": repeated.shared, "differences": list(repeated.differences)}
    answer(as_json, {"output": str(output), "methods": entries(found), **values}, said)
    if repeated is not None and (repeated.differences or not repeated.shared):
        sys.exit(1)


@click.command(name="bench-equal", cls=ManyValues)
@MESHES
@METHODS_OPTION
@OWN
@click.option("--payloads", multiple=True, type=click.IntRange(1), help="Bits of a message.  [default: 16 64]")
@click.option("--shares", multiple=True, type=float, help="Of the limits of what is hidden.  [default: 0.5 1 2]")
@SAMPLES
@WORKERS
@OUTPUT
@QUIET
@JSON
def bench_equal_command(
    meshes: tuple[Path, ...],
    methods: tuple[str, ...],
    own: tuple[Path, ...],
    payloads: tuple[int, ...],
    shares: tuple[float, ...],
    samples: int,
    workers: int,
    output: Path,
    as_json: bool,
) -> None:
    """Bring methods to the same visibility on each MESH, and find the strongest noise that each survives.

    The folder gets equal.md, and equal.jsonl, from which the same command goes on where it was ended.
    """
    table = equal_visibility(
        meshes,
        output,
        methods=[*methods, *own] or ["keyed"],
        payloads=payloads or (16, 64),
        shares=shares or SHARES,
        samples=samples,
        workers=processes(workers, keep_programs),
        say=current().doing,
    )
    write_atomically(output / "equal.md", (table.markdown() + "\n").encode())
    answer(as_json, {"heads": list(table.heads), "lines": [list(line) for line in table.lines]}, table.markdown())


@click.command(name="bench-corpus")
@click.argument("folder", type=_PATH)
@click.option(
    "--most-vertices", type=click.IntRange(1), default=10**6, show_default=True, help="Larger meshes are left out."
)
@QUIET
@JSON
def bench_corpus_command(folder: Path, most_vertices: int, as_json: bool) -> None:
    """Write the meshes of the benchmark's corpus to FOLDER, by formula and of packages that are installed.

    A line for each says whether its hash is the one that is known; hashes.json holds them.
    """
    made = make_corpus(folder, most_vertices=most_vertices, say=partial(say, err=as_json))
    answer(as_json, {"output": str(folder), "hashes": made}, f"{len(made)} meshes → {folder}")


def _write(found: BenchResults, output: Path, about: str) -> None:
    """All files but the cells."""
    title = f"What watermarks of meshes survive: {', '.join(dict.fromkeys(task.track for task, _ in found.tasks))}"
    save_entries(found, output / "results.json")
    found.save_csv(output / "all_readings.csv")
    save_readings(found, output / "readings.csv")
    write_atomically(output / "results.md", page.markdown(found, title, about).encode())
    if importlib.util.find_spec("pyarrow") and importlib.util.find_spec("pandas"):
        require("pandas", "study").read_csv(output / "all_readings.csv").to_parquet(output / "all_readings.parquet")
    try:
        page.save_page(found, output / "page.html", title, about.replace("`", ""))
    except JaxmarkError as error:
        say(f"No page: {error}")


def _command() -> str:
    return shlex.join(["jaxmark", *sys.argv[1:]])


def _machine() -> str:
    return f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}, Python {platform.python_version()}"
