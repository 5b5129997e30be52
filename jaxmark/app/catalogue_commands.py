"""The commands of `jaxmark catalogue`, and `jaxmark mark-for`, which marks a copy for a recipient."""

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import click

from jaxmark.app.folders import mesh_files
from jaxmark.app.mark_files import mark_file
from jaxmark.app.options import FILE, JSON, KEY, OVERWRITE, QUIET, budget_options, read_key
from jaxmark.app.output import FileOutcome, answer, check_distinct, error_text, say
from jaxmark.app.progress import current
from jaxmark.catalogue import Catalogue, export_catalogue, import_catalogue
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash, replacing
from jaxmark.files.pair import refuse_existing, writing_pair
from jaxmark.files.typed import normalise
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.record import RECORD_SUFFIX, Record, load_record

_PLAIN = re.compile(r"\w[\w.@+-]*")  # names of recipients that may become part of a file name
CATALOGUE = click.option("--catalogue", "catalogue_file", type=FILE, required=True, help="File of the catalogue.")


@click.group(name="catalogue")
def catalogue_group() -> None:
    """Identify the original and the recipient of a suspect, among many originals.

    A catalogue is one file with originals, records, recipients and verdicts. It contains no key.
    """


@catalogue_group.command(name="add")
@click.argument("files", type=FILE, nargs=-1, required=True)
@CATALOGUE
@click.option(
    "--records",
    is_flag=True,
    help=f"Also add all records in the folders of FILES; their names end in {RECORD_SUFFIX}.",
)
@click.option("--copy", is_flag=True, help="Store copies of the mesh files in the catalogue.")
@QUIET
@JSON
def add_command(files: tuple[Path, ...], catalogue_file: Path, records: bool, copy: bool, as_json: bool) -> None:
    """Add originals and records to a catalogue.

    FILES are mesh files, folders of mesh files, and files of records. If the catalogue does not exist, it is created. A
    file that is in the catalogue already changes nothing. Prints one line per file. A refused file does not stop the
    others.

    Exit status 0 if all files are added, 2 if a file is refused.
    """
    status = 0
    meshes = [file for file in files if not file.name.endswith(RECORD_SUFFIX)]
    record_files = [file for file in files if file.name.endswith(RECORD_SUFFIX)]
    if records:
        folders = dict.fromkeys(file if file.is_dir() else file.parent for file in files)
        record_files += [file for folder in folders for file in sorted(folder.glob("*" + RECORD_SUFFIX))]
    with Catalogue(catalogue_file) as catalogue:
        for file in _each_file(meshes):
            current().doing(f"adding {file}")
            try:
                if file.is_dir():
                    mesh_files(file)  # raises an error: folders come here only if they have no mesh file
                added = catalogue.add(file, copy=copy)
            except (JaxmarkError, OSError) as error:
                status = 2
                _refused(as_json, file, error)
                continue
            text = f"{file}: {added.status} as {added.id}"
            text += f", {added.meshes} meshes" * (added.meshes > 1) + _skipped_text(added.skipped)
            answer(as_json, {"file": str(file), **added._asdict()}, text)
        for file in dict.fromkeys(record_files):
            try:
                entries = catalogue.add_record(load_record(file))
            except (JaxmarkError, OSError) as error:
                status = 2
                _refused(as_json, file, error)
                continue
            new = sum(entry.status == "added" for entry in entries)
            text = f"{len(entries)} records, {new} new" if len(entries) > 1 else f"record {entries[0].status}"
            answer(as_json, {"file": str(file), "records": len(entries), "new": new}, f"{file}: {text}")
    sys.exit(status)


def _each_file(files: Sequence[Path]) -> Iterator[Path]:
    """Yield files and the files in folders; a folder without any is yielded itself, to be refused."""
    for file in files:
        try:
            yield from mesh_files(file) if file.is_dir() else [file]
        except JaxmarkError:
            yield file


def _refused(as_json: bool, file: Path, error: Exception) -> None:
    text = error_text(error)
    if as_json:
        answer(True, {"file": str(file), "refused": text})
    else:
        say(f"{file}: refused. {text}")


def _skipped_text(skipped: object) -> str:
    names = list(skipped) if isinstance(skipped, dict) else []
    return f"; without {', '.join(map(repr, names[:3]))}{', …' * (len(names) > 3)}" if names else ""


