"""Marking meshes: messages and keys in, meshes and evidence out."""

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from jaxmark import alignment, distortion, evidence
from jaxmark.alignment import Align, Alignment
from jaxmark.budget import Budget, Limits, make_budget, write
from jaxmark.carriers import Carrier, KeyedCarrier
from jaxmark.detectors import Detector, claims, joint, projected
from jaxmark.errors import JaxmarkError
from jaxmark.keys import Key, commitment
from jaxmark.mesh import Mesh
from jaxmark.message import CANDIDATES, TAG_BITS, decode, encode
from jaxmark.observation import Observation
from jaxmark.original import Original, prepare
from jaxmark.payload import Capacity, Conditions
from jaxmark.record import Record
from jaxmark.schemes import DEFAULT_SCHEME, SCHEMES, KeyedScheme, Scheme, get_scheme, parameters_of

DEFAULT_BITS = 64
NOISE = 0.005  # the strongest of the SMI 2010 protocol
COVERAGE = 0.5


class EmbedInfo(NamedTuple):
    """What was done to a mesh."""

    rms: float  # displacement of the welded vertices that faces use, unweighted, over the bounding-box diagonal
    max: float  # the largest such displacement
    beta: float  # strength: the factor on the carrier's unit displacement, in diagonals
    record: Record


class Detection(NamedTuple):
    """What was found in a suspect."""

    message: bytes | None  # the message read, None unless its keyed tag fits
    log10_p: float  # log10 of a bound on the false-positive probability, in [-77, 0]
    log10_p_fitted: float  # the same if the score were Gaussian: an estimate, which decides nothing
    scores: Float64[np.ndarray, " code"]  # soft values of the code bits, of root mean square 1
    coverage: float  # share of the original's points that the suspect gave evidence for
    alignment: Alignment  # how the suspect was brought back to the original

    def detected(self, alpha: float = 1e-6) -> bool:
        """Whether the false-positive probability is at most `alpha`.

        Raises:
            JaxmarkError: if `alpha` is not in (0, 1).
        """
        if not 0 < alpha < 1:
            raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
        return self.log10_p <= math.log10(alpha)


