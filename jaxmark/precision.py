"""Sums that keep the digits of their type, on any device and in any order.

Accelerators multiply float32 matrices in bfloat16 or TF32 unless they are told otherwise, and lose all but three
digits: `matmul` and `einsum` tell them, and no traced function of this package has a matrix product but by these. A
plain sum of millions of terms may be off by more than what it decides: `compensated_sum` is not.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

matmul = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
einsum = partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)

_ROWS = 64  # that are added one after the other, all columns at once


@jax.custom_jvp
def compensated_sum(terms: Float[Array, "..."]) -> Float[Array, ""]:
    """Σ terms as if in twice the precision, then rounded (Ogita, Rump, Oishi, "Accurate sum and dot product", 2005).

    The error of each addition, had exactly by Knuth's two-sum, is added up beside it. With n terms and unit roundoff u,
    2⁻²⁴ in float32, the result is off by at most u|S| + log₆₄(n) (64 u)² Σ|terms|: below 2u (|S| + ‖terms‖) for ten
    million terms in float32, as Σ|terms| ≤ √n ‖terms‖. A plain sum has no better bound than u times n or log₂ n.

    The derivative is that of a sum. What computes the terms is not fused into the additions, for a loop reads them
    from memory; `jax.lax.reduce` with the same steps loses the compensation to XLA.
    """

    def add(sums: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        (high, low), (term, error) = sums, row
        total = high + term
        part = total - high
        return (total, low + (error + ((high - (total - part)) + (term - part)))), None

    sums = terms.ravel(), jnp.zeros(terms.size, terms.dtype)
    while sums[0].size > 1:
        rows = [jnp.pad(one, (0, -one.size % _ROWS)).reshape(_ROWS, -1) for one in sums]
        nothing = jnp.zeros_like(rows[0][0])
        sums, _ = jax.lax.scan(add, (nothing, nothing), (rows[0], rows[1]))
    return jnp.sum(sums[0] + sums[1])


compensated_sum.defjvps(lambda tangent, _, __: jnp.sum(tangent))


def sum_and_norm(terms: Float[Array, "..."]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Σ terms and ‖terms‖, neither the worse for many terms: what a score and its probability come from.

    Terms may be so small that their squares underflow. Of up to ten million float32 terms the quotient of the two, t,
    is off by at most 4 eps (1 + |t|), with eps = 1.2e-7; of float64 terms likewise. `jaxmark.evidence` allows for it.
    """
    peak = jax.lax.stop_gradient(jnp.max(jnp.abs(terms), initial=0))
    # Select before the root: its slope at nothing is infinite.
    square = jnp.where(peak > 0, compensated_sum((terms / jnp.where(peak > 0, peak, 1)) ** 2), 1)
    return compensated_sum(terms), peak * jnp.sqrt(square)