@catalogue_group.command(name="list")
@CATALOGUE
@JSON
def list_command(catalogue_file: Path, as_json: bool) -> None:
    """List the originals in a catalogue, one per line."""
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        for entry in catalogue.originals():
            counts = _counts(vertex=entry.vertices, record=entry.records, recipient=entry.recipients)
            answer(as_json, entry._asdict(), f"{entry.id}  {entry.path}  {counts}")


@catalogue_group.command(name="show")
@click.argument("original")
@CATALOGUE
@JSON
def show_command(original: str, catalogue_file: Path, as_json: bool) -> None:
    """Show the meshes, records and recipients of ORIGINAL.

    ORIGINAL is given by its number, its path, or the beginning of its hash.
    """
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        shown = catalogue.show(original)
    lines = [f"{shown['id']}  {shown['path']}", f"SHA-256 {shown['content']}, added {shown['added']}"]
    for shape in shown["shapes"]:
        named = f"mesh {shape['name']!r}: " if shape["name"] else ""
        lines.append(f"{named}{shape['vertices']} vertices, {shape['faces']} faces")
        lines += [
            f"  record {record['digest'][:16]} of a {record['content']}, key {record['key'][:16]}"
            for record in shape["records"]
        ]
        lines += [
            f"  copy for {copy['recipient']}, key {copy['key'][:16]}, {copy['added']}" for copy in shape["copies"]
        ]
    answer(as_json, shown, *lines)


@catalogue_group.command(name="remove")
@click.argument("original")
@CATALOGUE
@click.option(
    "--with-records", is_flag=True, help="Also remove its records and recipients; its copies can then not be traced."
)
@JSON
def remove_command(original: str, catalogue_file: Path, with_records: bool, as_json: bool) -> None:
    """Remove ORIGINAL from the catalogue; its file is not deleted.

    ORIGINAL is given by its number, its path, or the beginning of its hash.
    """
    with _existing(catalogue_file) as catalogue:
        entry = catalogue.remove(original, records=with_records)
    answer(as_json, entry._asdict(), f"removed {entry.path}")


@catalogue_group.command(name="export")
@click.argument("file", type=FILE)
@CATALOGUE
@OVERWRITE
@JSON
def export_command(file: Path, catalogue_file: Path, overwrite: bool, as_json: bool) -> None:
    """Write the whole content of the catalogue to FILE, as JSON Lines.

    A FILE that exists may be the only backup of a catalogue, and is refused without --overwrite.
    """
    if file.resolve() == catalogue_file.resolve():
        raise JaxmarkError(f"FILE and --catalogue are the same file, {file}; give another name.")
    refuse_existing(file, overwrite=overwrite)
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        counts = export_catalogue(catalogue, file)
    answer(as_json, counts._asdict(), f"{_counts_text(counts)} → {file}")


@catalogue_group.command(name="import")
@click.argument("file", type=FILE)
@CATALOGUE
@JSON
def import_command(file: Path, catalogue_file: Path, as_json: bool) -> None:
    """Merge FILE, which `jaxmark catalogue export` wrote, into the catalogue.

    If the catalogue does not exist, it is created. If FILE is refused, nothing of it is imported.
    """
    if not file.is_file():
        raise JaxmarkError(f"{file} is not a file; give one that `jaxmark catalogue export` wrote.")
    # A new catalogue gets its name when the import has succeeded.
    is_new = not catalogue_file.exists()
    with replacing(catalogue_file) if is_new else nullcontext(catalogue_file) as target:
        with Catalogue(target) as catalogue:
            counts = import_catalogue(catalogue, file)
        if is_new and catalogue_file.exists():
            raise JaxmarkError(f"Another process has made {catalogue_file} meanwhile; import again.")
    answer(as_json, counts._asdict(), f"{_counts_text(counts)}, new in {catalogue_file}")


@catalogue_group.command(name="check")
@CATALOGUE
@JSON
def check_command(catalogue_file: Path, as_json: bool) -> None:
    """Check that the catalogue is undamaged, and that the files of all originals exist and are unchanged.

    Exit status 0 if so, 1 if a file is missing or changed, 2 if the catalogue is damaged.
    """
    wrong = 0
    with Catalogue(catalogue_file, read_only=True) as catalogue:
        if problems := catalogue.database.problems():
            raise JaxmarkError(f"{catalogue_file} is damaged: {problems[0]}; import an export into a new catalogue.")
        count = 0
        for entry, problem in catalogue.check():
            count += 1
            wrong += problem is not None
            if as_json:
                answer(True, {"id": entry.id, "path": entry.path, "problem": problem})
            elif problem is not None:
                answer(False, {}, f"{entry.id}  {entry.path}: {problem}")
    if not as_json:
        answer(False, {}, f"{count - wrong} of {count} originals exist and are unchanged")
    sys.exit(1 if wrong else 0)


