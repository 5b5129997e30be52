"""Randomness comes in as a seed: a whole number, a JAX random key, or on the host a NumPy generator.

A whole number and the JAX key that it makes stand for the same random choices, in traced code and on the host.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

Seed = int | np.integer | Int[Array, ""] | PRNGKeyArray
Randomness = Seed | np.random.Generator


def random_key(seed: Randomness) -> PRNGKeyArray:
    """Make a JAX random key from a seed; a key is returned as it is, and a NumPy generator draws one."""
    if isinstance(seed, np.random.Generator):
        return jax.random.key(int(seed.integers(2**31)))
    if isinstance(seed, int | np.integer) or (jnp.issubdtype(seed.dtype, jnp.integer) and not seed.ndim):
        return jax.random.key(seed)
    return seed


def generator(seed: Randomness) -> np.random.Generator:
    """Make a NumPy generator from a seed; a generator is returned as it is."""
    if isinstance(seed, np.random.Generator):
        return seed
    return np.random.default_rng(np.asarray(jax.random.key_data(random_key(seed))))
