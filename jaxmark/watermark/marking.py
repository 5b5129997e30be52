"""Marking meshes and reading them: from meshes, messages and keys to marked meshes and evidence."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from jaxmark import distortion
from jaxmark.alignment import alignment
from jaxmark.alignment.alignment import Align, Alignment
from jaxmark.alignment.heights import VertexHeights
from jaxmark.alignment.nonrigid import Bent
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.canonical import Canonical
from jaxmark.geometry.imprint import Imprint, make_imprint, restore
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.carriers.keyed import KeyedCarrier
from jaxmark.watermark.coding.keys import SCHEME_VERSION, VERSIONS, Choices, Key, bind, commitment
from jaxmark.watermark.coding.message import CANDIDATES, TAG_BITS, Decoded, decode, encode
from jaxmark.watermark.evidence import bounds as evidence
from jaxmark.watermark.interfaces import Carrier, Reader, Received
from jaxmark.watermark.perception.budget import Budget, Limits, Visibility, make_budget, visibility_of, write
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.reading.coarse import receive_coarse
from jaxmark.watermark.reading.detectors import Detector, claims
from jaxmark.watermark.reading.reception import Reception
from jaxmark.watermark.record import Content, Record, commit, seal_imprint
from jaxmark.watermark.schemes.passband import suited
from jaxmark.watermark.schemes.scheme import DEFAULT_SCHEME, SCHEMES, Scheme, get_scheme, parameters_of, stands_for

DEFAULT_BITS = 64  # size of the payload
_MIN_ORIGINAL_SHARE = 0.5  # share of an original's points from which on an edited copy is read with, as an estimate
_SAME_SHAPE = 0.01  # distance of shapes, over their size, below which an original looks like a marked or edited copy
# Shares of the probability. Whoever reads may choose how to align, and sees whether the claimed message reads or
# another one; what is usual keeps nearly all of it.
ALIGN_SHARES = {"auto": 0.97, "same": 0.01, "similarity": 0.01, "affine": 0.01}
CLAIM_SHARE = 0.97
_QUICK_SHARE = 0.03  # of the message that plain matched correlations read first; decoding jointly keeps nearly all
_OTHER_SHARE = 0.05  # of suspects of few vertices, read by these, or bent, read without their bends
_USUAL_SHARE = 0.9  # of the usual pass band; readers with a record know the band
_HAND_SHARE = 0.97  # of the hand that fits a surface better
_MAX_TRIED_NOISE = 0.05  # beyond which no shape is left


class Survival(NamedTuple):
    """The strongest uniform noise that a mark survives: half width over the mean distance of vertices to the centre.

    It is infinite for schemes whose readers have no model of noise.
    """

    whole: float  # if all vertices are left
    half: float  # if half of them are lost


class EmbedInfo(NamedTuple):
    """How a mesh was marked."""

    rms: float  # RMS displacement of the welded vertices that faces use, unweighted, over the bounding-box diagonal
    max: float  # the largest such displacement
    beta: float  # strength: the factor on the carrier's unit displacement, in diagonals
    record: Record  # what the owner needs to read the mark again
    survives: Survival = Survival(0.0, 0.0)  # as predicted; `Marker.tried` tries it


class Detection(NamedTuple):
    """The result of reading a suspect.

    Attributes:
        message: the message that was read; None unless its keyed tag fits.
        log10_p: log10 of a bound on the false-positive probability, in [-77, 0], if all that is claimed is dated.
        log10_p_undated: the same if nothing is: for the best message of any of 2^64 keys, originals and records.
        log10_p_fitted: log10 of that probability if the score were Gaussian: an estimate, which decides nothing.
        log10_p_unfloored: log10_p without the floor at -77: orders attacks and schemes, proves and decides nothing.
        scores: soft values of the code bits that the message was decoded from, scaled to root mean square 1.
        coverage: share of the original's points that the suspect gave evidence for.
        alignment: how the suspect was brought back to the original.
        version: version of the keyed choices that were read with.
        doubts: why the probabilities are estimates, not proofs; empty if they are proofs.
        remarks: what else the suspect looks like.
    """

    message: bytes | None
    log10_p: float
    log10_p_undated: float
    log10_p_fitted: float
    log10_p_unfloored: float
    scores: Float64[np.ndarray, " code"]
    coverage: float
    alignment: Alignment
    version: int
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def premises(self) -> str:
        """What must have been fixed before the suspect existed."""
        return "key, original, message and record"

    def detected(self, alpha: float = 1e-6) -> bool:
        """Whether the false-positive probability is at most `alpha`, if all that is claimed is dated.

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
    choices: Choices  # what derives from the key
    bits: int  # size of the payload in bits
    scheme: Scheme
    carrier: Carrier
    code_bits: int  # number of code bits that are carried
    detector: Detector
    content: Content = "message"  # what the code bits say
    record: Record | None = None  # the record of the mark that is read
    doubts: tuple[str, ...] = ()  # why what is read is no proof

    @property
    def key(self) -> Key:
        """The key."""
        return self.choices.key

    def choices_of(self, key: bytes) -> Choices:
        """The keyed choices of the same mark under another key."""
        return replace(self.choices, key=Key(key))

    @cached_property
    def reader(self) -> Reader:
        """The reader of the carrier; made when it is first needed."""
        return self.carrier.reader()

    @cached_property
    def capacity(self) -> Capacity:
        """What the original can carry with the scheme."""
        return Capacity(self.original, self.scheme, {self.bits: lambda: self.reader})

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
        read_back: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `embed`.

        Pass `read_back=False` if you verify the written file yourself.
        """
        self.check_size(message)
        bounds = make_budget(budget, limits, visibility, named=visibility_of(self.original.mesh))
        _check_noise(noise)
        marked, info = self.write(self.codeword(message), bounds, told=message)
        # A budget without limits is met up to rounding, so its own number is used.
        reached = info.rms if bounds.limits else bounds.rms or 0.0
        room = self.capacity
        if noise is not None:
            self._check_capacity(room, reached, Conditions(bounds, noise, COVERAGE))
        noises = (room.noise(self.bits, reached, Conditions(bounds, 1.0, share)) for share in (1.0, COVERAGE))
        info = info._replace(survives=Survival(*noises))
        if read_back:
            self.check(marked, message)
        return marked, info

    def with_record(self, record: Record) -> "Marker":
        """The marker that reads a mark it has just made; a blind scheme's then knows what was chosen."""
        return self

    def tried(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """Try what a mark survives: add noise, lose half of the points, and read; the prediction where it reads.

        Where it does not, less noise is tried; 0 if not even a tenth of what was predicted. Messages are read by plain
        correlations, which is quick: joint decoding may read in still more noise.

        Returns:
            The noise; None if the message does not even read without any.

        Args:
            marked: the marked mesh, in the original's order.
            message: its message.
            predicted: from `EmbedInfo`.
        """
        found, rng = alignment.align(self.original, marked, "same"), np.random.default_rng(0)
        if not self._reads_in_order(found, message):
            return None
        points, used = self.original.positions, self.original.used
        radius = float(np.linalg.norm(points[used] - points[used].mean(axis=0), axis=1).mean())
        unit = radius * rng.uniform(-1, 1, points.shape)
        near = points[:, 0] <= np.median(points[used, 0])  # half of the mesh, as if it was cut
        tried = []
        for noise, seen in zip(predicted, (np.ones_like(near), near), strict=True):
            strengths = [share * min(noise, _MAX_TRIED_NOISE) for share in (1.0, 0.7, 0.5, 0.3, 0.1)]
            suspects = (
                found._replace(displacement=found.displacement + strength * unit, weights=found.weights * seen)
                for strength in strengths
            )
            reads = (strength for strength, one in zip(strengths, suspects, strict=True) if self._hears(one, message))
            tried.append(next(reads, 0.0) if 0 < noise < math.inf else noise)
        return Survival(*tried)

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that a message can be read from a marked mesh that was not attacked.

        Raises:
            JaxmarkError: if it cannot be read.
        """
        if not self.reads(marked, message):
            raise JaxmarkError(
                f"This mesh ({int(self.original.used.sum())} points) cannot carry {self._payload} with the scheme"
                f" {self.scheme.name!r}: it does not read back, even unattacked. Use a larger budget,"
                f"{' a shorter message or a presence mark,' if self.bits else ''} or a finer or less regular mesh."
            )

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message can be read from a mesh that has the original's vertex order.

        Plain correlations nearly always read a keyed mark that was not attacked. They are tried first, because
        weighting the bands and joint decoding are most of the work of `detect`.
        """
        return self._reads_in_order(alignment.align(self.original, marked, "same"), message)

    def _reads_in_order(self, aligned: Alignment, message: bytes) -> bool:
        observed = self.observe(aligned)
        # `Reader.glance` stands for the scheme's own detector, not for any other.
        quick = self.glance(observed) if self.detector is self.scheme.detector else None
        if quick == message and message:
            return True
        return self._reads(aligned, message)

    def _hears(self, aligned: Alignment, message: bytes) -> bool:
        """Like `_reads`, but with little computation."""
        return self.glance(self.observe(aligned)) == message if message else self._reads(aligned, message)

    def _reads(self, aligned: Alignment, message: bytes) -> bool:
        """Whether a message is read, or without one a presence proven, from a suspect as it was aligned."""
        if not self.bits:
            return self._detect(aligned, b"", None, 1.0).detected()
        return self.decode(self.soft_values(self.receive(aligned))) == message

    @property
    def tag_bits(self) -> int:
        """Size of the keyed tag that follows the message."""
        return TAG_BITS

    def align(self, suspect: Mesh) -> Alignment:
        """Bring a suspect back to the original, which `detect` takes in its place, with whatever key."""
        return alignment.align(self.original, suspect)

    def glance(self, seen: Observation) -> bytes | None:
        """Read what was hardly attacked with little computation, see `Reader.glance`; None if nothing reads so."""
        quick = self.reader.glance(seen)
        return self.decode(quick if quick is not None else self.soft_values(self.reader.receive(seen)))

    def detect(
        self,
        suspect: Mesh | Alignment,
        message: bytes | None = None,
        weights: ArrayLike | None = None,
        align: Align = "auto",
        *,
        share: float = 1.0,
    ) -> Detection:
        """Read a suspect, with a claimed message or without; see `detect`.

        Points that are far off are masked. Without a claim, two kinds of proof are tried, and each is paid for: the
        tag, and the union bound over all messages, or over the one that the record commits to. With one, log10_p is
        Hoeffding's bound (see `evidence.log10_p_claimed`). The score is the plain correlation of the codeword: joint
        decoding may choose the codeword, but does not enter the score. It is taken for each way of weighting the
        suspect (see `detectors.claims`), and each is paid for, too; so are ways of aligning other than `"auto"`, and,
        where no message is read otherwise, reading surfaces of few vertices by these
        (`jaxmark.watermark.reading.coarse`), and what was bent by a map of its own around each point
        (`jaxmark.alignment.nonrigid`).
        Weights depend on suspect and original only.

        A suspect that is read with several keys needs to be aligned only once: pass the result of
        `jaxmark.alignment.alignment.align` in its place, and in `share` the share of the probability that this reading
        has of all that are tried.
        """
        if not 0 < share <= 1:
            raise JaxmarkError(f"A reading's share of the probability is in (0, 1], got {share:g}.")
        if not isinstance(suspect, Alignment):
            return Markers([[(share, lambda: self)]]).detect(suspect, message, weights, align)[0]
        return self._detect(suspect, self.claimed(message), weights, share)

    def suited(
        self,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
    ) -> "Marker":
        """The marker with the pass band that suits a budget, if its scheme is the default; see `suiting.suited`.

        Args and raises: see `embed`; without a demand, what is to be survived is the noise of `payload.NOISE`.
        """
        bounds = make_budget(budget, limits, visibility, named=visibility_of(self.original.mesh))
        _check_noise(noise)
        return self.with_scheme(suited(self.capacity, self.bits, bounds, noise or NOISE))

    def with_scheme(self, scheme: Scheme, bits: int | None = None) -> "Marker":
        """The same marker, which has no record, with another scheme of this library, or payload of so many bits.

        Raises:
            JaxmarkError: if the payload does not fit.
        """
        bits = self.bits if bits is None else bits
        if (scheme, bits) == (self.scheme, self.bits):
            return self
        code_bits, content = _code_bits(scheme, self.original, bits), _content(bits)
        choices = bind_mark(self.key, self.original, scheme, bits, content, self.choices.version)
        carrier = scheme.carrier(self.original, choices, bits, code_bits)
        return replace(
            self,
            choices=choices,
            bits=bits,
            scheme=scheme,
            carrier=carrier,
            code_bits=code_bits,
            detector=scheme.detector if self.detector == self.scheme.detector else self.detector,
            content=content,
        )

    def _detect(self, aligned: Alignment, message: bytes | None, weights: ArrayLike | None, share: float) -> Detection:
        """Read a suspect as it was aligned, with a share of the probability."""
        received = self.receive(aligned, weights)
        coverage = self._coverage(received.observed)
        doubts = self.doubts if weights is None else (*self.doubts, "the weights were chosen by the reader")
        silent = np.zeros(self.code_bits)
        found = Detection(None, 0.0, 0.0, 0.0, 0.0, silent, coverage, aligned, self.choices.version, doubts)
        # Rounding moves no coordinate by more than half of the grid's spacing, and the fit of the pose by little more;
        # a mark that can be read moves some.
        if np.abs(aligned.displacement).max() * self.original.diagonal <= 0.75 * self.original.grid:
            remark = "The suspect is the original itself, without a mark."
            return found._replace(remarks=(remark,))
        share *= ALIGN_SHARES[aligned.how]
        read_otherwise = self._read_otherwise(found, received) if weights is None else None
        if read_otherwise is None:
            return self._weigh(found, received, *self._hear(received), message, share)
        usual = self._weigh(found, received, *self._hear(received), message, share * (1 - _OTHER_SHARE))
        if usual.detected() and (usual.message is not None or not self.bits):
            return usual
        other = read_otherwise(message, share * _OTHER_SHARE)
        if not other.detected():
            other = other._replace(remarks=usual.remarks)
        return min(usual, other, key=lambda one: (one.log10_p, one.message is None))

    def _read_otherwise(
        self, found: Detection, received: Received
    ) -> Callable[[bytes | None, float], Detection] | None:
        """What reads a suspect again that has few vertices or is bent, with a share of the probability; else None."""
        aligned = found.alignment
        if aligned.bent is not None:
            return partial(self._read_straightened, found, aligned.bent)
        # The proof for strengths that version 1 does not bind holds for weights that do not depend on them.
        if aligned.heights is None or self.choices.version == 1:
            return None
        if isinstance(self.carrier, KeyedCarrier) and isinstance(received, Reception):
            return partial(self._read_by_vertices, found, received, self.carrier, aligned.heights)
        return None

    def _read_straightened(self, found: Detection, bent: Bent, message: bytes | None, share: float) -> Detection:
        """Read a suspect without its bends; the alignment that is told stays the one that no key had a part in."""
        received = self.receive(alignment.straightened(self.original, found.alignment, bent))
        found = found._replace(
            coverage=self._coverage(received.observed),
            remarks=("Each point was brought back by a map of its own surroundings, as if the suspect was bent.",),
        )
        return self._weigh(found, received, *self._hear(received), message, share)

    def _read_by_vertices(
        self,
        found: Detection,
        received: Reception,
        carrier: KeyedCarrier,
        heights: VertexHeights,
        message: bytes | None,
        share: float,
    ) -> Detection:
        """Read a surface by its vertices; nothing where errors of few vertices have no model."""
        coarse = receive_coarse(carrier, self.original, heights, received)
        if coarse is None:
            return found
        found = found._replace(remarks=("The suspect was read by its own vertices, which are few.",))
        soft = np.asarray(self.reader.correlate(coarse), np.float64)
        return self._weigh(found, coarse, soft, self._decode(soft), message, share)

    def _coverage(self, observed: Observation) -> float:
        """Share of the original's points that a suspect gives evidence for."""
        return float(np.mean(self.original.to_host(observed.weights)[self.original.used] > 0))

    def _hear(self, received: Received) -> tuple[Float64[np.ndarray, " code"], Decoded | None]:
        """The soft values of a suspect, and what they say.

        Matched correlations read what was not attacked hard. Only their first message is tried; where its tag does not
        fit, the detector decodes all bits jointly, which is most of the work of reading. Both are paid for.
        """
        # `Reader.correlate` stands for the scheme's own detector, not for any other.
        quick = self.reader.correlate(received) if self.detector is self.scheme.detector else None
        if quick is not None and ((first := self._decode(quick, 1)) is not None or not self.bits):
            return np.asarray(quick, np.float64), first and first.paid(_QUICK_SHARE)
        soft = self.soft_values(received)
        decoded = self._decode(soft)
        return soft, decoded and decoded.paid(1.0 if quick is None else 1 - _QUICK_SHARE)

    def _weigh(
        self,
        found: Detection,
        received: Received,
        soft: Float64[np.ndarray, " code"],
        decoded: Decoded | None,
        claimed: bytes | None,
        share: float,
    ) -> Detection:
        """Complete a detection by what was decoded and what was claimed, with a share of the probability."""
        found = found._replace(scores=soft / (np.sqrt(np.mean(soft**2)) or 1.0))
        if decoded is None and claimed is None:
            return found
        fixed = claimed
        if claimed is None and self.record is not None and self.record.told and decoded is not None:
            # A message that the record commits to was fixed with the record.
            fixed = decoded.message if self.record.commits_to(decoded.message, self.choices) else b""
        if fixed is None:
            return self._with_evidence(found, received, decoded, share=share)
        if decoded is None or decoded.message == fixed:
            share *= CLAIM_SHARE
            return self._with_evidence(found, received, decoded, fixed=fixed, tagged=claimed is None, share=share)
        # The claim is refuted, but not that the mark is there: its owner wrote several messages, or means another copy.
        other = self._with_evidence(found, received, decoded, share=share * (1 - CLAIM_SHARE))
        remark = f"Another message of this key reads than the one {'claimed' if claimed else 'in the record'}."
        if claimed:
            there = self._fitted_beside(received, claimed, decoded.message)
            remark += f" That both are there is an estimate: log10 p about {there:.1f} for the one claimed."
        return other._replace(remarks=(*other.remarks, remark))

    def _fitted_beside(self, received: Received, claimed: bytes, read: bytes) -> float:
        """Estimate log10 p of a claimed message beside another one that was read: of what their codewords do not share.

        There is no bound without a model: the mean of two copies shows nothing where their codewords differ.
        """
        words = [jnp.asarray(self.codeword(one), received.observed.residual.dtype) for one in (claimed, read)]
        (score, norm), (other, _) = (tuple(part[0] for part in claims(self.reader, received, word)) for word in words)
        shared = float(jnp.vdot(*words)) / self.code_bits
        return evidence.log10_p_fitted(score - shared * other, norm * math.sqrt(max(1 - shared**2, 1e-12)))

    def _with_evidence(
        self,
        found: Detection,
        received: Received,
        decoded: Decoded | None,
        *,
        fixed: bytes | None = None,
        tagged: bool = True,
        share: float = 1.0,
    ) -> Detection:
        """Complete a detection by the evidence for a message that was fixed beforehand, else for the one decoded.

        Its tag is a proof of its own, unless the message was claimed: then there may be none to look at.
        """
        message = fixed if fixed is not None else decoded.message if decoded is not None else b""
        codeword = jnp.asarray(self.codeword(message), received.observed.residual.dtype)
        ways = list(zip(*claims(self.reader, received, codeword), strict=True))
        unknown = 0 if fixed is not None else self.bits
        tag = [evidence.log10_p_tag(TAG_BITS, decoded.rank)] if decoded is not None and tagged else []

        def proven(floor: float) -> float:
            proofs = [evidence.log10_p_read(*way, unknown, floor) for way in ways] + tag
            return evidence.share_of(evidence.any_of(*proofs, floor=floor), share, floor)

        # The best message is not tried out but decoded, so who claims one that nothing dates pays for all of them.
        late = [evidence.log10_p_read(*way, self.bits) for way in ways]
        if self.choices.version == 1 and (free := self.scheme.free_strengths):
            late = [evidence.log10_p_fitted_strengths(*way, free) + self.bits * math.log10(2) for way in ways]
        return found._replace(
            message=None if decoded is None else decoded.message,
            log10_p=proven(evidence.MIN_LOG10_P),
            log10_p_undated=evidence.undated(evidence.share_of(evidence.any_of(*late), share)),
            log10_p_fitted=evidence.any_of(*(evidence.log10_p_fitted(*way, unknown) for way in ways)),
            log10_p_unfloored=proven(evidence.UNFLOORED),
        )

    def write(
        self, amplitudes: Float64[np.ndarray, " code"], budget: Budget, *, told: bytes = b""
    ) -> tuple[Mesh, EmbedInfo]:
        """Displace the original by the carrier, with any amplitudes of the code bits, as far as a budget allows.

        Args:
            amplitudes: one number for each code bit, up to a common factor.
            budget: the bounds to keep, see `budget.write`.
            told: what the amplitudes say, which the record commits to; nothing if it is empty.

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
        written = write(original, unit, budget, self.capacity.reference if budget.limits else None)
        return written.mesh, EmbedInfo(
            written.moved.rms, written.moved.max, written.scale, self._make_record(written.scale, told)
        )

    def _make_record(self, beta: float, told: bytes) -> Record:
        """The record of a mark of this strength."""
        original = self.original
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=beta,
            original=self.original.geometry.hex(),
            key=commitment(self.key),
            parameters=parameters_of(self.scheme),
            content=self.content,
            version=self.choices.version,
        )
        if record.version == 1:
            return record
        canonical = Canonical(original.points, original.weld, original.geometry)
        imprint = make_imprint(canonical, original.grid, original.order)
        record = replace(
            record, told=commit(told, self.choices) if told else "", imprint=seal_imprint(imprint, self.key)
        )
        return record.sealed(self.key)

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
        return encode(message, self.choices, self.code_bits)

    def soft_values(self, received: Received) -> Float64[np.ndarray, " code"]:
        """Compute one soft value per code bit."""
        return np.asarray(self.detector(self.reader, received, 1.0), np.float64)

    def _decode(self, soft: ArrayLike, candidates: int = CANDIDATES) -> Decoded | None:
        """Decode the message whose keyed tag fits, if there is one among so many."""
        return decode(np.asarray(soft, np.float64), self.bits, self.choices, candidates)

    def decode(self, soft: ArrayLike) -> bytes | None:
        """Decode the message in soft values; None if no message's keyed tag fits."""
        decoded = self._decode(soft)
        return None if decoded is None else decoded.message

    def _per_point(self, weights: ArrayLike) -> Float64[np.ndarray, " points"]:
        """Convert weights of vertices to weights of points, each the mean over the vertices at the point."""
        given, point = np.asarray(weights, np.float64), self.original.weld.point
        if given.shape != point.shape or not (np.isfinite(given) & (given >= 0)).all():
            raise JaxmarkError(f"weights must be {len(point)} finite numbers, not negative, one for each vertex.")
        return np.bincount(point, given) / np.bincount(point)

    @property
    def _payload(self) -> str:
        return f"a message of {self.bits} bits" if self.bits else "a presence mark"

    def _check_capacity(self, room: Capacity, reached: float, conditions: Conditions) -> None:
        """Check that the payload is readable under these conditions at an RMS displacement of `reached` diagonals."""
        least = room.least_budget(self.bits, conditions)
        if least <= reached:
            return
        most = room.bits(conditions) if self.bits else 0
        present = room.least_budget(0, conditions) <= reached
        mend = ["a shorter message"] if most else ["a presence mark"] if present else []
        if math.isfinite(least):
            mend.append(f"a budget of at least {_rounded_up(least):g}{self._seen_at(_rounded_up(least), conditions)}")
        carried = f"carries at most {most} bits" if most else "carries no message" if self.bits else "carries nothing"
        wanted = f", not {self.bits}" if most else ""
        raise JaxmarkError(
            f"This mesh ({int(self.original.used.sum())} points) {carried} at {conditions.budget}, with noise of"
            f" {conditions.noise:g} and half of it lost{wanted}. Use {', or '.join(mend or ['less noise'])}."
        )

    def _seen_at(self, budget: float, conditions: Conditions) -> str:
        """How far a mark of a size would exceed the limits, as half a sentence."""
        if not (limits := conditions.budget.limits):
            return ""
        word = np.random.default_rng(0).choice([-1.0, 1.0], self.code_bits)
        marked, _ = self.write(word, make_budget(min(budget, 0.5)))
        seen = distortion.measure(self.original.mesh, marked, limits.keys())
        told = ", ".join(f"{name} would be {value or 0:.2g}" for name, value in seen.items())
        return f" (at which {told})"

    def claimed(self, message: bytes | None) -> bytes | None:
        """The message that is claimed: presence, if that is all that can be.

        Raises:
            JaxmarkError: see `check_claim`.
        """
        if message is None:
            return None if self.bits else b""
        self.check_claim(message)
        return message

    def check_claim(self, message: bytes) -> None:
        """Check that a message may be claimed: that it has the payload's size, and is the one in the record, if any.

        Raises:
            JaxmarkError: if not.
        """
        self.check_size(message)
        if self.record is not None and self.record.told and not self.record.commits_to(message, self.choices):
            raise JaxmarkError("The record commits to another message than the one claimed; claim that, or none.")

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
    version: int | None = None,
) -> Marker:
    """Prepare an original for marking, or for reading many suspects.

    Args:
        original: the unmarked mesh. Vertices at the same position, or so near to each other that they round to the same
            point (see `jaxmark.geometry.canonical`), move together; a vertex that no face uses stays where it is. With
            a record, a copy that was saved again will do: rounded, reordered, moved or scaled.
        key: 32 bytes, from `new_key`.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else 64. With 0, the mark says
            nothing but that it is there.
        record: the record of an earlier mark, which fixes scheme and payload size; original and key must be those that
            it was made with.
        scheme: a name (`"keyed"`, `"host"`, `"eigen"`), which a record overrides; or a scheme of
            `jaxmark.watermark.schemes.scheme` or your own.
        detector: a detector of `jaxmark.watermark.reading.detectors`; by default the scheme's own.
        version: version of the keyed choices: the record's, else 2; 1 is for marks of that version without a record.

    Returns:
        The marker.

    Raises:
        JaxmarkError: if the mesh, key or payload is unusable, or the record was edited or is for another original, key
            or payload.
    """
    key = Key(key)
    if record is not None:
        record.check("message" if record.bits else "presence", key)
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        bits = record.bits
        if isinstance(scheme, str):
            scheme = get_scheme(record.scheme, record.parameters)
        elif not _matches_record(scheme, record):
            raise JaxmarkError(
                f"The record is of the scheme {record.scheme!r} with {dict(record.parameters)}, not {scheme}."
            )
    used = record.version if record is not None else SCHEME_VERSION if version is None else version
    ready, doubts = recall(original, key, record, used)
    scheme = get_scheme(scheme, version=used)
    payload = DEFAULT_BITS if bits is None else bits
    code_bits, content = _code_bits(scheme, ready, payload), _content(payload)
    choices = bind_mark(key, ready, scheme, payload, content, used, record=record)
    carrier = scheme.carrier(ready, choices, payload, code_bits)
    if not isinstance(scheme, tuple(SCHEMES.values())):
        doubts += (f"the scheme {scheme.name!r} is not one of this library",)
    if detector not in (None, scheme.detector):
        doubts += ("the detector is not the scheme's own",)
    return Marker(
        ready, choices, payload, scheme, carrier, code_bits, detector or scheme.detector, content, record, doubts
    )


