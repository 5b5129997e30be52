"""The dossier of a detection: a page for non-technical readers, and the same facts as JSON for verification.

A dossier contains no secret: it has no key, and only pictures of the original. `save_report` draws a picture of the
registration. Both need the extra `plot`.
"""

import base64
import json
import math
import platform
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmark.alignment.original import Original
from jaxmark.alignment.result import Alignment
from jaxmark.app.output import make_folder, power
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash, replacing, write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot import View, draw, save_views
from jaxmark.plot.figures import fill_template
from jaxmark.watermark.coding.keys import commitment as commitment_to
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.evidence.ledger import charges_as_json, rounded_up
from jaxmark.watermark.mark import Mark
from jaxmark.watermark.record import TimestampedCommitment

_SIDES = {"front": 25.0, "right": 115.0, "back": 205.0, "left": 295.0}  # azimuths in degrees
_MOST_ALPHA = 1e-6  # largest false-positive probability of a proof that others should believe
_PACKAGES = ("jaxmark", "jax", "numpy", "scipy", "trimesh")


@dataclass(frozen=True)
class Case:
    """The subject of a dossier: a detection, its files, and the facts that were given about them."""

    suspect: Path
    original: Path
    record: Path | None
    mesh: Mesh  # the mesh of the suspect
    mark: Mark  # the mark that was read
    found: Detection
    claimed: bool  # whether the message was claimed
    commitment: TimestampedCommitment | None
    timestamped: float | None  # log10 of the bound if the commitment is older than the suspect
    obtained: str  # when and where the suspect was obtained
    meshes: Sequence[str] = ()  # names of the meshes that were selected
    schemes: Sequence[str] = ()  # names of the schemes that were named


def save_report(folder: Path, original: Original, suspect: Mesh, alignment: Alignment) -> Path:
    """Draw the original, the suspect in the original's pose, the weights of the points, and their residuals.

    Args:
        folder: folder for the picture `alignment.png`, which is created if it does not exist.
        original: the original.
        suspect: the mesh that was aligned to it.
        alignment: the alignment of the suspect.

    Returns:
        The picture's path.

    Raises:
        JaxmarkError: if matplotlib is missing, or the picture cannot be written.
    """
    mesh, point = original.mesh, original.weld.point
    distances = _distances(alignment)
    posed = suspect._replace(vertices=alignment.pose(np.asarray(suspect.vertices, np.float64)))
    views = [
        View("Original", mesh),
        View(f"Suspect, aligned by {alignment.method}", posed),
        View("Weight", mesh, alignment.weights[point], "1 registered, 0 masked"),
        View("Residual", mesh, 100 * distances[point], "% of the diagonal"),
    ]
    path = make_folder(folder) / "alignment.png"
    save_views(views, path)
    return path


def missing_proof(detection: Detection, alpha: float = _MOST_ALPHA) -> str:
    """Return why a detection has no dossier, which is only about proofs; "" if it may have one."""
    alpha = min(alpha, _MOST_ALPHA)
    if detection.evidence.caveats:
        return f"There is no dossier of an estimate: {'; '.join(detection.evidence.caveats)}."
    if not detection.detected(alpha):
        level = power(math.log10(alpha))
        return f"There is no dossier, because nothing was detected at a false-positive probability of {level}."
    return ""


def save_dossier(folder: Path, case: Case) -> None:
    """Write `dossier.html` and `dossier.json` to a folder, which is created if it does not exist.

    Raises:
        JaxmarkError: if the detection proves nothing, see `missing_proof`, if an extra is missing, or if a file cannot
            be read or written.
    """
    if reason := missing_proof(case.found):
        raise JaxmarkError(reason)
    facts = _facts(case)
    make_folder(folder)
    text = fill_template("jaxmark.app", "dossier.html", **facts, rounded_up=rounded_up, pictures=_draw_sides(case))
    with replacing(folder / "dossier.html") as page, replacing(folder / "dossier.json") as data:
        write_atomically(data, (json.dumps(facts, indent=2) + "\n").encode())
        write_atomically(page, text.encode())


