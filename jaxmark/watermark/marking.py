"""Marking meshes and reading them: from meshes, messages and keys to marked meshes and evidence."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from jaxmark import distortion
from jaxmark.alignment import alignment
from jaxmark.alignment.alignment import Align, Alignment
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark import evidence
from jaxmark.watermark.budget import Budget, Limits, make_budget, write
from jaxmark.watermark.carriers.carrier import Carrier, Reader, Received
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.coding.message import CANDIDATES, TAG_BITS, decode, encode
from jaxmark.watermark.detectors import Detector, claims
from jaxmark.watermark.payload import Capacity, Conditions
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes import DEFAULT_SCHEME, SCHEMES, Scheme, get_scheme, parameters_of

DEFAULT_BITS = 64  # size of the payload
NOISE = 0.005  # half width over the mean distance to the centre: the strongest noise of the SMI 2010 protocol
COVERAGE = 0.5  # share of the vertices that may be left


class EmbedInfo(NamedTuple):
    """How a mesh was marked."""

    rms: float  # RMS displacement of the welded vertices that faces use, unweighted, over the bounding-box diagonal
    max: float  # the largest such displacement
    beta: float  # strength: the factor on the carrier's unit displacement, in diagonals
    record: Record  # what the owner needs to read the mark again


class Detection(NamedTuple):
    """The result of reading a suspect."""

    message: bytes | None  # the message that was read; None unless its keyed tag fits
    log10_p: float  # log10 of a bound on the false-positive probability, in [-77, 0]
    log10_p_fitted: float  # log10 of that probability if the score were Gaussian: an estimate, which decides nothing
    scores: Float64[np.ndarray, " code"]  # soft values of the code bits, scaled to root mean square 1
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
    """Marks one original and reads any number of suspects, with one key, payload size and scheme; prepares only once.

    Make one with `make_marker`.
    """

    original: Original
    key: Key
    bits: int  # size of the payload in bits
    scheme: Scheme
    carrier: Carrier
    code_bits: int  # number of code bits that are carried
    detector: Detector

    @cached_property
    def reader(self) -> Reader:
        """The reader of the carrier; made when it is first needed."""
        return self.carrier.reader()

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        noise: float = NOISE,
        read_back: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `embed`.

        Pass `read_back=False` if you verify the written file yourself.
        """
        self.check_size(message)
        bounds = make_budget(budget, limits)
        if not 0 <= noise < math.inf:
            raise JaxmarkError(f"The noise to survive is a number of at least 0, got {noise}.")
        marked, info = self.write(self.codeword(message), bounds)
        # A budget without limits is met up to rounding, so its own number is used.
        reached = info.rms if bounds.limits else bounds.rms or 0.0
        self._check_capacity(reached, Conditions(bounds, noise, COVERAGE))
        if read_back:
            self.check(marked, message)
        return marked, info

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that a message can be read from a marked mesh that was not attacked.

        Raises:
            JaxmarkError: if it cannot be read.
        """
        if not self.reads(marked, message):
            raise JaxmarkError(
                f"This mesh ({int(self.original.used.sum())} points) cannot carry {self.bits} bits with the scheme"
                f" {self.scheme.name!r}: they do not read back, even unattacked. Use a shorter message, or a finer or"
                " less regular mesh."
            )

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message can be read from a mesh that has the original's vertex order.

        Plain correlations nearly always read a keyed mark that was not attacked. They are tried first, because
        weighting the bands and joint decoding are most of the work of `detect`.
        """
        observed = self.observe(alignment.align(self.original, marked, "same"))
        # `Reader.glance` stands for the scheme's own detector, not for any other.
        quick = self.reader.glance(observed) if self.detector is self.scheme.detector else None
        if quick is not None and self._decode(quick) == message:
            return True
        return self._decode(self.soft_values(self.reader.receive(observed))) == message

    def detect(
        self,
        suspect: Mesh | Alignment,
        message: bytes | None = None,
        weights: ArrayLike | None = None,
        align: Align = "auto",
    ) -> Detection:
        """Read a suspect, with a claimed message or without; see `detect`.

        A suspect that is read with several keys needs to be aligned only once: pass the result of
        `jaxmark.alignment.alignment.align` in its place.
        """
        if message is not None:
            self.check_size(message)
        aligned = suspect if isinstance(suspect, Alignment) else alignment.align(self.original, suspect, align)
        received = self.receive(aligned, weights)
        observed, soft = received.observed, self.soft_values(received)
        found = self._decode(soft)
        log10_p = fitted = 0.0
        # If another message is read, it refutes the claim, however similar the two are.
        if (chosen := message or found) is not None and found in (None, chosen):
            codeword = jnp.asarray(self.codeword(chosen), observed.residual.dtype)
            scores, norms = claims(self.reader, received, codeword)
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
        coverage = float(np.mean(self.original.to_host(observed.weights)[self.original.used] > 0))
        return Detection(found, log10_p, fitted, soft / size, coverage, aligned)

    def write(self, amplitudes: Float64[np.ndarray, " code"], budget: Budget) -> tuple[Mesh, EmbedInfo]:
        """Displace the original by the carrier, with any amplitudes of the code bits, as far as a budget allows.

        Args:
            amplitudes: one number for each code bit, up to a common factor.
            budget: the bounds to keep, see `budget.write`.

        Raises:
            JaxmarkError: if the carrier does not displace this mesh at all; or see `budget.write`.
        """
        original = self.original
        unit = original.to_host(self.carrier.displacement(jnp.asarray(amplitudes, original.signal.dtype)))
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
        """Align a suspect and find what it shows of each point's displacement, in diagonals; independent of the key.

        Args:
            suspect: a mesh, or its alignment.
            weights: one number for each vertex of the original, see `detect`.
        """
        found = suspect if isinstance(suspect, Alignment) else alignment.align(self.original, suspect)
        if weights is not None:
            found = found._replace(weights=found.weights * self._per_point(weights))
        return alignment.observation(self.original, found)

    def receive(self, suspect: Mesh | Alignment, weights: ArrayLike | None = None) -> Received:
        """Find what the reader learns from a suspect, independently of the key; see `Reader.receive`."""
        return self.reader.receive(self.observe(suspect, weights))

    def codeword(self, message: bytes) -> Float64[np.ndarray, " code"]:
        """The code bits of a message and its keyed tag, each -1 or +1."""
        return encode(message, self.key, self.original.geometry, self.code_bits)

    def soft_values(self, received: Received) -> Float64[np.ndarray, " code"]:
        """Compute one soft value per code bit."""
        return np.asarray(self.detector(self.reader, received, 1.0), np.float64)

    def _decode(self, soft: ArrayLike) -> bytes | None:
        """Decode the message whose keyed tag fits, if there is one."""
        return decode(np.asarray(soft, np.float64), self.bits, self.key, self.original.geometry)

    def _per_point(self, weights: ArrayLike) -> Float64[np.ndarray, " points"]:
        """Convert weights of vertices to weights of points, each the mean over the vertices at the point."""
        given, point = np.asarray(weights, np.float64), self.original.weld.point
        if given.shape != point.shape or not (np.isfinite(given) & (given >= 0)).all():
            raise JaxmarkError(f"weights must be {len(point)} finite numbers, not negative, one for each vertex.")
        return np.bincount(point, given) / np.bincount(point)

    def _check_capacity(self, reached: float, conditions: Conditions) -> None:
        """Check that the payload is readable under these conditions at an RMS displacement of `reached` diagonals."""
        room = Capacity(self.original, self.scheme, {self.bits: self.reader})
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
        """Check that a message has exactly the payload's size.

        Raises:
            JaxmarkError: if it is not bytes, or of another size.
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
            stays where it is.
        key: 32 bytes, from `new_key`.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else 64.
        record: the record of an earlier mark, which fixes scheme and payload size; original and key must be those that
            it was made with.
        scheme: a name (`"keyed"`, `"host"`, `"eigen"`), which a record overrides; or a scheme of
            `jaxmark.watermark.schemes` or your own.
        detector: a detector of `jaxmark.watermark.detectors`; by default the scheme's own.

    Returns:
        The marker.

    Raises:
        JaxmarkError: if the mesh, key or payload is unusable, or the record is for another original, key or payload.
    """
    key = Key(key)
    ready = make_original(original)
    if record is not None:
        record.check("message", ready.geometry, key)
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        bits = record.bits
        if isinstance(scheme, str):
            scheme = get_scheme(record.scheme, record.parameters)
        elif not _matches_record(scheme, record):
            raise JaxmarkError(
                f"The record is of the scheme {record.scheme!r} with {dict(record.parameters)}, not {scheme}."
            )
    scheme = get_scheme(scheme)
    payload = DEFAULT_BITS if bits is None else bits
    code_bits = scheme.code_length(ready, payload)
    carrier = scheme.carrier(ready, key, payload, code_bits)
    return Marker(ready, key, payload, scheme, carrier, code_bits, detector or scheme.detector)


