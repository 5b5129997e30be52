"""Reading with the original: decoding of aligned suspects, and the evidence of the readings.

Alternatives are tried in a fixed order until one of them detects the mark:

- all marks that the suspect may carry (`Alternatives`);
- both reflections, if the suspect is registered by its surface;
- if no message is decoded otherwise, a second reading: of a coarse surface by the heights of its vertices
  (`jaxmark.watermark.reading.coarse`), or of a deformed suspect by non-rigid registration
  (`jaxmark.alignment.nonrigid`).

The ledger charges each alternative, whether it is tried or not.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from jaxmark.alignment import attempts
from jaxmark.alignment.heights import VertexHeights
from jaxmark.alignment.nonrigid import DeformedPoints
from jaxmark.alignment.original import Original
from jaxmark.alignment.result import Align, Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.message import TAG_BITS, Decoded, check_size
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence, Tag, estimate_beside, weigh
from jaxmark.watermark.evidence.ledger import Charge
from jaxmark.watermark.interfaces import ChipCarrier, Claim, Received
from jaxmark.watermark.mark import Mark
from jaxmark.watermark.reading.coarse import receive_coarse
from jaxmark.watermark.reading.detectors import claims_by_way
from jaxmark.watermark.reading.reception import Reception
from jaxmark.watermark.record import is_recorded

Charges = tuple[Charge, ...]

_SAME = (
    "Suspect and original have the same shape, so that there is nothing to read. Is the original the marked mesh? Then"
    " give the unmarked one."
)
_WORSE = 3.0  # ratio of residuals from which on the worse reflection is not read


class Alternatives(NamedTuple):
    """The marks of one original, key and payload that a suspect may carry, the likeliest first.

    Attributes:
        marks: the charges of each mark, and the function that prepares it, which is called when it is read.
    """

    marks: Sequence[tuple[Charges, Callable[[], Mark]]]

    @property
    def first(self) -> Mark:
        """The likeliest mark; it is prepared at each access."""
        return self.marks[0][1]()

    def read(
        self, suspect: Mesh, message: bytes | None = None, weights: ArrayLike | None = None, align: Align = "auto"
    ) -> tuple[Detection, Mark]:
        """Read a suspect with each mark until one is detected; see `detect`.

        Returns:
            The best detection, and its mark.
        """
        first = self.first
        if message is not None:
            check_claim(first, message)
        first.begin_reading()
        readings: list[tuple[Detection, Mark]] = []
        for reflection_charges, aligned in _registrations(first.original, suspect, align):
            for mark_charges, prepare in self.marks:
                mark = prepare()
                # A second reading takes seconds, hence only the likeliest alternative gets one.
                observation = aligned._replace(heights=None, deformed=None) if readings else aligned
                detection = read(mark, observation, message, weights, charges=(*mark_charges, *reflection_charges))
                if detection.detected(allow_estimate=True):
                    return detection, mark
                readings.append((detection, mark))
        return min(readings, key=lambda reading: reading[0].rank)


def _registrations(original: Original, suspect: Mesh, align: Align) -> Iterator[tuple[Charges, Alignment]]:
    """Iterate over the alignments of a suspect, the likeliest first, and their charges."""
    aligned = attempts.align(original, suspect, align)
    if aligned.method != "surface":
        yield (), aligned
        return
    yield (ledger.REFLECTION.charge("better fit"),), aligned
    # A shape that is nearly its own mirror image fits nearly as well with the wrong reflection, as a whole or in parts.
    reflections = (not aligned.pose.mirrors,)
    with suppress(JaxmarkError):
        other = attempts.align(original, suspect, align, reflections=reflections, in_parts=not aligned.as_whole)
        # With a shape that is no mirror image of itself, the wrong reflection leaves a much larger residual.
        if other.residual > _WORSE * aligned.residual and other.coverage(original) <= aligned.coverage(original):
            return
        yield (ledger.REFLECTION.charge("worse fit"),), other


def read(
    mark: Mark,
    aligned: Alignment,
    message: bytes | None = None,
    weights: ArrayLike | None = None,
    *,
    charges: Charges = (),
) -> Detection:
    """Read a suspect that was aligned with the mark's original.

    Points with large residuals are masked. Without a claim, two kinds of tests are made: the tag, and a union bound
    over all messages, or over the one that the record commits to. The score is the plain correlation of the codeword:
    joint decoding may choose the codeword, but has no influence on its score. A score is computed for each way of
    weighting the suspect (see `detectors.claims`). Weights depend on suspect and original only.

    Args:
        mark: the mark to look for.
        aligned: the suspect, from `jaxmark.alignment.attempts.align`; it is aligned once for all keys.
        message: the claimed message; None to read without a claim.
        weights: see `detect`.
        charges: charges for earlier choices.

    Raises:
        JaxmarkError: if the claimed message has another size than the payload, or is not the one that the record
            commits to.
    """
    claimed = b"" if message is None and not mark.bits else message
    if claimed is not None:
        check_claim(mark, claimed)
    received = mark.receive(aligned, weights)
    caveats = mark.caveats if weights is None else (*mark.caveats, "the weights were chosen by the reader")
    empty = Detection(
        None,
        Evidence(caveats=caveats),
        aligned,
        np.zeros(mark.code_bits),
        mark.coverage(received.observed),
        mark.scheme.name,
        premises=f"key, original, message and {'record' if mark.record else 'options'}",
        claimed=claimed,
    )
    # Rounding moves no coordinate by more than half of the grid spacing, and the fit of the pose by little more. A mark
    # that can be read moves some coordinates by more.
    if np.abs(aligned.displacement).max() * mark.original.diagonal <= 0.75 * mark.original.grid:
        return empty._replace(notes=(_SAME,))
    charges = (*charges, *mark.order_charges, ledger.ALIGNMENT.charge(aligned.align))
    reading = _Reading(mark, aligned, empty, claimed)
    second_reading = reading.alternative(received) if weights is None else None
    if second_reading is None:
        return reading.read(received, charges)
    standard = reading.read(received, (*charges, ledger.READING.charge("standard")))
    if standard.detected(allow_estimate=True) and (standard.message is not None or not mark.bits):
        return standard
    second = second_reading((*charges, ledger.READING.charge("coarse or non-rigid")))
    if not second.detected(allow_estimate=True):
        second = second._replace(notes=standard.notes)
    return min(standard, second, key=lambda detection: detection.rank)


def claims_of(mark: Mark, received: Received, message: bytes) -> list[Claim]:
    """Compute score and norm of a message's codeword for each way of weighting the suspect."""
    codeword = jax.device_put(mark.codeword(message).astype(received.observed.residual.dtype))
    return claims_by_way(mark.reader, received, codeword)


