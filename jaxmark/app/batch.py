"""Mark and read single mesh files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from jaxmark import distortion
from jaxmark.alignment.alignment import Align
from jaxmark.alignment.original import shift_of
from jaxmark.app.dossier import Case, file_hash, save_dossier
from jaxmark.app.mistakes import guess_mistakes, is_original
from jaxmark.app.programs import release_programs
from jaxmark.app.progress import Doing, quietly
from jaxmark.app.report import save_report
from jaxmark.app.scene import mark_scene, pick
from jaxmark.app.telling import Told, describe, told_payload, told_survival
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_scene, load_skin, load_texture, save_mesh
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.deposit import Deposit
from jaxmark.watermark.everyday import AnyScheme, also, name_of, prepare
from jaxmark.watermark.marking import Markers, Survival, make_markers
from jaxmark.watermark.perception.budget import Visibility
from jaxmark.watermark.record import Record
from jaxmark.watermark.scenes import SceneDetection, SceneRecord, detect_scene, load_record, pair
from jaxmark.watermark.schemes.scheme import DEFAULT_SCHEME, LADDER
from jaxmark.watermark.tracing.tracer import make_tracer


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
    noise: float | None,
    scheme: AnyScheme = DEFAULT_SCHEME,
    meshes: Sequence[str] = (),
    doing: Doing = quietly,
) -> Told:
    """Mark a mesh file, and write the marked file and its record, both or neither.

    Args:
        original: the mesh file to mark.
        marked: path of the marked file, with the same suffix.
        record: path of the mark's record.
        key: the key to mark with.
        message: the message to write, empty for a presence mark; None if `recipient` is given.
        recipient: identifier of the recipient of this copy; None if `message` is given.
        budget: see `embed`.
        limits: see `embed`.
        visibility: see `embed`.
        noise: see `embed`.
        scheme: see `embed`.
        meshes: names of the meshes to mark, of several in the file; by default all that can carry the message.
        doing: is told what begins.

    Raises:
        JaxmarkError: see `embed`; also if the mark does not read from the written file, whose numbers are rounded.
    """
    if (message is None) == (recipient is None):
        raise JaxmarkError("Give --message, --presence or --recipient, one of them.")
    doing(f"reading {original}")
    scene = pick(load_scene(original), meshes, original)
    if len(scene.meshes) + len(scene.left) > 1:
        if message is None:
            raise JaxmarkError("Fingerprints are for files of one mesh; save the meshes of this one apart.")
        try:
            return mark_scene(
                original,
                marked,
                record,
                scene,
                message,
                key=key,
                budget=budget,
                limits=limits,
                visibility=visibility,
                noise=noise,
                scheme=scheme,
                doing=doing,
            )
        except JaxmarkError:
            # The objects of an OBJ file lie in the same coordinates, and together they may carry what none can alone.
            if original.suffix.lower() != ".obj" or meshes:
                raise
    mesh, marker = load_mesh(original), None
    doing(f"preparing {original}")
    if message is not None:
        marker = prepare(mesh, key, 8 * len(message), scheme)
        marker = marker.suited(budget, limits=limits, visibility=visibility, noise=noise)
        doing(f"embedding {original}")
        result, info = marker.embed(message, budget, limits=limits, visibility=visibility, noise=noise, read_back=False)
        marker = marker.with_record(info.record)
        prepared, said = marker.original, told_payload(info.record.bits)
        tries = partial(marker.tried, message=message, predicted=info.survives)
    else:
        if scheme != DEFAULT_SCHEME:
            raise JaxmarkError(f"Fingerprints are carried by the scheme {DEFAULT_SCHEME!r}, not {scheme!r}.")
        tracer, name = make_tracer(mesh, key), str(recipient)
        doing(f"embedding {original}")
        result, info = tracer.fingerprint(name, budget, limits=limits, visibility=visibility)
        prepared, said = tracer.marker.original, f"fingerprint of {recipient}"
        tries = partial(tracer.finds, recipient=name)
    with replacing(marked) as draft, replacing(record) as record_draft:
        doing(f"writing {marked}, and trying what the mark survives")
        save_mesh(result, draft, like=original)
        # The mark must read from the written file, whose numbers are rounded.
        written = load_mesh(draft)
        survives = tries(written)
        if not survives:
            if marker is not None and message is not None:
                marker.check(result, message)
            raise JaxmarkError(
                f"Rounded to the numbers of {original}, the mark no longer reads; use a larger budget, or a file with"
                " more digits."
            )
        write_atomically(record_draft, info.record.to_json().encode())
    doing("measuring what was moved")
    texture = load_texture(original)
    drift = None if texture is None else distortion.texture_drift(mesh, written, texture)
    change = distortion.DisplacementSize.of(shift_of(prepared, written)[prepared.used])
    answer = {
        "rms": change.rms,
        "max": change.max,
        "bits": info.record.bits,
        "scheme": name_of(scheme),
        "parameters": dict(info.record.parameters),
        "content": info.record.content,
        "survives": survives._asdict() if isinstance(survives, Survival) else None,
        "texture_drift": drift,
        "record": str(record),
        "marked": str(marked),
    }
    text = f"{said} → {marked}, RMS {change.rms:.3g} and max {change.max:.3g} of the diagonal; record → {record}"
    if isinstance(survives, Survival):
        text += f"; it survives {told_survival(survives)}"
    if (band := info.record.parameters.get("passband")) in LADDER[1:]:
        text += f"; so faint a mark is written in the pass band {band!r}, which the record says"
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
    meshes: Sequence[str] = ()  # names of the original's meshes to read; by default all
    also: Sequence[BlindScheme] = ()  # schemes of marks that are read besides, to unite what all prove
    doing: Doing = quietly  # is told what begins
    _last: tuple[tuple[Path, str | None], Markers] | None = field(default=None, init=False, repr=False)

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
        known = None if record is None else load_record(record)
        if known is not None and self.scheme not in (None, scheme_of(known)):
            raise JaxmarkError(f"--scheme {self.scheme} contradicts the record, which says {scheme_of(known)}.")
        self.doing(f"reading {suspect} and {original}")
        case = self._case(suspect, original, known)
        if isinstance(case, SceneDetection):
            if report is not None or dossier is not None:
                raise JaxmarkError("Reports and dossiers are about one mesh; pick it by --mesh.")
            if self.also:
                raise JaxmarkError("Several schemes are read in files of one mesh; pick it by --mesh.")
            return self._tell_scene(case, known, suspect)
        mesh, original_mesh, known = case
        self.doing(f"preparing {original}")
        markers = self._markers(original_mesh, original, known, mesh)
        self.doing(f"aligning {suspect}, and looking for a mark in it")
        found, marker = markers.detect(mesh, self.message, align=self.how)
        if self.also:
            found = also(found, self.also, mesh, self.key, marker.bits, self.message)
        aligned = found.alignment
        if report is not None:
            self.doing("drawing the report")
            save_report(report, marker.original, mesh, aligned)
        detected = found.detected(self.alpha)
        remarks = found.remarks
        if self.guesses and record is None and found.message is None and not detected and not remarks:
            self.doing("nothing detected, looking for a mistake")
            remarks = guess_mistakes(mesh, marker, self.how)
        if not detected and found.alignment.bent is not None and _has_skin(original):
            remarks += ("If it is in another pose of the original's skeleton, `jaxmark unpose` undoes that.",)
        answer = {
            "detected": detected,
            "log10_p": found.log10_p,
            "log10_p_undated": found.log10_p_undated,
            "log10_p_fitted": found.log10_p_fitted,
            "log10_p_unfloored": found.log10_p_unfloored,
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
            self.doing("making the dossier")
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

    def _case(
        self, suspect: Path, original: Path, record: Record | SceneRecord | None
    ) -> tuple[Mesh, Mesh, Record | None] | SceneDetection:
        """What is to be read: a suspect's mesh, the original's and its record; or several, which are read at once."""
        if isinstance(record, Record):  # of the whole file
            return load_mesh(suspect), load_mesh(original), record
        originals = pick(load_scene(original), self.meshes, original).meshes
        if record is not None:
            picked = {name: one for name, one in record.meshes.items() if not self.meshes or name in self.meshes}
            if not picked:
                raise JaxmarkError(f"The record is of {', '.join(map(repr, record.meshes))}, none of which was picked.")
            record = SceneRecord(picked)
            originals = {name: mesh for name, mesh in originals.items() if name in picked}
        suspects = load_scene(suspect).meshes
        if len(originals) == 1:
            ((name, mesh),) = originals.items()
            other = pair(originals, suspects).get(name)
            found = load_mesh(suspect) if other is None else suspects[other]
            return found, mesh, None if record is None else record.meshes[name]
        self.doing(f"looking for marks in {len(originals)} meshes of {suspect}")
        return detect_scene(
            suspects,
            originals=originals,
            key=self.key,
            record=record,
            bits=self.bits,
            message=self.message,
            scheme=self.scheme or DEFAULT_SCHEME,
            how=self.how,
            after=release_programs,
        )

    def _tell_scene(self, found: SceneDetection, record: Record | SceneRecord | None, suspect: Path) -> Told:
        """Tell what the meshes of a file prove."""
        united, detected = found.united, found.detected(self.alpha)
        answer = {
            "detected": detected,
            "log10_p": united.log10_p,
            "log10_p_undated": united.log10_p_undated,
            "log10_p_fitted": united.log10_p_fitted,
            "log10_p_unfloored": united.log10_p_unfloored,
            "proof": not united.doubts,
            "doubts": list(united.doubts),
            "remarks": list(united.remarks),
            "version": united.version,
            "suspect_sha256": file_hash(suspect),
            "obtained": self.obtained or None,
            "message": None if united.message is None else united.message.hex(),
            "meshes": {
                name: {
                    "detected": one.detected(self.alpha),
                    "log10_p": one.log10_p,
                    "log10_p_unfloored": one.log10_p_unfloored,
                    "message": None if one.message is None else one.message.hex(),
                    "coverage": one.coverage,
                    "method": one.alignment.method,
                    "residual": one.alignment.residual,
                }
                for name, one in found.meshes.items()
            },
            "left": dict(found.left),
        }
        dated = None
        if record is not None:
            answer["record_digest"] = record.digest()
            if self.deposit is not None:
                dated = self.deposit.log10_p(united.log10_p, record, claimed=self.message is not None)
                answer["log10_p_deposited"] = dated
        alone = sum(one.detected(self.alpha) for one in found.meshes.values())
        remarks = [*united.remarks, f"{alone} of {len(found.meshes) + len(found.left)} meshes prove it alone."]
        return Told(answer, describe(united, detected, self.alpha, dated, remarks), detected)

    def _markers(self, mesh: Mesh, original: Path, record: Record | None, suspect: Mesh) -> Markers:
        place = original, None if record is None else record.digest()
        if self._last is None or self._last[0] != place:
            bits = self.bits
            if bits is None and record is None and self.message is not None:
                bits = 8 * len(self.message)
            scheme = self.scheme or DEFAULT_SCHEME
            try:
                markers = make_markers(mesh, self.key, bits=bits, record=record, scheme=scheme)
            except JaxmarkError as error:
                if record is not None and is_original(suspect, record, self.key):
                    raise JaxmarkError(f"{error} The suspect is that mesh: exchange the two files.") from None
                raise
            self._last = place, markers
        return self._last[1]


def _has_skin(path: Path) -> bool:
    """Whether a file has a skin by which a pose can be undone."""
    try:
        load_skin(path)
    except JaxmarkError:
        return False
    return True


def scheme_of(record: Record | SceneRecord) -> str:
    """Name of the scheme of a record."""
    return record.scheme if isinstance(record, Record) else next(iter(record.meshes.values())).scheme