def _matches_record(scheme: Scheme, record: Record) -> bool:
    """Whether a record names this scheme, which may be one of the caller's own, with these fields."""
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
    """Embed a message in the vertex positions of a mesh.

    The mark is as strong as budget and limits allow; by default it is so weak that people do not notice it
    (`budget.DEFAULT_LIMITS`). The message is read back before the mesh is returned, and a mesh that cannot carry it is
    refused.

    Args:
        mesh: the original.
        message: any bytes, at least one.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement of the welded vertices that faces use, unweighted, relative to the diagonal of their
            axis-aligned bounding box: 0.0008 is 0.08 % of it. It is met exactly, unless a limit is reached first.
        limits: the largest values that metrics of `distortion.METRICS` may reach, by name, in the units of
            `distortion.Comparison`; or that metrics of your own may, by function (see `distortion.measure`).
        noise: the noise that the message must survive when half of the vertices are lost, see `capacity`; 0 requires
            only that there are enough dimensions. It has no effect for schemes whose readers have no model of noise,
            such as `host` and `eigen`.
        scheme: a name or a scheme, see `make_marker`.

    Returns:
        The marked mesh (float64 vertices, same faces) and how it was marked.

    Raises:
        JaxmarkError: if the mesh, key, budget or payload is unusable, or the mesh cannot carry so many bits; the
            error then states the largest payload, and the least budget if there is one.
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
    scheme: str | Scheme = DEFAULT_SCHEME,
) -> int:
    """Compute how many bits a mesh can carry, by the energy and the dimensions of a mark that projection leaves.

    For schemes whose readers have no model of noise, such as `host` and `eigen`, only the number of code bits counts.

    Args:
        mesh: the original.
        budget: RMS displacement, see `embed`.
        limits: limits on metrics, see `embed`; how much displacement they allow is tried for each payload size.
        noise: half width of uniform noise on each coordinate, relative to the mean distance of the vertices to their
            centre; by default the strongest of the SMI 2010 protocol (Wang et al.), 0.5 %.
        coverage: share of the vertices that may be left.
        scheme: a name or a scheme, see `make_marker`.

    Returns:
        The largest payload in bits, a multiple of 8; 0 if not even 8.

    Raises:
        JaxmarkError: if the mesh is unusable or a number is out of range.
    """
    if not (0 <= noise < math.inf and 0 < coverage <= 1):
        raise JaxmarkError(
            f"capacity needs a noise of at least 0 and a coverage in (0, 1], got {noise:g} and {coverage:g}."
        )
    conditions = Conditions(make_budget(budget, limits), noise, coverage)
    return Capacity(make_original(mesh), get_scheme(scheme)).bits(conditions)


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
    """Read a mark from a suspect, and compute what the reading proves.

    The suspect is first aligned with the original (`jaxmark.alignment.alignment.align`); points that are far off are
    masked. Without `message`, the message that is read counts only if its keyed tag fits. Two kinds of proof are then
    tried, and each is paid for: the tag, and the union bound over all messages. With `message`, log10_p is Hoeffding's
    bound for that message (see `evidence.log10_p_claimed`), which can prove a mark whose message can no longer be read;
    if another message is read, the claim is refuted (log10_p = 0). The score is taken for each way of weighting the
    suspect (see `detectors.claims`), and each is paid for, too.

    Both bounds hold for any suspect independent of the key, provided that key, original and claimed message were fixed
    before the suspect was seen; that weights depend on suspect and original only; and that the score is the plain
    correlation of the codeword: joint decoding may choose the codeword, but does not enter the score. A mesh marked
    under the same key is not independent of it: once its message can no longer be read, a claim of a message that has
    many bits in common with it may pass.

    Args:
        suspect: any mesh: moved, reordered, cropped, remeshed.
        original: the unmarked mesh.
        key: 32 bytes.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else the claimed message's, else
            64.
        message: the message that is claimed to be in the suspect; None to read without a claim.
        record: the record of the mark, see `make_marker`.
        scheme: the scheme that the mark was embedded with, if there is no record.
        detector: a detector, see `make_marker`.
        weights: one number for each vertex of the original, not negative: how far to trust what the suspect shows of
            it, 0 for not at all; **must not depend on the key**.
        align: how the suspect is aligned: `"auto"`, `"same"`, `"similarity"` or `"affine"`.

    Returns:
        The result of the reading; a suspect identical to the original gives log10_p = 0.

    Raises:
        JaxmarkError: see `make_marker`; also if the suspect cannot be aligned, or the claimed message has another size
            than the payload.
    """
    if bits is None and record is None and isinstance(message, bytes):
        bits = 8 * len(message)
    marker = make_marker(original, key, bits=bits, record=record, scheme=scheme, detector=detector)
    return marker.detect(suspect, message, weights, align)
