"""Read marks from mesh files, with their originals or without."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from jaxmark.alignment.pairing import pair
from jaxmark.alignment.result import Align
from jaxmark.app.diagnosis import diagnose, is_original
from jaxmark.app.dossier import Case, save_dossier, save_report
from jaxmark.app.mark_files import pick
from jaxmark.app.output import FileOutcome, detection_text, detection_values
from jaxmark.app.process import release_programs
from jaxmark.app.progress import Doing, quietly
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_scene, load_skin
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.reading import best_of, try_each
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.everyday import alternatives, detect_scene, read_blind, with_blind
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.nonblind import Alternatives
from jaxmark.watermark.record import Record, SceneRecord, TimestampedCommitment, load_record
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, DEFAULT_SCHEME


@dataclass
class FileReader:
    """Reads files as `detect` reads meshes; an original that several suspects share is prepared once."""

    key: Key
    bits: int | None
    message: bytes | None
    schemes: tuple[str, ...] = ()  # names of the schemes of marks without a record; several if they were made together
    align: Align = "auto"
    alpha: float = 1e-6  # largest false-positive probability of a detection
    commitment: TimestampedCommitment | None = None  # that holds the records' digests
    obtained: str = ""  # when and where the suspects were got
    diagnoses: bool = True  # whether to look for a mistake where nothing is detected, which takes several times as long
    meshes: Sequence[str] = ()  # names of the original's meshes to read, of a blind mark the suspect's; by default all
    shows_charges: bool = False  # whether the text says what each choice cost
    doing: Doing = quietly  # is told what begins
    _last: tuple[tuple[Path, str | None], Alternatives] | None = field(default=None, init=False, repr=False)

    def read(
        self,
        suspect: Path,
        original: Path | None,
        record: Path | None = None,
        report: Path | None = None,
        dossier: Path | None = None,
    ) -> FileOutcome:
        """Read one file.

        Args:
            suspect: the suspect's mesh file.
            original: the unmarked mesh's file; None to read a blind mark.
            record: file of the mark's record.
            report: folder for a picture of the alignment.
            dossier: folder for the dossier of a detection, see `jaxmark.app.dossier`.

        Raises:
            JaxmarkError: see `detect`; also if the record is not under the commitment, or a dossier is asked for an
                estimate.
        """
        known = None if record is None else load_record(record)
        if original is None:
            return self._outcome(self._read_blind(suspect, known), suspect, known)
        if known is not None and self.schemes and self.schemes[0] != known.scheme:
            raise JaxmarkError(f"--scheme {self.schemes[0]} contradicts the record, which says {known.scheme}.")
        self.doing(f"reading {suspect} and {original}")
        meshes = self._pick(suspect, original, known)
        if meshes is None:
            if report is not None or dossier is not None:
                raise JaxmarkError("Reports and dossiers are about one mesh; pick it by --mesh.")
            if len(self.schemes) > 1:
                raise JaxmarkError("Several schemes are read in files of one mesh; pick it by --mesh.")
            return self._outcome(self._read_scene(suspect, original, known), suspect, known)
        mesh, original_mesh, known = meshes
        self.doing(f"preparing {original}")
        marks = self._alternatives(original_mesh, original, known, mesh)
        self.doing(f"aligning {suspect}, and looking for a mark in it")
        found, mark = marks.read(mesh, self.message, align=self.align)
        together = [BLIND_SCHEMES[name] for name in self.schemes[1:]]
        found = with_blind(found, together, mesh, self.key, mark.bits, self.message)
        if report is not None:
            self.doing("drawing the report")
            save_report(report, mark.original, mesh, found.registration)
        detected, notes = found.detected(self.alpha, allow_estimate=True), found.notes
        if self.diagnoses and record is None and found.message is None and not detected and not notes:
            self.doing("nothing detected, looking for a mistake")
            notes = diagnose(mesh, mark, self.align)
        if not detected and found.registration.deformed is not None and _has_skin(original):
            notes += ("If it is in another pose of the original's skeleton, `jaxmark unpose` undoes that.",)
        outcome = self._outcome(found._replace(notes=notes), suspect, known)
        if dossier is not None:
            self.doing("making the dossier")
            timestamped = outcome.values.get("log10_p_timestamped")
            files = (suspect, original, record)
            case = Case(
                *files, mesh, mark, found, self.message is not None, self.commitment, timestamped, self.obtained
            )
            save_dossier(dossier, case)
            outcome.values["dossier"] = str(dossier)
        return outcome

    def _outcome(self, found: Detection, suspect: Path, record: Record | SceneRecord | None) -> FileOutcome:
        """What was detected, with what a commitment adds to it."""
        timestamped = None
        if record is not None and self.commitment is not None:
            charges = self.commitment.charges(record, claimed=self.message is not None)
            timestamped = found.evidence.charged(*charges).log10_p
        digest = None if record is None else record.digest()
        values = detection_values(found, self.alpha, suspect, self.obtained, timestamped, digest)
        text = detection_text(found, self.alpha, timestamped, charges=self.shows_charges)
        return FileOutcome(values, text, found.detected(self.alpha, allow_estimate=True))

    def _read_blind(self, suspect: Path, record: Record | SceneRecord | None) -> Detection:
        """Read a file without its original: as one mesh, or each of its meshes, whose number is charged."""
        records = [None] if record is None else list(record.meshes.values())
        for one in records:
            if one is not None and one.scheme not in BLIND_SCHEMES:
                raise JaxmarkError(f"The record says that the scheme is {one.scheme!r}, which needs --original.")
        self.doing(f"reading {suspect}")
        scene = pick(load_scene(suspect), self.meshes, suspect)
        several = len(scene.meshes) > 1
        candidates = scene.meshes if several else {"": load_mesh(suspect)}
        self.doing(f"looking for a mark in {suspect}, without an original")
        named = [BLIND_SCHEMES[name] for name in self.schemes if name in BLIND_SCHEMES]
        schemes = named if len(named) == 1 and record is None else []

        def read(mesh: Mesh, record: Record | None) -> Detection:
            release_programs()
            return read_blind(mesh, self.key, bits=self.bits, message=self.message, record=record, schemes=schemes)

        found = list(try_each(partial(read, mesh, one) for mesh in candidates.values() for one in records))
        best = best_of(found, ledger.PARTS, len(candidates) * len(records))
        return self._count_alone(best, found, len(candidates)) if several else best

    def _pick(
        self, suspect: Path, original: Path, record: Record | SceneRecord | None
    ) -> tuple[Mesh, Mesh, Record | None] | None:
        """The suspect's mesh, the original's and its record; None if there are several, which are read at once."""
        if isinstance(record, Record):  # of the whole file
            return load_mesh(suspect), load_mesh(original), record
        originals, record = self._originals(original, record)
        if len(originals) != 1:
            return None
        ((name, mesh),) = originals.items()
        suspects = load_scene(suspect).meshes
        other = pair(originals, suspects).get(name)
        found = load_mesh(suspect) if other is None else suspects[other]
        return found, mesh, None if record is None else record.meshes[name]

    def _originals(self, original: Path, record: SceneRecord | None) -> tuple[dict[str, Mesh], SceneRecord | None]:
        """The meshes of an original that were picked, and their records."""
        originals = dict(pick(load_scene(original), self.meshes, original).meshes)
        if record is None:
            return originals, None
        picked = {name: one for name, one in record.meshes.items() if not self.meshes or name in self.meshes}
        if not picked:
            raise JaxmarkError(f"The record is of {', '.join(map(repr, record.meshes))}, none of which was picked.")
        return {name: mesh for name, mesh in originals.items() if name in picked}, SceneRecord(picked)

    def _read_scene(self, suspect: Path, original: Path, record: Record | SceneRecord | None) -> Detection:
        """Read the meshes of a file at once."""
        assert not isinstance(record, Record)
        originals, record = self._originals(original, record)
        self.doing(f"looking for marks in {len(originals)} meshes of {suspect}")
        found = detect_scene(
            load_scene(suspect).meshes,
            originals=originals,
            key=self.key,
            record=record,
            bits=self.bits,
            message=self.message,
            scheme=self.schemes[0] if self.schemes else DEFAULT_SCHEME,
            align=self.align,
            after=release_programs,
        )
        return self._count_alone(found, list(found.parts.values()), len(found.parts) + len(found.skipped))

    def _count_alone(self, found: Detection, alone: Sequence[Detection], meshes: int) -> Detection:
        """Note how many of several meshes prove the mark alone."""
        proving = sum(one.detected(self.alpha, allow_estimate=True) for one in alone)
        return found._replace(notes=(*found.notes, f"{proving} of {meshes} meshes prove it alone."))

    def _alternatives(self, mesh: Mesh, original: Path, record: Record | None, suspect: Mesh) -> Alternatives:
        place = original, None if record is None else record.digest()
        if self._last is None or self._last[0] != place:
            bits = self.bits
            if bits is None and record is None and self.message is not None:
                bits = 8 * len(self.message)
            scheme = self.schemes[0] if self.schemes else DEFAULT_SCHEME
            try:
                marks = alternatives(make_marker(mesh, self.key, bits=bits, record=record, scheme=scheme), scheme)
            except JaxmarkError as error:
                if record is not None and is_original(suspect, record, self.key):
                    raise JaxmarkError(f"{error} The suspect is that mesh: exchange the two files.") from None
                raise
            self._last = place, marks
        return self._last[1]


def _has_skin(path: Path) -> bool:
    """Whether a file has a skin by which a pose can be undone."""
    try:
        load_skin(path)
    except JaxmarkError:
        return False
    return True
