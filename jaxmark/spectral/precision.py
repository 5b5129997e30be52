"""Matrix products and sums that keep the digits of their dtype, on any device and in any order of the terms.

By default, accelerators multiply float32 matrices in bfloat16 or TF32, and lose all but three digits: `matmul` and
`einsum` ask for full precision, and every matrix product in traced code of this package is one of these. A plain sum of
millions of terms may be off by more than the quantity that it decides; `compensated_sum` is not.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError

matmul = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
einsum = partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)

_FOLDED_ROWS = 64  # into which terms are folded; rows are added one after the other, all columns at once


def check_precision(name: str, x: Array | np.ndarray) -> None:
    """Refuse half precision, in which recurrences and solves keep no digit, and what is no floating-point number.

    Raises:
        JaxmarkError: if the dtype is neither float32 nor float64.
    """
    if x.dtype not in (np.float32, np.float64):
        raise JaxmarkError(f"{name} needs floating-point values, float32 or float64, got {x.dtype}.")


@jax.custom_jvp
def compensated_sum(terms: Float[Array, "..."]) -> Float[Array, ""]:
    """Sum terms as if in twice the precision, then round (Ogita, Rump, Oishi, "Accurate sum and dot product", 2005).

    The error of each addition, which Knuth's two-sum gives exactly, is summed beside the additions. With n terms, their
    sum S and the unit roundoff u, 2⁻²⁴ in float32, the result is off by at most u|S| + log₆₄(n) (64 u)² Σ|terms|: below
    2u (|S| + ‖terms‖) for ten million terms in float32, as Σ|terms| ≤ √n ‖terms‖. The error of a plain sum is bounded
    only by u Σ|terms| times n or, summed pairwise, log₂ n.

    The derivative is that of a sum. The computation of the terms is not fused into the additions, because a loop reads
    them from memory; with the same steps in `jax.lax.reduce`, XLA would optimise the compensation away.
    """

    def add(sums: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        (high, low), (term, error) = sums, row
        total = high + term
        part = total - high
        return (total, low + (error + ((high - (total - part)) + (term - part)))), None

    sums = terms.ravel(), jnp.zeros(terms.size, terms.dtype)
    while sums[0].size > 1:
        rows = [jnp.pad(part, (0, -part.size % _FOLDED_ROWS)).reshape(_FOLDED_ROWS, -1) for part in sums]
        zeros = jnp.zeros_like(rows[0][0])
        sums, _ = jax.lax.scan(add, (zeros, zeros), (rows[0], rows[1]))
    return jnp.sum(sums[0] + sums[1])


compensated_sum.defjvps(lambda tangent, _, __: jnp.sum(tangent))


def sum_and_norm(terms: Float[Array, "..."]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Σ terms and ‖terms‖, both by compensated sums: a score and its probability are computed from these.

    Terms may be so small that their squares underflow. For up to ten million float32 terms the quotient t of the two is
    off by at most 4 eps (1 + |t|), with eps = 1.2e-7, or 2.2e-16 for float64 terms.
    `jaxmark.watermark.evidence.bounds` allows for this error.
    """
    peak = jax.lax.stop_gradient(jnp.max(jnp.abs(terms), initial=0))
    # Select before the root: its slope at zero is infinite.
    square = jnp.where(peak > 0, compensated_sum((terms / jnp.where(peak > 0, peak, 1)) ** 2), 1)
    return compensated_sum(terms), peak * jnp.sqrt(square)
