"""Tuning: choose the strengths of bands, or the width and the step of a blind mark, for the worst of several attacks.

`tune` measures the channels of the attacks: how much of each band of a mark remains. It solves for the best strengths
for these channels, with a proof of how good they are. From these strengths, or from the scheme's default strengths, it
continues by trials with the detector. `tune_blind` compares all widths and steps that a budget allows.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain, groupby
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.adversaries.by_name import attack, get_attack
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import Original, make_original
from jaxmark.attacks import Kind
from jaxmark.distortion import name_of
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.allocation import balance, upper_bound
from jaxmark.evaluation.channels import Channels, Margin, margins, measure
from jaxmark.evaluation.trials import CHECKED, Trials
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Seed, probe_signs, random_key
from jaxmark.spectral.chebyshev import band_energies, filter
from jaxmark.watermark.blind.prediction import Left, best_margin, compare
from jaxmark.watermark.blind.reading import codeword, register
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.blind.writing import Plan, carried, sureness
from jaxmark.watermark.interfaces import Displacement, Scheme
from jaxmark.watermark.markers import make_blind_marker
from jaxmark.watermark.perception.budget import Bounds, Budget, BudgetLike, displace_within, reference_of
from jaxmark.watermark.perception.capacity import Capacity
from jaxmark.watermark.perception.masking import apply_mask
from jaxmark.watermark.perception.visibility import band_visibility
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.passband import choose_pass_band
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, DEFAULT_SCHEME, find_blind, get_nonblind

Attacker = tuple[Kind, float] | Callable[[Mesh, int], Mesh]  # an attack and a strength, or (mesh, seed) → mesh

_LOW_PASS = (1 / 8, 1 / 4)  # lowest fractions of the spectrum that are tested with equal strengths
_PUBLIC_KEY = bytes(32)  # key of the predictions of blind marks, which hardly depend on it
_LEAST_GAIN = 1.2  # least ratio of improvement over the scheme's own strengths, for which others are returned


class Report(NamedTuple):
    """A report on the quality of tuned strengths, with a bound on the quality of all others.

    The bound is for channels, which are a model of attacks, limits and reader. The decision is made by trials, in which
    marks are written within the limits, attacked and read.
    """

    margins: Float64[np.ndarray, " attacks"]  # margin of the channels' best strengths after each attack
    bound: float  # upper bound on the worst margin, by the channels, of any strengths within the budget
    gap: float  # (bound - worst margin) / bound
    binding: Mapping[str, float]  # weights of the limits in the channels' budget
    trials: Float64[np.ndarray, " attacks"]  # worth of the tuned strengths to the detector after each attack
    channel_trials: Float64[np.ndarray, " attacks"]  # the same for the channels' optimum; 0 if the payload does not fit
    default_trials: Float64[np.ndarray, " attacks"]  # the same for the scheme with the strengths that `embed` uses
    default_kept: (
        bool  # whether no strengths were better than those of the scheme as `embed` takes it, which is returned
    )


class Tuned(NamedTuple):
    """A scheme with strengths per band that are tuned to a mesh."""

    scheme: KeyedScheme  # the scheme for `embed`, with the strengths as its profile
    beta: Float64[np.ndarray, " bands"]  # the strengths in diagonals, within the limits
    channels: Channels  # of the attacks, as measured
    cost: Float64[np.ndarray, "limits bands"]  # squared fraction of each limit that β_j² = 1 uses
    detector_weights: Float64[np.ndarray, "attacks bands"]  # matched to each attack: gain · β / noise
    report: Report


def tune(
    mesh: Mesh,
    attacks: Sequence[Attacker],
    budget: BudgetLike = None,
    *,
    seed: Seed,
    bits: int = 64,
    scheme: str | Scheme = DEFAULT_SCHEME,
    samples: int = 1,
    margin: Margin = "rate",
    cap: float = 0.125,
    start: Float[np.ndarray, " bands"] | None = None,
) -> Tuned:
    """Tune the strengths of a scheme's bands to a mesh, a set of attacks and a budget.

    Each attack's channel is measured with a probe that uses an equal share of the budget in all bands. Limits on
    metrics other than the RMS displacement are modelled as quadratic in the strengths, with the measured visibility of
    each band. For this model, the best strengths are proven, but the model simplifies limits, attacks and reader.
    Therefore three kinds of strengths are compared by trials within the real limits: these strengths, the scheme's own
    strengths in the adaptive pass band, and low-pass profiles. The best of them are improved by the gradient of the
    detector's margin after the worst attack, as long as trials with other signs and seeds confirm the improvement
    (`jaxmark.evaluation.trials`). If the scheme's own strengths are as good, they are returned.

    Args:
        mesh: the original.
        attacks: the attacks to survive: pairs of a name in `ATTACKS`, or an `Attack`, and a strength; or functions of
            mesh and seed.
        budget: see `embed`.
        seed: seed of the attacks' random choices, a whole number or a JAX random key; it need not be secret.
        bits: size of the payload in bits.
        scheme: the scheme whose bands are tuned; its profile is replaced.
        samples: number of times that each attack is tried; measurements are averaged.
        margin: the quantity to maximise after the worst attack: `"evidence"`, for a claimed message, or `"rate"`, for a
            message that is to be decoded; see `jaxmark.evaluation.channels.margins`. Trials measure S²/2‖a‖² of the
            claim, in nats, or the bits that the soft decisions of joint decoding transmit.
        cap: the largest share of the budget that one band gets, so that losing a band does not lose the mark.
        start: strengths to start from, such as those of an earlier tuning.

    Raises:
        JaxmarkError: if the mesh, an attack, the budget or a number is unusable, or the scheme has no bands to tune.
    """
    seeds = _draw_seeds("tune", attacks, samples, seed)
    if margin not in get_args(Margin):
        raise JaxmarkError(f"The margin to tune for is one of {', '.join(get_args(Margin))}, got {margin!r}.")
    if find_blind(scheme) is not None:
        raise JaxmarkError(f"The blind scheme {scheme!r} has no bands to tune; use tune_blind.")
    tunable = get_nonblind(scheme).tunable()
    original, family = make_original(mesh), tunable.family()
    bounds = Budget.of(budget).bounds_of(original)
    signs = probe_signs("tuning", original.signal.shape, dtype=original.signal.dtype)[0]
    signs = signs * original.to_traced(original.used)[:, None]
    mask = tunable.mask(original)

    def shape_signs(strengths: Float64[np.ndarray, " bands"]) -> Float64[np.ndarray, "points 3"]:
        return original.to_host(apply_mask(mask, filter(original.operator, family.T @ strengths, signs)))

    cost = _costs(original, family, signs, mask, bounds)
    equal = 1 / np.sqrt(len(family) * cost.sum(axis=0))
    # Equal shares, so that each band is measured.
    probe = shape_signs(equal)
    written = displace_within(original, probe, bounds)
    mark = original.to_traced(written.scale * probe)
    suspects = [[apply_attack(one, written.mesh, seed) for seed in seeds] for one in attacks]
    observations = [[align(original, suspect).observation(original) for suspect in row] for row in suspects]

    def measure_channels(profile: tuple[float, ...]) -> Channels:
        receiver = tunable.with_profile(profile).receiver(original, bits)
        rows = [[measure(receiver, one, mark) for one in row] for row in observations]
        means = [jax.tree.map(lambda *values: jnp.mean(jnp.stack(values), axis=0), *row) for row in rows]
        return Channels(*map(jnp.concatenate, zip(*means, strict=True)))

    # The receiver's projection depends on the profile: channels are measured for a first one, and for the tuned one.
    first = measure_channels(_profile(equal if start is None else np.asarray(start, np.float64)))
    start, _ = balance(first, cost, margin, cap, start)
    channels = measure_channels(_profile(start))
    beta, weights = balance(channels, cost, margin, cap, start)
    worth = np.asarray(margins(channels, jnp.asarray(beta**2, original.signal.dtype), margin), np.float64)
    bound = upper_bound(channels, weights @ cost, cap=cap, margin=margin)

    trials = Trials(original, bits, bounds, [partial(apply_attack, one) for one in attacks], seeds, margin)
    default = trials.run(choose_pass_band(Capacity(original, tunable), bits, bounds).tunable())
    solved = tunable.with_profile(_profile(beta))
    low_pass = [tunable.with_profile((1.0,) * round(share * len(family))) for share in _LOW_PASS]
    others = [trials.run(one) for one in (solved, *low_pass) if trials.fits(one)]
    chosen = trials.ascend(max(default, *others, key=lambda one: one.worst), cost)
    # The best of several in few trials is partly the best by chance; therefore other marks decide.
    checked = {one: trials.run(one, CHECKED) for one in {default.scheme, solved, chosen.scheme} if trials.fits(one)}
    usual, best = checked[default.scheme], max(checked.values(), key=lambda one: one.worst)
    if not best.surpasses(usual, _LEAST_GAIN):
        best = usual
    names = [*map(name_of, bounds.limits)] + ["budget"] * (bounds.rms is not None)
    others = checked[solved].worth if solved in checked else np.zeros(len(attacks))
    binding, gap = dict(zip(names, map(float, weights), strict=True)), 1 - float(worth.min()) / bound
    report = Report(worth, bound, gap, binding, best.worth, others, usual.worth, best is usual)
    exact = np.pad(best.strengths, (0, len(family) - len(best.strengths)))
    matched = np.asarray(channels.gain * exact / channels.noise, np.float64)
    return Tuned(best.scheme, exact, channels, cost, matched, report)


def _costs(
    original: Original,
    family: Float64[np.ndarray, "bands terms"],
    signs: Displacement,
    mask: Float[Array, " rows *axes"] | None,
    bounds: Bounds,
) -> Float64[np.ndarray, "limits bands"]:
    """Compute the squared fraction of each limit that β_j = 1 uses in band j."""
    whole = band_energies(original.operator, jnp.asarray(family, signs.dtype), signs, signs)
    energy = np.maximum(np.asarray(whole, np.float64) / original.used.sum(), 1e-12)
    names = list(bounds.limits)
    visible = band_visibility(original, family, names, mask) if names else []
    rows = [energy * (row / bounds.limits[name]) ** 2 for name, row in zip(names, visible, strict=True)]
    return np.stack(rows + ([energy / bounds.rms**2] if bounds.rms is not None else []))


def _profile(beta: Float64[np.ndarray, " bands"]) -> tuple[float, ...]:
    """Round relative strengths to four digits; bands below a hundredth of the strongest are set to zero."""
    relative = np.where(beta >= 0.01 * beta.max(), beta / beta.max(), 0)
    return tuple(float(f"{value:.4g}") for value in relative[: 1 + np.flatnonzero(relative)[-1]])


class TunedBlind(NamedTuple):
    """A blind scheme, with the width and the step whose predicted surplus after the worst attack is largest."""

    scheme: BlindScheme  # the scheme for `embed`; reading needs the scheme's name only
    worst: float  # surplus after the worst of the attacks; if it is negative, messages are not expected to be readable
    choices: tuple[tuple[float, float], ...]  # all widths and steps that the budget allows
    surplus: Float64[np.ndarray, "choices attacks"]  # in nats, see `jaxmark.watermark.blind.prediction.margin`


def tune_blind(
    mesh: Mesh,
    attacks: Sequence[Attacker],
    budget: BudgetLike = None,
    *,
    seed: Seed,
    bits: int = 64,
    scheme: str | BlindScheme = "field",
    samples: int = 1,
) -> TunedBlind:
    """Choose width and step of a blind mark for the attacks that it must survive; for other parameters see `tune`.

    The original is attacked, and the values of its anchors are read as in a suspect; their change predicts how much of
    a mark would remain. A wide average survives more smoothing, a narrow one gives more anchors. A large step survives
    more noise, a small step is realised more exactly within the same budget. All widths and steps that the budget
    allows are compared by their surplus: the remaining information, minus the information of payload and tag. If the
    surplus is negative after the worst attack, the mark is not expected to survive it. `scheme` is a blind scheme,
    whose widths and steps are compared.

    Raises:
        JaxmarkError: if the mesh, an attack, the budget or a number is unusable, the scheme is not blind, or the budget
            allows no width and step.
    """
    seeds = _draw_seeds("tune_blind", attacks, samples, seed)
    blind = find_blind(scheme)
    if blind is None:
        raise JaxmarkError(
            f"tune_blind tunes the schemes that are read without the original ({', '.join(BLIND_SCHEMES)}), not"
            f" {scheme!r}; for the others there is tune."
        )
    if blind.by_key:
        raise JaxmarkError(
            f"The anchors of the scheme {blind.name!r} are found on marked meshes only, so that nothing can be compared"
            " on an unmarked one; tune 'field' or 'local'."
        )
    writer = make_blind_marker(mesh, _PUBLIC_KEY, bits=bits, scheme=blind).writer
    word = codeword(bytes(bits // 8), writer.choices)
    allowances = writer.allowances(word, Budget.of(budget).bounds(mesh), reference_of(writer.original))
    plans = [one.plan(step) for one in allowances for step in writer.steps(one)]
    if not plans:
        raise JaxmarkError(f"This mesh, or the budget for it, leaves the scheme {blind.name!r} nothing to write in.")

    def looks(suspect: Mesh) -> dict[float, list[Look]]:
        views = chain.from_iterable(blind.views(register(suspect), writer.choices))
        found = sorted(views, key=lambda look: look.width)
        return {width: list(some) for width, some in groupby(found, key=lambda look: look.width)}

    before = {width: some[0] for width, some in looks(mesh).items()}

    def left(attacker: Attacker, seed: int) -> dict[float, list[Left]]:
        anchors = looks(apply_attack(attacker, mesh, seed))
        return {
            width: [way for look in some for way in compare(before[width], look)] for width, some in anchors.items()
        }

    found, size = [[left(one, seed) for seed in seeds] for one in attacks], carried(bits)

    def surplus_of(plan: Plan, ways: dict[float, list[Left]]) -> float:
        return best_margin(ways[plan.width], plan.step, plan.alpha, size).surplus

    surplus = np.array([[np.mean([surplus_of(plan, ways) for ways in row]) for row in found] for plan in plans])
    worst = surplus.min(axis=1)
    chosen = max(range(len(plans)), key=lambda one: (sureness(plans[one], bits), worst[one]))
    choices = tuple((plan.width, plan.step) for plan in plans)
    return TunedBlind(blind.fixed(*choices[chosen]), float(worst[chosen]), choices, surplus)


def _draw_seeds(tuner: str, attacks: Sequence[Attacker], samples: int, seed: Seed) -> list[int]:
    """Draw the seeds of the attacks' samples.

    Raises:
        JaxmarkError: if there is no attack or no sample, one attack is neither a function of mesh and seed nor a pair
            of an attack and a strength, or there is no such attack.
    """
    if not attacks or samples < 1:
        raise JaxmarkError(f"{tuner} needs at least one attack and one sample, got {len(attacks)} and {samples}.")
    for attacker in attacks:
        if callable(attacker):
            continue
        if not isinstance(attacker, tuple) or len(attacker) != 2:
            raise JaxmarkError(f"An attack to tune for is a pair such as ('noise', 0.005), got {attacker!r}.")
        get_attack(attacker[0])
    return jax.random.randint(random_key(seed), (samples,), 0, 2**31 - 1).tolist()


def apply_attack(attacker: Attacker, mesh: Mesh, seed: int) -> Mesh:
    """Apply an attack with a seed."""
    if callable(attacker):
        return attacker(mesh, seed)
    kind, strength = attacker
    return attack(mesh, kind, strength, seed=seed)
