"""Find which original a suspect is, and whose copy, by a catalogue."""

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NoReturn

import click

from jaxmark.alignment.result import Align
from jaxmark.app.catalogue_commands import CATALOGUE, catalogue_group
from jaxmark.app.folders import begin_worker
from jaxmark.app.options import ALIGN, FILE, JSON, KEYS, QUIET, read_key
from jaxmark.app.output import answer, message_text, power, say
from jaxmark.app.process import release_programs
from jaxmark.app.progress import current
from jaxmark.catalogue import Catalogue, Finder, Match, Plan, Verdict, find_each, mesh_files_below
from jaxmark.errors import JaxmarkError, require
from jaxmark.evaluation.cells import Pool, processes


@catalogue_group.command(name="find")
@click.argument("suspect", type=FILE, required=False)
@CATALOGUE
@KEYS
@click.option("--bits", type=int, help="Payload of messages without a record.  [default: 64]")
@click.option(
    "--depth",
    type=click.IntRange(1),
    default=3,
    show_default=True,
    help="Originals that are aligned and read, of those that look most like SUSPECT as a whole, and as a part.",
)
@ALIGN
@click.option("--alpha", type=float, default=1e-6, show_default=True, help="Largest probability that names anybody.")
@click.option("--list", "list_file", type=FILE, help="Instead of SUSPECT: file with a path a line, or -.")
@click.option("--output", type=FILE, help="For many suspects: file that grows by a line of JSON for each.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="For many suspects: processes.")
@click.option("--dask", "scheduler", help="For many suspects: address of a Dask scheduler (extra `benchmarks`).")
@QUIET
@JSON
def find_command(
    suspect: Path | None,
    catalogue_file: Path,
    key_files: tuple[Path, ...],
    bits: int | None,
    depth: int,
    align: Align,
    alpha: float,
    list_file: Path | None,
    output: Path | None,
    workers: int,
    scheduler: str | None,
    as_json: bool,
) -> None:
    """Find which original SUSPECT is: whole or a part of it, in any pose and scale; and the message or recipient.

    Exit status 0 if an original is named, 1 if SUSPECT is nobody's, 2 if it is refused. The probability pays for every
    original, key, record and list of recipients that could have been named. The verdict is kept in the catalogue.

    For a folder, with all below it, or a --list, each suspect gets a line; the exit status is the worst of all. What is
    in --output is not done again; suspects that cannot be read are in a file beside it, .dead.jsonl.
    """
    if (suspect is None) == (list_file is None):
        raise JaxmarkError("Give SUSPECT or --list, one of them.")
    keys = [read_key(file) for file in key_files]
    if suspect is None or suspect.is_dir():
        options = {"alpha": alpha, "bits": bits, "depth": depth, "align": align}
        suspects = _listed(list_file) if list_file is not None else mesh_files_below(suspect or Path())
        files = tuple(file.resolve() for file in key_files)
        plan = Plan(catalogue_file.resolve(), files, tuple(options.items()), release_programs)
        _find_many(plan, suspects, output, _workers(workers, scheduler), as_json)
    current().doing(f"looking for {suspect} among the originals")
    with opened(catalogue_file) as catalogue:
        verdict = Finder(catalogue, keys, alpha=alpha, bits=bits, depth=depth, align=align).find(suspect)
        keep(catalogue, suspect, verdict)
    answer(as_json, verdict.as_json(), describe(verdict, alpha))
    sys.exit(0 if verdict.named else 1)


def _find_many(
    plan: Plan, suspects: Iterable[Path], output: Path | None, workers: int | Pool, as_json: bool
) -> NoReturn:
    """Find the originals of many suspects, with a line for each, and exit with the worst status."""
    if output is None:
        raise JaxmarkError("Many suspects need a file for what is found: give --output.")
    if output.resolve() in (plan.catalogue, *plan.keys):
        raise JaxmarkError(f"{output} is the catalogue or a key; give another --output.")
    counted = {0: 0, 1: 0, 2: 0}
    current().doing("looking for the first of many suspects")
    with closing(find_each(plan, suspects, output, workers, say)) as rows:
        for row in rows:
            status = 2 if "refused" in row else 0 if row["named"] else 1
            counted[status] += 1
            answer(as_json, row, f"{row['suspect']}: {_line(row)}")
            current().doing(f"{sum(counted.values())} suspects done")
    say(f"{counted[0]} named, {counted[1]} nobody's, {counted[2]} refused → {output}")
    sys.exit(max((status for status, count in counted.items() if count), default=0))


def _line(row: Mapping[str, Any]) -> str:
    """A verdict of one of many suspects, in words."""
    if "refused" in row:
        return f"refused. {row['refused']}"
    if not row["named"]:
        return "nobody's"
    what = row["recipient"] or row["message"] or "a mark"
    return f"{row['original']}, {what}, probability at most {power(row['log10_p'])}"


def _listed(file: Path) -> Iterator[Path]:
    """The paths in a text file, one a line; those that are relative are so to where the command runs."""
    try:
        with click.open_file(str(file), encoding="utf-8") as lines:
            yield from (Path(line.rstrip("\n")) for line in lines if line.strip())
    except UnicodeDecodeError:
        raise JaxmarkError(f"{file} is no text in UTF-8; give one path a line.") from None


def _workers(workers: int, scheduler: str | None) -> int | Pool:
    """The workers that were asked for, which end with this command."""
    if scheduler is None:
        return processes(workers, begin_worker) if workers > 1 else 1
    distributed = require("distributed", "benchmarks")
    try:
        client = distributed.Client(scheduler, timeout="20s")
    except (OSError, ValueError) as error:
        raise JaxmarkError(f"There is no Dask scheduler at {scheduler}: {error}.") from None
    return lambda: client.get_executor(pure=False)


def identify_by_catalogue(
    suspect: Path, catalogue_file: Path, key_file: Path, align: Align, alpha: float, as_json: bool
) -> NoReturn:
    """Name the recipients whose copies a suspect was made from, of whatever original; exit as `identify` does.

    Raises:
        JaxmarkError: see `Finder`.
    """
    current().doing(f"looking for the copies of recipients in {suspect}")
    with opened(catalogue_file) as catalogue:
        finder = Finder(catalogue, [read_key(key_file)], alpha=alpha, align=align, only_recipients=True)
        verdict = finder.find(suspect)
        keep(catalogue, suspect, verdict)
    accused = {name: match.original for match in verdict.named for name in match.accused}
    answer(as_json, {"accused": list(accused), **verdict.as_json()}, describe(verdict, alpha))
    sys.exit(0 if accused else 1)


def opened(catalogue_file: Path) -> Catalogue:
    """Open a catalogue that exists; for reading only where it cannot be written."""
    catalogue = Catalogue(catalogue_file, read_only=True)
    if not (os.access(catalogue_file, os.W_OK) and os.access(catalogue_file.resolve().parent, os.W_OK)):
        return catalogue
    catalogue.close()
    return Catalogue(catalogue_file)


def keep(catalogue: Catalogue, suspect: Path, verdict: Verdict) -> None:
    """Keep a verdict in the catalogue, unless it is only read."""
    if catalogue.database.read_only:
        say("jaxmark: the catalogue cannot be written; the verdict is not kept in it.")
    else:
        catalogue.record_verdict(verdict.suspect, os.path.realpath(suspect), verdict.as_json())


def describe(verdict: Verdict, alpha: float) -> str:
    """A verdict in words."""
    if verdict.named:
        return "\n".join(_named(match) for match in verdict.named)
    seen = [match for match in verdict.matches if match.refused is None]
    said = f"nobody's: none of {verdict.readings} readings is named (--alpha {alpha:g})"
    if seen:
        said += f"; most like {_place(seen[0])}, probability at most {power(seen[0].log10_p)}"
        said += "".join(f". {note}" for note in seen[0].notes)
    elif verdict.matches:
        said += f"; {_place(verdict.matches[0])} could not be read: {verdict.matches[0].refused}"
    return said + _caveats(seen)


def _caveats(matches: Sequence[Match]) -> str:
    caveats = dict.fromkeys(caveat for match in matches for caveat in match.caveats)
    return f"; estimates, which name nobody: {'; '.join(caveats)}" if caveats else ""


def _place(match: Match) -> str:
    return match.original + (f", mesh {match.mesh!r}" if match.mesh else "")


def _named(match: Match) -> str:
    if match.accused:
        what = f"copy for {', '.join(match.accused)}"
    elif match.message:
        what = f"message {message_text(bytes.fromhex(match.message))}"
    else:
        what = "a mark"
    piece = f"{match.piece}: " if match.piece else ""
    part = "" if match.coverage >= 0.95 else f", {100 * match.coverage:.0f} % of it"
    return (
        f"{piece}{_place(match)}{part}: {what}; probability at most {power(match.log10_p)} if keys, originals and"
        f" records were fixed before the suspect existed, {power(match.log10_p_uncommitted)} if nothing dates them"
    )
