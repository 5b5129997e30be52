"""The command that brings a posed model back."""

from pathlib import Path

import click

from jaxmark.app.answering import JSON, QUIET, answer, progress
from jaxmark.app.outputs import check_distinct, check_suffix
from jaxmark.files import load_mesh, load_skin, save_mesh
from jaxmark.files.atomic import replacing
from jaxmark.geometry import unpose

_FILE = click.Path(path_type=Path)


@click.command(name="unpose")
@click.argument("suspect", type=_FILE)
@click.argument("original", type=_FILE)
@click.argument("target", metavar="OUT", type=_FILE)
@QUIET
@JSON
def unpose_command(suspect: Path, original: Path, target: Path, as_json: bool) -> None:
    """Bring SUSPECT, in any pose of the skeleton of ORIGINAL, back to the pose in which ORIGINAL is stored.

    ORIGINAL is a GLB or glTF file with a skin, as it is, unmarked; SUSPECT has its vertices in its order. OUT is the
    file SUSPECT with other positions, which `jaxmark detect` reads.
    """
    check_suffix(suspect, target)
    check_distinct(SUSPECT=suspect, ORIGINAL=original, OUT=target)
    progress().doing(f"bringing {suspect} back")
    back = unpose(load_mesh(original), load_skin(original), load_mesh(suspect))
    with replacing(target) as draft:
        save_mesh(back, draft, like=suspect)
    answer(as_json, {"vertices": len(back.vertices), "output": str(target)}, f"{suspect} as {original} lies → {target}")
