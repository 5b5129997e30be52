"""Optimal strengths per band for the worst of several attacks, for given channels.

The problem is concave. `allocate` solves it and is differentiable; `upper_bound` bounds how much better other strengths
could be. This is the only module that imports jaxopt, and only when it is called.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Float64
from scipy import optimize

from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.channels import Channels, Margin, margins

Bands = Float[Array, " bands"]

_ANNEALING_SHARES = (0.01, 0.1)  # of the final sharpness, in the stages before the last
_BALANCING_ROUNDS = 30  # in which several limits are weighed against each other


def allocate(
    channels: Channels,
    cost: Bands,
    budget: float | Float[Array, ""] = 1.0,
    *,
    margin: Margin = "rate",
    cap: float = 1.0,
    sharpness: float = 100.0,
    steps: int = 500,
    start: Bands | None = None,
) -> Bands:
    """Compute strengths per band that maximise the worst attack's margin under Σ_j cost_j β_j² = budget²; traceable.

    The problem is solved by projected gradients for the bands' shares of the budget, which lie on a simplex cut off at
    `cap`, so that the budget is met exactly. The worst margin is an annealed soft minimum, whose gap to the minimum is
    at most log(attacks)/sharpness of the margin at equal shares. Reverse mode differentiates the solution implicitly
    with respect to channels, cost and budget; there is no forward mode, and no derivative with respect to `start`.

    Args:
        channels: channels of the attacks to survive.
        cost: cost of each band at β = 1, positive; if it is the mean square displacement, the budget is an RMS.
        budget: root of the total cost.
        margin: see `channels.margins`.
        cap: the largest share of the budget that one band gets, at least 1/bands.
        sharpness: sharpness of the soft minimum.
        steps: largest number of iterations.
        start: strengths to start from; equal shares unless given.

    Returns:
        β ≥ 0, `[bands]`.

    Raises:
        JaxmarkError: if the shapes do not fit, or a number is out of range.
    """
    attacks, bands = channels.gain.shape
    if not channels.noise.shape == channels.dimensions.shape == (attacks, bands) or cost.shape != (bands,):
        raise JaxmarkError(
            "allocate needs gain, noise and dimensions [attacks, bands] and cost [bands], got"
            f" {channels.gain.shape}, {channels.noise.shape}, {channels.dimensions.shape} and {cost.shape}."
        )
    if not isinstance(cost, Tracer) and not (np.asarray(cost) > 0).all():
        raise JaxmarkError(f"allocate needs a positive cost of every band, got {np.asarray(cost).min():g} for one.")
    if isinstance(budget, float | int) and not budget > 0:
        raise JaxmarkError(f"allocate needs a positive budget, got {budget}.")
    if not cap * bands >= 1:
        raise JaxmarkError(f"{bands} bands with at most {cap:g} of the budget each cannot spend it; raise the cap.")
    first = jnp.full_like(cost, 1 / bands) if start is None else cost * jnp.asarray(start, cost.dtype) ** 2
    first = _capped_simplex(first / first.sum(), min(cap, 1.0))
    numbers = (jnp.asarray(budget, cost.dtype), jnp.asarray(sharpness, cost.dtype))
    return _allocate(channels, cost, numbers, first, margin, min(cap, 1.0), steps)


@partial(jax.jit, static_argnames=("margin", "cap", "steps"))
def _allocate(
    channels: Channels, cost: Array, numbers: tuple[Array, Array], first: Array, margin: Margin, cap: float, steps: int
) -> Array:
    budget, sharpness = numbers
    # A band's share of the budget buys this much β².
    scaled = channels._replace(gain=channels.gain * budget / jnp.sqrt(cost))
    level = 1 / margins(scaled, jnp.full_like(cost, 1 / len(cost)), margin).mean()

    def loss(shares: Array, scaled: Channels, level: Array, sharpness: Array) -> Array:
        return jax.nn.logsumexp(-sharpness * level * margins(scaled, shares, margin)) / sharpness

    def stage(shares: Array, share: Array) -> tuple[Array, None]:
        data = {"scaled": scaled, "level": level, "sharpness": share * sharpness}
        project, options = partial(_capped_simplex, cap=cap), {"maxiter": steps, "tol": 1e-7, "acceleration": False}
        return minimise(loss, project, shares, data, **options), None

    warm = jax.lax.stop_gradient(jax.lax.scan(stage, first, jnp.asarray(_ANNEALING_SHARES, first.dtype))[0])
    shares = stage(warm, jnp.ones_like(sharpness))[0]
    # The root's slope at an empty band is infinite: select before it. NaN is not empty, and stays.
    empty = shares <= 0
    return jnp.where(empty, 0, budget * jnp.sqrt(jnp.where(empty, 1, shares) / cost))


def minimise(
    loss: Callable[..., Array],
    project: Callable[[Array], Array],
    start: Array,
    data: dict[str, Any] | None = None,
    **options: Any,
) -> Array:
    """Minimise a function over a convex set by projected gradients; call it in compiled code, because jaxopt retraces.

    Args:
        loss: function of a point and of `data`. jaxopt differentiates the solution with respect to `data`, but not with
            respect to variables that the function closes over.
        project: projection onto the set.
        start: a point of the set.
        data: keyword arguments of `loss`.
        options: options of `jaxopt.ProjectedGradient`.
    """
    with warnings.catch_warnings():
        # jaxopt warns at import that it is not maintained; no maintained library solves constrained problems in JAX.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt
    with jax.numpy_dtype_promotion("standard"):  # jaxopt mixes integers into its floats
        solver = jaxopt.ProjectedGradient(loss, lambda x, _: project(x), **options)
        return solver.run(start, hyperparams_proj=None, **(data or {})).params


@partial(jax.jit, static_argnames="cap")
def _capped_simplex(x: Bands, cap: float) -> Bands:
    """Project onto Σ_j s_j = 1, 0 ≤ s_j ≤ cap: subtract one level from all, and clip."""

    def halve(_: Array | int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        high = jnp.clip(x - middle, 0, cap).sum() > 1
        return jnp.where(high, middle, ends[0]), jnp.where(high, ends[1], middle)

    ends = jax.lax.stop_gradient((x.min() - 1, x.max()))
    level = jax.lax.stop_gradient(jax.lax.fori_loop(0, 60, halve, ends)[1])
    # Exactly, and with its derivative: the sum is linear while the same bands are free.
    free = (x - level > 0) & (x - level < cap)
    level = level + (jnp.clip(x - level, 0, cap).sum() - 1) / jnp.maximum(free.sum().astype(x.dtype), 1)
    return jnp.clip(x - level, 0, cap)


def upper_bound(
    channels: Channels, cost: Float[Array | np.ndarray, " bands"], *, cap: float = 1.0, margin: Margin = "rate"
) -> float:
    """Bound the worst attack's margin over all strengths with Σ_j cost_j β_j² ≤ 1; on the host, in float64.

    By weak duality: for weights w ≥ 0, Σ_a w_a = 1 of the attacks and a price μ ≥ 0 of the budget, the worst margin is
    at most μ + Σ_j max_p [Σ_a w_a m_aj(p) - μ cost_j p] over 0 ≤ p ≤ cap/cost_j, whatever w and μ are. The search is
    for the least such bound, which is tight because the problem is concave (Boyd, Vandenberghe, "Convex Optimization",
    5.2).
    """
    gain, noise, dimensions = (np.asarray(field, np.float64) for field in channels)
    cost = np.asarray(cost, np.float64)
    # In shares s = cost · p of the budget, of which slope · s is the SNR.
    half, slope = dimensions / 2, gain**2 / noise / cost

    def worth(shares: np.ndarray) -> np.ndarray:
        """Compute each attack's margin in each band."""
        snr = slope * shares
        return half * {"rate": np.log2(1 + snr), "evidence": snr / (1 + snr), "snr": snr}[margin]

    def rising(shares: np.ndarray) -> np.ndarray:
        """Compute the derivative of `worth`."""
        snr = slope * shares
        each = {"rate": 1 / (1 + snr) / np.log(2), "evidence": 1 / (1 + snr) ** 2, "snr": np.ones_like(snr)}
        return half * slope * each[margin]

    def spent(weights: np.ndarray, price: float) -> np.ndarray:
        """Compute the optimal share of each band at a price."""
        low, high = np.zeros(len(cost)), np.full(len(cost), min(cap, 1.0))
        for _ in range(60):
            middle = (low + high) / 2
            worthwhile = weights @ rising(middle) > price
            low, high = np.where(worthwhile, middle, low), np.where(worthwhile, high, middle)
        return low

    def bound(variables: np.ndarray) -> tuple[float, np.ndarray]:
        weights = np.exp(variables[:-1] - variables[:-1].max())
        weights /= weights.sum()
        price = float(np.exp(variables[-1]))
        shares = spent(weights, price)
        values = worth(shares).sum(axis=1)
        total = float(weights @ values + price * (1 - shares.sum()))
        return total, np.append(weights * (values - weights @ values), price * (1 - shares.sum()))

    even = worth(np.full(len(cost), 1 / len(cost))).sum(axis=1)
    start = np.append(np.zeros(len(gain)), np.log(max(even.min(), 1e-300)))
    best = np.inf
    # The bound holds at every trial, so that the least value of all is a bound. It is not smooth, so that a search may
    # stop early and is started again.
    for _ in range(20):
        found = optimize.minimize(bound, start, jac=True, method="L-BFGS-B", options={"maxiter": 500})
        improved, best, start = found.fun < best * (1 - 1e-6), min(best, float(found.fun)), found.x
        if not improved:
            break
    return best


