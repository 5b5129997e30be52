"""Seeds of random choices: a whole number, a JAX random key, or on the host a NumPy generator.

A whole number gives the same random choices as the JAX key that is made from it, in traced code and on the host.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int, PRNGKeyArray

from jaxmark.errors import JaxmarkError

Seed = int | np.integer | Int[Array, ""] | PRNGKeyArray
Randomness = Seed | np.random.Generator

_SEEDS = 2**32  # of larger seeds, JAX drops the upper half, unless 64-bit types are enabled

# The results of probes affect marks and readings; therefore these seeds must never change.
_PROBES = {"reception": 0, "detection": 1, "capacity": 2, "channels": 3, "visibility": 4, "tuning": 5}


def random_key(seed: Randomness) -> PRNGKeyArray:
    """Make a JAX random key from a seed; a key is returned unchanged, and a NumPy generator draws a key.

    Raises:
        JaxmarkError: if the seed is neither a whole number from 0 to 2³² - 1, nor a key, nor a generator.
    """
    if isinstance(seed, np.random.Generator):
        return jax.random.key(int(seed.integers(2**31)))
    if isinstance(seed, int | np.integer):
        if not 0 <= seed < _SEEDS:
            raise JaxmarkError(f"A seed must be from 0 to {_SEEDS - 1}, got {seed}.")
        return jax.random.key(seed)
    if not isinstance(seed, jax.Array | np.ndarray):
        raise JaxmarkError(
            f"A seed must be a whole number, such as 0, or a random key of JAX, got {type(seed).__name__}."
        )
    return jax.random.key(seed) if jnp.issubdtype(seed.dtype, jnp.integer) and not seed.ndim else seed


def generator(seed: Randomness) -> np.random.Generator:
    """Make a NumPy generator from a seed; a generator is returned as it is."""
    if isinstance(seed, np.random.Generator):
        return seed
    return np.random.default_rng(np.asarray(jax.random.key_data(random_key(seed))))


def probe_signs(purpose: str, *shapes: tuple[int, ...], dtype: DTypeLike) -> list[Float[Array, "..."]]:
    """Draw arrays of independent random signs for probing linear maps; they are public, and equal at every call.

    Args:
        purpose: the purpose of the probe: "reception", "detection", "capacity", "channels", "visibility" or "tuning";
            each has its own signs.
        shapes: the shape of each array.
        dtype: the dtype of all arrays.
    """
    key = jax.random.key(_PROBES[purpose])
    keys = [key] if len(shapes) == 1 else jax.random.split(key, len(shapes))
    return [jax.random.rademacher(one, shape, dtype) for one, shape in zip(keys, shapes, strict=True)]