@dataclass(frozen=True, eq=False)
class Marker:
    """Key, payload and scheme on one original: marks it, and reads any number of suspects, preparing only once.

    Make one with `make_marker`.
    """

    original: Original
    key: Key
    bits: int  # payload
    scheme: Scheme
    carrier: Carrier
    code: int  # how many code bits are carried
    detector: Detector

    @cached_property
    def reader(self) -> Carrier:
        """The carrier, with what only reading needs."""
        return self.carrier.prepared() if isinstance(self.carrier, KeyedCarrier) else self.carrier

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        noise: float = NOISE,
        read_back: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Hide a message of just the payload's size in the original; see `embed`.

        Who reads the mark back elsewhere, from the file it went to, can leave that out here.
        """
        self.check_size(message)
        bounds = make_budget(budget, limits)
        if not 0 <= noise < math.inf:
            raise JaxmarkError(f"The noise to survive is a number of at least 0, got {noise}.")
        marked, info = self.write(encode(message, self.key, self.original.geometry, self.code), bounds)
        if isinstance(self.scheme, KeyedScheme) and isinstance(self.reader, KeyedCarrier):
            # A budget without limits is met up to rounding.
            reached = info.rms if bounds.limits else bounds.rms or 0.0
            self._check_capacity(self.scheme, self.reader, reached, Conditions(bounds, noise, COVERAGE))
        if read_back:
            self.check(marked, message)
        return marked, info

    def check(self, marked: Mesh, message: bytes) -> None:
        """Refuse a mesh from which the message does not read, unattacked as it is.

        Raises:
            JaxmarkError: if so.
        """
        if not self.reads(marked, message):
            raise JaxmarkError(
                f"This mesh ({int(self.original.used.sum())} points) cannot carry {self.bits} bits with the scheme"
                f" {self.scheme.name!r}: they do not read back, even unattacked. Use a shorter message, or a finer or"
                " less regular mesh."
            )

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message reads from a mesh in the original's order.

        A keyed mark that nobody attacked nearly always reads by plain correlations; weighing bands and joint decoding
        are most of the work of `detect`.
        """
        observed = self.observe(alignment.align(self.original, marked, "same"))
        if self.detector is joint and self._decoded(projected(self.reader, observed)) == message:
            return True
        return self._decoded(self.soft_values(observed)) == message

    def detect(
        self,
        suspect: Mesh | Alignment,
        message: bytes | None = None,
        weights: ArrayLike | None = None,
        align: Align = "auto",
    ) -> Detection:
        """Read a suspect, with a claimed message or without; see `detect`.

        One that is read with several keys needs to be aligned only once, by `jaxmark.alignment.align`.
        """
        if message is not None:
            self.check_size(message)
        aligned = suspect if isinstance(suspect, Alignment) else alignment.align(self.original, suspect, align)
        observed = self.observe(aligned, weights)
        if isinstance(self.reader, KeyedCarrier) and self.detector is joint:
            # Reading and claiming begin alike.
            received = self.reader.received(observed)
            soft, claim = np.asarray(joint(self.reader, received), np.float64), partial(claims, self.reader, received)
        else:
            soft, claim = self.soft_values(observed), partial(claims, self.reader, observed)
        found = self._decoded(soft)
        log10_p = fitted = 0.0
        # Another message that reads refutes the claim, however much the two have in common.
        if (chosen := message or found) is not None and found in (None, chosen):
            codeword = encode(chosen, self.key, self.original.geometry, self.code)
            scores, norms = claim(jnp.asarray(codeword, observed.residual.dtype))
            ways = list(zip(scores, norms, strict=True))
            if message is not None:
                log10_p = evidence.any_of(*(evidence.log10_p_claimed(score, norm) for score, norm in ways))
            else:
                log10_p = evidence.any_of(
                    evidence.log10_p_tag(TAG_BITS, CANDIDATES),
                    *(evidence.log10_p_read(score, norm, self.bits) for score, norm in ways),
                )
            unknown = 0 if message is not None else self.bits
            fitted = evidence.any_of(*(evidence.log10_p_fitted(score, norm, unknown) for score, norm in ways))
        size = np.sqrt(np.mean(soft**2)) or 1.0
        coverage = float(np.mean(self.original.on_host(observed.weights)[self.original.used] > 0))
        return Detection(found, log10_p, fitted, soft / size, coverage, aligned)

    def write(self, amplitudes: Float64[np.ndarray, " code"], budget: Budget) -> tuple[Mesh, EmbedInfo]:
        """Displace the original by the carrier of any amplitudes, as far as the budget allows; see `budget.write`."""
        original = self.original
        unit = original.on_host(self.carrier.displacement(jnp.asarray(amplitudes, original.signal.dtype)))
        size = float(distortion.rms(unit[original.used]))
        if not (math.isfinite(size) and size > 0):
            raise JaxmarkError(
                f"The {len(unit)} points of this mesh leave the scheme {self.scheme.name!r} nothing to write in."
            )
        written = write(original, unit, budget)
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=written.scale,
            original=original.geometry.hex(),
            key=commitment(self.key),
            parameters=parameters_of(self.scheme),
        )
        return written.mesh, EmbedInfo(written.moved.rms, written.moved.max, written.scale, record)

    def observe(self, suspect: Mesh | Alignment, weights: ArrayLike | None = None) -> Observation:
        """What a suspect shows of each point's displacement, in diagonals; free of the key."""
        found = suspect if isinstance(suspect, Alignment) else alignment.align(self.original, suspect)
        if weights is not None:
            found = found._replace(weights=found.weights * self._per_point(weights))
        return alignment.observation(self.original, found)

    def soft_values(self, seen: Observation) -> Float64[np.ndarray, " code"]:
        """One soft value per code bit."""
        return np.asarray(self.detector(self.reader, seen, 1.0), np.float64)

    def _decoded(self, soft: ArrayLike) -> bytes | None:
        """The message whose keyed tag fits, if any."""
        return decode(np.asarray(soft, np.float64), self.bits, self.key, self.original.geometry)

    def _per_point(self, weights: ArrayLike) -> Float64[np.ndarray, " points"]:
        """Weights of vertices as weights of points; a point's copies are averaged."""
        given, point = np.asarray(weights, np.float64), self.original.weld.point
        if given.shape != point.shape or not (np.isfinite(given) & (given >= 0)).all():
            raise JaxmarkError(f"weights must be {len(point)} finite numbers, not negative, one for each vertex.")
        return np.bincount(point, given) / np.bincount(point)

    def _check_capacity(
        self, scheme: KeyedScheme, carrier: KeyedCarrier, reached: float, conditions: Conditions
    ) -> None:
        room = Capacity(self.original, scheme, {self.bits: carrier})
        least = room.least_budget(self.bits, conditions)
        if least <= reached:
            return
        most = room.bits(conditions)
        mend = "Use a shorter message"
        if math.isfinite(least):
            mend += f", or a budget of at least {math.ceil(1e6 * least) / 1e6:g}"
        raise JaxmarkError(
            f"This mesh ({int(self.original.used.sum())} points) carries at most {most} bits at"
            f" {conditions.budget}, with noise of {conditions.noise:g} and half of it lost, not {self.bits}. {mend}."
        )

    def check_size(self, message: bytes) -> None:
        """Refuse what is no message of just the payload's size.

        Raises:
            JaxmarkError: so.
        """
        if not isinstance(message, bytes):
            raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
        if 8 * len(message) != self.bits:
            raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {self.bits} bits.")