def balance(
    channels: Channels,
    cost: Float64[np.ndarray, "limits bands"],
    margin: Margin,
    cap: float,
    start: Float[np.ndarray, " bands"] | None,
) -> tuple[Float64[np.ndarray, " bands"], Float64[np.ndarray, " limits"]]:
    """Compute strengths within several limits, and the weights of the single budget that has the same solution.

    Any weighted mean of the limits is a weaker bound than all of them together. The weights for which its solution
    keeps all limits are found by raising those of limits that are exceeded.
    """
    weights, dtype = np.full(len(cost), 1 / len(cost)), channels.gain.dtype
    best = -np.inf, np.zeros(len(cost[0])), weights
    for _ in range(_BALANCING_ROUNDS if len(cost) > 1 else 1):
        given = None if start is None else jnp.asarray(start, dtype)
        solved = allocate(channels, jnp.asarray(weights @ cost, dtype), margin=margin, cap=cap, start=given)
        power = np.asarray(solved, np.float64) ** 2
        used = cost @ power
        power /= used.max()
        worst = float(margins(channels, jnp.asarray(power, dtype), margin).min())
        if not worst <= best[0]:
            best = worst, np.sqrt(power), weights
        if used.max() < 1.001:
            break
        start, weights = np.sqrt(power), weights * used**0.5
        weights = weights / weights.sum()
    return best[1], best[2]
