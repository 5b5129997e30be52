"""Strengths per band by jaxopt that leave most readable after the worst of several attacks, within a budget.

This is the only module that imports jaxopt, and only when it is called. `tune` measures and solves for a mesh;
`allocate` solves for given channels and is differentiable; `upper_bound` says how much better other strengths could be.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import ModuleType
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Float64, Int64, PRNGKeyArray
from scipy import optimize

from jaxmark.alignment.alignment import align, observation
from jaxmark.alignment.original import Original, make_original
from jaxmark.attacks import Kind, attack
from jaxmark.distortion import name_of
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.chebyshev import band_energies, filter
from jaxmark.watermark.budget import Budget, Limits, make_budget, write
from jaxmark.watermark.carriers.carrier import Displacement
from jaxmark.watermark.channels import Channels, Margin, margins, measure
from jaxmark.watermark.everyday import blind_scheme
from jaxmark.watermark.probes import probe_signs
from jaxmark.watermark.schemes import DEFAULT_SCHEME, Scheme, TunableScheme, get_scheme
from jaxmark.watermark.visibility import apply_mask, band_visibility

Solver = Literal["projected-gradient", "accelerated-gradient"]
Attacker = tuple[Kind, float] | Callable[[Mesh, int], Mesh]  # an attack and a strength, or (mesh, seed) → mesh

_ANNEALING_SHARES = (0.01, 0.1)  # of the final sharpness, in the stages before the last
_BALANCING_ROUNDS = 30  # in which several limits are weighed against each other


class Report(NamedTuple):
    """How well the tuned strengths do, and how much better any others could."""

    margins: Float64[np.ndarray, " attacks"]  # margin of the tuned strengths after each attack, by the channels
    bound: float  # upper bound on the worst margin of any strengths within the budget
    gap: float  # (bound - worst margin) / bound
    binding: Mapping[str, float]  # weights of the limits in the tuned budget


class Tuned(NamedTuple):
    """Strengths per band that are tuned to a mesh."""

    scheme: TunableScheme  # has the strengths as its profile; `embed` takes it
    beta: Float64[np.ndarray, " bands"]  # the strengths in diagonals, within the budget
    channels: Channels  # of the attacks, as measured
    cost: Float64[np.ndarray, "limits bands"]  # share of each limit, squared, that β_j² = 1 uses up
    detector_weights: Float64[np.ndarray, "attacks bands"]  # matched to each attack: gain · β / noise
    report: Report


def tune(
    mesh: Mesh,
    attacks: Sequence[Attacker],
    budget: float | None = None,
    *,
    limits: Limits | None = None,
    key: PRNGKeyArray,
    bits: int = 64,
    scheme: str | Scheme = DEFAULT_SCHEME,
    seeds: int = 1,
    margin: Margin = "rate",
    cap: float = 0.125,
    solver: Solver = "projected-gradient",
    start: Float[np.ndarray, " bands"] | None = None,
) -> Tuned:
    """Tune the strengths of a scheme's bands to a mesh, a set of attacks and a budget.

    Each attack's channel is measured from a probe that spends equal shares of the budget in all bands. Limits on other
    metrics than RMS displacement count as quadratic in the strengths, with the measured visibility of each band; a
    common factor then brings the strengths within the real limits.

    Args:
        mesh: the original.
        attacks: the attacks to survive: pairs of a name in `ATTACKS`, or an `Attack`, and a strength; or functions of
            mesh and seed.
        budget: see `embed`.
        limits: see `embed`.
        key: a JAX random key for the attacks' random choices; not secret.
        bits: size of the payload in bits.
        scheme: the scheme whose bands are tuned; its profile is replaced.
        seeds: number of times that each attack is tried; gain and noise are averaged.
        margin: see `jaxmark.watermark.channels.margins`.
        cap: the largest share of the budget that one band gets, so that losing a band does not lose the mark.
        solver: see `allocate`.
        start: strengths to start from, such as those of an earlier tuning.

    Returns:
        The strengths, the scheme that has them, and a report.

    Raises:
        JaxmarkError: if the mesh, an attack, the budget or a number is unusable, or the scheme has no bands to tune.
    """
    if not attacks or seeds < 1:
        raise JaxmarkError(f"tune needs at least one attack and one seed, got {len(attacks)} and {seeds}.")
    if blind_scheme(scheme) is not None:
        raise JaxmarkError(f"The scheme {scheme!r} is read without the original, and has no bands; see tune_blind.")
    numbers = seed_numbers("tune", key, seeds)
    bounds, tunable = make_budget(budget, limits), get_scheme(scheme).tunable()
    original, family = make_original(mesh), tunable.family()
    (signs,) = probe_signs("tuning", original.signal.shape, dtype=original.signal.dtype)
    signs = signs * original.to_traced(original.used)[:, None]
    mask = tunable.mask(original)

    def shape_signs(strengths: Float64[np.ndarray, " bands"]) -> Float64[np.ndarray, "points 3"]:
        return original.to_host(apply_mask(mask, filter(original.operator, family.T @ strengths, signs)))

    cost = _costs(original, family, signs, mask, bounds)
    equal = 1 / np.sqrt(len(family) * cost.sum(axis=0))
    # Equal shares, so that each band is measured.
    probe = shape_signs(equal)
    written = write(original, probe, bounds)
    mark = original.to_traced(written.scale * probe)
    suspects = [[apply_attack(one, written.mesh, int(seed)) for seed in numbers] for one in attacks]
    seen = [[observation(original, align(original, suspect)) for suspect in row] for row in suspects]

    def measure_channels(profile: tuple[float, ...]) -> Channels:
        receiver = tunable.with_profile(profile).receiver(original, bits)
        rows = [_mean([measure(receiver, one, mark) for one in row]) for row in seen]
        return Channels(*map(jnp.concatenate, zip(*rows, strict=True)))

    # What the receiver projects off depends on the profile: once for a first one, and again for what it was tuned to.
    first = measure_channels(_profile(equal if start is None else np.asarray(start, np.float64)))
    start, _ = _balanced(first, cost, margin, cap, solver, start)
    channels = measure_channels(_profile(start))
    beta, weights = _balanced(channels, cost, margin, cap, solver, start)
    profile = _profile(beta)
    worth = np.asarray(margins(channels, jnp.asarray(beta**2, original.signal.dtype), margin), np.float64)
    bound = upper_bound(channels, weights @ cost, cap=cap, margin=margin)
    report = Report(
        worth, bound, 1 - float(worth.min()) / bound, dict(zip(_names(bounds), map(float, weights), strict=True))
    )
    # The real metrics decide on the mark that the profile makes.
    exact = np.zeros(len(family))
    exact[: len(profile)] = profile
    exact *= write(original, shape_signs(exact), bounds).scale
    matched = np.asarray(channels.gain * exact / channels.noise, np.float64)
    return Tuned(tunable.with_profile(profile), exact, channels, cost, matched, report)


def allocate(
    channels: Channels,
    cost: Float[Array, " bands"],
    budget: float | Float[Array, ""] = 1.0,
    *,
    margin: Margin = "rate",
    cap: float = 1.0,
    sharpness: float = 100.0,
    steps: int = 500,
    solver: Solver = "projected-gradient",
    start: Float[Array, " bands"] | None = None,
) -> Float[Array, " bands"]:
    """Strengths per band that maximise the worst attack's margin under Σ_j cost_j β_j² = budget²; traceable.

    The problem is solved for the bands' shares of the budget, which lie on a simplex cut off at `cap`, so that the
    budget is met exactly. The worst margin is an annealed soft minimum, whose gap to the minimum is at most
    log(attacks)/sharpness of the margin at equal shares. Reverse mode differentiates the solution implicitly with
    respect to channels, cost and budget; there is no forward mode, and no derivative with respect to `start`.

    Args:
        channels: channels of the attacks to survive.
        cost: cost of each band at β = 1, positive; if it is the mean square displacement, the budget is an RMS.
        budget: root of the total cost.
        margin: see `jaxmark.watermark.channels.margins`.
        cap: the largest share of the budget that one band gets, at least 1/bands.
        sharpness: sharpness of the soft minimum.
        steps: largest number of iterations.
        solver: `"projected-gradient"` (jaxopt's `ProjectedGradient`) or `"accelerated-gradient"` (the same with FISTA's
            momentum). `LBFGSB` on the box is not offered: it stops short of the best, and ends in NaN under newer JAX.
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
    if solver not in get_args(Solver):
        raise JaxmarkError(f"solver must be one of {', '.join(get_args(Solver))}, got {solver!r}.")
    first = jnp.full_like(cost, 1 / bands) if start is None else cost * jnp.asarray(start, cost.dtype) ** 2
    first = _capped_simplex(first / first.sum(), min(cap, 1.0))
    numbers = (jnp.asarray(budget, cost.dtype), jnp.asarray(sharpness, cost.dtype))
    return _allocate(channels, cost, *numbers, first, margin, min(cap, 1.0), steps, solver)


