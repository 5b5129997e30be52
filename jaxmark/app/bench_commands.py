"""The commands `jaxmark bench`, `bench-equal` and `bench-corpus`, which compare watermarking methods."""

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
from jaxmark.files.programs import keep_programs, release_programs

_PATH = click.Path(path_type=Path)


class ManyValues(click.Command):
    """A command in which an option with several values takes all arguments up to the next option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Insert the option before each of its values, as click expects it."""
        repeatable = {name for param in self.params if getattr(param, "multiple", False) for name in param.opts}
        expanded, option = [], ""
        for number, arg in enumerate(args):
            if arg == "--":
                expanded += args[number:]
                break
            if arg.startswith("-") and arg != "-":
                option = arg if arg in repeatable else ""
                if option and (number + 1 == len(args) or args[number + 1].startswith("--")):
                    raise click.BadOptionUsage(option, f"Option {option!r} needs a value.", ctx)
                expanded += [] if option else [arg]
            else:
                expanded += [option, arg] if option else [arg]
        return super().parse_args(ctx, expanded)


MESHES = click.argument("meshes", nargs=-1, type=_PATH, metavar="MESH...", required=True)
METHODS_OPTION = click.option(
    "--methods",
    multiple=True,
    help=f"Methods to compare, by name: {', '.join(METHODS)}; or files as for --method.  [default: keyed]",
)
OWN = click.option(
    "--method", "own", multiple=True, type=_PATH, help="A Python or TOML file that declares a method of your own."
)
SAMPLES = click.option(
    "--samples",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of repetitions, each with its own key, message and seed of the attacks.",
)
WORKERS = click.option(
    "--workers", type=click.IntRange(1), default=os.cpu_count(), help="Number of processes.  [default: all cores]"
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
    help="Track: a set of attacks and distortion limits.  [default: smi2010]",
)
@click.option(
    "--attacks",
    multiple=True,
    help="Attacks of the track, by name or by the first words of their names.  [default: all]",
)
@click.option("--limits", multiple=True, help="Sets of distortion limits of the track, by name.  [default: all]")
@click.option("--payloads", multiple=True, type=click.IntRange(1), help="Payloads in bits.  [default: 64]")
@SAMPLES
@click.option(
    "--others", multiple=True, type=_PATH, help="Unmarked meshes that are read as further suspects for each MESH."
)
@click.option(
    "--keys",
    type=click.IntRange(1),
    default=KEYS,
    show_default=True,
    help="Number of keys with which each unmarked suspect is read.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0, 1, True, True),
    default=RATE,
    show_default=True,
    help="False-positive rate at which methods are compared.",
)
@WORKERS
@click.option(
    "--against",
    type=_PATH,
    help="Published readings.csv to compare this run with; differences are printed.",
)
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
    """Measure the robustness and the false-positive rates of watermarking methods.

    Every method marks every MESH as strongly as a set of distortion limits allows, and is read after every attack of
    the track. Its score is calibrated on suspects without a mark. Options with several values take all values up to the
    next option.

    Writes to the folder --output: results.json, with an entry for each method; results.md; readings.csv, the readings
    of marks, for publication; all_readings.csv, with the readings of unmarked suspects; and page.html, if the extra
    `plot` is installed. If a run was interrupted, the same command resumes it. A run with more meshes, methods or
    attacks reuses the readings that are in the folder.

    Exit status 0 if done, 2 if the input is refused. With --against, 1 if readings differ from the published ones, or
    if none of them is published.
    """
    start = time.time()
    published = None if against is None else load_published(against)
    results = run(
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
        workers=processes(workers, keep_programs),  # in separate processes, because a program of an attack may crash
        after=release_programs,
        log=current().doing,
    )
    repeated = hold_against(results, published) if published is not None else None
    hours, projected = results.seconds / 3600, results.projected(8, 5) / 3600
    about = (
        f"`{_command()}`, jaxmark {importlib.metadata.version('jaxmark')}, {_machine()}: {hours:.2g} hours of work for"
        f" one process. 8 meshes and 5 seeds would take {projected:.2g} hours."
    )
    _write(results, output, about)
    spent = {"command": _command(), "machine": _machine(), "seconds": round(time.time() - start, 1)}
    spent |= {"hours_of_one_process": hours, "hours_for_8_meshes_and_5_seeds": projected}
    write_atomically(output / "run.json", json.dumps(spent).encode())
    text = "\n\n".join(table.markdown() for table in tables(results)[:2])
    if repeated is not None:
        lines = [f"{repeated.shared} readings are published; {len(repeated.differences)} of them differ:"]
        text += "\n\n" + "\n".join([*lines, *repeated.differences])
    values = {} if repeated is None else {"repeated": repeated.shared, "differences": list(repeated.differences)}
    answer(as_json, {"output": str(output), "methods": entries(results), **values}, *text.split("\n"))
    if repeated is not None and (repeated.differences or not repeated.shared):
        sys.exit(1)