def make_marker(
    original: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    record: Record | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
    detector: Detector | None = None,
) -> Marker:
    """Prepare an original for marking, or for reading many suspects.

    Args:
        original: the unmarked mesh. Vertices at exactly the same position move together; a vertex that no face uses
            stays.
        key: 32 bytes, from `new_key`.
        bits: payload, a multiple of 8; by default the record's, else 64.
        record: of an earlier mark; fixes scheme and payload, and binds to original and key.
        scheme: a name (`"keyed"`, `"host"`, `"eigen"`), which a record overrides; or an object of `jaxmark.schemes`.
        detector: see `jaxmark.detectors`; by default the scheme's own.

    Returns:
        The marker.

    Raises:
        JaxmarkError: if the mesh, key or payload is unusable, or the record is for another original, key or payload.
    """
    key = Key(key)
    ready = prepare(original)
    if record is not None:
        record.check("message", ready.geometry, key)
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        bits = record.bits
        if isinstance(scheme, str):
            scheme = get_scheme(record.scheme, record.parameters)
        elif not _recorded(scheme, record):
            raise JaxmarkError(
                f"The record is of the scheme {record.scheme!r} with {dict(record.parameters)}, not {scheme}."
            )
    scheme = get_scheme(scheme)
    payload = DEFAULT_BITS if bits is None else bits
    code = scheme.code_length(ready, payload)
    carrier = scheme.carrier(ready, key, payload, code)
    return Marker(ready, key, payload, scheme, carrier, code, detector or scheme.detector)


def _recorded(scheme: Scheme, record: Record) -> bool:
    """Whether a record is of a scheme, which may be one of the caller's own."""
    if scheme.name in SCHEMES:
        return scheme == get_scheme(record.scheme, record.parameters)
    return (scheme.name, parameters_of(scheme)) == (record.scheme, dict(record.parameters))


