"""A mark that is read with the original: its original, key, payload and scheme, and how it is written and read."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from jaxmark import distortion
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original, make_original
from jaxmark.alignment.result import Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.canonical import Canonical
from jaxmark.geometry.imprint import Imprint, make_imprint, restore
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Choices, Key, bind, commitment
from jaxmark.watermark.coding.message import CANDIDATES, Decoded, decode, encode
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.ledger import Charge
from jaxmark.watermark.interfaces import Carrier, Detector, Reader, Received, Scheme
from jaxmark.watermark.perception.budget import Budget, BudgetLike, displace_within
from jaxmark.watermark.perception.capacity import Capacity, Survival
from jaxmark.watermark.record import Content, Record, commit, seal_imprint
from jaxmark.watermark.schemes.registry import is_builtin, parameters_of

_MIN_ORIGINAL_SHARE = 0.5  # least share of an original's points with which an edited copy is used, for an estimate
_SAME_SHAPE = 0.01  # distance of shapes over their size; with a smaller one the mesh looks like a marked or edited copy


_AnyMark = TypeVar("_AnyMark", bound="Mark")


class EmbedInfo(NamedTuple):
    """The strength, the record and the predicted survival of a mark that was embedded."""

    rms: float  # unweighted RMS displacement of the welded vertices of faces, over the bounding-box diagonal
    max: float  # the largest such displacement
    beta: float  # strength: the factor on the carrier's unit displacement, in diagonals
    record: Record  # the record, which the owner needs to read the mark again
    survives: Survival = Survival(0.0, 0.0)  # as predicted; `Marker.measure_survival` measures it
    notes: tuple[str, ...] = ()  # why limits allow far less than usual, if they do

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Return a context that adds the notes to the sentence of a `JaxmarkError`."""
        try:
            yield
        except JaxmarkError as error:
            raise JaxmarkError(" ".join((str(error), *self.notes))) from error


