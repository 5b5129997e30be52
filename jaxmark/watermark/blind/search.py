"""The search for small changes of a suspect's values, for example by its pose, that fit the key's offsets.

A view of a suspect is nearly the same as that of the marked mesh. The remaining change is found from the key's offsets,
which are independent of the claimed message (see `jaxmark.watermark.blind.dither`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from numpy.typing import ArrayLike

from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.scheme import Look

_STARTS_PER_CLIMB, _STEPS = 64, 6  # random changes for each that is refined, and the number of steps
_BATCH = 256  # random changes that are tried at once, to limit the memory


def random_changes(count: int, size: int) -> Float64[np.ndarray, "count size"]:
    """Draw small changes in standard deviations, the same in every call; the first is no change."""
    changes = np.random.default_rng(0).normal(size=(count, size))
    changes[0] = 0
    return changes


def reliability(error: ArrayLike, step: ArrayLike) -> np.ndarray:
    """Compute the mean cosine exp(-2 (πσ/step)²) of a phase whose value has an error of this standard deviation σ."""
    return np.asarray(np.exp(-2 * (np.pi * np.asarray(error) / np.asarray(step)) ** 2))


class Found(NamedTuple):
    """The small change for each turn and step that fits the key's offsets best."""

    change: Float[Array, "turns steps changes"]
    pilot: Float[Array, "turns steps"]  # fit of the offsets, in standard deviations of the fit by chance


@jax.jit
def search(
    values: Float[Array, " anchors"],
    changes: Float[Array, "anchors changes"],
    weights: Float[Array, "steps anchors"],
    offsets: Float[Array, "turns anchors"],
    steps: Float[Array, " steps"],
    spread: Float[Array, " changes"],
    starts: Float[Array, "starts changes"],
) -> Found:
    """Find the small changes for which values fit the offsets best, modulo half a step: max Σ ω cos 4π(y/step - δ).

    Random changes are tried, and the best ones are refined by Gauss-Newton steps.

    Args:
        values: the values y of a view.
        changes: derivatives of the values with respect to small changes, see `Look`.
        weights: ω of each anchor for each step, from 0 for anchors that do not count to 1.
        offsets: δ of each anchor, for each turn.
        steps: quantisation steps of the values.
        spread: standard deviations of the small changes.
        starts: changes to begin with, in standard deviations, see `random_changes`.
    """
    scaled, climbs = changes * spread, max(len(starts) // _STARTS_PER_CLIMB, 1)

    def fit(
        step: Float[Array, ""], weight: Float[Array, " anchors"], offset: Float[Array, " anchors"]
    ) -> tuple[Array, Array]:
        base, slope = values / step - offset, scaled / step

        def pilot(change: Float[Array, "batch changes"]) -> Float[Array, " batch"]:
            return jnp.cos(4 * jnp.pi * (base + matmul(change, slope.T))) @ weight

        def refine(change: Float[Array, "batch changes"], _: None) -> tuple[Float[Array, "batch changes"], None]:
            phase = base + matmul(change, slope.T)
            residual = phase - jnp.round(2 * phase) / 2
            pull = weight * jnp.maximum(jnp.cos(4 * jnp.pi * residual), 0)
            gram = jnp.einsum("ac,ta,ad->tcd", slope, pull, slope) + jnp.eye(len(spread), dtype=values.dtype)
            gradient = jnp.einsum("ac,ta->tc", slope, pull * residual)
            return change - jnp.linalg.solve(gram, gradient[..., None])[..., 0], None

        batches = starts.reshape(-1, min(_BATCH, len(starts)), starts.shape[1])
        best = starts[jax.lax.top_k(jax.lax.map(pilot, batches).ravel(), climbs)[1]]
        best = jnp.concatenate([starts[:1], best, jax.lax.scan(refine, best, None, length=_STEPS)[0]])
        # Large changes are unlikely, and some of many changes fit by chance.
        fit_score = pilot(best) / jnp.sqrt(jnp.maximum(jnp.sum(weight**2), 1) / 2)
        chosen = jnp.argmax(fit_score - jnp.sum(best**2, axis=1) / 8)
        return best[chosen] * spread, fit_score[chosen]

    change, pilot = jax.lax.map(
        lambda kind: jax.vmap(lambda offset: fit(kind[0], kind[1], offset))(offsets), (steps, weights)
    )
    return Found(jnp.swapaxes(change, 0, 1), pilot.T)


def moved(view: Look, change: Float64[np.ndarray, " changes"]) -> Float64[np.ndarray, " anchors"]:
    """Compute the values of a view after a small change."""
    return np.asarray(view.values, np.float64) + np.asarray(view.changes, np.float64) @ change