@partial(jax.jit, static_argnames=("margin", "cap", "steps", "solver"))
def _allocate(
    channels: Channels,
    cost: Array,
    budget: Array,
    sharpness: Array,
    first: Array,
    margin: Margin,
    cap: float,
    steps: int,
    solver: Solver,
) -> Array:
    jaxopt = _import_jaxopt()
    # A band's share of the budget buys this much β².
    scaled = channels._replace(gain=channels.gain * budget / jnp.sqrt(cost))
    level = 1 / margins(scaled, jnp.full_like(cost, 1 / len(cost)), margin).mean()

    # jaxopt differentiates its solution with respect to arguments, not to what a closure holds.
    def loss(shares: Array, scaled: Channels, level: Array, sharpness: Array) -> Array:
        # Momentum may leave the simplex, where a margin has no meaning.
        inside = jnp.where(shares < 0, 0, shares)
        return jax.nn.logsumexp(-sharpness * level * margins(scaled, inside, margin)) / sharpness

    accelerated = solver == "accelerated-gradient"
    simplex = jaxopt.ProjectedGradient(
        fun=loss,
        projection=lambda x, _: _capped_simplex(x, cap),
        maxiter=steps,
        tol=1e-7,
        acceleration=accelerated,
    )
    run = partial(simplex.run, hyperparams_proj=None)

    def stage(shares: Array, share: Array) -> tuple[Array, None]:
        return run(shares, scaled=scaled, level=level, sharpness=share * sharpness).params, None

    with jax.numpy_dtype_promotion("standard"):  # jaxopt mixes integers into its floats
        warm = jax.lax.stop_gradient(jax.lax.scan(stage, first, jnp.asarray(_ANNEALING_SHARES, first.dtype))[0])
        shares = stage(warm, jnp.ones_like(sharpness))[0]
    shares = _capped_simplex(shares, cap) if accelerated else shares
    # The root's slope at an empty band is infinite: select before it. NaN is not empty, and stays.
    empty = shares <= 0
    return jnp.where(empty, 0, budget * jnp.sqrt(jnp.where(empty, 1, shares) / cost))


