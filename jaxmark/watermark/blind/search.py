"""Small changes of a suspect's values, as by its pose, that the key's offsets speak for.

What a suspect shows is nearly what was marked: the search for the rest is by the key's offsets, which say nothing of
what is claimed (see `jaxmark.watermark.blind.dither`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.scheme import Look

_STARTS, _CLIMBS, _STEPS = 256, 4, 6  # random changes; how many climb, and how far


class Found(NamedTuple):
    """The best small change for each turn and step, by the key's offsets."""

    change: Float[Array, "turns steps changes"]
    pilot: Float[Array, "turns steps"]  # how well the offsets fit, in standard deviations of what chance gives


@jax.jit
def search(
    values: Float[Array, " anchors"],
    changes: Float[Array, "anchors changes"],
    good: Float[Array, " anchors"],
    offsets: Float[Array, "turns anchors"],
    steps: Float[Array, " steps"],
    spread: Float[Array, " changes"],
) -> Found:
    """Find small changes by which values lie half a step apart as the offsets say: largest Σ cos 4π(y/step - δ).

    Random changes are tried; the best climb by steps of Gauss and Newton.

    Args:
        values: of a view.
        changes: of its values, in the order of `Look`.
        good: 1 for each anchor that counts, else 0.
        offsets: δ of each anchor, for each turn.
        steps: of the lattice of values.
        spread: of small changes.
    """
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(_STARTS, len(spread))), values.dtype).at[0].set(0)
    scaled = changes * spread

    def fit(step: Float[Array, ""], offset: Float[Array, " anchors"]) -> tuple[Array, Array]:
        base, slope = values / step - offset, scaled / step * good[:, None]

        def pilot(change: Float[Array, "tried changes"]) -> Float[Array, " tried"]:
            return jnp.cos(4 * jnp.pi * (base + matmul(change, slope.T))) @ good

        def climb(change: Float[Array, "tried changes"], _: None) -> tuple[Float[Array, "tried changes"], None]:
            phase = base + matmul(change, slope.T)
            off = phase - jnp.round(2 * phase) / 2
            weight = good * jnp.maximum(jnp.cos(4 * jnp.pi * off), 0)
            gram = jnp.einsum("ac,ta,ad->tcd", slope, weight, slope) + jnp.eye(len(spread), dtype=values.dtype)
            towards = jnp.einsum("ac,ta->tc", slope, weight * off)
            return change - jnp.linalg.solve(gram, towards[..., None])[..., 0], None

        best = starts[jax.lax.top_k(pilot(starts), _CLIMBS)[1]]
        best = jnp.concatenate([starts[:1], best, jax.lax.scan(climb, best, None, length=_STEPS)[0]])
        # Large changes are unlikely, and among many some fit by chance.
        worth = pilot(best) / jnp.sqrt(jnp.maximum(good.sum(), 1) / 2)
        chosen = jnp.argmax(worth - jnp.sum(best**2, axis=1) / 8)
        return best[chosen] * spread, worth[chosen]

    change, pilot = jax.lax.map(lambda step: jax.vmap(lambda offset: fit(step, offset))(offsets), steps)
    return Found(jnp.swapaxes(change, 0, 1), pilot.T)


def moved(view: Look, change: Float64[np.ndarray, " changes"]) -> Float64[np.ndarray, " anchors"]:
    """Values of a view after a small change."""
    return np.asarray(view.values, np.float64) + np.asarray(view.changes, np.float64) @ change