def _facts(case: Case) -> dict[str, Any]:
    """Collect all facts of the dossier, as values for JSON."""
    detection, record, commitment = case.found, case.mark.record, case.commitment
    evidence, alignment = detection.evidence, detection.registration
    roles = {"suspect": case.suspect, "original": case.original, "record": case.record}
    files = [
        {"role": role, "name": path.name, "sha256": file_hash(path)} for role, path in roles.items() if path is not None
    ]
    timestamped = None
    if commitment is not None and case.timestamped is not None:
        size = len(commitment.digests)
        timestamped = {"root": commitment.root, "records": size, "log10_p": case.timestamped}
    return {
        "suspect": files[0],
        "original": files[1],
        "files": files,
        "message": None if detection.message is None else detection.message.hex(),
        "claimed": None if detection.claimed is None else detection.claimed.hex(),
        "notes": list(detection.notes),
        "log10_p": evidence.log10_p,
        "log10_p_uncommitted": evidence.log10_p_uncommitted,
        "charges": charges_as_json(evidence.charges),
        "chance": _in_words(evidence.log10_p_uncommitted),
        "premises": detection.premises,
        "commitment": timestamped,
        "obtained": case.obtained,
        "coverage": detection.coverage,
        "pose": "vertex by vertex" if alignment.method != "surface" else "by its surface",
        "registration": alignment.facts(),
        "record_digest": None if record is None else record.digest(),
        "key_commitment": commitment_to(case.mark.key),
        "version": detection.version,
        "command": _command(case),
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "software": {name: version(name) for name in _PACKAGES} | {"Python": platform.python_version()},
    }


def _in_words(log10_p: float) -> str:
    """Express a bound in words, rounded up: 10^-9.7 is at most once in 10^9 cases."""
    if log10_p > -3:
        return "with a probability that is only small if the dates are proven, see below"
    cases = math.floor(-log10_p)
    return f"at most once in 10^{cases} cases" if cases > 9 else f"at most once in {10**cases:,} cases"


def _command(case: Case) -> str:
    """Compose the command that repeats the detection, without the path of the key."""
    words = ["jaxmark", "detect", case.suspect.name, "--original", case.original.name, "--key", "KEYFILE"]
    schemes = case.schemes
    if case.record is not None:
        words += ["--record", case.record.name]
    else:
        words += ["--bits", str(case.mark.bits)]
        schemes = schemes or (case.mark.scheme.name,)
    if schemes:
        words += ["--scheme", ",".join(schemes)]
    for name in case.meshes:
        words += ["--mesh", name]
    if case.found.registration.align != "auto":
        words += ["--align", case.found.registration.align]
    return shlex.join(words) + (" --message CLAIMED" if case.claimed else "")


def _draw_sides(case: Case) -> dict[str, str]:
    """Draw suspect and original from four sides; returns PNG pictures, encoded in base 64."""
    original, alignment = case.mark.original, case.found.registration
    posed = alignment.pose(np.asarray(case.mesh.vertices, np.float64))
    mesh = original.mesh
    both = Mesh(
        np.concatenate([mesh.vertices, posed]),
        np.concatenate([mesh.faces, np.asarray(case.mesh.faces) + len(mesh.vertices)]),
    )
    which = np.repeat([0.0, 1.0], [len(mesh.vertices), len(posed)])
    distances = _distances(alignment)
    views = [
        View("original and suspect", both, which, "0 original, 1 suspect"),
        View("distance", mesh, 100 * distances[original.weld.point], "% of the diagonal"),
    ]
    return {side: base64.b64encode(draw(views, azimuth=azimuth).png()).decode() for side, azimuth in _SIDES.items()}


def _distances(alignment: Alignment) -> Float64[np.ndarray, " points"]:
    """Compute the known distance of a suspect from each point of the original, in diagonals."""
    if alignment.normals is not None:
        return np.abs(np.sum(alignment.normals * alignment.displacement, axis=1))
    return np.linalg.norm(alignment.displacement, axis=1)