@partial(jax.jit, static_argnames="cap")
def _capped_simplex(x: Float[Array, " bands"], cap: float) -> Float[Array, " bands"]:
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
    """Upper bound on the worst attack's margin over all strengths with Σ_j cost_j β_j² ≤ 1; host side, in float64.

    By weak duality: for weights w ≥ 0, Σ_a w_a = 1 of the attacks and a price μ ≥ 0 of the budget, the worst margin is
    at most μ + Σ_j max_p [Σ_a w_a m_aj(p) - μ cost_j p] over 0 ≤ p ≤ cap/cost_j, whatever w and μ are. The search is
    for the least such bound, which is tight because the problem is concave (Boyd, Vandenberghe, "Convex Optimization",
    5.2).
    """
    gain, noise, dimensions = (np.asarray(field, np.float64) for field in channels)
    cost = np.asarray(cost, np.float64)
    # In shares s = cost · p of the budget, of which slope · s is the SNR.
    half, slope = dimensions / 2, gain**2 / noise / cost

    def rising(shares: np.ndarray) -> np.ndarray:
        """Derivative of each attack's margin in each band."""
        snr = slope * shares
        each = {"rate": 1 / (1 + snr) / np.log(2), "evidence": 1 / (1 + snr) ** 2, "snr": np.ones_like(snr)}
        return half * slope * each[margin]

    def spent(weights: np.ndarray, price: float) -> np.ndarray:
        """The share of each band that is best at a price."""
        low, high = np.zeros(len(cost)), np.full(len(cost), min(cap, 1.0))
        for _ in range(60):
            middle = (low + high) / 2
            worthwhile = weights @ rising(middle) > price
            low, high = np.where(worthwhile, middle, low), np.where(worthwhile, high, middle)
        return low

    def by_attack(shares: np.ndarray) -> np.ndarray:
        snr = slope * shares
        return (half * {"rate": np.log2(1 + snr), "evidence": snr / (1 + snr), "snr": snr}[margin]).sum(axis=1)

    def bound(variables: np.ndarray) -> tuple[float, np.ndarray]:
        weights = np.exp(variables[:-1] - variables[:-1].max())
        weights /= weights.sum()
        price = float(np.exp(variables[-1]))
        shares = spent(weights, price)
        values = by_attack(shares)
        total = float(weights @ values + price * (1 - shares.sum()))
        return total, np.append(weights * (values - weights @ values), price * (1 - shares.sum()))

    even = by_attack(np.full(len(cost), 1 / len(cost)))
    start = np.append(np.zeros(len(gain)), np.log(max(even.min(), 1e-300)))
    best = np.inf
    # The bound holds at every trial, so the least of all counts; a bend of it can stop a search, so it starts again.
    for _ in range(20):
        found = optimize.minimize(bound, start, jac=True, method="L-BFGS-B", options={"maxiter": 500})
        improved, best, start = found.fun < best * (1 - 1e-6), min(best, float(found.fun)), found.x
        if not improved:
            break
    return best