def _code_bits(scheme: Scheme, original: Original, bits: int) -> int:
    """Number of code bits of a payload; a presence mark has one.

    Raises:
        JaxmarkError: if the payload does not fit.
    """
    return scheme.code_length(original, bits) if bits else 1


def _content(bits: int) -> Content:
    return "message" if bits else "presence"


def bind_mark(
    key: bytes,
    original: Original,
    scheme: Scheme,
    bits: int,
    content: Content,
    version: int = SCHEME_VERSION,
    *,
    record: Record | None = None,
) -> Choices:
    """Bind the keyed choices of a mark to its original and to all that reading it uses.

    The fields of the scheme are those in the record, if there is one: a later jaxmark may know more fields.
    """
    parameters = parameters_of(scheme) if record is None else record.parameters
    fixed = {"content": content, "scheme": scheme.name, "parameters": parameters, "bits": bits}
    fixed["order"] = original.order.hex()
    return bind(key, original.geometry, fixed, version)


def recall(original: Mesh, key: bytes, record: Record | None, version: int) -> tuple[Original, tuple[str, ...]]:
    """Prepare the original of a mark exactly as it was when the mark was made.

    Args:
        original: the unmarked mesh as its owner has it now.
        key: 32 bytes.
        record: the record of the mark, if there is one.
        version: version of the keyed choices.

    Returns:
        The original; and why what is read with it is no proof, which is if it was edited since.

    Raises:
        JaxmarkError: if the mesh is unusable, or not the one that the record was made for.
    """
    if record is None:
        return make_original(original, None if version > 1 else 0.0), ()
    if version == 1:
        ready = make_original(original, 0.0)
        if ready.geometry.hex() != record.original:
            raise JaxmarkError("The original is not the mesh that the record was made for (its geometry differs).")
        return ready, ()
    imprint = record.open_imprint(key)
    ready = make_original(original, imprint.grid)
    if ready.geometry == imprint.hash:
        return _in_order_of(ready, imprint), ()
    copy = restore(original, imprint)
    ready = make_original(copy.mesh, imprint.grid)
    if copy.exact:
        return _in_order_of(ready, imprint), ()
    if copy.share < _MIN_ORIGINAL_SHARE:
        said = f"{100 * copy.share:.0f} % of that mesh's points are in it"
        if copy.distance < _SAME_SHAPE:
            raise JaxmarkError(
                f"The original is not the mesh that the record was made for: {said}, though their shapes differ by only"
                f" {100 * copy.distance:.2g} % of their size. It looks like the marked file, or another edited copy."
            )
        raise JaxmarkError(
            f"The original is not the mesh that the record was made for: {said}, and their shapes differ by"
            f" {100 * copy.distance:.2g} % of their size."
        )
    places = np.full(len(ready.used), -1)
    places[ready.weld.point] = copy.places
    ready = replace(ready, geometry=imprint.hash, places=places, count=len(imprint.tags))
    ready = _in_order_of(ready, imprint)
    return ready, (f"the original was edited: {100 * copy.share:.1f} % of its points are left",)


