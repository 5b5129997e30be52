"""A collusion-resistant fingerprint code: it finds contributors to a copy from one soft decision per slot.

This is Tardos's code (STOC 2003) with the symmetric score of Škorić, Katzenbeisser and Celik (2008). Each slot has a
keyed bias p. The codeword X of every recipient is +1 there with probability p, independently of the others. The score
of a recipient is Σ y g(X), where y are the soft decisions and g standardises X: g(+1) = √((1 - p)/p) and
g(-1) = -√(p/(1 - p)). The values y may come from any collusion: given p and y, the probability of a false accusation
depends only on the innocent recipient's own codeword.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int8

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.evidence.detection import accuse
from jaxmark.watermark.evidence.ledger import RECIPIENTS, UNFLOORED, Charge, figure

Slots = Float[np.ndarray, " slots"]

# The smallest bias, in units of 1/256. It is that of the optimal discrete biases against 10 colluders (Nuida et al.
# 2009), the zeros of the shifted Legendre polynomial of degree 5. Tardos's 1/(300c) is for a proof at large c: such
# extreme biases gain little from noisy soft decisions, and give the scores of innocents a heavy tail.
MIN_BIAS_LEVEL = 12

# The values of the arcsine distribution function, in units of 2⁻³², at which a bias changes from one multiple of 1/256
# to the next. Biases must not depend on the last digits, in which mathematical libraries may differ, so keyed words are
# compared with integers. No value is within 10⁻⁴ of a rounding boundary, fifty times the effect of the last digits.
_ANGLES = [math.asin(math.sqrt((level - 0.5) / 256)) for level in range(MIN_BIAS_LEVEL, 258 - MIN_BIAS_LEVEL)]
_THRESHOLDS = np.array([round(2**32 * (a - _ANGLES[0]) / (_ANGLES[-1] - _ANGLES[0])) for a in _ANGLES[1:-1]], np.uint32)

_CHUNK_RECIPIENTS = 1024  # number of recipients whose codewords are in memory at a time


class Accusation(NamedTuple):
    """The evidence against one recipient."""

    recipient: str  # identifier
    score: float  # score, of mean 0 and variance 1 for innocents
    log10_p: float  # log10 of a bound on the probability that any innocent among those tested reaches this score
    caveats: tuple[str, ...] = ()  # the reasons why the probability is an estimate; empty if it is a proof
    charges: tuple[Charge, ...] = ()  # the choices that the probability is charged for

    def charged(self, *charges: Charge) -> "Accusation":
        """Charge further choices, see `jaxmark.watermark.evidence.ledger`."""
        return self._replace(log10_p=figure(self.log10_p, charges, UNFLOORED), charges=(*self.charges, *charges))


def biases(choices: Choices, length: int) -> Float64[np.ndarray, " slots"]:
    """Derive the probability of +1 in each slot from the key: arcsine law with a cut-off, in multiples of 1/256.

    Args:
        choices: the keyed choices of the mark.
        length: number of slots; codes of different lengths are independent.

    Returns:
        `[length]`, from `MIN_BIAS_LEVEL`/256 to 1 - `MIN_BIAS_LEVEL`/256.

    Raises:
        JaxmarkError: if there is no slot.
    """
    if length < 1:
        raise JaxmarkError(f"A fingerprint needs at least one slot, got {length}.")
    words = np.frombuffer(choices.derive(f"fingerprint/{length}/biases", 4 * length), "<u4")
    return (MIN_BIAS_LEVEL + np.searchsorted(_THRESHOLDS, words, side="right")) / 256


def codewords(recipients: Sequence[str], choices: Choices, biases_: Slots) -> Int8[np.ndarray, "recipients slots"]:
    """Derive the codewords (±1) of recipients from the key: a slot is +1 if its keyed byte is below 256 p.

    Args:
        recipients: identifiers.
        choices: the keyed choices of the mark.
        biases_: p, from `biases`, `[slots]`.

    Returns:
        `[recipients, slots]`.

    Raises:
        JaxmarkError: if an identifier is empty.
    """
    if not all(recipients):
        raise JaxmarkError("A recipient's identifier is empty. Give every recipient an identifier.")
    label = f"fingerprint/{len(biases_)}/codeword"
    stream = b"".join(choices.derive(label, len(biases_), recipient.encode()) for recipient in recipients)
    keyed_bytes = np.frombuffer(stream, np.uint8).reshape(len(recipients), len(biases_))
    return 2 * (keyed_bytes < (256 * biases_).astype(np.uint8)).view(np.int8) - 1


def scores(
    values: Slots, biases_: Slots, words: Int8[np.ndarray, "recipients slots"]
) -> Float64[np.ndarray, " recipients"]:
    """Compute the score Σ y g(X) of each codeword; for innocents it has mean 0 and variance Σ y².

    Args:
        values: y, `[slots]`.
        biases_: p, `[slots]`.
        words: the codewords X, `[recipients, slots]`.

    Returns:
        `[recipients]`.
    """
    weights = values / (2 * np.sqrt(biases_ * (1 - biases_)))
    return words.astype(np.float64) @ weights - (2 * biases_ - 1) @ weights


def rank(values: Slots, recipients: Iterable[str], choices: Choices, *, top: int = 10) -> list[Accusation]:
    """Find the recipients with the highest scores, with bounds on the probability that an innocent reaches these.

    Args:
        values: y at any scale, `[slots]`; **independent of the codewords of innocents**.
        recipients: identifiers; an identifier that occurs twice is tested once.
        choices: the keyed choices of the mark.
        top: largest number of recipients to return.

    Returns:
        At most `top` recipients, the highest score first. Their probabilities hold for all tested recipients together
        (union bound).

    Raises:
        JaxmarkError: if a value is not finite, there is no slot, or an identifier is empty.
    """
    if not np.isfinite(values).all():
        raise JaxmarkError("The value of a slot is not finite. Use 0 for unknown values.")
    p = biases(choices, len(values))
    y = _remove_trend(np.asarray(values, np.float64), p)
    candidates = list(dict.fromkeys(recipients))
    totals = np.empty(len(candidates))
    for i in range(0, len(candidates), _CHUNK_RECIPIENTS):
        totals[i : i + _CHUNK_RECIPIENTS] = scores(y, p, codewords(candidates[i : i + _CHUNK_RECIPIENTS], choices, p))
    best = np.argsort(-totals, kind="stable")[:top]
    log10_p = accuse(totals[best], y, p, len(candidates))
    charges = (RECIPIENTS.charge("each", max(len(candidates), 1)),)
    return [
        Accusation(candidates[i], float(totals[i]), float(bound), charges=charges)
        for i, bound in zip(best, log10_p, strict=True)
    ]


def _remove_trend(y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Subtract from y its least-squares fit by a cubic in p, and scale the rest to unit norm; zero if there is no rest.

    The copy of any coalition follows p: the expected average of its codewords is 2p - 1. Because g(X) has mean 0 given
    p, subtracting this trend does not change a member's expected score, but reduces the norm. The scores of 8
    recipients who average their copies increase by half or more.
    """
    y = y / max(np.abs(y).max(), np.finfo(float).tiny)
    powers = np.vander(p, 4)
    rest = y - powers @ np.linalg.lstsq(powers, y, rcond=None)[0]
    norm = np.linalg.norm(rest)
    return rest / norm if norm > 1e-9 * np.linalg.norm(y) else np.zeros_like(y)
