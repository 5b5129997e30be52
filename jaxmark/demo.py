"""The main job on one mesh, start to end: key, mark, attack, detect, and a folder that shows it."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmark import distortion
from jaxmark.attacks import attack
from jaxmark.budget import make_budget
from jaxmark.errors import JaxmarkError
from jaxmark.extras import package_folder, require
from jaxmark.files import load_mesh, save_mesh
from jaxmark.files.atomic import write_atomically
from jaxmark.keys import new_key
from jaxmark.marking import Marker, make_marker
from jaxmark.mesh import Mesh
from jaxmark.message import encode
from jaxmark.original import Original
from jaxmark.plot import View, displacement, exaggerated, save_views, visibility
from jaxmark.record import RECORD_SUFFIX
from jaxmark.schemes import DEFAULT_SCHEME, SCHEMES

_ATTACKS = (
    ("noise", 0.001),
    ("noise", 0.005),
    ("smoothing", 1),
    ("smoothing", 10),
    ("smoothing", 50),
    ("quantisation", 10),
    ("quantisation", 8),
)
_PICTURED = ("noise", 0.005)


class Outcome(NamedTuple):
    """One line of the demo's table."""

    scheme: str
    attack: str
    rms: float  # of the attack itself, over the diagonal
    wrong: float  # share of the code bits
    message_read: bool  # and its tag fits
    log10_p: float  # with the message unknown
    log10_p_claimed: float  # with the message claimed


def sample_mesh() -> Path:
    """The closed bunny of 28,088 vertices that pymeshlab's wheel carries.

    Raises:
        JaxmarkError: if pymeshlab is not installed.
    """
    path = package_folder("pymeshlab", "attacks") / "tests" / "sample_meshes" / "bunny.obj"
    if not path.is_file():
        raise JaxmarkError(f"This pymeshlab carries no sample mesh at {path}; give a mesh of your own.")
    return path


def run_demo(
    source: str | os.PathLike[str] | None, output: str | os.PathLike[str], say: Callable[[str], None]
) -> list[Outcome]:
    """Mark a mesh with a fresh key and message, attack it, and read it again, by each scheme.

    Leaves in the folder `output`: the marked mesh of each scheme with its record, the table `table.md`, and the
    pictures `mark.png` and `attacked.png`. The key is thrown away.

    Args:
        source: a mesh file, or None for `sample_mesh`.
        output: a folder; made where it does not exist.
        say: is called with each line of the account.

    Returns:
        The rows of the table.

    Raises:
        JaxmarkError: if an extra is missing, the mesh is unusable, or the folder cannot be written.
    """
    require("matplotlib", "plot")
    source = Path(source) if source is not None else sample_mesh()
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"The folder {folder} cannot be made: {error.strerror}.") from None
    mesh = load_mesh(source)
    say(f"{source.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")
    key = new_key()
    message = os.urandom(8)
    say(f"message {message.hex()} (64 bits), as strong as the eye allows ({make_budget()})")
    rows: list[Outcome] = []
    for scheme in SCHEMES:
        try:
            marker = make_marker(mesh, key, bits=8 * len(message), scheme=scheme)
            marked, info = marker.embed(message)
        except JaxmarkError as error:
            say(f"{scheme}: refused. {error}")
            continue
        target = folder / f"marked-{scheme}{source.suffix}"
        save_mesh(marked, target, like=source)
        write_atomically(f"{target}{RECORD_SUFFIX}", info.record.to_json().encode())
        say(f"{scheme}: marked, RMS {info.rms:.6f}, max {info.max:.6f} → {target}")
        marked = load_mesh(target)
        rows += _attacked(marker, marked, message)
        for row in rows[-len(_ATTACKS) - 1 :]:
            say("  " + _line(row))
        if scheme == DEFAULT_SCHEME:
            _pictures(folder, marker.original, marked)
            say(f"pictures → {folder / 'mark.png'}, {folder / 'attacked.png'}")
    if not rows:
        raise JaxmarkError(f"No scheme can mark {source.name}.")
    write_atomically(folder / "table.md", _table(rows).encode())
    lost = sum(not row.message_read for row in rows)
    say(f"table → {folder / 'table.md'}; message read in {len(rows) - lost} of {len(rows)} cases, lost in {lost}")
    return rows


def _attacked(marker: Marker, marked: Mesh, message: bytes) -> Iterator[Outcome]:
    sent = encode(message, marker.key, marker.original.geometry, marker.code)
    for kind, strength in (("none", 0.0), *_ATTACKS):
        suspect = marked if kind == "none" else attack(marked, kind, strength, seed=0)
        blind, claimed = marker.detect(suspect), marker.detect(suspect, message)
        yield Outcome(
            marker.scheme.name,
            kind if kind == "none" else f"{kind} {strength:g}",
            distortion.moved(marked, suspect).rms,
            float(np.mean(np.sign(blind.scores) != sent)),
            blind.message == message,
            blind.log10_p,
            claimed.log10_p,
        )


def _line(row: Outcome) -> str:
    outcome = "read" if row.message_read else "LOST"
    return (
        f"{row.attack:<16} attack RMS {row.rms:.6f}  {100 * row.wrong:4.1f} % of code bits wrong, message {outcome:<4}"
        f" log10 p {row.log10_p:6.1f}, claimed {row.log10_p_claimed:6.1f}"
    )


def _table(rows: list[Outcome]) -> str:
    head = (
        "| scheme | attack | attack RMS / diagonal | wrong code bits | message | log10 p | log10 p, claimed |\n"
        "|---|---|---|---|---|---|---|\n"
    )
    lines = (
        f"| {r.scheme} | {r.attack} | {r.rms:.6f} | {100 * r.wrong:.1f} % | {'read' if r.message_read else 'lost'}"
        f" | {r.log10_p:.1f} | {r.log10_p_claimed:.1f} |\n"
        for r in rows
    )
    return head + "".join(lines)


def _pictures(folder: Path, original: Original, marked: Mesh) -> None:
    save_views(
        [
            View("original", original.mesh),
            View("marked", marked),
            exaggerated(original, marked),
            displacement(original, marked),
            visibility(original, marked),
        ],
        folder / "mark.png",
    )
    attacked = attack(marked, *_PICTURED, seed=0)
    smoothed = attack(marked, "smoothing", 50, seed=0)
    coarse = attack(marked, "quantisation", 8, seed=0)
    save_views(
        [
            View("noise, 0.5 % of the mean radius", attacked),
            View("smoothing, 50 steps of 0.1", smoothed),
            View("quantisation, 8 bits", coarse),
        ],
        folder / "attacked.png",
    )