@dataclass(frozen=True, eq=False)
class Mark:
    """A mark: its original, key, payload and scheme, prepared once for writing it and for reading suspects."""

    original: Original
    choices: Choices  # the keyed choices
    bits: int  # size of the payload in bits
    scheme: Scheme
    carrier: Carrier
    code_bits: int  # number of code bits that are carried
    detector: Detector
    content: Content = "message"  # the kind of content of the code bits
    record: Record | None = None  # the record of the mark that is read
    caveats: tuple[str, ...] = ()  # the reasons why readings are no proof

    @classmethod
    def make(
        cls: "type[_AnyMark]",
        original: Original,
        key: bytes,
        scheme: Scheme,
        bits: int,
        *,
        record: Record | None = None,
        detector: Detector | None = None,
        caveats: tuple[str, ...] = (),
    ) -> "_AnyMark":
        """Make a mark that carries a message, or a presence mark if there is no payload.

        Raises:
            JaxmarkError: if the payload does not fit.
        """
        code_bits = scheme.code_length(original, bits) if bits else 1
        content: Content = "message" if bits else "presence"
        choices = bind_mark(key, original, scheme, bits, content, record)
        carrier = scheme.carrier(original, choices, bits, code_bits)
        if not is_builtin(scheme):
            caveats += (f"the scheme {scheme.name!r} is not one of this library",)
        if detector not in (None, carrier.detector):
            caveats += ("the detector is not the carrier's own",)
        chosen = detector or carrier.detector
        return cls(original, choices, bits, scheme, carrier, code_bits, chosen, content, record, caveats)

    @property
    def key(self) -> Key:
        """The key."""
        return self.choices.key

    @cached_property
    def reader(self) -> Reader:
        """The reader of the carrier; made at its first use."""
        return self.carrier.reader()

    def begin_reading(self) -> None:
        """Begin to make the reader, which JAX does beside what follows, such as aligning a suspect."""
        _ = self.reader

    @cached_property
    def capacity(self) -> Capacity:
        """The capacity of the original with the scheme."""
        return Capacity(self.original, self.scheme, {self.bits: partial(getattr, self, "reader")})

    @property
    def order_charges(self) -> tuple[Charge, ...]:
        """The charge for the order of vertices in which the original was presented, if there is a record."""
        if self.record is None:
            return ()
        return (ledger.ORDER.charge("marked" if self.original.in_order else "another"),)

    @property
    def uses_own_detector(self) -> bool:
        """Whether the detector is the carrier's own; only then do the reader's shortcuts give equivalent results."""
        return self.detector is self.carrier.detector

    def choices_of(self, key: bytes) -> Choices:
        """Return the keyed choices of the same mark under another key."""
        return replace(self.choices, key=Key(key))

    def codeword(self, message: bytes) -> Float64[np.ndarray, " code"]:
        """Encode a message and its keyed tag as code bits, each -1 or +1."""
        return encode(message, self.choices, self.code_bits)

    def write(
        self, amplitudes: Float64[np.ndarray, " code"], budget: BudgetLike = None, *, content: bytes = b""
    ) -> tuple[Mesh, EmbedInfo]:
        """Displace the original by the carrier, with any amplitudes of the code bits, as far as a budget allows.

        Args:
            amplitudes: one number for each code bit, up to a common factor.
            budget: see `embed`.
            content: the message or the recipient that the record commits to; b"" for none.

        Raises:
            JaxmarkError: if the carrier does not displace this mesh at all; see also `displace_within`.
        """
        original, bounds = self.original, Budget.of(budget).bounds_of(self.original)
        if original.weld.point.max() >= len(original.used):
            raise JaxmarkError(
                "The original has vertices that no face uses, and another order than when it was marked with this"
                " record; mark it without the record."
            )
        if not original.is_whole:
            raise JaxmarkError(
                "The original was edited since it was marked with this record; give an exact copy, or mark without the"
                " record."
            )
        unit = original.to_host(self.carrier.displacement(jax.device_put(amplitudes.astype(original.signal.dtype))))
        size = float(distortion.rms(unit[original.used]))
        if not (math.isfinite(size) and size > 0):
            raise JaxmarkError(
                f"This mesh ({len(unit)} points) cannot be marked with the scheme {self.scheme.name!r}: no point moves."
            )
        written = displace_within(original, unit, bounds)
        canonical = Canonical(original.points, original.weld, original.geometry, original.order)
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=written.scale,
            original=original.geometry.hex(),
            key=commitment(self.key),
            parameters=parameters_of(self.scheme),
            content=self.content,
            message_commitment=commit(content, self.choices) if content else "",
            imprint=seal_imprint(make_imprint(canonical, original.grid), self.key),
        ).sealed(self.key)
        return written.mesh, EmbedInfo(
            written.moved.rms, written.moved.max, written.scale, record, notes=(written.note,) if written.note else ()
        )

    def observe(self, aligned: Alignment, weights: ArrayLike | None = None) -> Observation:
        """Compute the observed displacement of each point of the original, in diagonals; independent of the key.

        Args:
            aligned: the suspect's alignment with the original.
            weights: one number for each vertex of the original, see `detect`.
        """
        if weights is not None:
            aligned = aligned._replace(weights=aligned.weights * self._per_point(weights))
        return aligned.observation(self.original)

    def receive(self, aligned: Alignment, weights: ArrayLike | None = None) -> Received:
        """Extract the data that the reader needs from a suspect, independently of the key; see `Reader.receive`."""
        return self.reader.receive(self.observe(aligned, weights))

    def soft_decisions(self, received: Received) -> Float64[np.ndarray, " code"]:
        """Compute one soft decision per code bit."""
        return np.asarray(self.detector(self.reader, received, 1.0), np.float64)

    def decode(self, soft: ArrayLike, candidates: int = CANDIDATES) -> Decoded | None:
        """Decode the message from soft decisions; None if the keyed tag of no candidate matches."""
        return decode(np.asarray(soft, np.float64), self.bits, self.choices, candidates)

    def read_quickly(self, observation: Observation) -> bytes | None:
        """Decode a lightly attacked suspect at low cost, see `Reader.read_quickly`; None if no message is decoded."""
        quick = self.reader.read_quickly(observation)
        decoded = self.decode(quick if quick is not None else self.soft_decisions(self.reader.receive(observation)))
        return None if decoded is None else decoded.message

    def coverage(self, observed: Observation) -> float:
        """Compute the share of the original's points that a suspect gives evidence for."""
        return float(np.mean(self.original.to_host(observed.weights)[self.original.used] > 0))

    def with_scheme(self: "_AnyMark", scheme: Scheme, bits: int | None = None) -> "_AnyMark":
        """Return the same mark with another scheme of this library or another payload size; it must have no record.

        Raises:
            JaxmarkError: if the payload does not fit.
        """
        bits = self.bits if bits is None else bits
        if (scheme, bits) == (self.scheme, self.bits):
            return self
        detector = None if self.uses_own_detector else self.detector
        return self.make(self.original, self.key, scheme, bits, detector=detector)

    def _per_point(self, weights: ArrayLike) -> Float64[np.ndarray, " points"]:
        """Convert weights of vertices to weights of points: the mean over all vertices at the point."""
        values, point = np.asarray(weights, np.float64), self.original.weld.point
        if values.shape != point.shape or not (np.isfinite(values) & (values >= 0)).all():
            raise JaxmarkError(f"weights must be {len(point)} finite numbers of at least 0, one for each vertex.")
        return (np.bincount(point, values) / np.bincount(point))[: len(self.original.used)]


