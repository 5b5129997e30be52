"""Read files without their originals."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jaxmark.app.dossier import file_hash
from jaxmark.app.programs import release_programs
from jaxmark.app.progress import Doing, quietly
from jaxmark.app.scene import pick
from jaxmark.app.telling import Told, describe
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_scene
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.reading import BlindDetection, best_of, try_each
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.deposit import Deposit
from jaxmark.watermark.everyday import blind_scheme, read_blind
from jaxmark.watermark.record import Record
from jaxmark.watermark.scenes import load_record


@dataclass(frozen=True)
class BlindReader:
    """Reads files as `detect` reads meshes without an original."""

    key: Key
    bits: int | None
    message: bytes | None
    alpha: float  # largest false-positive probability of a detection
    deposit: Deposit | None = None  # that holds the records' digests
    obtained: str = ""  # when and where the suspects were got
    meshes: Sequence[str] = ()  # names of the suspect's meshes to read; by default all
    scheme: BlindScheme | None = None  # for marks without a record; by default any
    doing: Doing = quietly  # is told what begins

    def read(self, suspect: Path, record: Path | None = None) -> Told:
        """Read one file: as one mesh, or each of its meshes, whose number is paid for.

        Raises:
            JaxmarkError: see `detect`; also if the record is not in the deposit.
        """
        known = None if record is None else load_record(record)
        records = [known] if isinstance(known, Record) else [None] if known is None else list(known.meshes.values())
        for one in records:
            if one is not None and blind_scheme(one.scheme) is None:
                raise JaxmarkError(f"The record says that the scheme is {one.scheme!r}, which needs --original.")
        self.doing(f"reading {suspect}")
        scene = pick(load_scene(suspect), self.meshes, suspect)
        several = len(scene.meshes) > 1
        tried = list(scene.meshes.values()) if several else [load_mesh(suspect)]
        self.doing(f"looking for a mark in {suspect}, without an original")
        found = list(try_each(partial(self._read, mesh, one) for mesh in tried for one in records))
        best = best_of(found, len(tried) * len(records))
        detected = best.detected(self.alpha)
        remarks = list(best.remarks)
        if several:
            alone = sum(one.detected(self.alpha) for one in found)
            remarks.append(f"{alone} of {len(tried)} meshes prove it alone.")
        answer = {
            "detected": detected,
            "scheme": best.scheme,
            "log10_p": best.log10_p,
            "log10_p_undated": best.log10_p_undated,
            "log10_p_fitted": best.log10_p_fitted,
            "log10_p_unfloored": best.log10_p_unfloored,
            "proof": not best.doubts,
            "doubts": list(best.doubts),
            "remarks": remarks,
            "version": best.version,
            "suspect_sha256": file_hash(suspect),
            "obtained": self.obtained or None,
            "message": None if best.message is None else best.message.hex(),
            "scores": [float(score) for score in best.scores],
            "anchors": best.anchors,
            "agreement": best.agreement,
            "width": best.width,
            "step": best.step,
            "pose": {"matrix": best.pose.matrix.tolist(), "shift": best.pose.shift.tolist()},
        }
        dated = None
        if known is not None:
            answer["record_digest"] = known.digest()
            if self.deposit is not None:
                dated = self.deposit.log10_p(best.log10_p, known, claimed=self.message is not None)
                answer["log10_p_deposited"] = dated
        return Told(answer, describe(best, detected, self.alpha, dated, remarks), detected)

    def _read(self, mesh: Mesh, record: Record | None) -> BlindDetection:
        """Read one mesh."""
        release_programs()
        scheme = self.scheme if record is None else None
        return read_blind(mesh, self.key, bits=self.bits, message=self.message, record=record, scheme=scheme)
