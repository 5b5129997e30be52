"""Mark and read mesh files, one at a time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from jaxmark import distortion
from jaxmark.alignment.alignment import Align
from jaxmark.alignment.original import shift_of
from jaxmark.app.dossier import Case, file_hash, save_dossier
from jaxmark.app.mistakes import guess_mistakes, is_original
from jaxmark.app.report import save_report
from jaxmark.errors import JaxmarkError
from jaxmark.files import SUFFIXES, load_mesh, load_texture, save_mesh
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.budget import Visibility
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.deposit import Deposit
from jaxmark.watermark.marking import Detection, Marker, detect_any, make_marker, make_markers
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes import DEFAULT_SCHEME
from jaxmark.watermark.tracing import make_tracer


class Told(NamedTuple):
    """The outcome for one file."""

    answer: dict[str, Any]  # for programs: values for JSON, except that numbers may not be finite
    said: str  # for people: one sentence
    done: bool = True  # False if nothing was detected, or the file was refused


def mesh_files(folder: Path) -> list[Path]:
    """List the files of a folder that have a mesh format's suffix, by name; hidden files are left out.

    Raises:
        JaxmarkError: if there is no such file.
    """
    found = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    if not found:
        raise JaxmarkError(f"The folder {folder} has no mesh file ({', '.join(SUFFIXES)}).")
    return found


def mark_file(
    original: Path,
    marked: Path,
    record: Path,
    *,
    key: Key,
    message: bytes | None = None,
    recipient: str | None = None,
    budget: float | None = None,
    limits: Mapping[str, float] | None = None,
    visibility: Visibility | None = None,
    noise: float,
    scheme: str = DEFAULT_SCHEME,
) -> Told:
    """Mark a mesh file, and write the marked file and its record, both or neither.

    Args:
        original: the mesh file to mark.
        marked: path of the marked file, with the same suffix.
        record: path of the mark's record.
        key: the key to mark with.
        message: the message to write; None if `recipient` is given.
        recipient: identifier of the recipient of this copy; None if `message` is given.
        budget: see `embed`.
        limits: see `embed`.
        visibility: see `embed`.
        noise: see `embed`.
        scheme: name of the scheme.

    Raises:
        JaxmarkError: see `embed`; also if the mark does not read from the written file, whose numbers are rounded.
    """
    mesh = load_mesh(original)
    if (message is None) == (recipient is None):
        raise JaxmarkError("Give either --message or --recipient.")
    marker = None
    if message is not None:
        marker = make_marker(mesh, key, bits=8 * len(message), scheme=scheme)
        result, info = marker.embed(message, budget, limits=limits, visibility=visibility, noise=noise, read_back=False)
        prepared = marker.original
        said, reads = f"{info.record.bits} bits", lambda mesh: marker.reads(mesh, message)
    else:
        if scheme != DEFAULT_SCHEME:
            raise JaxmarkError(f"Fingerprints are carried by the scheme {DEFAULT_SCHEME!r}, not {scheme!r}.")
        tracer, name = make_tracer(mesh, key), str(recipient)
        result, info = tracer.fingerprint(name, budget, limits=limits, visibility=visibility)
        prepared = tracer.marker.original
        said, reads = f"fingerprint of {recipient}", lambda mesh: tracer.finds(mesh, name)
    with replacing(marked) as draft, replacing(record) as record_draft:
        save_mesh(result, draft, like=original)
        # The mark must read from the written file, whose numbers are rounded.
        written = load_mesh(draft)
        if not reads(written):
            if marker is not None and message is not None:
                marker.check(result, message)
            raise JaxmarkError(
                f"Rounded to the numbers of {original}, the mark no longer reads; use a larger budget, or a file with"
                " more digits."
            )
        write_atomically(record_draft, info.record.to_json().encode())
    texture = load_texture(original)
    drift = None if texture is None else distortion.texture_drift(mesh, written, texture)
    change = distortion.DisplacementSize.of(shift_of(prepared, written)[prepared.used])
    answer = {
        "rms": change.rms,
        "max": change.max,
        "bits": info.record.bits,
        "scheme": info.record.scheme,
        "content": info.record.content,
        "texture_drift": drift,
        "record": str(record),
        "marked": str(marked),
    }
    text = f"{said} → {marked}, RMS {change.rms:.3g} and max {change.max:.3g} of the diagonal; record → {record}"
    if drift is not None:
        text += f"; a texture of 2,048 x 2,048 drifts by {drift:.2g} texels"
    return Told(answer, text)


@dataclass
class FileReader:
    """Reads files as `detect` reads meshes; an original that several suspects share is prepared once."""

    key: Key
    bits: int | None
    message: bytes | None
    scheme: str | None  # name of the scheme for marks without a record
    how: Align  # see `align`
    alpha: float  # largest false-positive probability of a detection
    deposit: Deposit | None = None  # that holds the records' digests
    obtained: str = ""  # when and where the suspects were got
    guesses: bool = True  # whether to look for a mistake where nothing is detected, which takes several times as long
    _last: tuple[tuple[Path, Path | None], list[Marker]] | None = field(default=None, init=False, repr=False)

    def read(
        self,
        suspect: Path,
        original: Path,
        record: Path | None = None,
        report: Path | None = None,
        dossier: Path | None = None,
    ) -> Told:
        """Read one file.

        Args:
            suspect: the suspect's mesh file.
            original: the unmarked mesh's file.
            record: file of the mark's record.
            report: folder for a picture of the alignment.
            dossier: folder for the dossier of a detection, see `jaxmark.app.dossier`.

        Raises:
            JaxmarkError: see `detect`; also if the record is not in the deposit, or a dossier is asked for an estimate.
        """
        mesh = load_mesh(suspect)
        markers = self._markers(original, record, mesh)
        found = detect_any(markers, mesh, self.message, align=self.how)
        marker = next(marker for marker in markers if marker.choices.version == found.version)
        aligned = found.alignment
        if report is not None:
            save_report(report, marker.original, mesh, aligned)
        detected = found.detected(self.alpha)
        remarks = found.remarks
        if self.guesses and record is None and found.message is None and not detected and not remarks:
            remarks = guess_mistakes(mesh, marker, self.how)
        answer = {
            "detected": detected,
            "log10_p": found.log10_p,
            "log10_p_undated": found.log10_p_undated,
            "log10_p_fitted": found.log10_p_fitted,
            "proof": not found.doubts,
            "doubts": list(found.doubts),
            "remarks": list(remarks),
            "version": found.version,
            "suspect_sha256": file_hash(suspect),
            "obtained": self.obtained or None,
            "message": None if found.message is None else found.message.hex(),
            "scores": [float(score) for score in found.scores],
            "coverage": found.coverage,
            "alignment": {
                "method": aligned.method,
                "pose": {"matrix": aligned.pose.matrix.tolist(), "shift": aligned.pose.shift.tolist()},
                "residual": aligned.residual,
                "seconds": aligned.seconds,
            },
        }
        dated = None
        if marker.record is not None:
            answer["record_digest"] = marker.record.digest()
            if self.deposit is not None:
                dated = self.deposit.log10_p(found.log10_p, marker.record, claimed=self.message is not None)
                answer["log10_p_deposited"] = dated
        if dossier is not None:
            save_dossier(
                dossier,
                Case(
                    suspect,
                    original,
                    record,
                    mesh,
                    marker,
                    found,
                    self.message is not None,
                    self.deposit,
                    dated,
                    self.obtained,
                ),
            )
            answer["dossier"] = str(dossier)
        return Told(answer, describe(found, detected, self.alpha, dated, remarks), detected)

    def _markers(self, original: Path, record_file: Path | None, suspect: Mesh) -> list[Marker]:
        if self._last is None or self._last[0] != (original, record_file):
            record = None if record_file is None else Record.load(record_file)
            if record is not None and self.scheme not in (None, record.scheme):
                raise JaxmarkError(f"--scheme {self.scheme} contradicts the record, which says {record.scheme}.")
            bits = self.bits
            if bits is None and record is None and self.message is not None:
                bits = 8 * len(self.message)
            scheme = self.scheme or DEFAULT_SCHEME
            mesh = load_mesh(original)
            try:
                markers = make_markers(mesh, self.key, bits=bits, record=record, scheme=scheme)
            except JaxmarkError as error:
                if record is not None and is_original(suspect, record, self.key):
                    raise JaxmarkError(f"{error} The suspect is that mesh: exchange the two files.") from None
                raise
            self._last = (original, record_file), markers
        return self._last[1]


def power(log10_p: float) -> str:
    """A bound as a power of ten, which rounding makes no smaller."""
    return f"10^{math.ceil(10 * log10_p - 1e-9) / 10 + 0.0:.1f}"


def describe(found: Detection, detected: bool, alpha: float, dated: float | None, remarks: Sequence[str]) -> str:
    """What was found, in words."""
    read = f"message {found.message.hex()}" if found.message is not None else "no message could be read"
    said = f"{'detected' if detected else 'nothing detected'}: {read}; "
    if found.doubts:
        said += f"false-positive probability about {power(found.log10_p)}, an estimate: {'; '.join(found.doubts)}"
    else:
        said += (
            f"false-positive probability at most {power(found.log10_p)} if key, original, message and record were fixed"
            f" before the suspect existed, {power(found.log10_p_undated)} if nothing dates them"
        )
        if dated is not None:
            said += f", {power(dated)} if the deposit is older than the suspect"
    return " ".join([f"{said} (--alpha {alpha:g})", *remarks])
