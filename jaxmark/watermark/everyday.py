"""The functions for everyday use: embed and detect a mark in a mesh or a scene of meshes, and compute the capacity.

Some schemes are read with the original, others are blind; see `jaxmark.watermark.schemes.registry`. Keyed choices are
bound to each mesh's geometry, so that the marks of different meshes of a scene are independent. Equal meshes carry
equal marks and count once.
"""

# `help` then shows the names of type aliases, such as ArrayLike, and not all that they stand for.
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from jaxmark.alignment.original import make_original
from jaxmark.alignment.pairing import pair
from jaxmark.alignment.result import Align, Alignment
from jaxmark.errors import AlignmentError, JaxmarkError
from jaxmark.files.typed import find_name, rename_like
from jaxmark.geometry.mesh import Mesh, check_mesh, digest
from jaxmark.watermark.blind import reading as blind_reading
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import KEY_BYTES, Key
from jaxmark.watermark.coding.message import DEFAULT_BITS, check_size, checked_payload
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence, united_score, weigh
from jaxmark.watermark.evidence.ledger import Charge
from jaxmark.watermark.interfaces import Detector, Scheme
from jaxmark.watermark.mark import EmbedInfo, Mark
from jaxmark.watermark.markers import Marker, NonBlindMarker, make_blind_marker, make_marker, prepare, unite
from jaxmark.watermark.nonblind import Alternatives, check_claim, claims_of, read
from jaxmark.watermark.perception.budget import Budget, BudgetLike
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.record import Record, SceneRecord, check_record, check_scheme, is_recorded
from jaxmark.watermark.schemes.passband import ADAPTIVE, candidates
from jaxmark.watermark.schemes.registry import (
    BLIND_SCHEMES,
    DEFAULT_SCHEME,
    USUAL_BLIND_SCHEMES,
    AnyScheme,
    find_blind,
    get_nonblind,
    make_blind_scheme,
    name_of,
    split,
)

EQUALS_ANOTHER = "It equals another mesh, which counts once"  # reason why a mesh of a scene is not read