def embed(
    mesh: Mesh,
    message: bytes,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
    noise: float = NOISE,
    scheme: str | Scheme = DEFAULT_SCHEME,
) -> tuple[Mesh, EmbedInfo]:
    """Hide a message in the vertex positions of a mesh.

    The mark is as strong as budget and limits allow; by default as people do not notice (`budget.DEFAULT_LIMITS`). It
    is read back before the mesh is returned: a mesh that does not carry it is refused, not marked in vain.

    Args:
        mesh: the original.
        message: any bytes, at least one.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement of the welded vertices that faces use, unweighted, relative to the diagonal of their
            axis-aligned bounding box: 0.0008 is 0.08 % of it. It is met exactly, unless a limit is reached first.
        limits: the most that metrics of `distortion.METRICS` may reach, by name, in the units of
            `distortion.Comparison`; or metrics of your own, by function (see `distortion.measure`).
        noise: which the message must survive when half of the vertices are lost, see `capacity`; 0 asks only that there
            are dimensions enough. For the keyed scheme only.
        scheme: see `make_marker`.

    Returns:
        The marked mesh (float64 vertices, same faces) and what was done to it.

    Raises:
        JaxmarkError: if the mesh, key, budget or payload is unusable, or the mesh cannot carry so many bits; the
            sentence then has the largest payload, and the least budget if there is one.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    marker = make_marker(mesh, key, bits=8 * len(message), scheme=scheme)
    return marker.embed(message, budget, limits=limits, noise=noise)


def capacity(
    mesh: Mesh,
    budget: float | None = None,
    *,
    limits: Limits | None = None,
    noise: float = NOISE,
    coverage: float = COVERAGE,
    scheme: KeyedScheme | None = None,
) -> int:
    """How many bits a mesh carries by the keyed scheme, by what is left after projection: energy and dimensions.

    Args:
        mesh: the original.
        budget: see `embed`.
        limits: see `embed`; how much displacement they allow is tried for each payload.
        noise: half width of uniform noise on each coordinate, relative to the mean distance of the vertices to their
            centre; by default the strongest of the SMI 2010 protocol (Wang et al.), 0.5 %.
        coverage: share of the vertices that may be left.
        scheme: by default `KeyedScheme()`.

    Returns:
        The largest payload in bits, a multiple of 8; 0 if not even 8.

    Raises:
        JaxmarkError: if the mesh is unusable or a number out of range.
    """
    if not (0 <= noise < math.inf and 0 < coverage <= 1):
        raise JaxmarkError(
            f"capacity needs a noise of at least 0 and a coverage in (0, 1], got {noise:g} and {coverage:g}."
        )
    conditions = Conditions(make_budget(budget, limits), noise, coverage)
    return Capacity(prepare(mesh), scheme or KeyedScheme()).bits(conditions)


def detect(
    suspect: Mesh,
    *,
    original: Mesh,
    key: bytes,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
    detector: Detector | None = None,
    weights: ArrayLike | None = None,
    align: Align = "auto",
) -> Detection:
    """Read a mark from a suspect, and say what the reading proves.

    The suspect is brought back to the original first (`jaxmark.alignment.align`); points that are far off are masked.
    Without `message`, the message read counts only if its keyed tag fits; proofs are then tried and paid for: the tag,
    and the union bound over all messages. With `message`, log10_p is Hoeffding's bound for that message (see
    `evidence.log10_p_claimed`), which can prove a mark whose message no longer reads; a claim is refuted (0) where
    another message reads. Scores are taken in each way of weighing that `detectors.claims` knows, and paid for, too.

    Both hold for any suspect independent of the key, provided that key, original and claimed message were fixed before
    the suspect was seen; that weights depend on suspect and original only; and that the score is the plain correlation
    of the codeword, which joint decoding may choose but does not enter. A mesh marked under the same key is not
    independent of it: once its message no longer reads, a claim that has many bits in common with it may pass.

    Args:
        suspect: any mesh: moved, reordered, cropped, remeshed.
        original: the unmarked mesh.
        key: 32 bytes.
        bits: payload, a multiple of 8; by default the record's, else the claimed message's, else 64.
        message: the message that is claimed to be there.
        record: see `make_marker`.
        scheme: as embedded, where there is no record.
        detector: see `make_marker`.
        weights: for each vertex of the original how far what the suspect shows of it may be trusted, 0 not at all; free
            of the key.
        align: how the suspect is compared: `"auto"`, `"same"`, `"similarity"` or `"affine"`.

    Returns:
        What was found; a suspect identical to the original gives log10_p = 0.

    Raises:
        JaxmarkError: as `make_marker`; also if the suspect cannot be aligned, or the claimed message has another size
            than the payload.
    """
    if bits is None and record is None and isinstance(message, bytes):
        bits = 8 * len(message)
    marker = make_marker(original, key, bits=bits, record=record, scheme=scheme, detector=detector)
    return marker.detect(suspect, message, weights, align)
