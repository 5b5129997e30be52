"""Markers: each one marks one original with one key and payload size, and reads the mark again.

A marker prepares its original only once. `NonBlindMarker` makes marks that are read with the original, `BlindMarker`
marks that are read without it, and `CombinedMarker` both in one mesh. All of them are a `Marker`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxmark import distortion
from jaxmark.alignment import attempts
from jaxmark.alignment.original import Original, displace, make_original
from jaxmark.alignment.result import Align, Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces
from jaxmark.watermark.arrays import MarkArrays, MarkBatch, make_arrays, make_batch
from jaxmark.watermark.blind import reading as blind_reading
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.blind.writing import Writer, remedies
from jaxmark.watermark.coding import message as coding
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.coding.message import DEFAULT_BITS, TAG_BITS, check_size, checked_payload
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.evidence.ledger import Charge, rounded_up
from jaxmark.watermark.interfaces import Detector, Scheme
from jaxmark.watermark.mark import EmbedInfo, Mark, recall
from jaxmark.watermark.nonblind import Alternatives, read
from jaxmark.watermark.perception.budget import Bounds, Budget, BudgetLike, reference_of
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Conditions, Survival
from jaxmark.watermark.record import Record, check_record, commit, is_recorded
from jaxmark.watermark.schemes.passband import choose_pass_band
from jaxmark.watermark.schemes.registry import (
    BLIND_SCHEMES,
    DEFAULT_SCHEME,
    SCHEMES,
    AnyScheme,
    get_nonblind,
    make_blind_scheme,
    make_scheme,
    parameters_of,
    split,
)

ReadBack = Literal["now", "later", "never"]  # when a marked mesh is verified

_MAX_TRIED_NOISE = 0.05  # larger noise, which destroys the shape, is not tried
_SHARES_OF_NOISE = (1.0, 0.7, 0.5, 0.3, 0.1)  # shares of the predicted noise to try; blind marks omit the last
_LEAST_SHARE, _MOST_SHARE = 0.3, 0.9  # limits on the share of the budget for a mark that is not the last


@runtime_checkable
class Marker(Protocol):
    """An object that marks one original, and reads any number of suspects."""

    @property
    def original(self) -> Original:
        """The mesh to mark."""
        ...

    def embed(
        self, message: bytes, budget: BudgetLike = None, *, read_back: ReadBack = "now"
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `jaxmark.watermark.everyday.embed`.

        Pass `read_back="later"` if you verify the written file yourself, or `"never"` if it need not be readable: then
        payloads that certainly cannot be read are written, too.
        """
        ...

    def with_record(self, record: Record) -> "Marker":
        """Return a marker that reads with a record; this marker must have made the record."""
        ...

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that a message can be read from a marked mesh that was not attacked.

        Raises:
            JaxmarkError: if it cannot be read.
        """
        ...

    def measure_survival(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """Measure the noise that a mark survives, with all points and with half of them, up to the predicted noise.

        Random noise of the predicted strength is added. If the mark cannot be read, smaller shares of it are tried.

        Args:
            marked: the marked mesh, in the original's vertex order.
            message: its message.
            predicted: the prediction, from `EmbedInfo`.

        Returns:
            The largest noise with which the mark was read, 0 if with none; None if it cannot be read without noise.
        """
        ...

    def register(self, suspect: Mesh) -> Any:
        """Prepare a suspect for `read`, independently of the key: once for any number of keys."""
        ...

    def read(self, registered: Any, message: bytes | None = None) -> Detection:
        """Read a suspect that `register` prepared, with or without a claimed message."""
        ...

    def detect(self, suspect: Mesh, message: bytes | None = None) -> Detection:
        """Read a suspect, with or without a claimed message; see `jaxmark.watermark.everyday.detect`."""
        ...

    def guess(self, found: Detection) -> bytes | None:
        """Decode the most plausible message of a detection without checking its tag."""
        ...


class NonBlindMarker(Mark):
    """A `Marker` whose marks are read with the original; make one with `make_marker`."""

    def embed(
        self, message: bytes, budget: BudgetLike = None, *, read_back: ReadBack = "now"
    ) -> tuple[Mesh, EmbedInfo]:
        """See `Marker`."""
        check_size(message, self.bits)
        budget = Budget.of(budget)
        bounds = budget.bounds_of(self.original)
        marked, info = self.write(self.codeword(message), budget, content=message)
        # A budget without limits is reached up to rounding, so its own number is used.
        reached = info.rms if bounds.limits else bounds.rms or 0.0
        if budget.noise is not None:
            self._check_capacity(reached, Conditions(bounds, budget.noise, COVERAGE))
        conditions = (Conditions(bounds, 1.0, share) for share in (1.0, COVERAGE))
        info = info._replace(survives=Survival(*(self.capacity.noise(self.bits, reached, case) for case in conditions)))
        if read_back == "now":
            with info.explained():
                self.check(marked, message)
        return marked, info

    def adapted(self, budget: BudgetLike = None) -> "NonBlindMarker":
        """Return the marker with the adaptive pass band for a budget, if its scheme is the default one.

        If the budget demands no noise, the pass band is chosen for `capacity.NOISE`; see
        `jaxmark.watermark.schemes.passband`.
        """
        budget = Budget.of(budget)
        bounds = budget.bounds_of(self.original)
        return self.with_scheme(choose_pass_band(self.capacity, self.bits, bounds, budget.noise or NOISE))

    def with_record(self, record: Record) -> "NonBlindMarker":
        """See `Marker`; claims are then checked against the record."""
        marker = replace(self, record=record)
        marker.__dict__.update({name: self.__dict__[name] for name in ("reader", "capacity") if name in self.__dict__})
        return marker

    def check(self, marked: Mesh, message: bytes) -> None:
        """See `Marker`."""
        if not self.reads(marked, message):
            shorter = " a shorter message or a presence mark," if self.bits else ""
            raise _does_not_read(self, f"a larger budget,{shorter} or a finer or less regular mesh")

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message can be read from a mesh that has the original's vertex order.

        Plain correlations nearly always decode a keyed mark that was not attacked. They are tried first, because
        weighting the bands and joint decoding are most of the work of `detect`.
        """
        return self._reads_in_order(attempts.align(self.original, marked, "same"), message)

    def _reads_in_order(self, aligned: Alignment, message: bytes) -> bool:
        # The reader's shortcut is equivalent only to the carrier's own detector.
        if message and self.uses_own_detector and self.read_quickly(self.observe(aligned)) == message:
            return True
        return self._reads(aligned, message)

    def _reads(self, aligned: Alignment, message: bytes) -> bool:
        """Whether an aligned suspect's message is decoded, or, for a presence mark, its presence is proven."""
        if not self.bits:
            return self.read(aligned, b"").detected(allow_estimate=True)
        decoded = self.decode(self.soft_decisions(self.receive(aligned)))
        return decoded is not None and decoded.message == message

    def measure_survival(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """See `Marker`; messages are decoded by plain correlations, although joint decoding may survive more noise."""
        aligned, rng = attempts.align(self.original, marked, "same"), np.random.default_rng(0)
        if not self._reads_in_order(aligned, message):
            return None
        points, used = self.original.positions, self.original.used
        unit = self.original.radius * rng.uniform(-1, 1, points.shape)
        near = points[:, 0] <= np.median(points[used, 0])  # half of the mesh, as after a cut

        def survives(noise: float, visible: np.ndarray) -> bool:
            noisy = aligned._replace(
                displacement=aligned.displacement + noise * unit, weights=aligned.weights * visible
            )
            return self.read_quickly(self.observe(noisy)) == message if message else self._reads(noisy, message)

        survived = []
        for noise, visible in zip(predicted, (np.ones_like(near), near), strict=True):
            strengths = (share * min(noise, _MAX_TRIED_NOISE) for share in _SHARES_OF_NOISE)
            reads = (strength for strength in strengths if survives(strength, visible))
            survived.append(next(reads, 0.0) if 0 < noise < math.inf else noise)
        return Survival(*survived)

    def register(self, suspect: Mesh, align: Align = "auto") -> Alignment:
        """Align a suspect with the original; see `jaxmark.alignment.attempts.align`."""
        return attempts.align(self.original, suspect, align)

    def read(self, registered: Alignment, message: bytes | None = None, weights: ArrayLike | None = None) -> Detection:
        """See `Marker`, and `jaxmark.watermark.nonblind.read`."""
        return read(self, registered, message, weights)

    def detect(
        self,
        suspect: Mesh,
        message: bytes | None = None,
        weights: ArrayLike | None = None,
        align: Align = "auto",
    ) -> Detection:
        """See `Marker`; if the suspect is registered by its surface, both reflections are read, unlike in `read`."""
        return Alternatives([((), lambda: self)]).read(suspect, message, weights, align)[0]

    def guess(self, found: Detection) -> bytes | None:
        """See `Marker`."""
        return found.message or coding.guess(found.scores, self.bits, TAG_BITS)

    def arrays(self, message: bytes) -> MarkArrays:
        """Return the arrays of the mark for a message, for pure functions of them; see `jaxmark.watermark.arrays`.

        Raises:
            JaxmarkError: if the message has another size than the payload.
        """
        check_size(message, self.bits)
        return make_arrays(self, message)

    def arrays_of_keys(self, message: bytes, keys: Sequence[bytes]) -> MarkBatch:
        """Return the arrays of the mark under other keys, for all of them at once; see `jaxmark.watermark.arrays`.

        Raises:
            JaxmarkError: if there is no key, one is no key, or the message has another size than the payload.
        """
        check_size(message, self.bits)
        return make_batch(self, message, keys)

    def to_mesh(self, coordinates: Float[Array, "rows 3"]) -> Mesh:
        """Convert coordinates in the order and pose of `MarkArrays.x` to a mesh like the original, on the host."""
        return displace(self.original, self.original.to_host(coordinates - self.original.signal))

    def _check_capacity(self, reached: float, conditions: Conditions) -> None:
        """Check that the payload is readable under these conditions at an RMS displacement of `reached` diagonals."""
        capacity = self.capacity
        least = capacity.least_budget(self.bits, conditions)
        if least <= reached:
            return
        most = capacity.bits(conditions) if self.bits else 0
        present = capacity.least_budget(0, conditions) <= reached
        advice = ["a shorter message"] if most else ["a presence mark"] if present else []
        if math.isfinite(least):
            budget = _rounded_up(least)
            advice.append(f"a budget of at least {budget:g}{self._distortion_at(budget, conditions.bounds)}")
        carries = f"carries at most {most} bits" if most else "carries no message" if self.bits else "carries no mark"
        payload = f"; the payload is {self.bits} bits" if most else ""
        raise JaxmarkError(
            f"This mesh ({int(self.original.used.sum())} points) {carries} at {conditions.bounds}, with noise of"
            f" {conditions.noise:g} and half of its points lost{payload}. Use {', or '.join(advice or ['less noise'])}."
        )

    def _distortion_at(self, rms: float, bounds: Bounds) -> str:
        """Describe the distortion by a mark of a given size, in the metrics that are limited, as half a sentence."""
        if not bounds.limits:
            return ""
        word = np.random.default_rng(0).choice([-1.0, 1.0], self.code_bits)
        marked, _ = self.write(word, min(rms, 0.5))
        values = distortion.measure(self.original.mesh, marked, bounds.limits.keys())
        described = ", ".join(f"{name} would be {value or 0:.2g}" for name, value in values.items())
        return f" (at which {described})"


@dataclass(frozen=True, eq=False)
class BlindMarker:
    """A `Marker` whose marks are read without the original; make one with `make_blind_marker`."""

    original: Original
    key: Key
    bits: int
    scheme: BlindScheme
    writer: Writer

    @classmethod
    def make(cls, original: Original, key: Key, bits: int, scheme: BlindScheme) -> "BlindMarker":
        """Prepare an original; see `make_blind_marker`."""
        bits = checked_payload(bits)
        blind_reading.code_length(bits)  # raises an error if the payload is too large
        check_faces("A mark that is read without the original", original.mesh)
        choices = blind_reading.context(key, bits, scheme.name)
        return cls(original, key, bits, scheme, Writer(original, scheme, choices))

    def embed(
        self, message: bytes, budget: BudgetLike = None, *, read_back: ReadBack = "now"
    ) -> tuple[Mesh, EmbedInfo]:
        """See `Marker`."""
        marked, info = self.write(message, budget, to_be_read=read_back != "never")
        if read_back == "now":
            with info.explained():
                self.with_record(info.record).check(marked, message)
        return marked, info

    def write(
        self,
        message: bytes,
        budget: BudgetLike = None,
        reference: distortion.Reference | None = None,
        *,
        to_be_read: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Write a message as far as a budget allows; limits are measured against `reference`, if given.

        Raises:
            JaxmarkError: see `jaxmark.watermark.everyday.embed`.
        """
        budget = Budget.of(budget)
        choices, bounds = self.writer.choices, budget.bounds_of(self.original)
        word = blind_reading.codeword(message, choices)
        written = self.writer.write(word, bounds, self.bits, reference, to_be_read=to_be_read)
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=float(written.plan.alpha),
            original="",
            key=commitment(self.key),
            parameters={
                "width": written.plan.width,
                "step": written.plan.step,
                **self.scheme.recorded(self.original),
            },
            content="message" if self.bits else "presence",
            message_commitment=commit(message, choices) if message else "",
        ).sealed(self.key)
        survives = self.writer.survives(written.plan, self.bits)
        if budget.noise is not None and survives.whole < budget.noise:
            raise JaxmarkError(
                f"The mark of {self.scheme.name!r} would survive noise of {survives.whole:.2g}, less than"
                f" {budget.noise:g}; use a larger budget, a shorter message or another scheme."
            )
        notes = (written.note,) if written.note else ()
        return written.mesh, EmbedInfo(written.moved.rms, written.moved.max, record.beta, record, survives, notes)

    def with_record(self, record: Record) -> "BlindMarker":
        """See `Marker`; only the width and the quantisation step of the record are then read."""
        return replace(self, scheme=make_blind_scheme(record.scheme, record.parameters))

    def check(self, marked: Mesh, message: bytes) -> None:
        """See `Marker`."""
        if not self.reads(marked, message):
            raise _does_not_read(self, remedies(self.bits))

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message is decoded, or, for a presence mark, its presence is proven."""
        detection = self.detect(marked)
        return detection.message == message if message else detection.detected(allow_estimate=True)

    def measure_survival(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """See `Marker`."""
        if not self.reads(marked, message):
            return None
        points, rng = np.asarray(marked.vertices, np.float64), np.random.default_rng(0)
        size = self.original.radius * self.original.diagonal
        unit = size * rng.uniform(-1, 1, self.original.positions.shape)[self.original.weld.point]
        faces = np.asarray(marked.faces)
        near = (points[faces, 0] <= np.median(points[faces, 0])).all(axis=1)
        # Reading marks that are found by the key takes long, so that only every second share is tried.
        shares, survived = _SHARES_OF_NOISE[1:-1:2] if self.scheme.by_key else _SHARES_OF_NOISE[:-1], []
        for strongest, part in zip(predicted, (faces, faces[near]), strict=True):
            strengths = [share * strongest for share in shares if strongest > 0]
            suspects = (Mesh(points + noise * unit, part) for noise in strengths)
            reads = (noise for noise, suspect in zip(strengths, suspects, strict=True) if self.reads(suspect, message))
            survived.append(next(reads, 0.0))
        return Survival(*survived)

    def register(self, suspect: Mesh) -> Mesh:
        """Weld a suspect, and drop vertices that no face uses; all of it is read in its own pose."""
        return blind_reading.register(suspect)

    def read(self, registered: Mesh, message: bytes | None = None) -> Detection:
        """See `Marker`, and `jaxmark.watermark.blind.reading.read`."""
        if message is not None:
            check_size(message, self.bits)
        found = blind_reading.read(registered, self.key, self.bits, self.scheme, message)
        return blind_reading.best_of([found], ledger.BLIND_SCHEME, len(BLIND_SCHEMES))

    def detect(self, suspect: Mesh, message: bytes | None = None) -> Detection:
        """See `Marker`."""
        return self.read(self.register(suspect), message)

    def guess(self, found: Detection) -> bytes | None:
        """See `Marker`."""
        return found.message or coding.guess(found.scores, self.bits, blind_reading.TAG_BITS)


@dataclass(frozen=True, eq=False)
class CombinedMarker:
    """A `Marker` of several marks in one mesh within one budget: one non-blind mark, and blind ones.

    The budget is shared so that all marks survive the same noise, as predicted from the noise that each mark survives
    if it uses the whole budget. The marks are written one after another, the blind ones last, and of these the one with
    `BlindScheme.written_last`. The last mark gets the part of the budget that the others left.
    """

    nonblind: NonBlindMarker
    schemes: tuple[BlindScheme, ...]  # the schemes of the blind marks

    @property
    def original(self) -> Original:
        """See `Marker`."""
        return self.nonblind.original

    def embed(
        self, message: bytes, budget: BudgetLike = None, *, read_back: ReadBack = "now"
    ) -> tuple[Mesh, EmbedInfo]:
        """See `Marker`; the record is that of the non-blind mark."""
        budget = Budget.of(budget)
        mesh = self.original.mesh
        bounds = budget.bounds_of(self.original)
        reference = reference_of(self.original)
        _, alone = self.nonblind.embed(message, Budget(rms=bounds.rms, limits=bounds.limits), read_back="never")
        sizes, survived = [alone.rms], [alone.survives.whole]
        blind = sorted(self._blind, key=lambda marker: marker.scheme.written_last)
        for marker in blind:
            plan = marker.writer.plan(
                blind_reading.codeword(message, marker.writer.choices), bounds, reference, marker.bits
            )
            sizes.append(plan.size)
            survived.append(marker.writer.survives(plan, marker.bits).whole)
        shares = _share(survived)
        first = Budget(rms=shares[0] * sizes[0], noise=budget.noise)
        marked, info = self.nonblind.embed(message, first, read_back="never")
        survives, notes = [info.survives], [*alone.notes]
        limits = {**bounds.limits, **({} if bounds.rms is None else {"rms": bounds.rms})}
        for place, scheme in enumerate((marker.scheme for marker in blind), 1):
            rms = None if place == len(blind) else shares[place] * sizes[place]
            marker = self._make_blind(make_original(marked), scheme)
            marked, blind_info = marker.write(
                message, Budget(rms=rms, noise=budget.noise, limits=limits), reference, to_be_read=read_back != "never"
            )
            survives.append(blind_info.survives)
            notes += blind_info.notes
        change = distortion.displacement_size(mesh, marked)
        least = Survival(min(survival.whole for survival in survives), max(survival.half for survival in survives))
        info = info._replace(rms=change.rms, max=change.max, survives=least, notes=tuple(notes[:1]))
        if read_back == "now":
            with info.explained():
                self.check(marked, message)
        return marked, info

    def with_record(self, record: Record) -> "CombinedMarker":
        """See `Marker`."""
        return replace(self, nonblind=self.nonblind.with_record(record))

    def check(self, marked: Mesh, message: bytes) -> None:
        """See `Marker`: each mark must be readable."""
        for marker in self._all:
            marker.check(marked, message)

    def measure_survival(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """See `Marker`: the noise that all marks survive, or, with half of the points lost, the best of them."""
        survivals: list[Survival] = []
        for marker in self._all:
            if (survived := marker.measure_survival(marked, message, predicted)) is None:
                return None
            survivals.append(survived)
        return Survival(min(noise.whole for noise in survivals), max(noise.half for noise in survivals))

    def register(self, suspect: Mesh) -> list[Any]:
        """See `Marker`: once for each mark."""
        return [marker.register(suspect) for marker in self._all]

    def read(self, registered: Sequence[Any], message: bytes | None = None) -> Detection:
        """See `Marker`: the evidence of all marks is united."""
        detections = [marker.read(part, message) for marker, part in zip(self._all, registered, strict=True)]
        return unite(self.nonblind, detections[0], detections[1:])

    def detect(self, suspect: Mesh, message: bytes | None = None) -> Detection:
        """See `Marker`: the evidence of all marks is united."""
        detections = [marker.detect(suspect, message) for marker in self._all]
        return unite(self.nonblind, detections[0], detections[1:])

    def guess(self, found: Detection) -> bytes | None:
        """See `Marker`: decodes the non-blind mark."""
        return self.nonblind.guess(found)

    @cached_property
    def _blind(self) -> list[BlindMarker]:
        return [self._make_blind(self.original, scheme) for scheme in self.schemes]

    @property
    def _all(self) -> Iterator[Marker]:
        yield self.nonblind
        yield from self._blind

    def _make_blind(self, original: Original, scheme: BlindScheme) -> BlindMarker:
        return BlindMarker.make(original, self.nonblind.key, self.nonblind.bits, scheme)


def make_marker(
    original: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    record: Record | None = None,
    scheme: str | Scheme | BlindScheme = DEFAULT_SCHEME,
    detector: Detector | None = None,
) -> NonBlindMarker:
    """Prepare an original for marking, or for reading many suspects.

    Args:
        original: the unmarked mesh. Vertices at the same position, or so close that they round to the same point (see
            `jaxmark.geometry.canonical`), move together. Vertices that no face uses do not move. With a record, a copy
            that was saved again can be used: rounded, reordered, moved or scaled.
        key: 32 bytes, from `new_key`.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else 64. With 0, the mark is a
            presence mark, which carries no message.
        record: the record of an earlier mark, which determines scheme and payload size; original and key must be those
            that it was made with.
        scheme: a name (`"keyed"`, `"host"`, `"eigen"`), which a record overrides; or a scheme of
            `jaxmark.watermark.schemes`, or one of your own.
        detector: a detector of `jaxmark.watermark.reading.detectors`; by default the carrier's own.

    Returns:
        The marker.

    Raises:
        JaxmarkError: if the mesh, key or payload is unusable, or the record was edited or is for another original, key
            or payload.
    """
    key = Key(key)
    check_record(record)
    if bits is not None:
        bits = checked_payload(bits)
    if record is not None:
        bits = record.payload(key, bits)
        if isinstance(scheme, str):
            scheme = make_scheme(record.scheme, record.parameters)
        elif not _matches_record(get_nonblind(scheme), record):
            raise JaxmarkError(
                f"The record is of the scheme {record.scheme!r} with {dict(record.parameters)}, not {scheme}."
            )
    ready, caveats = recall(original, key, record)
    payload = DEFAULT_BITS if bits is None else bits
    return NonBlindMarker.make(
        ready, key, get_nonblind(scheme), payload, record=record, detector=detector, caveats=caveats
    )


def make_blind_marker(original: Mesh, key: bytes, *, bits: int = DEFAULT_BITS, scheme: BlindScheme) -> BlindMarker:
    """Prepare an original for blind marks.

    Raises:
        JaxmarkError: if the mesh or the key is unusable, or the payload is not a multiple of 8 bits.
    """
    return BlindMarker.make(make_original(original), Key(key), bits, scheme)


def prepare(mesh: Mesh, key: bytes, bits: int, scheme: AnyScheme, *, adapt_to: Budget | None = None) -> Marker:
    """Prepare an original for marking with one or several schemes.

    Args:
        mesh: the original.
        key: 32 bytes.
        bits: size of the payload in bits.
        scheme: a scheme, its name, or several names.
        adapt_to: the budget for which the pass band of the default scheme is chosen, if `scheme` is a name; None for
            the usual pass band.

    Raises:
        JaxmarkError: see `make_marker` and `split`.
    """
    nonblind, blind = split(scheme)
    original, secret = make_original(mesh), Key(key)
    if nonblind is None:
        return BlindMarker.make(original, secret, bits, *blind)
    marker = NonBlindMarker.make(original, secret, get_nonblind(nonblind), bits)
    if adapt_to is not None and isinstance(nonblind, str):
        marker = marker.adapted(adapt_to)
    return CombinedMarker(marker, blind) if blind else marker


def unite(mark: Mark, nonblind: Detection, blind: Sequence[Detection]) -> Detection:
    """Unite the detections of all marks of a mesh, whose signs are independent, into one non-blind detection.

    It is about one message: that of the non-blind mark, or else the first that was decoded. Marks of other messages are
    not counted. A record does not name the other marks, so that their choice is charged.

    Args:
        mark: the non-blind mark, whose record may commit to a message.
        nonblind: its detection.
        blind: the detections of the other marks, if any.
    """
    united = _product(mark, nonblind, blind) if blind else nonblind
    if mark.record is None:
        return united
    names = " and ".join(sorted(detection.scheme for detection in blind)) or "none"
    return united._replace(evidence=united.evidence.charged(ledger.BESIDE.charge(names)))


def _product(mark: Mark, nonblind: Detection, blind: Sequence[Detection]) -> Detection:
    """Unite the detections of at least two marks; see `unite`."""
    detections = (nonblind, *blind)
    message = next((about for each in detections if (about := _subject(each)) is not None), None)
    agreeing = [_subject(detection) in (None, message) for detection in detections]
    decoded = next((each for each in compress(detections, agreeing) if each.message is not None), nonblind)
    recorded, charges = decoded.recorded, list[Charge]()
    if decoded is not nonblind and decoded.message is not None:
        recorded = is_recorded(mark.record, decoded.message, mark.choices)
        if recorded is not None:
            charges.append(ledger.MARKS_MESSAGE.charge("claimed or recorded" if recorded else "another"))
    notes = tuple(
        f"The mark of {detection.scheme!r}, if it were the only one that was read, would have a probability of"
        f" {'about' if detection.evidence.caveats else 'at most'} 10^{rounded_up(detection.log10_p):.1f}."
        for detection in blind
    )
    notes += tuple(
        f"The mark of {detection.scheme!r} has another message, and is not counted."
        for detection, agrees in zip(detections, agreeing, strict=True)
        if not agrees
    )
    if recorded is False and decoded is not nonblind:
        notes += (f"The mark of {decoded.scheme!r} has another message than the one in the record.",)
    evidence = (each.evidence if agrees else Evidence() for each, agrees in zip(detections, agreeing, strict=True))
    return nonblind._replace(
        message=decoded.message,
        recorded=recorded,
        scheme=decoded.scheme,
        evidence=Evidence.product(*evidence).charged(*charges),
        notes=(*nonblind.notes, *notes),
        parts={detection.scheme: detection for detection in detections},
    )


def _subject(detection: Detection) -> bytes | None:
    """Return the message that the evidence is about: what was decoded, or else what was claimed."""
    return detection.claimed if detection.message is None else detection.message


def _does_not_read(marker: NonBlindMarker | BlindMarker, remedy: str) -> JaxmarkError:
    """Make the error for a mark that cannot be read back, with advice."""
    payload = f"a message of {marker.bits} bits" if marker.bits else "a presence mark"
    return JaxmarkError(
        f"This mesh ({int(marker.original.used.sum())} points) cannot carry {payload} with the scheme"
        f" {marker.scheme.name!r}: it does not read back, even unattacked. Use {remedy}."
    )


def _matches_record(scheme: Scheme, record: Record) -> bool:
    """Whether a record is of this scheme with these fields; the scheme may be one of the caller's own."""
    if scheme.name in SCHEMES:
        return scheme == make_scheme(record.scheme, record.parameters)
    return (scheme.name, parameters_of(scheme)) == (record.scheme, dict(record.parameters))


def _share(survived: Sequence[float]) -> list[float]:
    """Share the budget so that all marks survive the same noise; the squares of the shares add up to 1."""
    if not all(0 < noise < math.inf for noise in survived):
        return [math.sqrt(1 / len(survived))] * len(survived)
    norm = math.sqrt(sum(noise**-2 for noise in survived))
    return [min(max(1 / noise / norm, _LEAST_SHARE), _MOST_SHARE) for noise in survived]


def _rounded_up(value: float) -> float:
    """Round a number up to four digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / unit * (1 + 1e-9)) * unit
