"""The demo: mark a mesh, attack it, read it, and write a table and pictures to a folder."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmark import distortion
from jaxmark.adversaries.by_name import attack
from jaxmark.alignment.original import Original
from jaxmark.app.output import power
from jaxmark.app.progress import Doing, quietly
from jaxmark.errors import JaxmarkError, package_folder, require
from jaxmark.evaluation._rates import Control
from jaxmark.files import load_mesh, save_mesh
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot import View, displacement, exaggerate, save_views, visibility
from jaxmark.watermark.coding.keys import new_key
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.markers import NonBlindMarker, make_marker
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.record import RECORD_SUFFIX
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, SCHEMES

_ATTACKS = (
    ("noise", 0.001),
    ("noise", 0.005),
    ("smoothing", 1),
    ("smoothing", 10),
    ("smoothing", 50),
    ("quantisation", 10),
    ("quantisation", 8),
)
_PICTURED = ("noise 0.005", "smoothing 50", "quantisation 8")
_CONTROL_ATTACK = ("noise", 0.001)
_HISTORICAL = {"host": "Sohn et al.", "eigen": "Ohbuchi et al."}
_TERMS = (
    "wrong code bits: errors in the encoded message, before error correction; chance gives 50 %",
    "attack RMS: displacement of the vertices by the attack (root mean square), relative to the diagonal of the"
    " bounding box; 0.001 is 0.1 %",
    "log10 p: base-10 logarithm of a bound on the false-positive probability; -6 is one in a million, and counts as"
    " detected",
    f"floor: {MIN_LOG10_P:.0f}, because a key of 256 bits cannot prove more; the choices of the reader cost a little"
    " of it",
    "without floor: the same bound without the floor; it compares strong marks, and proves nothing beyond the floor",
    "unmarked, wrong key: controls, in which nothing must be detected",
    "claimed: log10 p if the message is known beforehand, and only has to be confirmed",
)


class DemoRow(NamedTuple):
    """One row of the demo's table."""

    scheme: str
    attack: str
    control: Control  # "marked", or a control: an unmarked mesh after the same attack, or reading with a wrong key
    rms: float  # RMS displacement by the attack, over the diagonal
    wrong: float  # fraction of the code bits that are wrong
    message_read: bool  # whether the exact message was read, and its tag matches
    detected: bool  # whether the false-positive probability is at most one in a million
    log10_p: float  # log10 p of a message that is not claimed
    log10_p_unfloored: float  # log10 p without its floor
    log10_p_claimed: float  # log10 p of the claimed message


def sample_mesh() -> Path:
    """Return the path of the closed bunny of 28,088 vertices, which pymeshlab contains.

    Raises:
        JaxmarkError: if pymeshlab is not installed.
    """
    path = package_folder("pymeshlab", "attacks") / "tests" / "sample_meshes" / "bunny.obj"
    if not path.is_file():
        raise JaxmarkError(f"The installed pymeshlab has no sample mesh at {path}; give a mesh of your own.")
    return path


def run_demo(
    source: str | os.PathLike[str] | None,
    output: str | os.PathLike[str],
    log: Callable[[str], None],
    doing: Doing = quietly,
) -> list[DemoRow]:
    """Mark a mesh with a new key and message, attack it, and read it, with each non-blind scheme.

    The default scheme marks as strongly as an invisible mark may be. The historical schemes mark with the same RMS
    displacement. The folder `output` receives the marked mesh of each scheme with its record, the table `table.md`,
    and the pictures `mark.png` and `attacked.png`. The key is not saved.

    Args:
        source: a mesh file, or None for `sample_mesh`.
        output: a folder, which is created if it does not exist.
        log: callback, called with each line of the output.
        doing: progress callback, called with a description of each step that begins.

    Returns:
        The rows of the table, including the controls.

    Raises:
        JaxmarkError: if an extra is missing, the mesh is unusable, or the folder cannot be written.
    """
    require("matplotlib", "plot")
    source = Path(source) if source is not None else sample_mesh()
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"The folder {folder} cannot be created: {error.strerror}.") from None
    doing(f"reading {source}")
    mesh = load_mesh(source)
    log(f"{source.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")
    key = new_key()
    message = os.urandom(8)
    log(f"message {message.hex()} (64 bits), as strong as an invisible mark may be ({Budget().bounds(mesh)})")
    rows: list[DemoRow] = []
    displacement: float | None = None
    for scheme in (DEFAULT_SCHEME, *(name for name in SCHEMES if name != DEFAULT_SCHEME)):
        doing(f"{scheme}: embedding {source.name}")
        try:
            marker = make_marker(mesh, key, bits=8 * len(message), scheme=scheme)
            marked, info = marker.embed(message, displacement)
        except JaxmarkError as error:
            log(f"{scheme}: refused. {error}")
            continue
        displacement = displacement or info.rms
        target = folder / f"marked-{scheme}{source.suffix}"
        save_mesh(marked, target, like=source)
        write_atomically(f"{target}{RECORD_SUFFIX}", info.record.to_json().encode())
        log(f"{scheme}: marked, RMS {info.rms:.6f}, max {info.max:.6f} of the diagonal → {target}")
        marked = load_mesh(target)
        for row in _attack_and_read(marker, marked, message, doing):
            log("  " + _line(row))
            rows.append(row)
        if scheme == DEFAULT_SCHEME:
            doing("drawing pictures")
            _save_pictures(
                folder, marker.original, marked, {row.attack: row for row in rows if row.control == "marked"}
            )
            log(f"pictures → {folder / 'mark.png'}, {folder / 'attacked.png'}")
    if not rows:
        raise JaxmarkError(f"No scheme can mark {source.name}; give another mesh.")
    write_atomically(folder / "table.md", _table(rows).encode())
    log(f"table → {folder / 'table.md'}")
    for line in (*(f"  {term}" for term in _TERMS), "Verdict:", *(f"  {sentence}" for sentence in verdict(rows))):
        log(line)
    return rows


