"""Detections: the results of reading suspects, and their evidence.

The evidence of all readings is computed by one function, `weigh`: the smallest p-value of several tests, after all
charges of the ledger.
"""

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.coding.keys import SCHEME_VERSION
from jaxmark.watermark.evidence import bounds, ledger
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P, UNFLOORED, Charge, figure, rounded_up


class Evidence(NamedTuple):
    """The evidence of a reading, as log10 of probabilities.

    Attributes:
        log10_p: the committed p-value: a bound on the false-positive probability, in [-77, 0], if everything that is
            claimed was fixed before the suspect existed, for example by a timestamped commitment.
        log10_p_uncommitted: the uncommitted p-value: the bound if nothing was fixed beforehand, for the best message of
            any of 2^64 keys, originals and records.
        log10_p_gaussian: an estimate of the probability that assumes a Gaussian score; no decision uses it.
        log10_p_unfloored: `log10_p` without the floor at -77. It orders attacks and schemes, but proves nothing, and no
            decision uses it.
        charges: the cost of each choice of the reading; `log10_p` includes all of them. If several marks were united,
            this is the cost of uniting them, and `Detection.parts` has the charges of each mark.
        caveats: the reasons why the probabilities are estimates instead of proofs; empty if they are proofs.
    """

    log10_p: float = 0.0
    log10_p_uncommitted: float = 0.0
    log10_p_gaussian: float = 0.0
    log10_p_unfloored: float = 0.0
    charges: tuple[Charge, ...] = ()
    caveats: tuple[str, ...] = ()

    def charged(self, *charges: Charge) -> "Evidence":
        """Charge further choices, which precede the choices that are already charged."""
        return self._replace(
            log10_p=figure(self.log10_p, charges, UNFLOORED),
            log10_p_uncommitted=figure(self.log10_p_uncommitted, charges, UNFLOORED),
            log10_p_unfloored=figure(self.log10_p_unfloored, charges, UNFLOORED),
            charges=(*charges, *self.charges),
        )

    @classmethod
    def least(cls, *alternatives: "Evidence") -> "Evidence":
        """Unite alternatives whose charges are included: take the smallest of each figure, and all caveats."""
        best = min(alternatives, key=lambda evidence: evidence.log10_p)
        return best._replace(
            log10_p_uncommitted=min(evidence.log10_p_uncommitted for evidence in alternatives),
            log10_p_unfloored=min(evidence.log10_p_unfloored for evidence in alternatives),
            caveats=_all_caveats(alternatives),
        )

    @classmethod
    def product(cls, *marks: "Evidence") -> "Evidence":
        """Unite the evidence of independent marks of one mesh by Fisher's product; uncommitted, take the smallest."""

        def combine(log10_p: Sequence[float], floor: float) -> float:
            return min(0.0, max(floor, bounds.log10_p_product(log10_p)))

        log10_p = [evidence.log10_p for evidence in marks]
        factor = bounds.log10_p_product(log10_p) - sum(log10_p)
        one_mark = ledger.MARKS.charge("one mark", len(marks))
        return marks[0]._replace(
            log10_p=combine(log10_p, MIN_LOG10_P),
            log10_p_uncommitted=figure(min(evidence.log10_p_uncommitted for evidence in marks), [one_mark], UNFLOORED),
            log10_p_unfloored=combine([evidence.log10_p_unfloored for evidence in marks], UNFLOORED),
            charges=(ledger.MARKS.charge("product", 10**factor),),
            caveats=_all_caveats(marks),
        )


def check_alpha(alpha: float) -> None:
    """Refuse what is no false-positive probability.

    Raises:
        JaxmarkError: if it is not in (0, 1).
    """
    if not 0 < alpha < 1:
        raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")


def _all_caveats(evidence: Sequence[Evidence]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(caveat for part in evidence for caveat in part.caveats))


class Tag(NamedTuple):
    """The evidence of a decoded message whose keyed tag matches."""

    bits: int  # size of the tag
    charges: tuple[Charge, ...]  # the cost of finding the message


