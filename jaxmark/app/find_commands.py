"""Identify the original and the recipient of a suspect by a catalogue."""

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
from jaxmark.app.output import ESTIMATE, Status, answer, message_text, power, say
from jaxmark.app.progress import current
from jaxmark.catalogue import Catalogue, Finder, LeftOut, Match, Plan, Verdict, find_each, mesh_files_below
from jaxmark.errors import JaxmarkError, require
from jaxmark.evaluation.cells import Pool, processes
from jaxmark.files.programs import release_programs

_MOST_REFUSED = 5  # most refusals that a description lists
_DIGITS = 16  # digits of a record's digest that are printed


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
    help="Number of originals to read: so many of those most similar to the whole SUSPECT, and so many of those that"
    " SUSPECT is most likely a part of.",
)
@ALIGN
@click.option(
    "--alpha",
    type=float,
    default=1e-6,
    show_default=True,
    help="Largest false-positive probability at which an original is named.",
)
@click.option(
    "--list",
    "list_file",
    type=FILE,
    help="Text file with the path of one suspect per line, instead of SUSPECT; - is standard input.",
)
@click.option("--output", type=FILE, help="For many suspects: file to which a line of JSON is appended for each.")
@click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="For many suspects: number of parallel processes.",
)
@click.option(
    "--dask", "scheduler", help="For many suspects: address of a Dask scheduler (needs the extra `benchmarks`)."
)
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
    """Name the original that SUSPECT was made from, and the message or the recipient.

    SUSPECT may be a whole mesh or a part, in any pose and scale. Needs the catalogue and the keys. The bound on the
    false-positive probability counts all originals, keys, records and lists of recipients in the catalogue. The verdict
    is stored in the catalogue.

    If SUSPECT is a folder, all mesh files in it and its subfolders are suspects; --list reads the paths of suspects
    from a file. For each suspect, a line is printed, and a line of JSON is appended to --output. Suspects that are in
    --output already are skipped. Suspects that cannot be read are listed in a file next to it, whose name ends in
    .dead.jsonl.

    Exit status 0 if an original is named, 1 if none is named, 2 if SUSPECT is refused, 3 if there is only an estimate,
    which names no original. For many suspects, 0 if it is 0 for all; otherwise 2, 1 or 3, the first of these that any
    suspect has.
    """
    if (suspect is None) == (list_file is None):
        raise JaxmarkError("Give either SUSPECT or --list.")
    keys = [read_key(file) for file in key_files]
    if suspect is None or suspect.is_dir():
        options = {"alpha": alpha, "bits": bits, "depth": depth, "align": align}
        suspects = _listed(list_file) if list_file is not None else mesh_files_below(suspect or Path())
        files = tuple(file.resolve() for file in key_files)
        plan = Plan(catalogue_file.resolve(), files, tuple(options.items()), release_programs)
        _find_many(plan, suspects, output, _workers(workers, scheduler), as_json)
    if output is not None:
        raise JaxmarkError("--output is for many suspects, a folder or a --list; leave it out, or use --json.")
    current().doing(f"comparing {suspect} with the originals")
    with opened(catalogue_file) as catalogue:
        verdict = Finder(catalogue, keys, alpha=alpha, bits=bits, depth=depth, align=align).find(suspect)
        keep(catalogue, suspect, verdict)
    answer(as_json, verdict.as_json(), *describe(verdict, alpha))
    sys.exit(Status.of(bool(verdict.named), bool(verdict.estimates)))


def _find_many(
    plan: Plan, suspects: Iterable[Path], output: Path | None, workers: int | Pool, as_json: bool
) -> NoReturn:
    """Find the originals of many suspects, print a line for each, and exit with the worst status of all."""
    if output is None:
        raise JaxmarkError("Many suspects need a file for the verdicts; give --output.")
    if output.resolve() in (plan.catalogue, *plan.keys):
        raise JaxmarkError(f"{output} is the catalogue or a key; give another --output.")
    counts = dict.fromkeys(Status, 0)
    current().doing("comparing the first of many suspects with the originals")
    with closing(find_each(plan, suspects, output, workers, say)) as rows:
        for row in rows:
            status = Status.REFUSED if "refused" in row else Status.of(row["named"], row["estimate"])
            counts[status] += 1
            answer(as_json, row, f"{row['suspect']}: {_line(row)}")
            current().doing(f"{sum(counts.values())} suspects done")
    named, nothing, refused, estimates = counts.values()
    say(f"{named} named, {estimates} estimates, {nothing} without an original, {refused} refused → {output}")
    sys.exit(Status.worst(status for status, count in counts.items() if count))


def _line(row: Mapping[str, Any]) -> str:
    """Describe the verdict on one of many suspects."""
    if "refused" in row:
        return f"refused. {row['refused']}"
    if row["estimate"]:
        return f"{ESTIMATE}: no original is named: {'; '.join(row['caveats'])}"
    refused = sum(match["refused"] is not None for match in row["matches"])
    refusals = f"; {refused} readings refused" if refused else ""
    unsearched = sum(pieces["number"] for pieces in row.get("left_out", ()))
    refusals += f"; {unsearched} pieces not searched" if unsearched else ""
    if not row["named"]:
        return f"no original is named{refusals}"
    content = row["recipient"] or row["message"] or "a mark"
    return f"{row['original']}, {content}, probability at most {power(row['log10_p'])}{refusals}"


