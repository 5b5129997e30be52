"""A fingerprint code that survives collusion: from one soft value per slot, it tells who contributed to a copy.

This is Tardos's code (STOC 2003) with the symmetric score of Škorić, Katzenbeisser and Celik (2008). Each slot has a
keyed bias p. Every recipient's codeword X is +1 there with probability p, independently, and its score is Σ y g(X),
where g standardises X: g(+1) = √((1 - p)/p) and g(-1) = -√(p/(1 - p)). The values y may come from any collusion: the
probability of a false accusation rests on the innocent recipient's own codeword alone, given p and y.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int8

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.evidence.detection import accuse
from jaxmark.watermark.evidence.ledger import UNFLOORED, Charge, figure

Slots = Float[np.ndarray, " slots"]

# The smallest bias, in units of 1/256: that of the optimal discrete biases against 10 colluders (Nuida et al. 2009),
# which are the zeros of the shifted Legendre polynomial of degree 5. Tardos's 1/(300c) serves a proof at large c: such
# extreme biases tell little from soft values under noise, and give the scores of innocents a heavy tail.
MIN_BIAS_LEVEL = 12

# The values of the arcsine distribution function, in units of 2⁻³², at which a bias passes from one multiple of 1/256
# to the next. Mathematical libraries may differ in the last digits and biases must not, so keyed words are compared
# with integers: none of these is within 10⁻⁴ of being rounded otherwise, fifty times what the last digits make.
_ANGLES = [math.asin(math.sqrt((level - 0.5) / 256)) for level in range(MIN_BIAS_LEVEL, 258 - MIN_BIAS_LEVEL)]
_THRESHOLDS = np.array([round(2**32 * (a - _ANGLES[0]) / (_ANGLES[-1] - _ANGLES[0])) for a in _ANGLES[1:-1]], np.uint32)

_CHUNK_RECIPIENTS = 1024  # whose codewords are in memory at a time


class Accusation(NamedTuple):
    """The evidence against one recipient."""

    recipient: str  # identifier
    score: float  # of mean 0 and variance 1 for innocents
    log10_p: float  # log10 of a bound on the probability that any innocent among those tried has such a score
    caveats: tuple[str, ...] = ()  # why the probability is an estimate, not a proof; empty if it is a proof

    def charged(self, *charges: Charge) -> "Accusation":
        """Charge further choices, see `jaxmark.watermark.evidence.ledger`."""
        return self._replace(log10_p=figure(self.log10_p, charges, UNFLOORED))


def biases(choices: Choices, length: int) -> Float64[np.ndarray, " slots"]:
    """Derive each slot's probability of +1 from the key, by the arcsine law with a cut-off, in multiples of 1/256.

    Args:
        choices: the keyed choices of the mark.
        length: number of slots; codes of different lengths share nothing.

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
    """Derive the recipients' codewords ±1 from the key: each slot has a keyed byte, and is +1 if that is below 256 p.

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
        raise JaxmarkError("A recipient's identifier is empty: give every recipient one.")
    label = f"fingerprint/{len(biases_)}/codeword"
    stream = b"".join(choices.derive(label, len(biases_), recipient.encode()) for recipient in recipients)
    drawn = np.frombuffer(stream, np.uint8).reshape(len(recipients), len(biases_))
    return 2 * (drawn < (256 * biases_).astype(np.uint8)).view(np.int8) - 1


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
    """Find the recipients with the highest scores, and how surely they are not innocent.

    Args:
        values: y at any scale, `[slots]`; **independent of the codewords of innocents**.
        recipients: identifiers; one that occurs twice is tried once.
        choices: the keyed choices of the mark.
        top: largest number of recipients to return.

    Returns:
        At most `top` recipients, the highest score first; the probabilities are for all that were tried together (union
        bound).

    Raises:
        JaxmarkError: if a value is not finite, there is no slot, or an identifier is empty.
    """
    if not np.isfinite(values).all():
        raise JaxmarkError("A slot's value is not finite: give 0 where nothing is known.")
    p = biases(choices, len(values))
    y = _remove_trend(np.asarray(values, np.float64), p)
    candidates = list(dict.fromkeys(recipients))
    found = np.empty(len(candidates))
    for i in range(0, len(candidates), _CHUNK_RECIPIENTS):
        found[i : i + _CHUNK_RECIPIENTS] = scores(y, p, codewords(candidates[i : i + _CHUNK_RECIPIENTS], choices, p))
    best = np.argsort(-found, kind="stable")[:top]
    log10_p = accuse(found[best], y, p, len(candidates))
    return [Accusation(candidates[i], float(found[i]), float(bound)) for i, bound in zip(best, log10_p, strict=True)]


def _remove_trend(y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Subtract from y its least-squares fit by a cubic in p, and scale the rest to unit norm; zero if nothing is left.

    The copy of any coalition follows p (the average of its codewords is 2p - 1 in expectation). As g(X) has mean 0
    given p, subtracting this trend takes nothing from a member's expected score, but much from the norm: the scores of
    8 recipients who average their copies rise by half or more.
    """
    y = y / max(np.abs(y).max(), np.finfo(float).tiny)
    powers = np.vander(p, 4)
    rest = y - powers @ np.linalg.lstsq(powers, y, rcond=None)[0]
    norm = np.linalg.norm(rest)
    return rest / norm if norm > 1e-9 * np.linalg.norm(y) else np.zeros_like(y)
