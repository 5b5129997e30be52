"""Randomness of attacks on the host."""

import jax
import numpy as np
from jaxtyping import PRNGKeyArray


def generator(key: PRNGKeyArray) -> np.random.Generator:
    """NumPy's generator from a JAX random key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
