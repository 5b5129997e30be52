"""Square roots whose derivative at 0 is 0 instead of infinite."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def root(square: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """√square; 0 with gradient 0 where `square` is not positive."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
