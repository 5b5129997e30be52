"""Random numbers for attacks on the host."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray


def generator(key: PRNGKeyArray) -> np.random.Generator:
    """Make a NumPy generator that a JAX random key seeds."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