def verdict(rows: Sequence[DemoRow]) -> list[str]:
    """Summarise the table in sentences."""
    sentences = []
    for scheme in dict.fromkeys(row.scheme for row in rows):
        marked_rows = [row for row in rows if row.scheme == scheme and row.control == "marked"]
        attacked = sum(row.attack != "none" for row in marked_rows)
        count = f"{sum(row.message_read for row in marked_rows)} of {len(marked_rows)} marked copies"
        count += f" ({attacked} of them attacked)"
        if scheme in _HISTORICAL:
            sentences.append(
                f"The historical scheme {scheme!r} ({_HISTORICAL[scheme]}), with the same RMS displacement, read the"
                f" message from {count}."
            )
            continue
        weakest = max((row.log10_p for row in marked_rows if row.message_read), default=0.0)
        floor = ", which is close to the least that a key can prove" if weakest < MIN_LOG10_P + 1 else ""
        sentences.append(f"The scheme {scheme!r} read the message from {count}.")
        sentences.append(f"The false-positive probability of each of its readings is at most {power(weakest)}{floor}.")
    controls = [row for row in rows if row.control != "marked"]
    false = sum(row.detected for row in controls)
    outcome = f"{false} were FALSE POSITIVES" if false else "nothing was detected, as expected"
    return [*sentences, f"In {len(controls)} controls, without a mark or with a wrong key, {outcome}."]


def _attack_and_read(marker: NonBlindMarker, marked: Mesh, message: bytes, doing: Doing) -> Iterator[DemoRow]:
    """Read the marked mesh after each attack, and then the controls."""
    name = marker.scheme.name
    for kind, strength in (("none", 0.0), *_ATTACKS):
        attack_name = kind if kind == "none" else f"{kind} {strength:g}"
        doing(f"{name}: {attack_name}")
        suspect = marked if kind == "none" else attack(marked, kind, strength, seed=0)
        yield _read(marker, marked, suspect, message, attack_name, "marked")
    unmarked, control = marker.original.mesh, f"{_CONTROL_ATTACK[0]} {_CONTROL_ATTACK[1]:g}"
    doing(f"{name}: controls")
    yield _read(marker, unmarked, attack(unmarked, *_CONTROL_ATTACK, seed=0), message, control, "unmarked")
    stranger = make_marker(unmarked, new_key(), bits=marker.bits, scheme=marker.scheme)
    yield _read(stranger, marked, attack(marked, *_CONTROL_ATTACK, seed=0), message, control, "wrong-key")


def _read(
    marker: NonBlindMarker, before: Mesh, suspect: Mesh, message: bytes, attack_name: str, control: Control
) -> DemoRow:
    """Read a suspect without and with a claim of the message."""
    unclaimed, claimed = marker.detect(suspect), marker.detect(suspect, message)
    return DemoRow(
        marker.scheme.name,
        attack_name,
        control,
        distortion.displacement_size(before, suspect).rms,
        float(np.mean(np.sign(unclaimed.scores) != marker.codeword(message))),
        unclaimed.message == message,
        unclaimed.detected() or claimed.detected(),
        unclaimed.log10_p,
        unclaimed.evidence.log10_p_unfloored,
        claimed.log10_p,
    )


def _outcome(row: DemoRow) -> str:
    """Describe the result of a reading in one or two words; in a control, nothing must be detected."""
    if row.control == "marked":
        return "read" if row.message_read else "LOST"
    return "FALSE POSITIVE" if row.detected else "none"


def _name(row: DemoRow) -> str:
    return row.attack if row.control == "marked" else f"{row.attack}, {row.control.replace('-', ' ')}"


def _line(row: DemoRow) -> str:
    return (
        f"{_name(row):<22} attack RMS {row.rms:.6f}  {100 * row.wrong:4.1f} % of code bits wrong, message"
        f" {_outcome(row):<4} log10 p {row.log10_p:6.1f} (without floor {row.log10_p_unfloored:.0f}), claimed"
        f" {row.log10_p_claimed:6.1f}"
    )


def _table(rows: Sequence[DemoRow]) -> str:
    head = (
        "| scheme | attack | attack RMS / diagonal | wrong code bits | message | log10 p | without floor"
        " | log10 p, claimed |\n|---|---|---|---|---|---|---|---|\n"
    )
    lines = (
        f"| {r.scheme} | {_name(r)} | {r.rms:.6f} | {100 * r.wrong:.1f} % | {_outcome(r).lower()} | {r.log10_p:.1f}"
        f" | {r.log10_p_unfloored:.1f} | {r.log10_p_claimed:.1f} |\n"
        for r in rows
    )
    terms = "".join(f"- {term}\n" for term in _TERMS)
    return f"{head}{''.join(lines)}\n{terms}\n{' '.join(verdict(rows))}\n"


def _save_pictures(folder: Path, original: Original, marked: Mesh, read: Mapping[str, DemoRow]) -> None:
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
    views = [View(f"marked, not attacked\n{_caption(read['none'])}", marked)]
    for name in _PICTURED:
        kind, strength = name.split()
        suspect = attack(marked, kind, float(strength), seed=0)
        views.append(View(f"{name}, RMS {100 * read[name].rms:.2g} %\n{_caption(read[name])}", suspect))
    save_views(views, folder / "attacked.png")


def _caption(row: DemoRow) -> str:
    if not row.message_read:
        return "message lost"
    return f"message read, p ≤ {power(row.log10_p)}"
