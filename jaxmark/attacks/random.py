"""Random numbers for attacks on the host, from a JAX random key or from a NumPy generator."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

Randomness = PRNGKeyArray | np.random.Generator


def generator(key: Randomness) -> np.random.Generator:
    """Make a NumPy generator that a JAX random key seeds; a generator is returned as it is."""
    if isinstance(key, np.random.Generator):
        return key
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def random_key(key: Randomness) -> PRNGKeyArray:
    """Make a JAX random key that a NumPy generator draws; a key is returned as it is."""
    return jax.random.key(int(key.integers(2**31))) if isinstance(key, np.random.Generator) else key