def _in_order_of(original: Original, imprint: Imprint) -> Original:
    """The original, bound to the order that was marked, which its file may have no longer."""
    return replace(original, order=imprint.order, in_order=original.order == imprint.order)


def _check_noise(noise: float | None) -> None:
    if noise is not None and not 0 <= noise < math.inf:
        raise JaxmarkError(f"The noise to survive is a number of at least 0, got {noise}.")


def _matches_record(scheme: Scheme, record: Record) -> bool:
    """Whether a record names this scheme, which may be one of the caller's own, with these fields."""
    if scheme.name in SCHEMES:
        return scheme == get_scheme(record.scheme, record.parameters)
    return (scheme.name, parameters_of(scheme)) == (record.scheme, dict(record.parameters))


def _rounded_up(value: float) -> float:
    """A number to four digits, none of which makes it smaller."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / unit * (1 + 1e-9)) * unit


def make_markers(
    original: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    record: Record | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
    detector: Detector | None = None,
) -> "Markers":
    """Prepare an original for reading all marks that may be meant, the likeliest first.

    With a record there is one. Without, marks have any version of the keyed choices, the newest first, and marks of the
    default scheme any pass band that `Marker.suited` chooses.

    Args and raises: see `make_marker`.
    """
    prepare = partial(make_marker, original, key, bits=bits, record=record, scheme=scheme, detector=detector)
    ladders = []
    for version in versions_of(record):
        usual = cache(partial(prepare, version=version))
        ladder = [(1.0, usual)]
        is_named = record is None and scheme == DEFAULT_SCHEME
        others = stands_for(get_scheme(DEFAULT_SCHEME, version=version))[1:] if is_named else ()
        if others:
            share = (1 - _USUAL_SHARE) / len(others)
            ladder = [(_USUAL_SHARE, usual), *((share, cache(partial(_with_scheme, usual, other))) for other in others)]
        ladders.append(ladder)
    return Markers(ladders)


def versions_of(record: Record | None) -> tuple[int, ...]:
    """The versions of the keyed choices to read with: that of the record, or without one all, the newest first."""
    return VERSIONS if record is None else (record.version,)


def _with_scheme(usual: Callable[[], Marker], scheme: Scheme) -> Marker:
    return usual().with_scheme(scheme)


class Markers:
    """Markers of one original, key and payload that read what a mark may be; prepared at first use, and kept."""

    def __init__(self, ladders: Sequence[Sequence[tuple[float, Callable[[], Marker]]]]) -> None:
        """Prepare the first marker, so that refusals come here.

        Args:
            ladders: for each version of the keyed choices the markers, which have the same original, and their shares
                of the probability.
        """
        self._ladders = ladders
        self.first = ladders[0][0][1]()

    def detect(
        self, suspect: Mesh, message: bytes | None = None, weights: ArrayLike | None = None, align: Align = "auto"
    ) -> tuple[Detection, Marker]:
        """Read a suspect with each marker until one detects its mark; all of them are paid for.

        Args and raises: see `detect`.

        Returns:
            The best detection, and the marker that made it.
        """
        message, found = self.first.claimed(message), []
        for ladder in self._ladders:
            for aligned, part in _ways(ladder[0][1]().original, suspect, align):
                for share, prepare in ladder:
                    marker = prepare()
                    # Reading once more takes seconds: only what is likeliest is read so.
                    seen = aligned._replace(heights=None, bent=None) if found else aligned
                    one = marker.detect(seen, message, weights, share=share * part / len(self._ladders))
                    if one.detected():
                        return one, marker
                    found.append((one, marker))
        return min(found, key=lambda one: (one[0].log10_p, one[0].message is None))


def _ways(original: Original, suspect: Mesh, align: Align) -> Iterator[tuple[Alignment, float]]:
    """The ways in which a suspect is aligned, the likeliest first, and their shares of the probability."""
    aligned = alignment.align(original, suspect, align)
    if aligned.method != "surface":
        yield aligned, 1.0
        return
    yield aligned, _HAND_SHARE
    # The surface of a shape that is nearly its own mirror image does not tell whether a suspect was mirrored.
    with suppress(JaxmarkError):
        yield alignment.align(original, suspect, align, hands=(not aligned.pose.mirrors,)), 1 - _HAND_SHARE
