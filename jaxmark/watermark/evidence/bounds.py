"""Bounds on the probability that a mesh which is independent of the key reaches a score.

All functions except `log10_p_gaussian` return log10 of an upper bound on a probability, at most 0 and without a floor;
`jaxmark.watermark.evidence.ledger` adds the cost of every choice and the floor of a 256-bit key. Pass scores and norms
in the dtype in which they were summed: the largest error that `precision.sum_and_norm` can make in this dtype is
subtracted from the score, so that rounding cannot make a probability too small.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from numpy.typing import ArrayLike
from scipy.special import log_ndtr  # scipy.stats takes long to import

from jaxmark.spectral.precision import matmul

_CHERNOFF_THETAS = np.geomspace(1e-2, 1e3, 512)  # so dense that the grid costs only a few ten-thousandths of log10 p


def log10_p_score(score: ArrayLike, norm: ArrayLike) -> float:
    """Bound P(S ≥ score) for a codeword that was fixed beforehand (Hoeffding 1963, Theorem 2), as log10.

    For S = Σ s·a with independent keyed signs s, P(S ≥ t‖a‖) ≤ exp(-t²/2). The bound holds for any suspect under three
    conditions:

    - The suspect, and therefore a, is independent of the signs. A mesh marked under the same key is not.
    - Weights, masks and pose do not depend on the key or the score.
    - Key, original and message were fixed before the suspect was seen.

    Args:
        score: S, the plain linear correlation of the codeword.
        norm: ‖a‖, the norm of the vector a that the signs multiply.

    Returns:
        A number of at most 0; 0 if score or norm is not positive or not finite.
    """
    s, a = _as_floats(score, norm)
    if not (s > 0 and a > 0 and math.isfinite(s) and math.isfinite(a)):
        return 0.0
    rounding = 4 * float(np.finfo(np.result_type(np.asarray(score), np.asarray(norm), np.float16)).eps)
    return -(max(s / a - rounding * (1 + s / a), 0.0) ** 2) / 2 / math.log(10)


def log10_p_tag(bits: int) -> float:
    """Return log10 of the probability that a message matches its keyed tag by chance, which is 2^-bits.

    The subkey of the tag is independent of everything that the message was chosen by.

    Args:
        bits: size of the tag in bits.
    """
    return -bits * math.log10(2)


def log10_p_gaussian(score: ArrayLike, norm: ArrayLike) -> float:
    """Return log10 P(S ≥ score) for a Gaussian S with standard deviation ‖a‖: close to the true value, but no bound."""
    s, a = _as_floats(score, norm)
    if not (a > 0 and math.isfinite(s) and math.isfinite(a)):
        return 0.0
    return float(log_ndtr(-s / a)) / math.log(10)


def log10_p_product(log10_p: Sequence[float]) -> float:
    """Return log10 of the probability that the product of independent p-values is at most the given product.

    A product of n independent p-values is at most q with probability q Σ (-ln q)^i/i! over i < n (Fisher 1932).
    """
    nats = -sum(log10_p) * math.log(10)
    return sum(log10_p) + math.log10(sum(nats**power / math.factorial(power) for power in range(len(log10_p))))


def log10_p_fingerprint(
    score: Float[np.ndarray, " scores"], values: Float[np.ndarray, " slots"], biases: Float[np.ndarray, " slots"]
) -> Float64[np.ndarray, " scores"]:
    """Bound the probability that an innocent recipient reaches a score (Chernoff 1952), as log10.

    P(S ≥ s) ≤ E exp(θS) / exp(θs) for every θ ≥ 0. The terms of S are independent and take two values each, so that the
    expectation is computed exactly. The minimum of these bounds over a grid of θ is also a bound, and one grid serves
    all scores.

    Args:
        score: scores s from `jaxmark.watermark.tracing.tardos.scores`, `[scores]`.
        values: slot values y, **independent of the recipient's codeword**, `[slots]`.
        biases: p of each slot, `[slots]`.

    Returns:
        Numbers of at most 0, `[scores]`; all are 0 if all values are 0.
    """
    peak = np.abs(values).max(initial=0)
    if peak == 0:
        return np.zeros(len(score))
    norm = peak * np.linalg.norm(values / peak)  # squares of the values themselves may underflow
    tilts = _CHERNOFF_THETAS[:, None] * (values / norm / np.sqrt(biases * (1 - biases)))
    logs = np.logaddexp(np.log(biases) + tilts * (1 - biases), np.log1p(-biases) - tilts * biases).sum(1)
    return np.minimum((logs - np.outer(score / norm, _CHERNOFF_THETAS)).min(1) / math.log(10), 0.0)


def _as_floats(score: ArrayLike, norm: ArrayLike) -> tuple[float, float]:
    return float(np.asarray(score, np.float64)), float(np.asarray(norm, np.float64))


def correlation_bound(
    sequences: Float[Array, "bits bands"],
    attack: Float[Array, " bands"],
    coherence: Float[Array, ""] | float,
    beta: Float[Array, ""] | float,
) -> Float[Array, " bits"]:
    """Compute the paper's lower bound (3) on |W_i|, the plain correlation, including the terms that the paper omits.

    Assume unit components with |⟨x_i, x_j⟩_D| ≤ ε, n bands, k bits of strength β, and an attack Σ_j a_j x_j in the span
    of the components. Then |W_i| ≥ βn - |Σ_j p_j a_j| - ε(n - 1)(βkn + Σ_j |a_j|). The paper omits β and the other
    bits. For the ε of real meshes with the paper's kernel (about 0.9) the bound is negative, hence vacuous: do not rely
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
