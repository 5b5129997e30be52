"""Reading with the original: what a suspect that was aligned says, and what that proves.

Alternatives are tried in a fixed order, until one detects the mark: the marks that may be meant (`Alternatives`), both
reflections of a surface, and, where no message reads otherwise, a second reading of a surface of few vertices by these
(`jaxmark.watermark.reading.coarse`) or of a deformed suspect by non-rigid registration
(`jaxmark.alignment.nonrigid`). The ledger charges each of them, whether it is tried or not.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64
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
from jaxmark.watermark.interfaces import ChipCarrier, Received
from jaxmark.watermark.mark import Mark
from jaxmark.watermark.reading.coarse import receive_coarse
from jaxmark.watermark.reading.detectors import claims
from jaxmark.watermark.reading.reception import Reception
from jaxmark.watermark.record import is_recorded

Charges = tuple[Charge, ...]


class Alternatives(NamedTuple):
    """The marks of one original, key and payload that a suspect may carry, the likeliest first.

    Attributes:
        marks: what each costs, and the function that prepares it, called only when it is read.
    """

    marks: Sequence[tuple[Charges, Callable[[], Mark]]]

    @property
    def first(self) -> Mark:
        """The likeliest mark."""
        return self.marks[0][1]()

    def read(
        self, suspect: Mesh, message: bytes | None = None, weights: ArrayLike | None = None, align: Align = "auto"
    ) -> tuple[Detection, Mark]:
        """Read a suspect with each mark until one detects; see `detect`.

        Returns:
            The best detection, and the mark that it is of.
        """
        if message is not None:
            check_claim(self.first, message)
        found: list[tuple[Detection, Mark]] = []
        for registered, aligned in _registrations(self.first.original, suspect, align):
            for charged, prepare in self.marks:
                mark = prepare()
                # A second reading takes seconds: only what is likeliest is read so.
                observation = aligned._replace(heights=None, deformed=None) if found else aligned
                one = read(mark, observation, message, weights, charges=(*charged, *registered))
                if one.detected(allow_estimate=True):
                    return one, mark
                found.append((one, mark))
        return min(found, key=lambda one: one[0].rank)


def _registrations(original: Original, suspect: Mesh, align: Align) -> Iterator[tuple[Charges, Alignment]]:
    """The ways in which a suspect is aligned, the likeliest first, and what they cost."""
    aligned = attempts.align(original, suspect, align)
    if aligned.method != "surface":
        yield (), aligned
        return
    yield (ledger.REFLECTION.charge("the one that fits better"),), aligned
    # The surface of a shape that is nearly its own mirror image does not tell whether a suspect was mirrored.
    with suppress(JaxmarkError):
        other = attempts.align(original, suspect, align, reflections=(not aligned.pose.mirrors,))
        yield (ledger.REFLECTION.charge("the other"),), other


def read(
    mark: Mark,
    aligned: Alignment,
    message: bytes | None = None,
    weights: ArrayLike | None = None,
    *,
    charges: Charges = (),
) -> Detection:
    """Read a suspect that was aligned with the mark's original.

    Points that are far off are masked. Without a claim, two kinds of proof are tried: the tag, and the union bound over
    all messages, or over the one that the record commits to. The score is the plain correlation of the codeword: joint
    decoding may choose the codeword, but does not enter the score. It is taken for each way of weighting the suspect
    (see `detectors.claims`). Weights depend on suspect and original only.

    Args:
        mark: the mark to look for.
        aligned: the suspect, from `jaxmark.alignment.attempts.align`; whatever the key, it is aligned only once.
        message: the message that is claimed; None to read without a claim.
        weights: see `detect`.
        charges: what was chosen before.

    Raises:
        JaxmarkError: if the claim has another size than the payload, or is not what the record commits to.
    """
    claimed = b"" if message is None and not mark.bits else message
    if claimed is not None:
        check_claim(mark, claimed)
    received = mark.receive(aligned, weights)
    caveats = mark.caveats if weights is None else (*mark.caveats, "the weights were chosen by the reader")
    found = Detection(
        None,
        Evidence(caveats=caveats),
        aligned,
        np.zeros(mark.code_bits),
        mark.coverage(received.observed),
        mark.scheme.name,
    )
    # Rounding moves no coordinate by more than half of the grid's spacing, and the fit of the pose by little more; a
    # mark that can be read moves some.
    if np.abs(aligned.displacement).max() * mark.original.diagonal <= 0.75 * mark.original.grid:
        return found._replace(notes=("The suspect is the original itself, without a mark.",))
    charges = (*charges, ledger.ALIGNMENT.charge(aligned.align))
    reading = _Reading(mark, aligned, found, claimed)
    read_again = reading.alternative(received) if weights is None else None
    if read_again is None:
        return reading.read(received, charges)
    usual = reading.read(received, (*charges, ledger.READING.charge("all points")))
    if usual.detected(allow_estimate=True) and (usual.message is not None or not mark.bits):
        return usual
    other = read_again((*charges, ledger.READING.charge("coarse or non-rigid")))
    if not other.detected(allow_estimate=True):
        other = other._replace(notes=usual.notes)
    return min(usual, other, key=lambda one: one.rank)


def claims_of(mark: Mark, received: Received, message: bytes) -> list[tuple[Array, Array]]:
    """Score and norm of a message's codeword for each way of weighting the suspect."""
    codeword = jnp.asarray(mark.codeword(message), received.observed.residual.dtype)
    return list(zip(*claims(mark.reader, received, codeword), strict=True))