@click.command(name="bench-equal", cls=ManyValues)
@MESHES
@METHODS_OPTION
@OWN
@click.option("--payloads", multiple=True, type=click.IntRange(1), help="Payloads in bits.  [default: 16 64]")
@click.option(
    "--shares",
    multiple=True,
    type=float,
    help="Visibilities, as multiples of the limits of a hidden mark.  [default: 0.5 1 2]",
)
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
    """Compare the strongest noise that methods survive, at equal visibility of their marks.

    Every method marks every MESH so that the visibility of the marks is equal. Writes equal.md and equal.jsonl to the
    folder --output. If a run was interrupted, the same command resumes it from equal.jsonl.
    """
    table = equal_visibility(
        meshes,
        output,
        methods=[*methods, *own] or ["keyed"],
        payloads=payloads or (16, 64),
        shares=shares or SHARES,
        samples=samples,
        workers=processes(workers, keep_programs),
        log=current().doing,
    )
    text = table.markdown()
    write_atomically(output / "equal.md", (text + "\n").encode())
    values = {"heads": list(table.heads), "lines": [list(line) for line in table.lines]}
    answer(as_json, values, *text.split("\n"))


@click.command(name="bench-corpus")
@click.argument("folder", type=_PATH)
@click.option(
    "--most-vertices",
    type=click.IntRange(1),
    default=10**6,
    show_default=True,
    help="Meshes with more vertices are left out.",
)
@QUIET
@JSON
def bench_corpus_command(folder: Path, most_vertices: int, as_json: bool) -> None:
    """Write the meshes of the benchmark's corpus to FOLDER.

    Some meshes are computed from formulas; others are copied from installed packages. For each mesh, prints whether its
    hash is the expected one. Also writes hashes.json.
    """
    made = make_corpus(folder, most_vertices=most_vertices, log=partial(say, err=as_json))
    answer(as_json, {"output": str(folder), "hashes": made}, f"{len(made)} meshes → {folder}")


def _write(results: BenchResults, output: Path, about: str) -> None:
    """Write all files of a run, except those from which it resumes."""
    title = f"Robustness of mesh watermarks: {', '.join(dict.fromkeys(task.track for task, _ in results.tasks))}"
    save_entries(results, output / "results.json")
    results.save_csv(output / "all_readings.csv")
    save_readings(results, output / "readings.csv")
    write_atomically(output / "results.md", page.markdown(results, title, about).encode())
    if importlib.util.find_spec("pyarrow") and importlib.util.find_spec("pandas"):
        require("pandas", "study").read_csv(output / "all_readings.csv").to_parquet(output / "all_readings.parquet")
    try:
        page.save_page(results, output / "page.html", title, about.replace("`", ""))
    except JaxmarkError as error:
        say(f"No page is written: {error}")


def _command() -> str:
    return shlex.join(["jaxmark", *sys.argv[1:]])


def _machine() -> str:
    return f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}, Python {platform.python_version()}"