def _listed(file: Path) -> Iterator[Path]:
    """Read paths from a text file, one per line; relative paths start at the working directory."""
    try:
        with click.open_file(str(file), encoding="utf-8-sig") as lines:
            yield from (Path(line.rstrip("\n")) for line in lines if line.strip())
    except UnicodeDecodeError:
        raise JaxmarkError(f"{file} is not text in UTF-8; write one path per line.") from None


def _workers(workers: int, scheduler: str | None) -> int | Pool:
    """Make the pool of workers that the options ask for; the workers end with this command."""
    if scheduler is None:
        return processes(workers, begin_worker) if workers > 1 else 1
    distributed = require("distributed", "benchmarks")
    try:
        client = distributed.Client(scheduler, timeout="20s")
    except (OSError, ValueError) as error:
        raise JaxmarkError(f"The Dask scheduler at {scheduler} cannot be reached: {error}.") from None
    return lambda: client.get_executor(pure=False)


def identify_by_catalogue(
    suspect: Path, catalogue_file: Path, key_file: Path, align: Align, alpha: float, as_json: bool
) -> NoReturn:
    """Name the recipients whose copies a suspect was made from, for all originals; exit as `identify` does.

    Raises:
        JaxmarkError: see `Finder`.
    """
    current().doing(f"testing the copies of recipients in {suspect}")
    with opened(catalogue_file) as catalogue:
        finder = Finder(catalogue, [read_key(key_file)], alpha=alpha, align=align, only_recipients=True)
        verdict = finder.find(suspect)
        keep(catalogue, suspect, verdict)
    accused = list(dict.fromkeys(name for match in verdict.named for name in match.accused))
    estimates = list(dict.fromkeys(name for match in verdict.estimates for name in match.estimates))
    values = {"accused": accused, "estimates": estimates, **verdict.as_json()}
    answer(as_json, values, *describe(verdict, alpha))
    sys.exit(Status.of(bool(accused), bool(estimates)))


def opened(catalogue_file: Path) -> Catalogue:
    """Open an existing catalogue; for reading only if its file cannot be written."""
    catalogue = Catalogue(catalogue_file, read_only=True)
    if not (os.access(catalogue_file, os.W_OK) and os.access(catalogue_file.resolve().parent, os.W_OK)):
        return catalogue
    catalogue.close()
    return Catalogue(catalogue_file)


def keep(catalogue: Catalogue, suspect: Path, verdict: Verdict) -> None:
    """Store a verdict in the catalogue; if the catalogue is read-only, print a warning."""
    if catalogue.database.read_only:
        say("jaxmark: the catalogue cannot be written, so the verdict is not stored in it.")
    else:
        catalogue.record_verdict(verdict.suspect, os.path.realpath(suspect), verdict.as_json())


def describe(verdict: Verdict, alpha: float) -> tuple[str, ...]:
    """Describe a verdict in lines, with the refusals."""
    refused = dict.fromkeys(_refused(match) for match in verdict.matches if match.refused is not None)
    refusals = list(refused)[:_MOST_REFUSED]
    if len(refused) > _MOST_REFUSED:
        refusals.append(f"{len(refused) - _MOST_REFUSED} more could not be read, see --json")
    refusals += map(_left_out, verdict.left_out)
    if verdict.named or verdict.estimates:
        return (*map(_likely, verdict.named + verdict.estimates), *refusals)
    read = [match for match in verdict.matches if match.refused is None]
    if not verdict.readings:
        return ("no original is named: no mesh of the suspect is large enough to be searched", *refusals)
    text = f"no original is named: none of {verdict.readings} readings detects a mark (--alpha {alpha:g})"
    if read:
        bound = "about" if read[0].caveats else "at most"
        text += f"; most similar to {_place(read[0])}, probability {bound} {power(read[0].log10_p)}"
        text += "".join(f". {note}" for note in read[0].notes)
    return text + _caveats(read), *refusals


def _left_out(pieces: LeftOut) -> str:
    """Describe pieces of a suspect that were not searched."""
    more = ", …" if pieces.number > len(pieces.names) else ""
    return f"not searched: {pieces.number} pieces ({', '.join(map(repr, pieces.names))}{more}): {pieces.reason}"


def _refused(match: Match) -> str:
    record = f", record {match.record[:_DIGITS]}," if match.record else ""
    return f"{_place(match)}{record} could not be read: {match.refused}"


def _caveats(matches: Sequence[Match]) -> str:
    caveats = dict.fromkeys(caveat for match in matches for caveat in match.caveats)
    return f"; some readings are estimates, which name no original: {'; '.join(caveats)}" if caveats else ""


def _place(match: Match) -> str:
    return match.original + (f", mesh {match.mesh!r}" if match.mesh else "")


def _likely(match: Match) -> str:
    """Describe an original that is named, or the estimate of one."""
    if recipients := match.accused + match.estimates:
        content = f"copy for {', '.join(recipients)}"
    elif match.message:
        content = f"message {message_text(bytes.fromhex(match.message))}"
    else:
        content = "a mark"
    piece = f"{match.piece}: " if match.piece else ""
    part = "" if match.coverage >= 0.95 else f", {100 * match.coverage:.0f} % of it"
    result = f"{piece}{_place(match)}{part}: {content}; probability"
    if match.estimate:
        return f"{ESTIMATE}: {result} about {power(match.log10_p)}: {'; '.join(match.caveats)}"
    return (
        f"{result} at most {power(match.log10_p)} if keys, originals, records and the list of recipients were fixed"
        f" before the suspect existed, {power(match.log10_p_uncommitted)} even if keys, originals and records were"
        " chosen afterwards"
    )
