"""The demo: mark one mesh, attack it, read it again, and write tables and pictures of it to a folder."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmark import distortion
from jaxmark.alignment.original import Original
from jaxmark.attacks import attack
from jaxmark.errors import JaxmarkError
from jaxmark.extras import package_folder, require
from jaxmark.files import load_mesh, save_mesh
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot import View, displacement, exaggerate, save_views, visibility
from jaxmark.watermark.budget import make_budget
from jaxmark.watermark.coding.keys import new_key
from jaxmark.watermark.marking import Marker, make_marker
from jaxmark.watermark.record import RECORD_SUFFIX
from jaxmark.watermark.schemes import DEFAULT_SCHEME, SCHEMES

_ATTACKS = (
    ("noise", 0.001),
    ("noise", 0.005),
    ("smoothing", 1),
    ("smoothing", 10),
    ("smoothing", 50),
    ("quantisation", 10),
    ("quantisation", 8),
)
_PICTURED_ATTACK = ("noise", 0.005)


class Outcome(NamedTuple):
    """One line of the demo's table."""

    scheme: str
    attack: str
    rms: float  # RMS displacement by the attack, over the diagonal
    wrong: float  # share of the code bits that are wrong
    message_read: bool  # the exact message was read, and its tag fits
    log10_p: float  # log10 p with the message unknown
    log10_p_claimed: float  # log10 p with the message claimed


def sample_mesh() -> Path:
    """Path of the closed bunny of 28,088 vertices in pymeshlab's wheel.

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

    The folder `output` gets the marked mesh of each scheme with its record, the table `table.md`, and the pictures
    `mark.png` and `attacked.png`. The key is thrown away.

    Args:
        source: a mesh file, or None for `sample_mesh`.
        output: a folder, which is made if it does not exist.
        say: function that is called with each line of the account.

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
        rows += _attack_and_read(marker, marked, message)
        for row in rows[-len(_ATTACKS) - 1 :]:
            say("  " + _line(row))
        if scheme == DEFAULT_SCHEME:
            _save_pictures(folder, marker.original, marked)
            say(f"pictures → {folder / 'mark.png'}, {folder / 'attacked.png'}")
    if not rows:
        raise JaxmarkError(f"No scheme can mark {source.name}.")
    write_atomically(folder / "table.md", _table(rows).encode())
    lost = sum(not row.message_read for row in rows)
    say(f"table → {folder / 'table.md'}; message read in {len(rows) - lost} of {len(rows)} cases, lost in {lost}")
    return rows


def _attack_and_read(marker: Marker, marked: Mesh, message: bytes) -> Iterator[Outcome]:
    sent = marker.codeword(message)
    for kind, strength in (("none", 0.0), *_ATTACKS):
        suspect = marked if kind == "none" else attack(marked, kind, strength, seed=0)
        blind, claimed = marker.detect(suspect), marker.detect(suspect, message)
        yield Outcome(
            marker.scheme.name,
            kind if kind == "none" else f"{kind} {strength:g}",
            distortion.displacement_size(marked, suspect).rms,
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


def _save_pictures(folder: Path, original: Original, marked: Mesh) -> None:
    save_views(
        [
            View("original", original.mesh),
            View("marked", marked),
            exaggerate(original, marked),
            displacement(original, marked),
            visibility(original, marked),
        ],
        folder / "mark.png",
    )
    attacked = attack(marked, *_PICTURED_ATTACK, seed=0)
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
