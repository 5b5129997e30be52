"""Trials of strengths: marks with public signs are written, attacked and read, to measure their worth to the detector.

Channels (`jaxmark.evaluation.channels`) give the best strengths for a model of attacks, limits and reader, fast and
with a proof. Trials use the real attacks, limits and reader. `Trials.ascend` differentiates them: from strengths to the
mark within its limits, to the part of it that remains after each attack, to the reader's weights of the bands, to the
claim.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int8

from jaxmark.alignment.attempts import align
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original, displace
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.allocation import minimise
from jaxmark.evaluation.channels import Margin, measure
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.carriers.chips import KeyedCarrier, KeyedReader
from jaxmark.watermark.coding.keys import KEY_BYTES, Choices, Key
from jaxmark.watermark.perception.budget import Bounds, Written, displace_within, reference_of
from jaxmark.watermark.schemes.keyed import KeyedScheme

Attack = Callable[[Mesh, int], Mesh]  # an attack of some strength on a mesh, with a seed

# Numbers of the signs of marks; each mark is tested together with its opposite. Strengths are fitted with the first
# signs, the best of several are chosen with others, and the choice is checked with others again, to avoid overfitting.
FITTED, CHOSEN, CHECKED = range(3, 6), range(3), range(6, 14)
_SHARPNESS = 50.0  # sharpness of the soft minimum over attacks, relative to the least worth
_SHAPES = 5  # number of cosines over the bands by which strengths are changed; more would overfit single bands
_STEPS, _TRIES = 5, 5  # gradient steps, and trials of the size of each step, between two trials of marks
_REACH = 0.7  # largest logarithm of the factor by which each cosine changes strengths between two trials
_LEAST_GAIN = 1.05  # least ratio of improvement, of the worth after the worst attack, for which the ascent continues
_SURE = 3.0  # least mean gain over marks, in standard errors, that counts as significant
_LEAST_WORTH = 1.0  # least mean gain over marks, in nats or bits, that counts as an improvement


class Trial(NamedTuple):
    """A trial: marks of one profile of strengths, attacked copies of them, and their worth to the detector."""

    scheme: KeyedScheme
    reader: KeyedReader
    word: Float[Array, " code"]  # codeword of all marks
    signs: tuple[Int8[Array, "vertices channels"], ...]  # carrier signs of each mark
    scales: tuple[float, ...]  # factor on each mark's displacement, within the limits, in diagonals
    used: Float64[np.ndarray, " limits"]  # fraction of each limit that the first mark uses
    observations: tuple[tuple[Observation, ...], ...]  # for each attack, observations of all marks, seed by seed
    worth: Float64[np.ndarray, " attacks"]
    by_signs: Float64[np.ndarray, "marks attacks"]  # worth of each mark with its opposite

    @property
    def worst(self) -> float:
        """The worth after the worst attack."""
        return float(self.worth.min())

    @property
    def strengths(self) -> Float64[np.ndarray, " passing"]:
        """The strength of each band of the pass band, in diagonals."""
        return np.mean(self.scales) * np.asarray(self.reader.carrier.profile, np.float64)

    def surpasses(self, other: "Trial", least: float) -> bool:
        """Whether the worth after the worst attack is significantly larger than that of a trial with the same signs.

        The ratio of the two must be at least `least`.
        """
        gains = self.by_signs.min(axis=1) - other.by_signs.min(axis=1)
        error = float(np.std(gains, ddof=1)) / len(gains) ** 0.5
        return self.worst >= least * other.worst and float(np.mean(gains)) > max(_SURE * error, _LEAST_WORTH)


@dataclass(frozen=True, eq=False)
class Trials:
    """A series of trials on one original, with the same attacks and limits for all profiles of strengths."""

    original: Original
    bits: int
    bounds: Bounds
    attacks: Sequence[Attack]
    seeds: Sequence[int]
    margin: Margin

    def fits(self, scheme: KeyedScheme) -> bool:
        """Whether the capacity of a scheme's bands suffices for the payload."""
        try:
            scheme.code_length(self.original, self.bits)
        except JaxmarkError:
            return False
        return True

    def run(self, scheme: KeyedScheme, numbers: range = CHOSEN) -> Trial:
        """Write, attack and read marks of a scheme.

        Each mark is tested together with its opposite. Chance correlations of the attacks with its signs then cancel,
        so that few marks suffice to compare two profiles.

        Args:
            scheme: the scheme with its strengths.
            numbers: numbers of the signs, which depend on no secret key; the first one is added to the attacks' seeds.

        Raises:
            JaxmarkError: if the payload does not fit, a limit cannot be kept, or a suspect cannot be aligned.
        """
        original = self.original
        code = scheme.code_length(original, self.bits)
        carrier = scheme.carrier(original, Choices(Key(bytes(KEY_BYTES)), b""), self.bits, code)
        word = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], code), original.signal.dtype)
        drawn = [carrier.redraw(number) for number in numbers]
        shifts = [original.to_host(one.displacement(word)) for one in drawn]
        written = [displace_within(original, shift, self.bounds) for shift in shifts]
        scaled = [one.scale * shift for one, shift in zip(written, shifts, strict=True)]
        marks = [displace(original, sign * shift) for shift in scaled for sign in (1, -1)]
        signs = tuple(sign * jnp.asarray(one.chips.signs) for one in drawn for sign in (1, -1))
        tries = [(mark, seed + numbers.start) for seed in self.seeds for mark in marks]
        suspects = [[one(*some) for some in tries] for one in self.attacks]
        observations = tuple(tuple(align(original, one).observation(original) for one in some) for some in suspects)
        scales, used = tuple(one.scale for one in written for _ in (1, -1)), self._used(written[0])
        reader = carrier.reader()
        left = [self._left(scheme, reader, word, signs, copies) for copies in observations]
        worth = np.array([self._worth(values) for values in left])
        by_signs = np.array([[self._worth(values[:, place]) for values in left] for place in range(len(numbers))])
        return Trial(scheme, reader, word, signs, scales, used, observations, worth, by_signs)

    def ascend(self, start: Trial, cost: Float64[np.ndarray, "limits bands"]) -> Trial:
        """Improve strengths along the gradient of the worth after the worst attack, as long as trials confirm it.

        `cost` is the squared fraction of each limit that β_j² = 1 uses in band j. The best trial is returned, which is
        the first one if no other is better.
        """
        best, found = start, self.run(self._improved(start, cost))
        while found.worst > _LEAST_GAIN * best.worst:
            best, found = found, self.run(self._improved(found, cost))
        return best

    def _improved(self, tried: Trial, cost: Float64[np.ndarray, "limits bands"]) -> KeyedScheme:
        """Return the scheme with improved strengths, by the observations of a trial whose strengths are similar."""
        at = self.run(tried.scheme, FITTED)
        carrier, dtype = at.reader.carrier, at.word.dtype
        base = jnp.asarray(carrier.profile)
        scales = [jnp.asarray(scale, dtype) for scale in at.scales]
        drawn = [_with_signs(carrier, signs).displacement(at.word) for signs in at.signs]
        marks = [scale * shift for scale, shift in zip(scales, drawn, strict=True)]
        most = max(
            (one.nuisance.shape[1] for some in at.observations for one in some if one.nuisance is not None), default=0
        )
        copies: dict[object, list[_Copy]] = {}
        for number, suspects in enumerate(at.observations):
            pairs = list(zip(suspects, cycle(zip(at.signs, scales, marks, strict=True)), strict=False))
            gains = [measure(at.reader.receiver, one, mark).gain[0] for one, (*_, mark) in pairs]
            gain = sum(gains[1:], gains[0]) / len(gains)
            for one, (signs, scale, _) in pairs:
                copy = _Copy(_widened(one, most), gain, signs, scale, jnp.asarray(number))
                copies.setdefault(jax.tree.structure(copy), []).append(copy)
        groups = tuple(jax.tree.map(lambda *leaves: jnp.stack(leaves), *some) for some in copies.values())
        limits = _Limits(jnp.asarray(cost[:, : len(base)], dtype), jnp.asarray(at.used / at.used.max(), dtype))
        level = jnp.asarray(1 / max(at.worst, 1e-3), dtype)
        strengths = np.asarray(_climb(at.reader, at.word, groups, limits, level, len(at.observations)), np.float64)
        return at.scheme.with_profile(tuple(float(f"{value:.4g}") for value in strengths / strengths.max()))

    def _left(
        self,
        scheme: KeyedScheme,
        reader: KeyedReader,
        word: Float[Array, " code"],
        signs: Sequence[Int8[Array, "vertices channels"]],
        copies: Sequence[Observation],
    ) -> Float64[np.ndarray, "seeds marks two values"]:
        """Compute the remaining evidence of each mark and its opposite after an attack: S/‖a‖, or soft decisions."""
        readers = cycle([reader.with_carrier(_with_signs(reader.carrier, one)) for one in signs])
        pairs = [(own, own.receive(one)) for one, own in zip(copies, readers, strict=False)]
        if self.margin == "rate":
            values = [np.asarray(word * reader.carrier.detector(*pair, 1.0), np.float64) for pair in pairs]
        else:
            claims = [own.claim(received, word) for own, received in pairs]
            values = [np.array([float(one.score) / (float(one.norm) or 1)]) for one in claims]
        return np.reshape(values, (len(self.seeds), len(signs) // 2, 2, -1))

    def _worth(self, values: Float64[np.ndarray, "*axes"]) -> float:
        """Compute the worth of this evidence, in the unit of the margin."""
        mean = max(np.mean(values), 0)
        if self.margin == "rate":
            return float(values.shape[-1] / 2 * np.log2(1 + (mean / (np.std(values) or 1)) ** 2))
        return float(mean**2 / 2)

    def _used(self, written: Written) -> Float64[np.ndarray, " limits"]:
        """Compute the fraction of each limit that a mark uses; the last is that of the RMS budget."""
        found = reference_of(self.original).measure(written.mesh, self.bounds.limits.keys())
        shares = [(found[metric] or 0.0) / limit for metric, limit in self.bounds.limits.items()]
        return np.array(shares + ([written.moved.rms / self.bounds.rms] if self.bounds.rms is not None else []))


class _Copy(NamedTuple):
    """The observation of an attacked mark."""

    observation: Observation
    gain: Float[Array, " passing"]  # remaining fraction of the mark's amplitude in each band
    signs: Int8[Array, "vertices channels"]  # carrier signs of the mark
    scale: Float[Array, ""]  # factor on the mark's displacement
    attack: Array  # number of the attack


class _Limits(NamedTuple):
    cost: Float[Array, "limits passing"]  # see `Trials.ascend`
    used: Float[Array, " limits"]  # fraction of each limit that the tested strengths use, over the largest fraction

    def scale(self, strengths: Float[Array, " passing"], base: Float[Array, " passing"]) -> Float[Array, ""]:
        """Compute the factor that brings strengths within the limits, relative to that of the tested strengths.

        By the model, a metric grows with the root of the sum of the bands' costs. Its value at the tested strengths was
        measured.
        """
        share = jnp.sqrt((self.cost @ strengths**2) / (self.cost @ base**2))
        return 1 / jnp.max(self.used * share)


def _with_signs(carrier: KeyedCarrier, signs: Int8[Array, "vertices channels"]) -> KeyedCarrier:
    return carrier._replace(chips=carrier.chips._replace(signs=signs))


def _widened(observation: Observation, columns: int) -> Observation:
    """Pad the nuisance of an observation to a number of columns, so that one compiled program serves all observations.

    The reader ignores columns of zeros.
    """
    if observation.nuisance is None:
        return observation
    return observation._replace(
        nuisance=jnp.pad(observation.nuisance, ((0, 0), (0, columns - observation.nuisance.shape[1])))
    )


@partial(jax.jit, static_argnames="attacks")
def _climb(
    reader: KeyedReader,
    word: Float[Array, " code"],
    groups: tuple[_Copy, ...],
    limits: _Limits,
    level: Float[Array, ""],
    attacks: int,
) -> Float[Array, " passing"]:
    """Search for the strengths with the best worst attack, among strengths that differ smoothly and not too much."""
    base = jnp.asarray(reader.carrier.profile)
    places = (np.arange(len(base)) + 0.5) / len(base)
    shapes = jnp.asarray(np.cos(np.pi * np.outer(places, np.arange(1, _SHAPES + 1))), base.dtype)

    def loss(change: Array) -> Array:
        strengths = base * jnp.exp(shapes @ change)
        left = limits.scale(strengths, base) * strengths - base

        def ratio(copy: _Copy) -> Array:
            """Compute S/‖a‖ for changed strengths; the noise and the changes of the host stay the same."""
            carrier = _with_signs(reader.carrier, copy.signs)
            moved = copy.scale * carrier.with_bands(copy.gain * left).displacement(word)
            changed = reader.with_carrier(carrier.with_bands(strengths))
            received = changed.receive(copy.observation._replace(residual=copy.observation.residual + moved))
            score, norm = changed.claim(received, word)
            return score / norm

        ratios = jnp.concatenate([jax.lax.map(ratio, some) for some in groups])
        which = jnp.concatenate([some.attack for some in groups])
        mean = jax.ops.segment_sum(ratios, which, attacks) / jax.ops.segment_sum(jnp.ones_like(ratios), which, attacks)
        nats = jnp.maximum(mean, 0) ** 2 / 2
        return jax.nn.logsumexp(-_SHARPNESS * nats * level) / _SHARPNESS

    start, reach = jnp.zeros(_SHAPES, base.dtype), partial(jnp.clip, min=-_REACH, max=_REACH)
    change = minimise(loss, reach, start, maxiter=_STEPS, maxls=_TRIES, tol=1e-4)
    return base * jnp.exp(shapes @ change)
