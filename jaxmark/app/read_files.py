"""Read marks from mesh files, blind or non-blind."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path

from jaxmark.alignment.pairing import pair
from jaxmark.alignment.result import Align
from jaxmark.app.diagnosis import diagnose, is_original
from jaxmark.app.dossier import Case, missing_proof, save_dossier, save_report
from jaxmark.app.mark_files import pick
from jaxmark.app.output import VERDICTS, FileOutcome, Status, detection_lines, detection_status, detection_values
from jaxmark.app.progress import Doing, quietly
from jaxmark.errors import AlignmentError, JaxmarkError, require
from jaxmark.files import Scene, limits, load_mesh, load_scene, load_skin
from jaxmark.files.programs import release_programs
from jaxmark.files.typed import find_name, rename_like
from jaxmark.geometry.mesh import Mesh, digest
from jaxmark.watermark.blind.reading import best_of, try_each
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.coding.message import DEFAULT_BITS
from jaxmark.watermark.everyday import EQUALS_ANOTHER, alternatives, detect_scene, read_blind, with_blind
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.nonblind import Alternatives, Charges
from jaxmark.watermark.record import Record, SceneRecord, TimestampedCommitment, check_scheme, load_record
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, DEFAULT_SCHEME, USUAL_BLIND_SCHEMES


@dataclass
class FileReader:
    """A reader of mesh files, which detects as `detect` does; an original of several suspects is prepared once."""

    key: Key
    bits: int | None
    message: bytes | None
    schemes: tuple[str, ...] = ()  # names of the schemes, if there is no record; several if a mesh was marked by all
    align: Align = "auto"
    alpha: float = 1e-6  # largest false-positive probability of a detection
    commitment: TimestampedCommitment | None = None  # commitment that contains the records' digests
    obtained: str = ""  # when and where the suspects were obtained
    diagnoses: bool = True  # whether to diagnose suspects without a detection, which takes several times as long
    charges: Charges = ()  # for choices that were made before, such as that of the original from a catalogue
    meshes: Sequence[str] = ()  # names of the meshes to read: of the original, or of a suspect read blind; default all
    shows_charges: bool = False  # whether the text lists what each choice cost
    doing: Doing = quietly  # progress callback, called with a description of each step that begins
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

        Returns:
            The outcome; if a dossier is requested and the detection proves nothing, it says so, and nothing is written.
            If the suspect cannot be aligned with the original, nothing is detected.

        Raises:
            JaxmarkError: see `detect`; also if the commitment does not contain the record.
        """
        try:
            return self._read(suspect, original, record, report, dossier)
        except AlignmentError as error:
            values = {"detected": False, "estimate": False, "message": None, "log10_p": 0.0, "log10_p_uncommitted": 0.0}
            values["notes"] = [str(error)]
            return FileOutcome(values, (f"{VERDICTS[Status.NOTHING]}: {error}",), Status.NOTHING)

    def _read(
        self, suspect: Path, original: Path | None, record: Path | None, report: Path | None, dossier: Path | None
    ) -> FileOutcome:
        """Read one file, see `read`.

        Raises:
            AlignmentError: if the suspect cannot be aligned with the original.
        """
        loaded = None if record is None else load_record(record)
        # Refusals come before meshes are read.
        caveats = () if loaded is None else loaded.caveats(self.key)
        if loaded is not None and self.commitment is not None:
            self.commitment.charges(loaded, claimed=self.message is not None)
        for folder in (report, dossier):
            if folder is not None and folder.exists() and not folder.is_dir():
                raise JaxmarkError(f"{folder} is a file; name a folder.")
            if folder is not None:
                require("matplotlib", "plot")
        if dossier is not None:
            require("jinja2", "plot")
        check_scheme(loaded, self.schemes[0] if self.schemes else None)
        if loaded is not None and (loaded.scheme in BLIND_SCHEMES) != (original is None):
            advice = (
                "blind; leave out --original"
                if original is not None
                else "read with the original; give --original, or leave out --record, if the mesh also has a blind mark"
            )
            raise JaxmarkError(f"{record}: the mark of this record is {advice}.")
        if original is None:
            return self._outcome(self._read_blind(suspect, loaded, caveats), suspect, loaded)
        self.doing(f"reading {suspect} and {original}")
        if isinstance(loaded, Record):  # a record of the whole file
            if self.meshes:
                raise JaxmarkError(f"{record} is the record of a whole file; leave out --mesh.")
            name, original_mesh, marked = "", load_mesh(original), loaded.meshes
        else:
            scene = load_scene(original)
            if loaded is not None:
                named = partial(rename_like, names=loaded.meshes)
                scene = Scene(named(scene.meshes), named(scene.skipped))
            name, *others = self._names(scene, original, loaded)
            if others:
                if report is not None or dossier is not None:
                    raise JaxmarkError("--report and --dossier need one mesh, not several; select one by --mesh.")
                if len(self.schemes) > 1:
                    raise JaxmarkError("Several schemes can only be read from one mesh; select it by --mesh.")
                return self._outcome(self._read_scene(suspect, scene, loaded), suspect, loaded)
            original_mesh, marked = scene.meshes[name], (loaded or scene).meshes
        # A suspect that cannot be read is refused before the original is prepared, which takes long.
        meshes = {"": load_mesh(suspect)} if isinstance(loaded, Record) else load_scene(suspect).meshes
        self.doing(f"preparing {original}")
        marks = self._alternatives(original_mesh, original, None if loaded is None else loaded.meshes[name], suspect)
        if len(meshes) == 1:
            (mesh,) = meshes.values()
        else:
            chosen = pair({name: marks.first.original.marked_order}, meshes).get(name)
            mesh = load_mesh(suspect) if chosen is None else meshes[chosen]
        self.doing(f"aligning {suspect} and reading it")
        detection, mark = marks.read(mesh, self.message, align=self.align)
        blind_schemes = [BLIND_SCHEMES[name] for name in self.schemes[1:]]
        detection = with_blind(detection, blind_schemes, mesh, self.key, mark, self.message)
        charges = *self.charges, *ledger.selection(1, len(marked))
        detection = _with_caveats(detection._replace(evidence=detection.evidence.charged(*charges)), caveats)
        if report is not None:
            self.doing("drawing the report")
            save_report(report, mark.original, mesh, detection.registration)
        nothing, notes = detection_status(detection, self.alpha) is Status.NOTHING, detection.notes
        if self.diagnoses and record is None and detection.message is None and nothing and not notes:
            self.doing("nothing detected, diagnosing")
            notes = diagnose(mesh, mark, self.align)
        if nothing and detection.registration.deformed is not None and _has_skin(original):
            notes += ("If the suspect is in another pose of the original's skeleton, remove it by `jaxmark unpose`.",)
        outcome = self._outcome(detection._replace(notes=notes), suspect, loaded)
        if dossier is not None and (reason := missing_proof(detection, self.alpha)):
            outcome.values["dossier"] = None
            return outcome._replace(lines=(*outcome.lines, reason))
        if dossier is not None:
            self.doing("making the dossier")
            timestamped = outcome.values.get("log10_p_timestamped")
            files = (suspect, original, record)
            case = Case(
                *(*files, mesh, mark, detection, self.message is not None, self.commitment, timestamped),
                obtained=self.obtained,
                meshes=self.meshes,
                schemes=self.schemes,
            )
            save_dossier(dossier, case)
            outcome.values["dossier"] = str(dossier)
        return outcome

    def _outcome(self, detection: Detection, suspect: Path, record: Record | SceneRecord | None) -> FileOutcome:
        """Describe a detection, with the bound that holds if the commitment is older than the suspect."""
        timestamped = None
        if record is not None and self.commitment is not None:
            charges = self.commitment.charges(record, claimed=self.message is not None)
            timestamped = detection.evidence.charged(*charges)
        digest = None if record is None else record.digest()
        values = detection_values(detection, self.alpha, suspect, self.obtained, timestamped, digest)
        lines = detection_lines(detection, self.alpha, timestamped, charges=self.shows_charges)
        return FileOutcome(values, lines, detection_status(detection, self.alpha))

    def _read_blind(self, suspect: Path, record: Record | SceneRecord | None, caveats: tuple[str, ...]) -> Detection:
        """Read a file without its original; if it has several meshes, read the selected ones, or else the largest.

        The charge is for all meshes that could have been selected, because a user may try one after another.
        """
        # Equal meshes and equal records give equal readings: they are read, and charged, once.
        records = [None] if record is None else list({each.digest(): each for each in record.meshes.values()}.values())
        self.doing(f"reading {suspect}")
        scene = load_scene(suspect)
        selected = pick(scene, self.meshes, suspect).meshes
        several = len(scene.meshes) > 1
        meshes = scene.meshes if several else {"": load_mesh(suspect)}
        largest = sorted(
            (name for name, mesh in meshes.items() if len(mesh.vertices) >= limits.BLIND_POINTS),
            key=lambda name: -len(meshes[name].vertices),
        )
        readable = _distinct(largest, meshes)
        names = _distinct([name for name in largest if name in selected], meshes) if several else readable
        if not names:
            raise JaxmarkError(
                f"{suspect}: a blind mark needs a mesh of {limits.BLIND_POINTS} points or more, and there is none"
                f"{' among the selected ones' if self.meshes else ''}; give --original."
            )
        if not self.meshes:
            names = names[: limits.BLIND_MESHES]
        self.doing(f"reading {suspect} without an original")
        blind_schemes = [BLIND_SCHEMES[name] for name in self.schemes if name in BLIND_SCHEMES]
        schemes = blind_schemes if len(blind_schemes) == 1 and record is None else []

        each: dict[str, list[Detection]] = {name: [] for name in names}

        def read(name: str, entry: Record | None) -> Detection:
            release_programs()
            options = {"bits": self.bits, "message": self.message, "record": entry, "schemes": schemes}
            each[name].append(_with_caveats(read_blind(meshes[name], self.key, **options), caveats))
            return each[name][-1]

        tries = len(readable) * len(records)
        best = best_of(list(try_each(partial(read, *pair) for pair in product(names, records))), ledger.PARTS, tries)
        if not self.meshes and len(names) < len(readable):
            note = f"Only the {len(names)} largest of {len(readable)} meshes were read; select others by --mesh."
            best = best._replace(notes=(*best.notes, note))
        sizes_open = self.bits is None and self.message is None
        if detection_status(best, self.alpha) is Status.NOTHING and (
            note := _other_reading(record, schemes, sizes_open=sizes_open)
        ):
            best = best._replace(notes=(*best.notes, note))
        parts = [best_of(found, ledger.PARTS, tries) for found in each.values() if found]
        return self._count_proving(best, parts, len(names)) if several else best

    def _names(self, scene: Scene, original: Path, record: SceneRecord | None) -> list[str]:
        """Return the names of the meshes to read; the record must have them, if there is one."""
        marked = scene.meshes if record is None else record.meshes
        known = {**scene.meshes, **scene.skipped}
        if not any(find_name(name, known) for name in marked):
            raise JaxmarkError(
                f"{original} has no mesh of the record, such as {next(iter(marked))!r}; give the file that was marked."
            )
        for name in self.meshes:
            if find_name(name, scene.meshes) and not find_name(name, marked):
                names = ", ".join(map(repr, marked))
                raise JaxmarkError(f"The record has no mesh {name!r}, which --mesh selects; it has {names}.")
        names = list(dict.fromkeys(self.meshes or marked))
        for name in names if record is not None and not self.meshes else ():
            if name not in known:
                raise JaxmarkError(f"{original} lacks the mesh {name!a} of the record; give the file that was marked.")
        return list(pick(scene, names, original).meshes)

    def _read_scene(self, suspect: Path, original: Scene, record: SceneRecord | None) -> Detection:
        """Read several meshes of a file, and combine their evidence."""
        self.doing(f"reading {len(original.meshes)} meshes of {suspect}")
        detection = detect_scene(
            load_scene(suspect).meshes,
            originals=original.meshes,
            names=self.meshes,
            key=self.key,
            record=record,
            bits=self.bits,
            message=self.message,
            scheme=self.schemes[0] if self.schemes else DEFAULT_SCHEME,
            align=self.align,
            after=release_programs,
        )
        count = len(detection.parts) + len(detection.skipped)
        charge = ledger.MESHES.charge("each", count)
        parts = [part._replace(evidence=part.evidence.charged(charge)) for part in detection.parts.values()]
        detection = self._count_proving(detection, parts, count)
        equal = list(detection.skipped.values()).count(EQUALS_ANOTHER)
        said = "mesh equals another, and adds" if equal == 1 else "meshes equal others, and add"
        return detection._replace(notes=(*detection.notes, f"{equal} {said} no evidence.")) if equal else detection

    def _count_proving(self, detection: Detection, parts: Sequence[Detection], meshes: int) -> Detection:
        """Add a note on how many of several meshes prove the mark without the others, after the charge for each."""
        proving = sum(part.detected(self.alpha) for part in parts)
        note = f"{proving} of {meshes} meshes {'proves' if proving == 1 else 'prove'} the mark without the others."
        return detection._replace(notes=(*detection.notes, note))

    def _alternatives(self, mesh: Mesh, original: Path, record: Record | None, suspect: Path) -> Alternatives:
        place = original, None if record is None else record.digest()
        if self._last is None or self._last[0] != place:
            bits = self.bits
            if bits is None and record is None and self.message is not None:
                bits = 8 * len(self.message)
            scheme = self.schemes[0] if self.schemes else DEFAULT_SCHEME
            try:
                marks = alternatives(make_marker(mesh, self.key, bits=bits, record=record, scheme=scheme), scheme)
            except JaxmarkError as error:
                if record is not None and is_original(load_mesh(suspect), record, self.key):
                    sentence = f"{error} The suspect is the record's original: exchange the two files."
                    raise JaxmarkError(sentence) from None
                raise
            self._last = place, marks
        return self._last[1]