def weigh(
    ways: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    bits: int,
    fixed: bool,
    tag: Tag | None = None,
    charges: Sequence[Charge] = (),
    looks: float = 1.0,
    meshes: int = 1,
    tag_was_open: bool = False,
    caveats: tuple[str, ...] = (),
) -> Evidence:
    """Compute the evidence for one message: the smallest p-value of its scores and its tag, after all charges.

    Args:
        ways: score and norm of the message's codeword for each way of weighting the suspect, see `log10_p_score`.
        bits: size of the payload in bits, without the tag.
        fixed: whether the message was claimed or recorded before the suspect was seen; otherwise all messages of the
            payload's size are charged.
        tag: the message's tag, if it is evidence; None if the message was claimed and not decoded.
        charges: charges for earlier choices.
        looks: number of views of the suspect whose scores were compared; blind readings are charged for them.
        meshes: number of meshes whose scores were added.
        tag_was_open: whether the reader could have tested the tag instead, by leaving out the claim.
        caveats: the reasons why the result is an estimate.
    """
    proof = ledger.PROOF if looks == 1 else ledger.BLIND_PROOF
    view_charges = () if looks == 1 else (ledger.LOOKS.charge("each", looks),)
    message_charges = (*view_charges, ledger.PAYLOAD.charge("each", bits=bits))
    score_charges = view_charges if fixed else message_charges
    scores = [bounds.log10_p_score(*way) for way in ways]
    count = len(ways) + (tag is not None or tag_was_open)
    proofs = [(score, (proof.charge("score", count), *score_charges)) for score in scores]
    if tag is not None:
        proofs.append((bounds.log10_p_tag(tag.bits), (proof.charge("tag", count), *tag.charges)))
    log10_p, spent = min(proofs, key=lambda candidate: figure(*candidate, UNFLOORED))
    spent = (*charges, *spent)
    # Without a commitment, the payload is always charged: the message may have been chosen to suit the suspect.
    uncommitted = (ledger.forgeries(meshes), *charges, proof.charge("score", len(ways)), *message_charges)
    gaussian = min(bounds.log10_p_gaussian(*way) for way in ways)
    return Evidence(
        log10_p=figure(log10_p, spent),
        log10_p_uncommitted=figure(min(scores), uncommitted),
        log10_p_gaussian=figure(gaussian, [proof.charge("score", len(ways)), *score_charges]),
        log10_p_unfloored=figure(log10_p, spent, UNFLOORED),
        charges=spent,
        caveats=caveats,
    )


def estimate_beside(claimed: tuple[ArrayLike, ArrayLike], read: tuple[ArrayLike, ArrayLike], shared: float) -> float:
    """Estimate log10 p of a claimed message beside a decoded one, from the code bits in which their codewords differ.

    No bound exists without a model: the mean of two marked copies carries no signal where their codewords differ.

    Args:
        claimed: score and norm of the claimed message.
        read: score and norm of the decoded message.
        shared: correlation of the two codewords, in [-1, 1].
    """
    (score, norm), (other, _) = (np.asarray(pair, np.float64) for pair in (claimed, read))
    return min(0.0, bounds.log10_p_gaussian(score - shared * other, norm * math.sqrt(max(1 - shared**2, 1e-12))))


def united_score(scores: Sequence[ArrayLike], norms: Sequence[ArrayLike], weights: Sequence[float]) -> float:
    """Unite the scores of meshes that carry one message under one key, as a score of norm 1, less rounding errors.

    A score divided by its norm is a sum of independent signs times factors whose squares add up to 1. The signs of
    different meshes are independent. A weighted sum over meshes, divided by the root of the sum of the squared weights,
    is therefore also such a sum.

    Args:
        scores: score of the message's codeword in each mesh.
        norms: norm of the vector that the signs multiply, for each mesh.
        weights: squared weight of each mesh; **independent of the key**.
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
    """Bound the probability that any innocent recipient among the tested ones reaches each score, as log10.

    Args:
        scores: scores of the accused recipients, see `jaxmark.watermark.tracing.tardos.scores`.
        values: values of the slots, **independent of the codewords of innocents**.
        biases: biases of the slots.
        candidates: number of all recipients who were tested.
    """
    charge = ledger.RECIPIENTS.charge("each", max(candidates, 1))
    return np.array([figure(log10_p, [charge]) for log10_p in bounds.log10_p_fingerprint(scores, values, biases)])


@runtime_checkable
class Registration(Protocol):
    """The registration of a suspect: an `Alignment`, or the pose of a blind reading."""

    @property
    def pose(self) -> Pose:
        """The map from the coordinates of the suspect's file to those in which it was read."""
        ...

    def facts(self) -> dict[str, Any]:
        """Return the facts that a report states about the registration, as values for JSON."""
        ...


