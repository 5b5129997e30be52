"""Random numbers for attacks on the host."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

Randomness = PRNGKeyArray | np.random.Generator


def generator(key: Randomness) -> np.random.Generator:
    """Make a NumPy generator that a JAX random key seeds; a generator is returned as it is."""
    if isinstance(key, np.random.Generator):
        return key
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