def check_claim(mark: Mark, message: bytes) -> None:
    """Check that a message may be claimed: that it has the payload's size, and is the one in the record, if any.

    Raises:
        JaxmarkError: if not.
    """
    check_size(message, mark.bits)
    if mark.record is not None:
        mark.record.check_claim(message, mark.choices)


class _Reading(NamedTuple):
    """The reading of one suspect for one mark."""

    mark: Mark
    aligned: Alignment  # no key had a part in it
    found: Detection  # what is known before anything is read
    claimed: bytes | None

    def read(self, received: Received, charges: Charges) -> Detection:
        """Decode what was received, and weigh the evidence.

        Matched correlations read what was not attacked hard. Only their first message is tried; where its tag does not
        fit, the detector decodes all bits jointly, which is most of the work of reading.
        """
        mark = self.mark
        # `Reader.correlate` stands for the scheme's own detector, not for any other.
        quick = mark.reader.correlate(received) if mark.uses_own_detector else None
        if quick is not None and ((first := mark.decode(quick, 1)) is not None or not mark.bits):
            return self.weigh(received, np.asarray(quick, np.float64), first, "correlations", charges)
        soft = mark.soft_decisions(received)
        return self.weigh(received, soft, mark.decode(soft), None if quick is None else "joint decoding", charges)

    def alternative(self, received: Received) -> Callable[[Charges], Detection] | None:
        """Return what reads a suspect again that has few vertices or is deformed; None for any other."""
        if self.aligned.deformed is not None:
            return partial(self.read_nonrigid, self.aligned.deformed)
        if self.aligned.heights is None or not isinstance(received, Reception):
            return None
        return partial(self.read_coarse, received, self.aligned.heights)

    def read_nonrigid(self, deformed: DeformedPoints, charges: Charges) -> Detection:
        """Read a suspect by non-rigid registration; the detection's registration stays that of one map."""
        received = self.mark.receive(self.aligned.undeformed(self.mark.original, deformed))
        found = self.found._replace(
            coverage=self.mark.coverage(received.observed),
            notes=("Each point was brought back by a map of its own surroundings, as if the suspect was bent.",),
        )
        return self._replace(found=found).read(received, charges)

    def read_coarse(self, received: Reception, heights: VertexHeights, charges: Charges) -> Detection:
        """Read a surface by its vertices; nothing where errors of few vertices have no model."""
        coarse = receive_coarse(cast(ChipCarrier, self.mark.carrier), self.mark.original, heights, received)
        if coarse is None:
            return self.found
        soft = np.asarray(self.mark.reader.correlate(coarse), np.float64)
        found = self.found._replace(notes=("The suspect was read by its own vertices, which are few.",))
        return self._replace(found=found).weigh(coarse, soft, self.mark.decode(soft), None, charges)

    def weigh(
        self,
        received: Received,
        soft: Float64[np.ndarray, " code"],
        decoded: Decoded | None,
        decoder: str | None,
        charges: Charges,
    ) -> Detection:
        """Complete the detection by what was decoded and what was claimed.

        Args:
            received: the suspect.
            soft: soft decisions of the code bits.
            decoded: the message whose keyed tag fits, if there is one.
            decoder: the decoder that it is from, if there was a choice.
            charges: what was chosen before.
        """
        mark, claimed = self.mark, self.claimed
        found = self.found._replace(
            scores=soft / (np.sqrt(np.mean(soft**2)) or 1.0), message=None if decoded is None else decoded.message
        )
        message = claimed if claimed is not None else found.message
        if message is None:
            return found
        recorded = is_recorded(mark.record, message, mark.choices)
        another = recorded is False if claimed is None else found.message not in (None, claimed)
        fixed = not another and (claimed is not None or recorded is True)
        if another:
            message = found.message or b""
        if claimed is not None or recorded is not None:
            charges += (ledger.MESSAGE.charge("another" if another else "claimed or recorded"),)
        # A claimed message has no tag to look at, unless it was another one that was read.
        tag = None
        if decoded is not None and (claimed is None or another):
            charged = () if decoder is None else (ledger.DECODER.charge(decoder),)
            tag = Tag(TAG_BITS, (*charged, ledger.RANK.charge("each", decoded.rank)))
        ways = claims_of(mark, received, message)
        caveats = found.evidence.caveats
        evidence = weigh(ways, bits=mark.bits, fixed=fixed, tag=tag, charges=charges, caveats=caveats)
        found = found._replace(evidence=evidence)
        if not another:
            return found
        # The claim is refuted, but not that the mark is there: its owner wrote several messages, or means another copy.
        note = f"Another message of this key reads than the one {'claimed' if claimed else 'in the record'}."
        if claimed:
            shared = float(np.vdot(mark.codeword(claimed), mark.codeword(message))) / mark.code_bits
            beside = estimate_beside(claims_of(mark, received, claimed)[0], ways[0], shared)
            note += f" That both are there is an estimate: log10 p about {beside:.1f} for the one claimed."
        return found._replace(notes=(*found.notes, note))