def _other_reading(
    record: Record | SceneRecord | None, schemes: Sequence[BlindScheme], *, sizes_open: bool = False
) -> str:
    """Say which reading may find a mark where a blind one of a record, or of some schemes, found none; "" if none."""
    if record is not None:
        return "Only the mark of the record was looked for; without the record, other blind marks of the key are, too."
    said = ""
    if sizes_open:
        said += f"Only messages of {DEFAULT_BITS} bits were looked for; give the size of another by --bits. "
    if not schemes:
        said += f"Marks of {DEFAULT_SCHEME!r}, the default scheme, are read only with --original. "
    if hinted := [scheme.name for scheme in schemes or USUAL_BLIND_SCHEMES if "hint" in scheme.remembered]:
        said += (
            "If the suspect is a part, or has more than the marked mesh, give the record: marks of"
            f" {' and '.join(map(repr, hinted))} are then read only with its hint. A record of several marks has none."
        )
    return said.rstrip()


def _distinct(names: Sequence[str], meshes: Mapping[str, Mesh]) -> list[str]:
    """Select the first of the named meshes that are equal."""
    first: dict[bytes, str] = {}
    for name in names:
        first.setdefault(digest(meshes[name]), name)
    return list(first.values())


def _with_caveats(detection: Detection, caveats: tuple[str, ...]) -> Detection:
    """Add the reasons why a record makes a detection no proof."""
    evidence = detection.evidence
    return detection._replace(evidence=evidence._replace(caveats=(*caveats, *evidence.caveats)))


def _has_skin(path: Path) -> bool:
    """Whether a file has a skin, so that `jaxmark unpose` can remove a pose."""
    try:
        load_skin(path)
    except JaxmarkError:
        return False
    return True
