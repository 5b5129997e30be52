"""Random signs that probe linear maps; they are fixed and public, and each purpose has its own."""

import jax
from jaxtyping import Array, DTypeLike, Float

# What is computed from probes enters marks and readings, so these seeds must never change.
_SEEDS = {"reception": 0, "detection": 1, "capacity": 2, "channels": 3, "visibility": 4, "tuning": 5}


def probe_signs(purpose: str, *shapes: tuple[int, ...], dtype: DTypeLike) -> list[Float[Array, "..."]]:
    """Draw arrays of independent random signs, -1 or +1; the same call always returns the same arrays.

    Args:
        purpose: what is probed: "reception", "detection", "capacity", "channels", "visibility" or "tuning".
        shapes: the shape of each array.
        dtype: the dtype of all arrays.
    """
    key = jax.random.key(_SEEDS[purpose])
    keys = [key] if len(shapes) == 1 else jax.random.split(key, len(shapes))
    return [jax.random.rademacher(one, shape, dtype) for one, shape in zip(keys, shapes, strict=True)]