class Detection(NamedTuple):
    """The result of reading a suspect.

    Attributes:
        message: the message that was decoded; None unless its keyed tag matches.
        evidence: the evidence of the reading.
        registration: the registration of the suspect, a `Registration`: an `Alignment` with the original, or the
            `Anchored` of a blind reading.
        scores: soft decisions of the code bits that the message was decoded from, scaled to root mean square 1.
        coverage: share of the original's points that the suspect gives evidence for; None for a blind reading.
        scheme: name of the scheme of the mark.
        premises: everything that must have been fixed before the suspect existed.
        notes: further observations about the suspect.
        parts: the detections that are united here, by the names of meshes or schemes.
        skipped: original meshes that could not be compared, and the reasons.
        version: version of the keyed choices that the mark was read with.
        claimed: the message that was claimed before the suspect was read, empty for the presence of a mark without a
            message; None if the suspect was read without a claim.
        recorded: whether the record commits to the decoded message; None without such a message or commitment.
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
    claimed: bytes | None = None
    recorded: bool | None = None

    @property
    def log10_p(self) -> float:
        """The committed p-value as log10, `evidence.log10_p`."""
        return self.evidence.log10_p

    @property
    def rank(self) -> tuple[float, bool]:
        """A sort key of detections: smaller p-values first, and among equal ones those with a message first."""
        return self.log10_p, self.message is None

    def statement(self) -> str:
        """State the result for a publication: the claim or the message, both p-values, and their conditions.

        A claim without a decoded message is called supported if its evidence is detected at 10^-6, as by `detected`.
        """
        evidence = self.evidence
        kind = "is estimated as" if evidence.caveats else "is at most"
        charges = ", ".join(f"{charge.choice} ({charge.taken}) {charge.log10:.2f}" for charge in evidence.charges)
        parts = [
            self._result(),
            f"For a mesh that is independent of the key, the probability of evidence that is as strong {kind}"
            f" 10^{rounded_up(evidence.log10_p):.1f} if {self.premises} were fixed before the mesh existed, and"
            f" 10^{rounded_up(evidence.log10_p_uncommitted):.1f} if nothing shows that, which charges a choice among"
            " 2^64 keys, originals or records for each mesh.",
            f"The first figure includes the choices of the reader, as log10 of their number: {charges}."
            if charges
            else "",
            f"They are estimates, because {'; '.join(evidence.caveats)}." if evidence.caveats else "",
            f"(jaxmark {version('jaxmark')}, keyed choices of version {self.version})",
        ]
        return " ".join(filter(None, parts))

    def _result(self) -> str:
        """State what was claimed, and what was found."""
        scheme = f"of the scheme {self.scheme!r}"
        if self.claimed is None:
            return self._result_of_reading(scheme)
        claim = f"the message {self.claimed.hex()} {scheme}" if self.claimed else f"the presence of a mark {scheme}"
        start = f"Before the mesh was read, {claim} was claimed"
        if self.message is None or not self.claimed:
            missing = ", although it could not be decoded," if self.claimed else ""
            if self.detected(allow_estimate=True):
                return f"{start}. The mesh supports the claim{missing} at a level of 10^-6."
            return f"{start}. The mesh does not support the claim at a level of 10^-6."
        if self.message == self.claimed:
            return f"{start}, and it was decoded."
        figures = "unite the evidence of all marks" if self.parts else "are those of the decoded message"
        return (
            f"{start}. The mesh does not support the claim: the message {self.message.hex()} was decoded instead, and"
            f" the figures {figures}."
        )

    def _result_of_reading(self, scheme: str) -> str:
        """State what was found without a claim."""
        if self.message is None:
            return f"No message was claimed, and none {scheme} was decoded, so there is no evidence of a mark."
        recorded = {
            True: " It is the message that the record commits to.",
            False: " It is another message than the one that the record commits to.",
            None: "",
        }
        return f"The message {self.message.hex()} {scheme} was decoded without a claim.{recorded[self.recorded]}"

    def detected(self, alpha: float = 1e-6, *, allow_estimate: bool = False) -> bool:
        """Whether the false-positive probability is proven to be at most `alpha`, if all claims were fixed before.

        Args:
            alpha: a probability.
            allow_estimate: whether an estimate, which has caveats, also counts.

        Raises:
            JaxmarkError: if `alpha` is not in (0, 1).
        """
        check_alpha(alpha)
        is_proof = allow_estimate or not self.evidence.caveats
        return is_proof and self.log10_p <= math.log10(alpha)
