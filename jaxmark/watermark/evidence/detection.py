"""Detections: what was read from a suspect, and the evidence for it.

Evidence is weighed in one way for all readings: the least of several proofs counts, after all that the ledger charges.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.coding.keys import SCHEME_VERSION
from jaxmark.watermark.evidence import bounds, ledger
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P, UNFLOORED, Charge, figure


class Evidence(NamedTuple):
    """What a reading proves, as log10 of probabilities.

    Attributes:
        log10_p: a bound on the false-positive probability, in [-77, 0], if all that is claimed was fixed, by a
            timestamped commitment for example, before the suspect existed.
        log10_p_uncommitted: the same if nothing was: for the best message of any of 2^64 keys, originals and records.
        log10_p_gaussian: the probability if the score were Gaussian: an estimate, which decides nothing.
        log10_p_unfloored: log10_p without the floor at -77: orders attacks and schemes, proves and decides nothing.
        charges: what each choice of the reading cost; `log10_p` includes all of them. Of several marks that were
            united, what uniting them cost: `Detection.parts` has the charges of each.
        caveats: why the probabilities are estimates, not proofs; empty if they are proofs.
    """

    log10_p: float = 0.0
    log10_p_uncommitted: float = 0.0
    log10_p_gaussian: float = 0.0
    log10_p_unfloored: float = 0.0
    charges: tuple[Charge, ...] = ()
    caveats: tuple[str, ...] = ()

    def charged(self, *charges: Charge) -> "Evidence":
        """Charge further choices, which came before those that were charged already."""
        return self._replace(
            log10_p=figure(self.log10_p, charges, UNFLOORED),
            log10_p_uncommitted=figure(self.log10_p_uncommitted, charges, UNFLOORED),
            log10_p_unfloored=figure(self.log10_p_unfloored, charges, UNFLOORED),
            charges=(*charges, *self.charges),
        )

    @classmethod
    def least(cls, *alternatives: "Evidence") -> "Evidence":
        """Unite alternatives that were charged: each figure is the least of theirs, and all caveats hold."""
        best = min(alternatives, key=lambda one: one.log10_p)
        return best._replace(
            log10_p_uncommitted=min(one.log10_p_uncommitted for one in alternatives),
            log10_p_unfloored=min(one.log10_p_unfloored for one in alternatives),
            caveats=_all_caveats(alternatives),
        )

    @classmethod
    def product(cls, *marks: "Evidence") -> "Evidence":
        """Unite what independent marks of one mesh prove: by Fisher's product, uncommitted by the least of them."""

        def united(log10_p: Sequence[float], floor: float) -> float:
            return min(0.0, max(floor, bounds.log10_p_product(log10_p)))

        log10_p = [one.log10_p for one in marks]
        factor = bounds.log10_p_product(log10_p) - sum(log10_p)
        one_mark = ledger.MARKS.charge("one mark", len(marks))
        return marks[0]._replace(
            log10_p=united(log10_p, MIN_LOG10_P),
            log10_p_uncommitted=figure(min(one.log10_p_uncommitted for one in marks), [one_mark], UNFLOORED),
            log10_p_unfloored=united([one.log10_p_unfloored for one in marks], UNFLOORED),
            charges=(ledger.MARKS.charge("product", 10**factor),),
            caveats=_all_caveats(marks),
        )


def _all_caveats(evidence: Sequence[Evidence]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(caveat for one in evidence for caveat in one.caveats))


class Tag(NamedTuple):
    """A message whose keyed tag fits, as evidence."""

    bits: int  # size of the tag
    charges: tuple[Charge, ...]  # what finding the message cost


def weigh(
    ways: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    bits: int,
    fixed: bool,
    tag: Tag | None = None,
    charges: Sequence[Charge] = (),
    looks: float = 1.0,
    caveats: tuple[str, ...] = (),
) -> Evidence:
    """Weigh the evidence for one message: the best of its scores, and of its tag, after all charges.

    Args:
        ways: score and norm of the message's codeword for each way of weighting the suspect, see `log10_p_score`.
        bits: size of the payload in bits, without the tag, which the message determines.
        fixed: whether the message was claimed or recorded before the suspect was seen; else all are charged.
        tag: the message's tag, if it may count: of a claimed message there may be none to look at.
        charges: what was chosen before.
        looks: number of looks at the suspect whose scores were compared, which blind readings charge.
        caveats: why the result is an estimate.
    """
    proof = ledger.PROOF if looks == 1 else ledger.BLIND_PROOF
    looked = () if looks == 1 else (ledger.LOOKS.charge("each", looks),)
    every = (*looked, ledger.PAYLOAD.charge("each", bits=bits))
    searched = looked if fixed else every
    scores = [bounds.log10_p_score(*way) for way in ways]
    count = len(ways) + (tag is not None)
    proofs = [(score, (proof.charge("score", count), *searched)) for score in scores]
    if tag is not None:
        proofs.append((bounds.log10_p_tag(tag.bits), (proof.charge("tag", count), *tag.charges)))
    log10_p, paid = min(proofs, key=lambda one: figure(*one, UNFLOORED))
    paid = (*charges, *paid)
    # The best message is not searched for but decoded, so that without a commitment all messages are charged.
    late = (ledger.FORGERIES, *charges, proof.charge("score", len(ways)), *every)
    gaussian = min(bounds.log10_p_gaussian(*way) for way in ways)
    return Evidence(
        log10_p=figure(log10_p, paid),
        log10_p_uncommitted=figure(min(scores), late),
        log10_p_gaussian=figure(gaussian, [proof.charge("score", len(ways)), *searched]),
        log10_p_unfloored=figure(log10_p, paid, UNFLOORED),
        charges=paid,
        caveats=caveats,
    )


