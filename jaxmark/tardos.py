"""A fingerprint code that survives collusion: who had a hand in a copy, from one soft value per slot.

Tardos's code (STOC 2003) with the symmetric score of Škorić, Katzenbeisser and Celik (2008). Each slot has a keyed bias
p; every recipient's codeword X is +1 there with probability p, independently, and scores Σ y g(X) with X standardised:
g(+1) = √((1 - p)/p) and g(-1) = -√(p/(1 - p)). The values y may come of any collusion: the probability of a false
accusation rests on the innocent recipient's own codeword alone, given p and y.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int8

from jaxmark.errors import JaxmarkError
from jaxmark.evidence import FLOOR
from jaxmark.keys import derive

Slots = Float[np.ndarray, " slots"]

# The least bias, in 1/256, as among the optimal discrete biases against 10 colluders (Nuida et al. 2009), the zeros of
# the shifted Legendre polynomial of degree 5. Tardos's 1/(300c) serves a proof at large c: biases so extreme tell
# little of soft values under noise, and give the scores of innocents a heavy tail.
LEAST = 12

# Where the arcsine distribution function passes from one multiple of 1/256 to the next, in 2⁻³². Mathematical libraries
# may differ in the last digits and biases must not, so words are compared with integers: none of these is within 10⁻⁴
# of being rounded otherwise, fifty times what the last digits make.
_ANGLES = [math.asin(math.sqrt((level - 0.5) / 256)) for level in range(LEAST, 258 - LEAST)]
_THRESHOLDS = np.array([round(2**32 * (a - _ANGLES[0]) / (_ANGLES[-1] - _ANGLES[0])) for a in _ANGLES[1:-1]], np.uint32)

_THETAS = np.geomspace(1e-2, 1e3, 512)  # so fine that log10 p loses a few ten-thousandths
_CHUNK = 1024  # recipients whose codewords are in memory at a time


class Accusation(NamedTuple):
    """A recipient, a score (mean 0, variance 1 for innocents), and log10 P(any innocent among those tried has it)."""

    recipient: str
    score: float
    log10_p: float


def biases(key: bytes, geometry: bytes, length: int) -> Float64[np.ndarray, " slots"]:
    """Each slot's probability of +1: keyed, of the arcsine law with a cut-off, rounded to multiples of 1/256.

    Args:
        key: 32 bytes.
        geometry: `geometry_hash` of the original.
        length: how many slots; codes of different lengths share nothing.

    Returns:
        `[length]`, from `LEAST`/256 to 1 - `LEAST`/256.

    Raises:
        JaxmarkError: if there is no slot.
    """
    if length < 1:
        raise JaxmarkError(f"A fingerprint needs at least one slot, got {length}.")
    words = np.frombuffer(derive(key, geometry, f"fingerprint/{length}/biases", 4 * length), "<u4")
    return (LEAST + np.searchsorted(_THRESHOLDS, words, side="right")) / 256


def codewords(
    recipients: Sequence[str], key: bytes, geometry: bytes, biases_: Slots
) -> Int8[np.ndarray, "recipients slots"]:
    """The recipients' codewords ±1, `[recipients, slots]`: a keyed byte per slot, +1 where it is below 256 p.

    Raises:
        JaxmarkError: if an identifier is empty.
    """
    if not all(recipients):
        raise JaxmarkError("A recipient's identifier is empty: give every recipient one.")
    label = f"fingerprint/{len(biases_)}/codeword"
    stream = b"".join(derive(key, geometry, label, len(biases_), recipient.encode()) for recipient in recipients)
    drawn = np.frombuffer(stream, np.uint8).reshape(len(recipients), len(biases_))
    return 2 * (drawn < (256 * biases_).astype(np.uint8)).view(np.int8) - 1


def scores(
    values: Slots, biases_: Slots, words: Int8[np.ndarray, "recipients slots"]
) -> Float64[np.ndarray, " recipients"]:
    """The score Σ y g(X) of each codeword, `[recipients]`; of mean 0 and variance Σ y² for innocents."""
    weights = values / (2 * np.sqrt(biases_ * (1 - biases_)))
    return words.astype(np.float64) @ weights - (2 * biases_ - 1) @ weights


def log10_p(score: Float[np.ndarray, " scores"], values: Slots, biases_: Slots) -> Float64[np.ndarray, " scores"]:
    """log10 of a bound on the probability that an innocent recipient has such a score (Chernoff 1952).

    P(S ≥ s) ≤ E exp(θS) / exp(θs) for every θ ≥ 0; the terms of S are independent and two-valued, which gives E
    exactly. The least over a grid of θ is a bound like any other, and serves all scores at once.

    Args:
        score: s from `scores`, `[scores]`.
        values: y, independent of the recipient's codeword, `[slots]`.
        biases_: p, `[slots]`.

    Returns:
        Numbers in [-77, 0], `[scores]`; 0 where all values are.
    """
    norm = np.linalg.norm(values)
    if norm == 0:
        return np.zeros(len(score))
    tilts = _THETAS[:, None] * (values / norm / np.sqrt(biases_ * (1 - biases_)))
    logs = np.logaddexp(np.log(biases_) + tilts * (1 - biases_), np.log1p(-biases_) - tilts * biases_).sum(1)
    return np.clip((logs - np.outer(score / norm, _THETAS)).min(1) / math.log(10), FLOOR, 0.0)


def rank(values: Slots, recipients: Iterable[str], key: bytes, geometry: bytes, *, top: int = 10) -> list[Accusation]:
    """The recipients with the highest scores, the highest first, and how surely they are no innocents.

    Args:
        values: y at any scale, `[slots]`; chosen without a look at the codewords of innocents.
        recipients: identifiers; one that comes twice is tried once.
        key: 32 bytes.
        geometry: `geometry_hash` of the original.
        top: how many to return.

    Returns:
        At most `top`; the probabilities are for all that were tried together (union bound).

    Raises:
        JaxmarkError: if a value is not finite, there is no slot, or an identifier is empty.
    """
    if not np.isfinite(values).all():
        raise JaxmarkError("A slot's value is not finite: give 0 where nothing is known.")
    p = biases(key, geometry, len(values))
    y = _unexplained(np.asarray(values, np.float64), p)
    tried = list(dict.fromkeys(recipients))
    found = np.empty(len(tried))
    for i in range(0, len(tried), _CHUNK):
        found[i : i + _CHUNK] = scores(y, p, codewords(tried[i : i + _CHUNK], key, geometry, p))
    best = np.argsort(-found, kind="stable")[:top]
    bounds = np.minimum(log10_p(found[best], y, p) + math.log10(max(len(tried), 1)), 0.0)
    return [Accusation(tried[i], float(found[i]), float(bound)) for i, bound in zip(best, bounds, strict=True)]


def _unexplained(y: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What a cubic in p does not predict of y, of unit norm; zero if nothing is left.

    All coalitions follow p (their average is 2p - 1 in expectation). As g(X) has mean 0 given p, leaving that out takes
    nothing from a member's expected score, but much from the norm: 8 who average score half as high again or more.
    """
    y = y / max(np.abs(y).max(), np.finfo(float).tiny)
    powers = np.vander(p, 4)
    rest = y - powers @ np.linalg.lstsq(powers, y, rcond=None)[0]
    norm = np.linalg.norm(rest)
    return rest / norm if norm > 1e-9 * np.linalg.norm(y) else np.zeros_like(y)
