"""The commands of `jaxmark catalogue`, and the one that marks a copy for a recipient."""

import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from jaxmark.app.folders import mesh_files
from jaxmark.app.mark_files import mark_file
from jaxmark.app.options import FILE, JSON, KEY, QUIET, budget_options, read_key
from jaxmark.app.output import FileOutcome, answer, error_text, say
from jaxmark.app.progress import current
from jaxmark.catalogue import Catalogue, export_catalogue, import_catalogue
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash, replacing
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.record import RECORD_SUFFIX, Record, load_record

_PLAIN = re.compile(r"\w[\w.@+-]*")  # recipients whose names may be in file names
CATALOGUE = click.option("--catalogue", "catalogue_file", type=FILE, required=True, help="The catalogue's file.")


@click.group(name="catalogue")
def catalogue_group() -> None:
    """Know which of many originals a suspect is, and whose copy.

    A catalogue is one file with originals, records, recipients and verdicts. It holds no key.
    """


@catalogue_group.command(name="add")
@click.argument("files", type=FILE, nargs=-1, required=True)
@CATALOGUE
@click.option(
    "--records",
    is_flag=True,
    help=f"Add the records that lie in the folders of FILES, too (names end in {RECORD_SUFFIX}).",
)
@click.option("--copy", is_flag=True, help="Keep the files themselves in the catalogue.")
@QUIET
@JSON
def add_command(files: tuple[Path, ...], catalogue_file: Path, records: bool, copy: bool, as_json: bool) -> None:
    """Add originals: mesh FILES, or all of a folder; and records, by their files.

    A known file changes nothing. With --json there is a line for each file. A file that is refused stops none of the
    others; the exit status is then 2.
    """
    status = 0
    meshes = [file for file in files if not file.name.endswith(RECORD_SUFFIX)]
    given = [file for file in files if file.name.endswith(RECORD_SUFFIX)]
    if records:
        folders = dict.fromkeys(file if file.is_dir() else file.parent for file in files)
        given += [file for folder in folders for file in sorted(folder.glob("*" + RECORD_SUFFIX))]
    with Catalogue(catalogue_file) as catalogue:
        for file in _each_file(meshes):
            current().doing(f"adding {file}")
            try:
                added = catalogue.add(file, copy=copy)
            except (JaxmarkError, OSError) as error:
                status = 2
                _refused(as_json, file, error)
                continue
            said = f"{file}: {added.status} as {added.id}"
            said += f", {added.meshes} meshes" * (added.meshes > 1) + _left(added.skipped)
            answer(as_json, {"file": str(file), **added._asdict()}, said)
        for file in dict.fromkeys(given):
            try:
                kept = catalogue.add_record(load_record(file))
            except (JaxmarkError, OSError) as error:
                status = 2
                _refused(as_json, file, error)
                continue
            fresh = sum(one.status == "added" for one in kept)
            said = f"{len(kept)} records, {fresh} new" if len(kept) > 1 else f"record {kept[0].status}"
            answer(as_json, {"file": str(file), "records": len(kept), "new": fresh}, f"{file}: {said}")
    sys.exit(status)


def _each_file(files: Sequence[Path]) -> Iterator[Path]:
    for file in files:
        yield from mesh_files(file) if file.is_dir() else [file]


def _refused(as_json: bool, file: Path, error: Exception) -> None:
    said = error_text(error)
    if as_json:
        answer(True, {"file": str(file), "refused": said}, "")
    else:
        say(f"{file}: refused. {said}")


def _left(left: object) -> str:
    names = list(left) if isinstance(left, dict) else []
    return f"; without {', '.join(map(repr, names[:3]))}{', …' * (len(names) > 3)}" if names else ""


@catalogue_group.command(name="list")
@CATALOGUE
@JSON
def list_command(catalogue_file: Path, as_json: bool) -> None:
    """List the originals. With --json, one object a line."""
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        for entry in catalogue.originals():
            held = f"{entry.vertices} vertices, {entry.records} records, {entry.recipients} recipients"
            answer(as_json, entry._asdict(), f"{entry.id}  {entry.path}  {held}")


@catalogue_group.command(name="show")
@click.argument("original")
@CATALOGUE
@JSON
def show_command(original: str, catalogue_file: Path, as_json: bool) -> None:
    """Show what is known of ORIGINAL: its number, path, or the beginning of its hash."""
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        shown = catalogue.show(original)
    lines = [f"{shown['id']}  {shown['path']}", f"SHA-256 {shown['content']}, added {shown['added']}"]
    for shape in shown["shapes"]:
        named = f"mesh {shape['name']!r}: " if shape["name"] else ""
        lines.append(f"{named}{shape['vertices']} vertices, {shape['faces']} faces")
        lines += [
            f"  record {one['digest'][:16]} of a {one['content']}, key {one['key'][:16]}" for one in shape["records"]
        ]
        lines += [f"  copy for {one['recipient']}, key {one['key'][:16]}, {one['added']}" for one in shape["copies"]]
    answer(as_json, shown, "\n".join(lines))


@catalogue_group.command(name="remove")
@click.argument("original")
@CATALOGUE
@click.option(
    "--with-records", is_flag=True, help="Remove its records and recipients, too: its copies are traced no more."
)
@JSON
def remove_command(original: str, catalogue_file: Path, with_records: bool, as_json: bool) -> None:
    """Remove ORIGINAL from the catalogue; its file stays."""
    with _existing(catalogue_file) as catalogue:
        entry = catalogue.remove(original, records=with_records)
    answer(as_json, entry._asdict(), f"removed {entry.path}")


