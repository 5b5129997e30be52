"""The search for small changes of a suspect's values, for example by its pose, that fit the key's offsets.

A view of a suspect is nearly the same as that of the marked mesh. The remaining change is found from the key's offsets,
which are independent of the claimed message (see `jaxmark.watermark.blind.dither`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.scheme import Look

_STARTS, _CLIMBS, _STEPS = 256, 4, 6  # random changes; how many of them are refined, and by how many steps


class Found(NamedTuple):
    """The small change for each turn and step that fits the key's offsets best."""

    change: Float[Array, "turns steps changes"]
    pilot: Float[Array, "turns steps"]  # fit of the offsets, in standard deviations of the fit by chance


@jax.jit
def search(
    values: Float[Array, " anchors"],
    changes: Float[Array, "anchors changes"],
    good: Float[Array, " anchors"],
    offsets: Float[Array, "turns anchors"],
    steps: Float[Array, " steps"],
    spread: Float[Array, " changes"],
) -> Found:
    """Find the small changes for which values fit the offsets best, modulo half a step: max Σ cos 4π(y/step - δ).

    Random changes are tried, and the best ones are refined by Gauss-Newton steps.

    Args:
        values: the values y of a view.
        changes: derivatives of the values with respect to small changes, see `Look`.
        good: 1 for each anchor that counts, else 0.
        offsets: δ of each anchor, for each turn.
        steps: quantisation steps of the values.
        spread: standard deviations of the small changes.
    """
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(_STARTS, len(spread))), values.dtype).at[0].set(0)
    scaled = changes * spread

    def fit(step: Float[Array, ""], offset: Float[Array, " anchors"]) -> tuple[Array, Array]:
        base, slope = values / step - offset, scaled / step * good[:, None]

        def pilot(change: Float[Array, "batch changes"]) -> Float[Array, " batch"]:
            return jnp.cos(4 * jnp.pi * (base + matmul(change, slope.T))) @ good

        def refine(change: Float[Array, "batch changes"], _: None) -> tuple[Float[Array, "batch changes"], None]:
            phase = base + matmul(change, slope.T)
            residual = phase - jnp.round(2 * phase) / 2
            weight = good * jnp.maximum(jnp.cos(4 * jnp.pi * residual), 0)
            gram = jnp.einsum("ac,ta,ad->tcd", slope, weight, slope) + jnp.eye(len(spread), dtype=values.dtype)
            gradient = jnp.einsum("ac,ta->tc", slope, weight * residual)
            return change - jnp.linalg.solve(gram, gradient[..., None])[..., 0], None

        best = starts[jax.lax.top_k(pilot(starts), _CLIMBS)[1]]
        best = jnp.concatenate([starts[:1], best, jax.lax.scan(refine, best, None, length=_STEPS)[0]])
        # Large changes are unlikely, and some of many changes fit by chance.
        fit_score = pilot(best) / jnp.sqrt(jnp.maximum(good.sum(), 1) / 2)
        chosen = jnp.argmax(fit_score - jnp.sum(best**2, axis=1) / 8)
        return best[chosen] * spread, fit_score[chosen]

    change, pilot = jax.lax.map(lambda step: jax.vmap(lambda offset: fit(step, offset))(offsets), steps)
    return Found(jnp.swapaxes(change, 0, 1), pilot.T)


def moved(view: Look, change: Float64[np.ndarray, " changes"]) -> Float64[np.ndarray, " anchors"]:
    """Compute the values of a view after a small change."""
    return np.asarray(view.values, np.float64) + np.asarray(view.changes, np.float64) @ change
