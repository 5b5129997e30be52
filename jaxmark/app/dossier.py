"""The dossier of a detection: one page for people who are no engineers, and the same as JSON for those who check it.

It holds nothing secret: no key, and of the original only pictures. Needs the extra `plot`.
"""

import base64
import hashlib
import json
import math
import platform
import shlex
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot import View, draw
from jaxmark.watermark.coding.keys import commitment
from jaxmark.watermark.deposit import Deposit
from jaxmark.watermark.marking import Detection, Marker

_SIDES = {"front": 25.0, "right": 115.0, "back": 205.0, "left": 295.0}  # azimuths in degrees
_PACKAGES = ("jaxmark", "jax", "numpy", "scipy", "trimesh")


@dataclass(frozen=True)
class Case:
    """What a dossier is about."""

    suspect: Path
    original: Path
    record: Path | None
    mesh: Mesh  # the suspect's
    marker: Marker  # that read it
    found: Detection
    claimed: bool  # whether the message was claimed
    deposit: Deposit | None
    dated: float | None  # log10 of the bound if the deposit is older than the suspect
    obtained: str  # when and where the suspect was got


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal.

    Raises:
        JaxmarkError: if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise JaxmarkError(f"Cannot read {path}: {error.strerror}.") from None


def save_dossier(folder: Path, case: Case) -> None:
    """Write `dossier.html` and `dossier.json` to a folder, which is made if it does not exist.

    Raises:
        JaxmarkError: if nothing was detected, if what was found is an estimate, if an extra is missing, or if a file
            cannot be read or written.
    """
    if case.found.doubts:
        raise JaxmarkError(f"There is no dossier of an estimate: {'; '.join(case.found.doubts)}.")
    if not case.found.detected():
        raise JaxmarkError("Nothing was detected that a dossier could show (at a probability of 10^-6).")
    jinja2 = require("jinja2", "plot")
    facts = _facts(case)
    template = resources.files("jaxmark.app").joinpath("dossier.html").read_text(encoding="utf-8")
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"{folder} cannot be made a folder: {error.strerror}.") from None
    text = page.render(**facts, pictures=_draw_sides(case))
    write_atomically(folder / "dossier.json", (json.dumps(facts, indent=2) + "\n").encode())
    write_atomically(folder / "dossier.html", text.encode())


def _facts(case: Case) -> dict[str, Any]:
    """Everything that the dossier says, as values for JSON."""
    found, record, deposit = case.found, case.marker.record, case.deposit
    roles = {"suspect": case.suspect, "original": case.original, "record": case.record}
    files = [
        {"role": role, "name": path.name, "sha256": file_hash(path)} for role, path in roles.items() if path is not None
    ]
    aligned = found.alignment
    deposited = None
    if deposit is not None and case.dated is not None:
        deposited = {
            "root": deposit.root,
            "records": len(deposit.digests),
            "log10_p": case.dated,
        }
    return {
        "suspect": files[0],
        "original": files[1],
        "files": files,
        "message": None if found.message is None else found.message.hex(),
        "remarks": list(found.remarks),
        "log10_p": found.log10_p,
        "log10_p_undated": found.log10_p_undated,
        "chance": _in_words(found.log10_p_undated if deposited is None else deposited["log10_p"]),
        "deposit": deposited,
        "obtained": case.obtained,
        "coverage": found.coverage,
        "pose": "into the original's place, vertex by vertex"
        if aligned.method != "surface"
        else "into the original's place by its surface",
        "alignment": {
            "method": aligned.method,
            "matrix": aligned.pose.matrix.tolist(),
            "shift": aligned.pose.shift.tolist(),
            "residual": aligned.residual,
        },
        "record_digest": None if record is None else record.digest(),
        "key_commitment": commitment(case.marker.key),
        "version": found.version,
        "command": _command(case),
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "software": {name: version(name) for name in _PACKAGES} | {"Python": platform.python_version()},
    }


def _in_words(log10_p: float) -> str:
    """A bound for people, rounded so that it stays one: 10^-9.7 is at most once in 10^9 cases."""
    if log10_p > -3:
        return "with a probability that only a date can bound, see below"
    cases = math.floor(-log10_p)
    return f"at most once in 10^{cases} cases" if cases > 9 else f"at most once in {10**cases:,} cases"


def _command(case: Case) -> str:
    """The command that repeats the detection; where the key is, is nobody's business."""
    words = ["jaxmark", "detect", case.suspect.name, "--original", case.original.name, "--key", "KEYFILE"]
    if case.record is not None:
        words += ["--record", case.record.name]
    else:
        words += ["--bits", str(case.marker.bits), "--scheme", case.marker.scheme.name]
    if case.found.alignment.how != "auto":
        words += ["--align", case.found.alignment.how]
    return shlex.join(words) + (" --message CLAIMED" if case.claimed else "")


def _draw_sides(case: Case) -> dict[str, str]:
    """Pictures of suspect and original from four sides, as PNG in base 64."""
    original, aligned = case.marker.original, case.found.alignment
    posed = aligned.pose(np.asarray(case.mesh.vertices, np.float64))
    mesh = original.mesh
    both = Mesh(
        np.concatenate([mesh.vertices, posed]),
        np.concatenate([mesh.faces, np.asarray(case.mesh.faces) + len(mesh.vertices)]),
    )
    which = np.repeat([0.0, 1.0], [len(mesh.vertices), len(posed)])
    off = np.linalg.norm(aligned.displacement, axis=1)
    if aligned.normals is not None:
        off = np.abs(np.sum(aligned.normals * aligned.displacement, axis=1))
    views = [
        View("original and suspect", both, which, "0 original, 1 suspect"),
        View("distance", mesh, 100 * off[original.weld.point], "% of the diagonal"),
    ]
    return {side: base64.b64encode(draw(views, azimuth=azimuth).png()).decode() for side, azimuth in _SIDES.items()}