def _balanced(
    channels: Channels,
    cost: Float64[np.ndarray, "limits bands"],
    margin: Margin,
    cap: float,
    solver: Solver,
    start: Float[np.ndarray, " bands"] | None,
) -> tuple[Float64[np.ndarray, " bands"], Float64[np.ndarray, " limits"]]:
    """Strengths within several limits at once, and the weights of the single budget that has the same solution.

    Any weighted mean of the limits is a weaker bound than all of them together. The weights for which its solution
    keeps all limits are found by raising those of limits that are exceeded.
    """
    weights, dtype = np.full(len(cost), 1 / len(cost)), channels.gain.dtype
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for _ in range(_BALANCING_ROUNDS if len(cost) > 1 else 1):
        given = None if start is None else jnp.asarray(start, dtype)
        mixed = jnp.asarray(weights @ cost, dtype)
        solved = allocate(channels, mixed, margin=margin, cap=cap, solver=solver, start=given)
        power = np.asarray(solved, np.float64) ** 2
        used = cost @ power
        power /= used.max()
        worst = float(margins(channels, jnp.asarray(power, dtype), margin).min())
        if best is None or worst > best[0]:
            best = worst, np.sqrt(power), weights
        if used.max() < 1.001:
            break
        start, weights = np.sqrt(power), weights * used**0.5
        weights = weights / weights.sum()
    assert best is not None
    return best[1], best[2]


def _costs(
    original: Original,
    family: Float64[np.ndarray, "bands terms"],
    signs: Displacement,
    mask: Float[Array, " rows *axes"] | None,
    bounds: Budget,
) -> Float64[np.ndarray, "limits bands"]:
    """Share of each limit, squared, that β_j = 1 uses up in band j."""
    whole = band_energies(original.operator, jnp.asarray(family, signs.dtype), signs, signs)
    energy = np.maximum(np.asarray(whole, np.float64) / original.used.sum(), 1e-12)
    seen = list(bounds.limits)
    visible = band_visibility(original, family, seen, mask) if seen else np.empty((0, len(family)))
    rows = [energy * (row / bounds.limits[name]) ** 2 for name, row in zip(seen, visible, strict=True)]
    return np.stack(rows + ([energy / bounds.rms**2] if bounds.rms is not None else []))


def _names(bounds: Budget) -> list[str]:
    """Names of the limits, in the order of `_costs`."""
    return [*map(name_of, bounds.limits)] + (["budget"] if bounds.rms is not None else [])


def _profile(beta: Float64[np.ndarray, " bands"]) -> tuple[float, ...]:
    """Relative strengths, to four digits; bands below a hundredth of the strongest are set to zero."""
    relative = np.where(beta >= 0.01 * beta.max(), beta / beta.max(), 0)
    return tuple(float(f"{value:.4g}") for value in relative[: 1 + np.flatnonzero(relative)[-1]])


def _mean(channels: list[Channels]) -> Channels:
    """Mean channel of several trials of one attack."""
    return jax.tree.map(lambda *values: jnp.mean(jnp.stack(values), axis=0), *channels)


def seed_numbers(caller: str, key: PRNGKeyArray, count: int) -> Int64[np.ndarray, " seeds"]:
    """Seeds of the attacks' random choices.

    Raises:
        JaxmarkError: if `key` is no random key of JAX.
    """
    try:
        found = jax.random.randint(key, (count,), 0, 2**31 - 1)
    except TypeError:
        raise JaxmarkError(
            f"{caller} needs a random key of JAX for the attacks, such as jax.random.key(0); got {type(key).__name__}."
        ) from None
    return np.asarray(found, np.int64)


def apply_attack(attacker: Attacker, mesh: Mesh, seed: int) -> Mesh:
    """Apply an attack with a seed."""
    if callable(attacker):
        return attacker(mesh, seed)
    kind, strength = attacker
    return attack(mesh, kind, strength, seed=seed)


def _import_jaxopt() -> ModuleType:
    with warnings.catch_warnings():
        # It says at import that nobody maintains it; no maintained library solves constrained problems in JAX.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt
    return jaxopt
