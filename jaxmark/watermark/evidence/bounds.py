"""What a score proves: probabilities of false detection that hold for any suspect independent of the key.

All results but that of `log10_p_fitted` are log10 of an upper bound on the probability, at most 0, and at least -77: a
256-bit key supports no claim below 2⁻²⁵⁶. With `floor=UNFLOORED` the same formulas go on below it: what they give there
orders attacks and schemes, but no claim rests on it. Pass scores and norms in the dtype that they were summed in: the
largest error that `precision.sum_and_norm` can make in it is subtracted from the score, so that rounding makes no
probability too small.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.special import log_ndtr  # scipy.stats takes long to import

from jaxmark.spectral.precision import matmul

MIN_LOG10_P = -77.0
UNFLOORED = -math.inf
_LOG10_TRIES = 64 * math.log10(2)


def log10_p_claimed(score: ArrayLike, norm: ArrayLike) -> float:
    """log10 of a bound on P(S ≥ score) for a codeword that was claimed beforehand (Hoeffding 1963, Theorem 2).

    For S = Σ s·a over keyed independent signs s, P(S ≥ t‖a‖) ≤ exp(-t²/2). This holds for any suspect, provided that
    the suspect, and with it a, is independent of the signs (a mesh marked under the same key is not); that weights,
    masks and pose never depend on the key or the score; and that key, original and message were fixed before the
    suspect was seen.

    Args:
        score: S, the plain linear correlation of the claimed codeword.
        norm: ‖a‖ of the same vector a that the signs multiply.

    Returns:
        A finite number in [-77, 0]; 0 if the score is not positive or the residual is zero.
    """
    return _clip(_log10_tail(score, norm))


def log10_p_fitted_strengths(score: ArrayLike, norm: ArrayLike, strengths: int) -> float:
    """log10 of a bound on P(S ≥ score) if relative strengths of bands were chosen after the suspect was seen.

    With m strengths, a lies in a space of m dimensions that is free of the key, and the supremum of S/‖a‖ over it is
    the length of the signs' projection: P(sup ≥ t) ≤ exp(-u²) with u = (√(2t² - m) - √m)/2 for t² ≥ m (Hsu, Kakade,
    Zhang, "A tail inequality for quadratic forms of subgaussian random vectors", Electronic Communications in
    Probability 17, 2012, Theorem 2.1).

    Args:
        score: S, the plain linear correlation of the claimed codeword.
        norm: ‖a‖ of the same vector a that the signs multiply.
        strengths: m, the number of strengths that were free.

    Returns:
        A finite number in [-77, 0].
    """
    square = -2 * math.log(10) * _log10_tail(score, norm)
    if square < strengths:
        return 0.0
    return _clip(-(((math.sqrt(2 * square - strengths) - math.sqrt(strengths)) / 2) ** 2) / math.log(10))


def undated(log10_p: float) -> float:
    """log10 of a bound on the probability that any of 2^64 keys, originals or records is so good.

    Whoever makes a claim that nothing dates may have tried as many; 2^64 hashes are about what can be paid for. What
    need not be tried one by one is paid for in `log10_p`: all messages, see `log10_p_read`, and in version 1 all
    strengths, see `log10_p_fitted_strengths`.
    """
    return _clip(log10_p + _LOG10_TRIES)


def share_of(log10_p: float, share: float, floor: float = MIN_LOG10_P) -> float:
    """log10 of the bound for a proof that has only a share of the probability, as others were possible in its place.

    Proofs whose shares add up to 1 have the stated probability together (a weighted Bonferroni bound).
    """
    return _clip(log10_p - math.log10(share), floor)


def log10_p_read(score: ArrayLike, norm: ArrayLike, bits: float, floor: float = MIN_LOG10_P) -> float:
    """log10 of a bound on the probability that any of 2^bits possible codewords scores so high (union bound).

    Args:
        score: S, the plain linear correlation of the codeword that was read.
        norm: ‖a‖ of the same vector a that the signs multiply.
        bits: size of the payload in bits, without the tag, which the message determines; and the logarithm to base 2
            of how many other choices were tried, if any were.
        floor: the least result.

    Returns:
        A finite number in [floor, 0].
    """
    return _clip(bits * math.log10(2) + _log10_tail(score, norm), floor)


def log10_p_tag(bits: int, candidates: float) -> float:
    """log10 of a bound on the probability that one of several messages fits its keyed tag by chance (union bound).

    The tag's subkey is independent of everything that chose the messages, so the probability is 2^-bits for each.

    Args:
        bits: size of the tag in bits.
        candidates: number of messages tried, or as how many this one counts, see `Decoded.paid`.
    """
    return _clip(math.log10(candidates) - bits * math.log10(2))


def any_of(*log10_p: float, floor: float = MIN_LOG10_P) -> float:
    """log10 of a bound on the probability that the best of several proofs is as good as it is (Bonferroni)."""
    return _clip(min(log10_p) + math.log10(len(log10_p)), floor)


def log10_p_fitted(score: ArrayLike, norm: ArrayLike, bits: float = 0) -> float:
    """log10 of the probability if S were Gaussian with standard deviation ‖a‖: close to the true one, but no bound.

    Args:
        score: S.
        norm: ‖a‖.
        bits: size of the payload in bits if the message was read; 0 if it was claimed.
    """
    s, a = float(np.asarray(score, np.float64)), float(np.asarray(norm, np.float64))
    if not (a > 0 and math.isfinite(s) and math.isfinite(a)):
        return 0.0
    return min(0.0, float(log_ndtr(-s / a)) / math.log(10) + bits * math.log10(2))


def _log10_tail(score: ArrayLike, norm: ArrayLike) -> float:
    """log10 of exp(-S²/2‖a‖²); 0 if score or norm is not positive or not finite."""
    s, a = float(np.asarray(score, np.float64)), float(np.asarray(norm, np.float64))
    if not (s > 0 and a > 0 and math.isfinite(s) and math.isfinite(a)):
        return 0.0
    rounding = 4 * float(np.finfo(np.result_type(np.asarray(score), np.asarray(norm), np.float16)).eps)
    return -(max(s / a - rounding * (1 + s / a), 0.0) ** 2) / 2 / math.log(10)


def _clip(log10_p: float, floor: float = MIN_LOG10_P) -> float:
    return min(0.0, max(floor, log10_p))


def correlation_bound(
    sequences: Float[Array, "bits bands"],
    attack: Float[Array, " bands"],
    coherence: Float[Array, ""] | float,
    beta: Float[Array, ""] | float,
) -> Float[Array, " bits"]:
    """Compute the paper's lower bound (3) on |W_i|, the plain correlation, completed by the terms that it leaves out.

    For unit components with |⟨x_i, x_j⟩_D| ≤ ε, n bands, k bits of strength β, and an attack Σ_j a_j x_j inside the
    span of the components, |W_i| ≥ βn - |Σ_j p_j a_j| - ε(n - 1)(βkn + Σ_j |a_j|). The paper omits β and the other
    bits. At the ε of real meshes under its own kernel (about 0.9) the bound is negative and says nothing: do not rely
    on it.

    Args:
        sequences: ±1, `[k, n]`, mutually orthogonal.
        attack: the attack's amplitudes a_j, `[n]`.
        coherence: ε, the bound on the inner products of different components.
        beta: strength β ≥ 0.

    Returns:
        The bound for each bit, `[k]`; negative values are vacuous.
    """
    k, n = sequences.shape
    spread = beta * k * n + jnp.abs(attack).sum()
    return beta * n - jnp.abs(matmul(sequences, attack)) - coherence * (n - 1) * spread