@catalogue_group.command(name="export")
@click.argument("file", type=FILE)
@CATALOGUE
@JSON
def export_command(file: Path, catalogue_file: Path, as_json: bool) -> None:
    """Write all that the catalogue holds to FILE, as JSON Lines."""
    if file.resolve() == catalogue_file.resolve():
        raise JaxmarkError(f"FILE and --catalogue are the same file, {file}; give another name.")
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        counted = export_catalogue(catalogue, file)
    answer(as_json, counted._asdict(), f"{_counts(counted)} → {file}")


@catalogue_group.command(name="import")
@click.argument("file", type=FILE)
@CATALOGUE
@JSON
def import_command(file: Path, catalogue_file: Path, as_json: bool) -> None:
    """Merge FILE, an export, into the catalogue, which is made if it does not exist; all of it or nothing."""
    if not file.is_file():
        raise JaxmarkError(f"{file} is no file that could be imported.")
    with Catalogue(catalogue_file) as catalogue:
        counted = import_catalogue(catalogue, file)
    answer(as_json, counted._asdict(), f"{_counts(counted)}, new in {catalogue_file}")


@catalogue_group.command(name="check")
@CATALOGUE
@JSON
def check_command(catalogue_file: Path, as_json: bool) -> None:
    """Check that the catalogue is whole, and the originals' files are there and unchanged; else exit status 1."""
    wrong = 0
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        if problems := catalogue.database.problems():
            raise JaxmarkError(f"{catalogue_file} is damaged: {problems[0]}; import an export into a new catalogue.")
        count = 0
        for entry, problem in catalogue.check():
            count += 1
            wrong += problem is not None
            if as_json:
                answer(True, {"id": entry.id, "path": entry.path, "problem": problem}, "")
            elif problem is not None:
                answer(False, {}, f"{entry.id}  {entry.path}: {problem}")
    if not as_json:
        answer(False, {}, f"{count - wrong} of {count} originals are there, unchanged")
    sys.exit(1 if wrong else 0)


def _existing(catalogue_file: Path) -> Catalogue:
    """A catalogue to change, which must exist: a mistyped name makes no new one."""
    Catalogue(catalogue_file, read_only=True).close()
    return Catalogue(catalogue_file)


def _counts(counted: tuple[int, ...]) -> str:
    originals, records, recipients, verdicts = counted
    return f"{originals} originals, {records} records, {recipients} recipients, {verdicts} verdicts"


@click.command(name="mark-for")
@click.argument("recipient")
@click.argument("original", type=FILE)
@CATALOGUE
@KEY
@click.option("--output", type=FILE, help="File for the copy.  [default: ORIGINAL's name, - and RECIPIENT, here]")
@budget_options(limits=False)
@QUIET
@JSON
def mark_for_command(
    recipient: str,
    original: Path,
    catalogue_file: Path,
    key_file: Path,
    output: Path | None,
    budget: Budget,
    as_json: bool,
) -> None:
    """Make the copy of ORIGINAL for RECIPIENT, and keep both in the catalogue, for `catalogue find` and `identify`.

    The recipient is in the catalogue before the copy is there. The same recipient always gets the same copy.
    """
    if output is None:
        if not _PLAIN.fullmatch(recipient):
            raise JaxmarkError(f"{recipient!r} cannot be part of a file's name; name the copy by --output.")
        output = Path(f"{original.stem}-{recipient}{original.suffix}")
    if os.path.realpath(output) in map(os.path.realpath, (original, key_file, catalogue_file)):
        raise JaxmarkError(f"{output} is the original, the key or the catalogue; give another name by --output.")
    key = read_key(key_file)
    current().doing(f"marking {original} for {recipient}")
    with Catalogue(catalogue_file) as catalogue:
        outcome = mark_copy(catalogue, recipient, original, output, key, budget)
    answer(as_json, {"recipient": recipient, **outcome.values}, outcome.text)


def mark_copy(
    catalogue: Catalogue, recipient: str, original: Path, copy: Path, key: Key, budget: Budget
) -> FileOutcome:
    """Make a recipient's copy, with its record beside it, and keep both in the catalogue.

    Args:
        catalogue: to which the original is added, if it is not in it.
        recipient: identifier.
        original: the mesh file.
        copy: file for the copy.
        key: the key to mark with.
        budget: how strong the mark may be, see `embed`.

    Raises:
        JaxmarkError: see `mark_file`.
    """
    catalogue.add(original)
    record = copy.with_name(copy.name + RECORD_SUFFIX)
    with replacing(copy) as draft, replacing(record) as record_draft:
        outcome = mark_file(original, draft, record_draft, key=key, recipient=recipient, budget=budget)
        # In the catalogue first: a copy that is not known is not traced, a recipient without a copy does no harm.
        catalogue.add_copy(Record.load(record_draft), recipient, file_hash(draft))
    places = {str(draft): str(copy), str(record_draft): str(record)}
    text = outcome.text
    for place, name in places.items():
        text = text.replace(place, name)
    return outcome._replace(values={**outcome.values, "record": str(record), "marked": str(copy)}, text=text)