def embed(
    mesh: Mesh, message: bytes, key: bytes, *, budget: BudgetLike = None, scheme: AnyScheme = DEFAULT_SCHEME
) -> tuple[Mesh, EmbedInfo]:
    """Embed a message in the vertex positions of a mesh.

    The mark is as strong as the budget allows; by default, people do not notice it. The message is read back before the
    mesh is returned, and a mesh that cannot carry it is refused. The noise that the mark survives
    (`EmbedInfo.survives`) depends on the mesh: it is large for scans, and small for models of a few hundred points.

    Args:
        mesh: the original.
        message: any bytes; b"" for a presence mark, which carries no message, and fits where messages do not.
        key: 32 bytes, from `new_key`.
        budget: how strong the mark may be, and what it must survive: a `Budget`; or, as short forms of one, an RMS
            displacement relative to the diagonal, the name of a visibility, or limits on metrics. By default, the mark
            is hidden.
        scheme: one of these:

            - a name or a scheme that is read with the original, see `make_marker`. If the default scheme is given by
              name, its pass band is adapted to the budget (`jaxmark.watermark.schemes.passband`); a scheme keeps its
              own pass band.
            - `"field"`, `"local"` or `"rooted"`, whose marks are blind: they are read after any remeshing, from any
              part, or from remeshed parts, respectively.
            - several names, such as `("keyed", "field")`, for several marks within one budget. The first is read with
              the original and has the record, the others are blind.

    Returns:
        The marked mesh (float64 vertices, same faces), and the strength, record and predicted survival of the mark.

    Raises:
        JaxmarkError: if the mesh, key, budget or payload is unusable, if the message does not read back, or if the
            demands of the budget cannot be met. In the last case, the error states the largest payload, and the least
            budget if there is one.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    budget = Budget.of(budget)
    return prepare(mesh, key, 8 * len(message), scheme, adapt_to=budget).embed(message, budget)


def capacity(
    mesh: Mesh,
    budget: BudgetLike = None,
    *,
    coverage: float = COVERAGE,
    scheme: str | Scheme | BlindScheme = DEFAULT_SCHEME,
) -> int:
    """Compute how many bits a mesh can carry, from the dimensions and the energy of a mark after projection.

    For schemes whose readers have no model of noise, such as `host` and `eigen`, only the number of code bits counts.
    Marks of `field` do not survive cropping, so that `coverage` has no effect on them.

    Args:
        mesh: the original.
        budget: see `embed`; if it has limits, the displacement that they allow is measured for each payload size. If it
            demands no noise, the noise to survive is the strongest of the SMI 2010 protocol (Wang et al.), 0.5 %.
        coverage: share of the vertices that may be left.
        scheme: a name or a scheme, see `make_marker`.

    Returns:
        The largest payload in bits, a multiple of 8; 0 if the mesh cannot carry 8 bits.

    Raises:
        JaxmarkError: if the mesh is unusable or a number is out of range.
    """
    if not (isinstance(coverage, SupportsFloat) and 0 < coverage <= 1):
        raise JaxmarkError(f"capacity needs a coverage in (0, 1], got {coverage!r}.")
    budget = Budget.of(budget)
    noise = NOISE if budget.noise is None else budget.noise
    if (blind := find_blind(scheme)) is not None:
        marker = make_blind_marker(mesh, bytes(KEY_BYTES), scheme=blind)
        return marker.writer.capacity(budget.bounds(mesh), noise)
    original = make_original(mesh)
    return Capacity(original, get_nonblind(scheme)).bits(Conditions(budget.bounds_of(original), noise, coverage))


def detect(
    suspect: Mesh,
    *,
    key: bytes,
    original: Mesh | None = None,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: AnyScheme | None = None,
    detector: Detector | None = None,
    weights: ArrayLike | None = None,
    align: Align = "auto",
) -> Detection:
    """Read a mark from a suspect, and compute the evidence of the reading.

    With `original`, the suspect is first aligned with it (`jaxmark.alignment.attempts.align`). Without it, marks of the
    blind schemes are read (`jaxmark.watermark.blind.reading`). Without `message`, a decoded message counts only if its
    keyed tag matches. With `message`, a mark is proven even if its message can no longer be decoded. If another message
    is decoded, the claim is refuted, but not the mark: the evidence is that for the decoded message, and a note reports
    it. Every choice that was open is charged (`jaxmark.watermark.evidence.ledger`).

    **The bounds hold for any suspect that is independent of the key**, provided that key, original, message and record
    were fixed before it existed. If nothing shows that, use `evidence.log10_p_uncommitted`. A mesh that is marked with
    the same key is not independent of it: when its message can no longer be decoded, a claimed message that has many
    bits in common with it may be detected. If the program cannot verify a condition, `evidence.caveats` states the
    reason, and the figures are estimates.

    Args:
        suspect: any mesh: moved, reordered, cropped, remeshed.
        key: 32 bytes.
        original: the unmarked mesh; None to read a blind mark.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else the claimed message's, else
            64. With 0, presence is claimed.
        message: the message that is claimed to be in the suspect; None to read without a claim.
        record: the record of the mark, see `make_marker`.
        scheme: the scheme that the mark was embedded with, which a record also says; by default `"keyed"` with an
            original, and `"field"` or `"local"` without it. Several names stand for marks that were embedded together,
            whose evidence is united.
        detector: a detector, see `make_marker`.
        weights: one number of at least 0 for each vertex of the original: how far to trust the suspect there, 0 for not
            at all; **must not depend on the key**.
        align: how the suspect is aligned: `"auto"`, `"same"`, `"similarity"` or `"affine"`.

    Returns:
        The result of the reading; a suspect identical to the original gives `log10_p` = 0.

    Raises:
        JaxmarkError: see `make_marker`; also if the suspect cannot be aligned, the claimed message has another size
            than the payload, or message or scheme are not those of the record.
    """
    if bits is None and record is None and isinstance(message, bytes):
        bits = 8 * len(message)
    together: tuple[BlindScheme, ...] = ()
    if isinstance(scheme, tuple):
        scheme, together = split(scheme)
    check_record(record)
    check_scheme(record, None if scheme is None else name_of(scheme))
    named = scheme if record is None else record.scheme
    blind = None if named is None else find_blind(named)
    if blind is not None or (named is None and original is None):
        if (detector, weights, align) != (None, None, "auto"):
            raise JaxmarkError("A blind mark is read without alignment, weights or a detector; leave them out.")
        schemes = () if blind is None else (blind,)
        return read_blind(suspect, key, bits=bits, message=message, record=record, schemes=schemes)
    if original is None:
        raise JaxmarkError(
            f"The scheme {named!r} is read with the original, which is missing. Give it, or embed with 'field'."
        )
    scheme = scheme or DEFAULT_SCHEME
    usual = make_marker(original, key, bits=bits, record=record, scheme=scheme, detector=detector)
    detection, mark = alternatives(usual, scheme).read(suspect, message, weights, align)
    return with_blind(detection, together, suspect, key, mark, message)


def alternatives(usual: NonBlindMarker, scheme: str | Scheme | BlindScheme = DEFAULT_SCHEME) -> Alternatives:
    """List all marks that the suspect may carry, the likeliest first.

    Without a record, marks of the default scheme by its name may have any of the adaptive pass bands. In all other
    cases there is one mark.
    """
    if usual.record is not None or scheme != DEFAULT_SCHEME:
        return Alternatives([((), lambda: usual)])
    return Alternatives(
        [
            ((ledger.PASS_BAND.charge(name),), cache(partial(usual.with_scheme, candidate)))
            for name, candidate in zip(ADAPTIVE, candidates(usual.scheme), strict=True)
        ]
    )


def read_blind(
    suspect: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    schemes: Sequence[BlindScheme] = (),
) -> Detection:
    """Read a blind mark of the given schemes, or else of the usual ones; see `detect`.

    Raises:
        JaxmarkError: see `detect`.
    """
    check_mesh(suspect)
    candidates = schemes or USUAL_BLIND_SCHEMES
    payload = DEFAULT_BITS if bits is None else checked_payload(bits)
    if record is not None:
        payload = record.payload(key, bits)
        if record.scheme not in BLIND_SCHEMES:
            raise JaxmarkError(
                f"The record says that the scheme is {record.scheme!r}, which is read with the original."
            )
        candidates = (make_blind_scheme(record.scheme, record.parameters),)
    if message is not None:
        check_size(message, payload)
        if record is not None:
            record.check_claim(message, blind_reading.context(Key(key), payload, record.scheme))
    suspect, secret = blind_reading.register(suspect), Key(key)
    detections: list[Detection] = []
    for detection in blind_reading.try_each(
        partial(blind_reading.read, suspect, secret, payload, scheme, message, record) for scheme in candidates
    ):
        detections.append(detection)
        if blind_reading.is_sure(detection):
            break
    if record is not None:  # it names the only scheme
        return detections[0]
    # A reader who names a scheme may have tried the others before.
    return blind_reading.best_of(detections, ledger.BLIND_SCHEME, max(len(BLIND_SCHEMES), len(candidates)))


def with_blind(
    found: Detection, schemes: Sequence[BlindScheme], suspect: Mesh, key: bytes, mark: Mark, message: bytes | None
) -> Detection:
    """Read further, blind marks of the same message, if there are any, and unite the evidence of all marks.

    Args:
        found: the detection of the non-blind mark.
        schemes: the schemes of the blind marks.
        suspect: see `detect`.
        key: see `detect`.
        mark: the non-blind mark.
        message: see `detect`.

    Raises:
        JaxmarkError: see `detect`.
    """
    blind = [read_blind(suspect, key, bits=mark.bits, message=message, schemes=[scheme]) for scheme in schemes]
    return unite(mark, found, blind)


class SceneInfo(NamedTuple):
    """The marks of the meshes of a scene."""

    meshes: Mapping[str, EmbedInfo]  # the marks of the marked meshes, by name
    skipped: Mapping[str, str]  # the meshes that were not marked, and the reasons
    record: SceneRecord


def embed_scene(
    meshes: Mapping[str, Mesh],
    message: bytes,
    key: bytes,
    *,
    budget: BudgetLike = None,
    scheme: AnyScheme = DEFAULT_SCHEME,
    after: Callable[[str, Marker, Mesh, EmbedInfo], EmbedInfo] = lambda name, marker, marked, info: info,
) -> tuple[dict[str, Mesh], SceneInfo]:
    """Embed one message in each mesh of a scene that can carry it.

    Meshes with equal arrays would get equal marks, so the mark is computed once for all of them.

    Args:
        meshes: by name, from `jaxmark.files.load_scene`.
        message: see `embed`.
        key: see `embed`.
        budget: see `embed`; relative to each mesh's own diagonal.
        scheme: see `embed`; each mesh gets the usual pass band.
        after: a function that is called with each mesh's name, marker, marked mesh and info. It returns the info to
            keep, or raises a `JaxmarkError` if the mesh must not be marked after all.

    Returns:
        The marked meshes, and the strength, records and predicted survival of their marks.

    Raises:
        JaxmarkError: if no mesh can carry the message; see also `embed`.
    """
    marked: dict[str, Mesh] = {}
    infos: dict[str, EmbedInfo] = {}
    skipped: dict[str, str] = {}
    equal: dict[bytes, list[str]] = {}
    for name, mesh in meshes.items():
        equal.setdefault(digest(mesh), []).append(name)
    for names in equal.values():
        try:
            marker = prepare(meshes[names[0]], key, 8 * len(message), scheme)
            result, info = marker.embed(message, budget)
        except JaxmarkError as error:
            skipped |= dict.fromkeys(names, str(error).rstrip("."))
            continue
        for name in names:
            try:
                with info.explained():
                    infos[name] = after(name, marker, result, info)
                marked[name] = result
            except JaxmarkError as error:
                skipped[name] = str(error).rstrip(".")
    skipped = {name: skipped[name] for name in meshes if name in skipped}
    if not marked:
        raise JaxmarkError(f"None of the {len(meshes)} meshes can carry the mark: {_reasons(skipped)}.")
    infos = {name: infos[name] for name in meshes if name in infos}
    record = SceneRecord({name: info.record for name, info in infos.items()}).sealed(key)
    return {name: marked[name] for name in infos}, SceneInfo(infos, skipped, record)


def detect_scene(
    suspects: Mapping[str, Mesh],
    *,
    originals: Mapping[str, Mesh],
    key: bytes,
    record: SceneRecord | None = None,
    names: Collection[str] = (),
    bits: int | None = None,
    message: bytes | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
    align: Align = "auto",
    after: Callable[[], None] = lambda: None,
) -> Detection:
    """Read the meshes of a scene, and unite their evidence.

    Each original mesh is compared with the suspect mesh that resembles it, see `jaxmark.alignment.pairing.pair`. Two
    kinds of evidence are computed: from each mesh alone, and from the weighted sum of all scores for one message.

    **The set of meshes must be fixed before the suspect exists**, like everything else that is claimed: whoever chooses
    meshes afterwards can choose those that happen to agree with the suspect. So all meshes of the record must be there,
    or, without a record, all of `originals` are read. Picking some of them by `names` is charged, and the uncommitted
    p-value of a sum is charged for a forged original of each mesh.

    Args:
        suspects: meshes by name, from `jaxmark.files.load_scene`.
        originals: the unmarked meshes by name.
        key: see `detect`.
        record: the record of the file, which contains the names of the marked meshes; by default, all may be marked.
        names: names of the marked meshes to read; by default all of them.
        bits: see `detect`.
        message: see `detect`.
        scheme: see `detect`.
        align: see `detect`.
        after: a function that is called after each mesh.

    Returns:
        The united detection. `parts` has the detection of each original mesh, and `skipped` the meshes that could not
        be compared, with reasons. Fields that belong to one mesh are those of the mesh with most evidence.

    Raises:
        AlignmentError: if no mesh can be aligned with that of the original.
        JaxmarkError: if no mesh can be compared, an original mesh is missing or is not the recorded one, or the record
            was edited; see also `detect`.
    """
    marked, caveats = originals, ()
    if record is not None:
        marked, caveats = record.meshes, record.caveats(key)
        originals = rename_like(originals, marked)
    names = [find_name(name, originals) or name for name in names]
    # The order of a file's meshes decides which of equal meshes counts; a record's digest does not cover it.
    chosen = sorted(name for name in marked if name in names or not names)
    for name in (*chosen, *names):
        if name not in originals or name not in marked:
            whose = "original" if name not in originals else "record"
            raise JaxmarkError(f"The {whose} has no mesh {name!r}; select others, or give another {whose}.")
    if bits is None and record is None and message is not None:
        bits = 8 * len(message)
    markers: dict[str, NonBlindMarker] = {}
    skipped: dict[str, str] = {}
    made: dict[tuple[bytes, str], NonBlindMarker] = {}  # equal meshes share a marker
    for name in chosen:
        mesh_record = None if record is None else record.meshes[name]
        identity = digest(originals[name]), "" if mesh_record is None else mesh_record.digest()
        try:
            marker = made.get(identity) or make_marker(
                originals[name], key, bits=bits, record=mesh_record, scheme=scheme
            )
        except JaxmarkError as error:
            if record is None:
                skipped[name] = str(error).rstrip(".")
                continue
            # If such meshes were skipped, damaging them would choose the meshes that are read.
            raise JaxmarkError(f"The mesh {name!r} of the original cannot be read: {error}") from None
        if message is not None:
            check_claim(marker, message)
        # Cached results of markers are dropped here and below: those of all meshes would not fit into memory.
        markers[name] = made[identity] = replace(marker)
    suspect_names = pair({name: marker.original.marked_order for name, marker in markers.items()}, suspects)
    readings: dict[str, _MeshReading] = {}
    counted: set[tuple[bytes, bytes]] = set()
    unlike = False  # whether a mesh of the suspect is unlike that of the original
    for name, marker in markers.items():
        try:
            if name not in suspect_names:
                raise AlignmentError("No mesh of the suspect resembles it.")
            geometry = marker.original.geometry, marker.original.order
            if geometry in counted:
                raise JaxmarkError(f"{EQUALS_ANOTHER}.")
            aligned = marker.register(suspects[suspect_names[name]], align)
            # One mesh alone may be read in both reflections, by `detect`.
            charges = (ledger.REFLECTION.charge("better fit"),) if aligned.method == "surface" else ()
            readings[name] = _MeshReading(marker, aligned, read(replace(marker), aligned, message, charges=charges))
            counted.add(geometry)
        except JaxmarkError as error:
            skipped[name], unlike = str(error).rstrip("."), unlike or isinstance(error, AlignmentError)
        after()
    if not readings:
        kind = AlignmentError if unlike else JaxmarkError
        raise kind(f"None of the {len(chosen)} meshes could be compared: {_reasons(skipped)}.")
    # An original can be presented so that it is unlike its counterpart, and is skipped. So the orders and the caveats
    # of all originals count, and the number of meshes is that of all originals.
    orders = [charge for marker in markers.values() for charge in marker.order_charges]
    presented = *ledger.selection(len(chosen), len(marked)), *ledger.in_all(orders)
    caveats = (*caveats, *dict.fromkeys(caveat for marker in markers.values() for caveat in marker.caveats))
    alone = () if len(chosen) == 1 else (ledger.SCENE.charge("one mesh"), ledger.MESHES.charge("each", len(chosen)))

    def charged(evidence: Evidence, *charges: Charge) -> Evidence:
        return evidence.charged(*presented, *charges)._replace(caveats=caveats)

    parts = {
        name: reading.found._replace(evidence=charged(reading.found.evidence, *alone))
        for name, reading in readings.items()
    }
    best = min(parts.values(), key=lambda detection: detection.rank)
    evidence, decoded = Evidence.least(*(detection.evidence for detection in parts.values())), best.message
    for candidate, of_sum in _sums(list(readings.values()), message):
        united = charged(of_sum)
        if united.log10_p < evidence.log10_p:
            decoded = candidate if any(detection.message == candidate for detection in parts.values()) else None
        evidence = Evidence.least(evidence, united)
    recorded = None if decoded is None else next(part.recorded for part in parts.values() if part.message == decoded)
    return best._replace(message=decoded, evidence=evidence, parts=parts, skipped=skipped, recorded=recorded)


class _MeshReading(NamedTuple):
    """The reading of one mesh of a scene; its pose does not depend on the key."""

    marker: NonBlindMarker
    aligned: Alignment
    found: Detection

    def claim(self, message: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Compute score and norm of a message with the first way of weighting, which does not depend on the key."""
        received = self.marker.receive(self.aligned)
        score, norm = claims_of(self.marker, received, message)[0]
        return np.asarray(score), np.asarray(norm)


