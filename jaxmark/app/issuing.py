"""Give each recipient a copy of their own, and know later whose it was."""

import os
import re
from collections.abc import Mapping
from pathlib import Path

import click

from jaxmark.app.answering import JSON, QUIET, answer, progress, read_key
from jaxmark.app.batch import mark_file
from jaxmark.app.catalogue import CATALOGUE
from jaxmark.app.telling import Told
from jaxmark.catalogue import Catalogue
from jaxmark.catalogue.originals import file_hash
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import replacing
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.perception.budget import VISIBILITY, Visibility
from jaxmark.watermark.record import RECORD_SUFFIX, Record

_PATH = click.Path(path_type=Path)
_PLAIN = re.compile(r"\w[\w.@+-]*")  # recipients whose names may be in file names


@click.command(name="mark-for")
@click.argument("recipient")
@click.argument("original", type=_PATH)
@CATALOGUE
@click.option("--key", "key_file", type=_PATH, required=True, help="Key file, from `jaxmark keygen`.")
@click.option("--output", type=_PATH, help="File for the copy.  [default: ORIGINAL's name, - and RECIPIENT, here]")
@click.option("--budget", type=float, help="RMS displacement of the vertices over the diagonal of the bounding box.")
@click.option("--visibility", type=click.Choice(list(VISIBILITY)), help="How well people may see the mark.")
@QUIET
@JSON
def mark_for_command(
    recipient: str,
    original: Path,
    catalogue_file: Path,
    key_file: Path,
    output: Path | None,
    budget: float | None,
    visibility: Visibility | None,
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
    progress().doing(f"marking {original} for {recipient}")
    with Catalogue(catalogue_file) as catalogue:
        told = issue(catalogue, recipient, original, output, key, {"budget": budget, "visibility": visibility})
    answer(as_json, {"recipient": recipient, **told.answer}, told.said)


def issue(
    catalogue: Catalogue, recipient: str, original: Path, copy: Path, key: Key, bounds: Mapping[str, object]
) -> Told:
    """Make a recipient's copy, with its record beside it, and keep both in the catalogue.

    Args:
        catalogue: to which the original is added, if it is not in it.
        recipient: identifier.
        original: the mesh file.
        copy: file for the copy.
        key: the key to mark with.
        bounds: how strong the mark may be, see `embed`.

    Raises:
        JaxmarkError: see `mark_file`.
    """
    catalogue.add(original)
    record = copy.with_name(copy.name + RECORD_SUFFIX)
    with replacing(copy) as draft, replacing(record) as record_draft:
        told = mark_file(original, draft, record_draft, key=key, recipient=recipient, noise=None, **bounds)  # type: ignore[arg-type]
        # In the catalogue first: a copy that is not known is not traced, a recipient without a copy does no harm.
        catalogue.add_copy(Record.load(record_draft), recipient, file_hash(draft))
    places = {str(draft): str(copy), str(record_draft): str(record)}
    said = told.said
    for place, name in places.items():
        said = said.replace(place, name)
    return told._replace(answer={**told.answer, "record": str(record), "marked": str(copy)}, said=said)