def estimate_beside(claimed: tuple[ArrayLike, ArrayLike], read: tuple[ArrayLike, ArrayLike], shared: float) -> float:
    """Estimate log10 p of a claimed message beside another one that was read, of what their codewords do not share.

    There is no bound without a model: the mean of two copies shows nothing where their codewords differ.

    Args:
        claimed: score and norm of the claimed message.
        read: score and norm of the message that was read.
        shared: correlation of their codewords, in [-1, 1].
    """
    (score, norm), (other, _) = (np.asarray(one, np.float64) for one in (claimed, read))
    return min(0.0, bounds.log10_p_gaussian(score - shared * other, norm * math.sqrt(max(1 - shared**2, 1e-12))))


def united_score(scores: Sequence[ArrayLike], norms: Sequence[ArrayLike], weights: Sequence[float]) -> float:
    """Unite the scores of meshes that carry one message under one key, as a score of norm 1, less rounding.

    A score over its norm is a sum of independent signs with factors whose squares add up to 1. So is the weighted sum
    over meshes, over the root of the sum of the squared weights, because the signs of different meshes are independent.

    Args:
        scores: of the message's codeword in each mesh.
        norms: of the vectors that the signs multiply.
        weights: of the meshes, squared; **independent of the key**.
    """
    total = rounding = 0.0
    for score, norm, weight in zip(map(np.asarray, scores), map(np.asarray, norms), weights, strict=True):
        ratio = float(score) / float(norm) if norm > 0 else 0.0
        total += math.sqrt(weight) * ratio
        rounding += math.sqrt(weight) * 4 * float(np.finfo(score.dtype).eps) * (1 + abs(ratio))
    return (total - rounding) / math.sqrt(sum(weights)) if sum(weights) else 0.0


def accuse(
    scores: Float[np.ndarray, " recipients"],
    values: Float[np.ndarray, " slots"],
    biases: Float[np.ndarray, " slots"],
    candidates: int,
) -> Float64[np.ndarray, " recipients"]:
    """Return log10 of a bound on the probability that any innocent of those who were tried has such a score.

    Args:
        scores: of the recipients who are accused, see `jaxmark.watermark.tracing.tardos.scores`.
        values: of the slots, **independent of the codewords of innocents**.
        biases: of the slots.
        candidates: number of all recipients who were tried.
    """
    charge = ledger.RECIPIENTS.charge("each", max(candidates, 1))
    return np.array([figure(one, [charge]) for one in bounds.log10_p_fingerprint(scores, values, biases)])


@runtime_checkable
class Registration(Protocol):
    """How a suspect was brought to where it was read: an `Alignment`, or the pose of a blind reading."""

    @property
    def pose(self) -> Pose:
        """From the suspect's file to where it was read."""
        ...

    def facts(self) -> dict[str, Any]:
        """What a report says of it, as values for JSON."""
        ...


class Detection(NamedTuple):
    """The result of reading a suspect.

    Attributes:
        message: the message that was read; None unless its keyed tag fits.
        evidence: what the reading proves.
        registration: how the suspect was brought to where it was read, a `Registration`: an `Alignment` with the
            original, or of a blind reading an `Anchored`.
        scores: soft decisions of the code bits that the message was decoded from, scaled to root mean square 1.
        coverage: share of the original's points that the suspect gave evidence for; None for a blind reading.
        scheme: name of the scheme that was read.
        premises: what must have been fixed before the suspect existed.
        notes: what else the suspect looks like.
        parts: the detections that are united here, by the names of meshes or schemes.
        skipped: original meshes that could not be compared, and why.
        version: version of the keyed choices that were read with.
    """

    message: bytes | None
    evidence: Evidence
    registration: Any
    scores: Float64[np.ndarray, " code"]
    coverage: float | None
    scheme: str
    premises: str = "key, original, message and record"
    notes: tuple[str, ...] = ()
    parts: Mapping[str, "Detection"] = {}
    skipped: Mapping[str, str] = {}
    version: int = SCHEME_VERSION

    @property
    def log10_p(self) -> float:
        """The head figure, `evidence.log10_p`."""
        return self.evidence.log10_p

    @property
    def rank(self) -> tuple[float, bool]:
        """A key that sorts detections: what proves more comes first, and of equals what reads a message."""
        return self.log10_p, self.message is None

    def detected(self, alpha: float = 1e-6, *, allow_estimate: bool = False) -> bool:
        """Whether the false-positive probability is proven to be at most `alpha`, if all that is claimed was fixed.

        Args:
            alpha: a probability.
            allow_estimate: whether an estimate, which has caveats, will do.

        Raises:
            JaxmarkError: if `alpha` is not in (0, 1).
        """
        if not 0 < alpha < 1:
            raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
        is_proof = allow_estimate or not self.evidence.caveats
        return is_proof and self.log10_p <= math.log10(alpha)