def _existing(catalogue_file: Path) -> Catalogue:
    """Open an existing catalogue for writing; a mistyped name does not create a new one."""
    Catalogue(catalogue_file, read_only=True).close()
    return Catalogue(catalogue_file)


def _counts_text(counts: tuple[int, ...]) -> str:
    return _counts(**dict(zip(("original", "record", "recipient", "verdict"), counts, strict=True)))


def _counts(**counts: int) -> str:
    """List numbers of things by their names in the singular."""
    plurals = {"vertex": "vertices"}
    return ", ".join(
        f"{count} {name if count == 1 else plurals.get(name, name + 's')}" for name, count in counts.items()
    )


@click.command(name="mark-for")
@click.argument("recipient")
@click.argument("original", type=FILE)
@CATALOGUE
@KEY
@click.option(
    "--output",
    type=FILE,
    help="File for the copy.  [default: in the working directory, named after ORIGINAL and RECIPIENT: model-alice.ply]",
)
@budget_options(limits=False)
@OVERWRITE
@QUIET
@JSON
def mark_for_command(
    recipient: str,
    original: Path,
    catalogue_file: Path,
    key_file: Path,
    output: Path | None,
    budget: Budget,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make the copy of ORIGINAL for RECIPIENT, and store both in the catalogue.

    Needs the key. Writes the copy and its record. `jaxmark catalogue find` and `jaxmark identify` trace the copy by the
    catalogue. The recipient is stored before the copy is written. The same recipient always gets the same copy.
    Files that exist are refused without --overwrite.
    """
    recipient = normalise(recipient)
    if output is None:
        if not _PLAIN.fullmatch(recipient):
            raise JaxmarkError(f"{recipient!r} cannot be part of a file's name; name the copy by --output.")
        output = Path(f"{original.stem}-{recipient}{original.suffix}")
    record = _record_of(output)
    check_distinct(original=original, key=key_file, catalogue=catalogue_file, output=output, record=record)
    key = read_key(key_file)
    current().doing(f"marking {original} for {recipient}")
    with Catalogue(catalogue_file) as catalogue:
        outcome = mark_copy(catalogue, recipient, original, output, key, budget, overwrite=overwrite)
    answer(as_json, {"recipient": recipient, **outcome.values}, *outcome.lines)


def _record_of(copy: Path) -> Path:
    return copy.with_name(copy.name + RECORD_SUFFIX)


def mark_copy(
    catalogue: Catalogue,
    recipient: str,
    original: Path,
    copy: Path,
    key: Key,
    budget: Budget,
    *,
    overwrite: bool = False,
) -> FileOutcome:
    """Make a recipient's copy and its record, and store original, record and recipient in the catalogue.

    Args:
        catalogue: the catalogue; the original is added to it, if necessary.
        recipient: the recipient's identifier.
        original: the original's mesh file.
        copy: path of the copy; the record is written next to it.
        key: the key to mark with.
        budget: how strong the mark may be, see `embed`.
        overwrite: see `mark_file`.

    Raises:
        JaxmarkError: see `mark_file`.
    """
    record = _record_of(copy)
    with writing_pair(copy, record, overwrite=overwrite) as pair:
        outcome = mark_file(original, pair.file, pair.record, key=key, recipient=recipient, budget=budget)
        catalogue.add(original)
        # The recipient is stored first: a recipient without a copy does no harm, but a copy without a recipient in the
        # catalogue could not be traced.
        catalogue.add_copy(Record.load(pair.record), recipient, file_hash(pair.file))
    places = {str(pair.file): str(copy), str(pair.record): str(record)}
    lines = (f"{outcome.lines[0]}{pair}", *outcome.lines[1:])
    for place, name in places.items():
        lines = tuple(line.replace(place, name) for line in lines)
    named = {"record": str(record), "marked": str(copy), "old_record": pair.kept}
    return outcome._replace(values={**outcome.values, **named}, lines=lines)
