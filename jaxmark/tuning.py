"""Strengths per band by jaxopt: the most that every attack leaves readable, within a distortion budget.

The one module that imports jaxopt, and only when it is called.
"""

import warnings
from functools import partial
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError


class Channels(NamedTuple):
    """What each of a set of attacks does to a mark of strength β_j in band j: SNR_aj = gain_aj² β_j² / noise_aj."""

    gain: Float[Array, "attacks bands"]  # share of the band's amplitude that the attack leaves
    noise: Float[Array, "attacks bands"]  # variance it adds to each dimension of the band, in units of β², positive
    dimensions: Float[Array, " bands"]  # how many dimensions n_j the band has


def rate(channels: Channels, beta: Float[Array, " bands"]) -> Float[Array, " attacks"]:
    """Bits that each attack leaves readable: Σ_j (n_j/2) log₂(1 + SNR_j), the capacity of parallel Gauss channels."""
    return _rate(channels, beta**2)


def tune(
    channels: Channels,
    cost: Float[Array, " bands"],
    budget: float | Float[Array, ""],
    *,
    sharpness: float = 100.0,
    steps: int = 500,
) -> Float[Array, " bands"]:
    """Strengths per band that maximise the worst attack's `rate` under Σ_j cost_j β_j² = budget².

    Projected gradient on the shares of the budget, which live on a simplex, so the budget is met exactly. The worst is
    a soft minimum; its gap to the minimum is at most log(attacks)/sharpness of the rate at equal shares.

    Args:
        channels: of the attacks to survive.
        cost: mean square displacement that the band makes at β = 1, positive; then the budget is an RMS displacement.
        budget: in the same length unit.
        sharpness: of the soft minimum.
        steps: at most so many iterations.

    Returns:
        β ≥ 0, `[bands]`.

    Raises:
        JaxmarkError: if the shapes do not fit, or the budget is not positive.
    """
    attacks, bands = channels.gain.shape
    if channels.noise.shape != (attacks, bands) or channels.dimensions.shape != (bands,) or cost.shape != (bands,):
        raise JaxmarkError(
            f"tune needs gain and noise [attacks, bands] and dimensions and cost [bands], got {channels.gain.shape},"
            f" {channels.noise.shape}, {channels.dimensions.shape} and {cost.shape}."
        )
    if isinstance(budget, float | int) and not budget > 0:
        raise JaxmarkError(f"tune needs a positive budget, got {budget}.")
    return _tune(channels, cost, jnp.asarray(budget, cost.dtype), jnp.asarray(sharpness, cost.dtype), steps)


@partial(jax.jit, static_argnames="steps")
def _tune(channels: Channels, cost: Array, budget: Array, sharpness: Array, steps: int) -> Array:
    jaxopt = _import_jaxopt()

    equal = jnp.full_like(cost, 1 / len(cost))
    # A band's share of the budget buys this much β².
    scaled = channels._replace(gain=channels.gain * budget / jnp.sqrt(cost))
    weight = sharpness / _rate(scaled, equal).mean()

    # jaxopt differentiates its solution with respect to arguments, not to what a closure holds.
    def loss(shares: Array, scaled: Channels, weight: Array, sharpness: Array) -> Array:
        return jax.nn.logsumexp(-weight * _rate(scaled, shares)) / sharpness

    solver = jaxopt.ProjectedGradient(
        fun=loss,
        projection=lambda x, _: jaxopt.projection.projection_simplex(x),
        maxiter=steps,
        tol=1e-7,
        acceleration=False,  # accelerated steps leave the simplex, where a rate has no meaning
    )
    with jax.numpy_dtype_promotion("standard"):  # jaxopt mixes integers into its floats
        shares = solver.run(equal, None, scaled, weight, sharpness).params
    # The root's slope at an empty band is infinite: select before it. NaN is not empty, and stays.
    empty = shares <= 0
    return jnp.where(empty, 0, budget * jnp.sqrt(jnp.where(empty, 1, shares) / cost))


def _rate(channels: Channels, power: Array) -> Array:
    """`rate` as a function of β², in which it is concave and smooth at 0."""
    snr = channels.gain**2 * power / channels.noise
    return (channels.dimensions / 2 * jnp.log2(1 + snr)).sum(axis=1)


def _import_jaxopt() -> ModuleType:
    with warnings.catch_warnings():
        # It says at import that nobody maintains it; no maintained library solves constrained problems in JAX.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt
    return jaxopt