def bind_mark(
    key: bytes, original: Original, scheme: Scheme, bits: int, content: Content, record: Record | None = None
) -> Choices:
    """Bind the keyed choices of a mark to its original and to everything else that reading the mark uses.

    With a record, the fields of the scheme are those in the record, because a later version of jaxmark may have more.
    """
    parameters = parameters_of(scheme) if record is None else record.parameters
    fixed = {"content": content, "scheme": scheme.name, "parameters": parameters, "bits": bits}
    fixed["order"] = original.order.hex()
    return bind(key, original.geometry, fixed)


def recall(original: Mesh, key: bytes, record: Record | None) -> tuple[Original, tuple[str, ...]]:
    """Prepare the original of a mark exactly as it was when the mark was made.

    Args:
        original: the unmarked mesh in its present form.
        key: 32 bytes.
        record: the record of the mark, if there is one.

    Returns:
        The original, and the caveats of reading with it: there is one if it was edited since.

    Raises:
        JaxmarkError: if the mesh is unusable, or is not the one that the record was made for.
    """
    if record is None:
        return make_original(original), ()
    imprint = record.open_imprint(key)
    ready = _restored(original, imprint)
    if ready.geometry == imprint.hash:
        return ready, ()
    copy = restore(original, imprint)
    if copy.exact:
        return _restored(copy.mesh, imprint), ()
    ready = make_original(copy.mesh, imprint.grid)
    if copy.share < _MIN_ORIGINAL_SHARE:
        share = f"it has {100 * copy.share:.0f} % of that mesh's points"
        if copy.distance < _SAME_SHAPE:
            raise JaxmarkError(
                f"The original is not the mesh that the record was made for: {share}, and their shapes differ by only"
                f" {100 * copy.distance:.2g} % of their size. It looks like the marked file, or another edited copy."
            )
        raise JaxmarkError(
            f"The original is not the mesh that the record was made for: {share}, and their shapes differ by"
            f" {100 * copy.distance:.2g} % of their size."
        )
    places = np.full(len(ready.used), -1)
    places[ready.weld.point] = copy.places
    ready = replace(ready, geometry=imprint.hash, places=places, count=len(imprint.tags))
    left = f"{math.floor(1000 * copy.share) / 10:.1f} % of its points are left; use an exact copy"
    return _in_order_of(ready, imprint), (f"the original was edited, and edits can feign a mark: {left}",)


def _restored(copy: Mesh, imprint: Imprint) -> Original:
    """Prepare a copy of an original whose points and faces are exactly those of the original.

    In another order than the marked one, only its canonical points that faces use and its canonical faces count. All
    else, which the imprint does not cover, would be the free choice of whoever presents the copy.
    """
    ready = make_original(copy, imprint.grid)
    if ready.order != imprint.order and not ready.used.all():
        surface = Mesh(ready.points.vertices[ready.used], ready.points.faces)
        ready = replace(make_original(surface, imprint.grid), mesh=ready.mesh, weld=ready.weld, order=ready.order)
    return _in_order_of(ready, imprint)


def _in_order_of(original: Original, imprint: Imprint) -> Original:
    """Bind an original to the vertex order that was marked, which its file may no longer have."""
    return replace(original, order=imprint.order, in_order=original.order == imprint.order)
