"""Percentiles of many numbers that are not negative, without sorting them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def percentile(
    values: Float[Array, " values"], weights: Float[Array, " values"], share: float | Float[Array, ""]
) -> Float[Array, ""]:
    """The least of the values at or below which lies a share of the weight; the gradient is that of this value.

    Numbers that are not negative are ordered as the integers that their bits are, and these are bisected, which takes a
    tenth of the time of sorting.

    Args:
        values: none negative.
        weights: of the values, none negative.
        share: from 0 to 1.
    """
    fixed = jax.lax.stop_gradient(values)
    size = 8 * values.dtype.itemsize
    bits = jax.lax.bitcast_convert_type(fixed, jnp.dtype(f"int{size}"))
    weights = weights.astype(values.dtype)
    enough = jnp.asarray(share).astype(values.dtype) * jnp.sum(weights)

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = low + (high - low) // 2
        inside = jnp.sum(jnp.where(bits <= middle, weights, 0)) >= enough
        return jnp.where(inside, low, middle + 1), jnp.where(inside, middle, high)

    most = jnp.max(bits)
    found, _ = jax.lax.fori_loop(0, size, halve, (jnp.zeros_like(most), most))
    return values[jnp.argmin(jnp.where(bits >= found, bits, jnp.iinfo(bits.dtype).max))]