def _sums(readings: Sequence[_MeshReading], claimed: bytes | None) -> Iterator[tuple[bytes, Evidence]]:
    """Yield each message that is claimed or was decoded, and the evidence of the sum of its scores over all meshes."""
    bits = readings[0].marker.bits
    if not bits:
        claimed = b""
    decoded = {reading.found.message for reading in readings} - {None}
    for message in decoded if claimed is None else {claimed}:
        if message is None or len(readings) == 1 or any(8 * len(message) != one.marker.bits for one in readings):
            continue
        recorded = [is_recorded(reading.marker.record, message, reading.marker.choices) for reading in readings]
        fixed = claimed is not None or all(recorded)
        charges = [
            ledger.SCENE.charge("sum over meshes"),
            ledger.SUM_ALIGNMENT.charge(readings[0].aligned.align),
        ]
        if fixed or any(flag is not None for flag in recorded):
            charges.append(ledger.MESSAGE.charge("claimed or recorded" if fixed else "another"))
        scores, norms = zip(*(reading.claim(message) for reading in readings), strict=True)
        # The weight of a mesh is the number of its points that the suspect shows.
        score = united_score(scores, norms, [float(np.sum(reading.aligned.weights > 0)) for reading in readings])
        yield message, weigh([(score, 1.0)], bits=bits, fixed=fixed, charges=charges, meshes=len(readings))


def _reasons(skipped: Mapping[str, str]) -> str:
    """List the reasons why meshes were skipped, at most three of them."""
    listed = "; ".join(f"{name!r}: {reason}" for name, reason in list(skipped.items())[:3])
    return listed + "; …" * (len(skipped) > 3)