def check_claim(mark: Mark, message: bytes) -> None:
    """Check that a message may be claimed: it must have the payload's size, and be the recorded one, if any.

    Raises:
        JaxmarkError: if it may not be claimed.
    """
    check_size(message, mark.bits)
    if mark.record is not None:
        mark.record.check_claim(message, mark.choices)


class _Reading(NamedTuple):
    """The reading of one suspect for one mark."""

    mark: Mark
    aligned: Alignment  # independent of the key
    found: Detection  # the detection before anything is decoded
    claimed: bytes | None

    def read(self, received: Received, charges: Charges) -> Detection:
        """Decode the reception, and compute the evidence.

        Matched correlations suffice for suspects that were not attacked strongly. Only their best candidate is tried.
        If its tag does not match, the detector decodes all bits jointly, which is most of the work of reading.
        """
        mark = self.mark
        # `Reader.correlate` replaces only the carrier's own detector.
        correlations = mark.reader.correlate(received) if mark.uses_own_detector else None
        if correlations is not None and ((first := mark.decode(correlations, 1)) is not None or not mark.bits):
            return self.weigh(received, np.asarray(correlations, np.float64), first, "correlations", charges)
        soft = mark.soft_decisions(received)
        return self.weigh(
            received, soft, mark.decode(soft), None if correlations is None else "joint decoding", charges
        )

    def alternative(self, received: Received) -> Callable[[Charges], Detection] | None:
        """Return a function for a second reading, if the suspect is coarse or deformed; else None."""
        if self.aligned.deformed is not None:
            return partial(self.read_nonrigid, self.aligned.deformed)
        if self.aligned.heights is None or not isinstance(received, Reception):
            return None
        return partial(self.read_coarse, received, self.aligned.heights)

    def read_nonrigid(self, deformed: DeformedPoints, charges: Charges) -> Detection:
        """Read a suspect by non-rigid registration; the detection keeps the registration by a single map."""
        received = self.mark.receive(self.aligned.undeformed(self.mark.original, deformed))
        detection = self.found._replace(
            coverage=self.mark.coverage(received.observed),
            notes=("The suspect was read after non-rigid registration: each point by a map of its neighbourhood.",),
        )
        return self._replace(found=detection).read(received, charges)

    def read_coarse(self, received: Reception, heights: VertexHeights, charges: Charges) -> Detection:
        """Read a coarse surface by its vertices; return a detection without evidence if they are too few."""
        coarse = receive_coarse(cast(ChipCarrier, self.mark.carrier), self.mark.original, heights, received)
        if coarse is None:
            return self.found
        soft = np.asarray(self.mark.reader.correlate(coarse), np.float64)
        detection = self.found._replace(notes=("The suspect has few vertices, and was read by their heights.",))
        return self._replace(found=detection).weigh(coarse, soft, self.mark.decode(soft), None, charges)

    def weigh(
        self,
        received: Received,
        soft: Float64[np.ndarray, " code"],
        decoded: Decoded | None,
        decoder: str | None,
        charges: Charges,
    ) -> Detection:
        """Complete the detection with the evidence for the decoded or the claimed message.

        Args:
            received: the reception of the suspect.
            soft: soft decisions of the code bits.
            decoded: the decoded message, if there is one whose keyed tag matches.
            decoder: the decoder that found the message, if there was a choice.
            charges: charges for earlier choices.
        """
        mark, claimed = self.mark, self.claimed
        detection = self.found._replace(
            scores=soft / (np.sqrt(np.mean(soft**2)) or 1.0), message=None if decoded is None else decoded.message
        )
        message = claimed if claimed is not None else detection.message
        if message is None:
            return detection
        recorded = is_recorded(mark.record, message, mark.choices)
        if message == detection.message:
            detection = detection._replace(recorded=recorded)
        is_another = recorded is False if claimed is None else detection.message not in (None, claimed)
        fixed = not is_another and (claimed is not None or recorded is True)
        if is_another:
            message = detection.message or b""
        if claimed is not None or recorded is not None:
            charges += (ledger.MESSAGE.charge("another" if is_another else "claimed or recorded"),)
        # The tag is no evidence for a claimed message, unless another message was decoded.
        tag = None
        if decoded is not None and (claimed is None or is_another):
            decoder_charges = () if decoder is None else (ledger.DECODER.charge(decoder),)
            tag = Tag(TAG_BITS, (*decoder_charges, ledger.RANK.charge("each", decoded.rank)))
        ways = claims_of(mark, received, message)
        caveats = detection.evidence.caveats
        evidence = weigh(
            ways,
            bits=mark.bits,
            fixed=fixed,
            tag=tag,
            charges=charges,
            tag_was_open=bool(mark.bits) and mark.record is not None,
            caveats=caveats,
        )
        detection = detection._replace(evidence=evidence)
        if not is_another:
            return detection
        # The claim is refuted, but not the mark: its owner wrote several messages, or the claim is about another copy.
        note = f"Another message of this key was decoded than the one {'claimed' if claimed else 'in the record'}."
        if claimed:
            shared = float(np.vdot(mark.codeword(claimed), mark.codeword(message))) / mark.code_bits
            estimate = estimate_beside(claims_of(mark, received, claimed)[0], ways[0], shared)
            note += (
                f" The claimed message may also be present: log10 p about {estimate:.1f} (an estimate without a bound)."
            )
        return detection._replace(notes=(*detection.notes, note))
