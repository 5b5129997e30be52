"""Randomness comes in as a seed: a whole number, a JAX random key, or on the host a NumPy generator.

A whole number and the JAX key that it makes stand for the same random choices, in traced code and on the host.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int, PRNGKeyArray

from jaxmark.errors import JaxmarkError

Seed = int | np.integer | Int[Array, ""] | PRNGKeyArray
Randomness = Seed | np.random.Generator

# What is computed from probes enters marks and readings, so these seeds must never change.
_PROBES = {"reception": 0, "detection": 1, "capacity": 2, "channels": 3, "visibility": 4, "tuning": 5}


def random_key(seed: Randomness) -> PRNGKeyArray:
    """Make a JAX random key from a seed; a key is returned as it is, and a NumPy generator draws one.

    Raises:
        JaxmarkError: if it is neither a whole number, nor a key, nor a generator.
    """
    if isinstance(seed, np.random.Generator):
        return jax.random.key(int(seed.integers(2**31)))
    if isinstance(seed, int | np.integer):
        return jax.random.key(seed)
    if not isinstance(seed, jax.Array | np.ndarray):
        raise JaxmarkError(f"A seed is a whole number, such as 0, or a random key of JAX, got {type(seed).__name__}.")
    return jax.random.key(seed) if jnp.issubdtype(seed.dtype, jnp.integer) and not seed.ndim else seed


def generator(seed: Randomness) -> np.random.Generator:
    """Make a NumPy generator from a seed; a generator is returned as it is."""
    if isinstance(seed, np.random.Generator):
        return seed
    return np.random.default_rng(np.asarray(jax.random.key_data(random_key(seed))))


def probe_signs(purpose: str, *shapes: tuple[int, ...], dtype: DTypeLike) -> list[Float[Array, "..."]]:
    """Draw arrays of independent random signs that probe linear maps; they are public, and the same at every call.

    Args:
        purpose: what is probed: "reception", "detection", "capacity", "channels", "visibility" or "tuning"; each has
            signs of its own.
        shapes: the shape of each array.
        dtype: the dtype of all arrays.
    """
    key = jax.random.key(_PROBES[purpose])
    keys = [key] if len(shapes) == 1 else jax.random.split(key, len(shapes))
    return [jax.random.rademacher(one, shape, dtype) for one, shape in zip(keys, shapes, strict=True)]
