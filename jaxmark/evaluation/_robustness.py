"""Robustness of a mark: readings after attacks of rising strength, and the least distortion that removes it."""

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from jaxmark.adversaries.by_name import attack, get_attack
from jaxmark.attacks import Kind
from jaxmark.distortion import Comparison, compare
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.markers import Marker


class Outcome(NamedTuple):
    """The reading of one suspect, compared with the message that was written."""

    read: bool  # whether the exact message was read, and its tag matches
    wrong: bool  # whether another message was read, whose tag matches
    bit_errors: float  # share of the message's bits that are wrong in the best guess; 1/2 if there is no guess
    log10_p: float  # log10 of a bound on the false-positive probability, with the message unknown
    log10_p_unfloored: float  # the same without its floor at -77, see `Detection`


class Robustness(NamedTuple):
    """The readings of each sample at each strength; a refused suspect counts as not read."""

    strengths: Float64[np.ndarray, " strengths"]
    success: Bool[np.ndarray, "strengths samples"]  # whether the exact message was read
    bit_errors: Float64[np.ndarray, "strengths samples"]  # see `Outcome`
    log10_p: Float64[np.ndarray, "strengths samples"]  # see `Outcome`
    log10_p_unfloored: Float64[np.ndarray, "strengths samples"]
    refusals: tuple[tuple[str, ...], ...]  # `[strengths][samples]`; the reason of a refusal, or an empty string


class Trial(NamedTuple):
    """An attack at one strength."""

    strength: float
    distortion: Comparison  # distortion of the suspect, relative to the marked mesh
    log10_p: float  # log10 p of a claim of the message; 0 if the suspect is refused


class Breaking(NamedTuple):
    """The least distortion at which an attack on a mark succeeds."""

    embedding: Comparison  # distortion of the marked mesh, relative to the original
    weakest: Trial | None  # the weakest attack found that succeeds; None if not even the strongest does
    curve: tuple[Trial, ...]  # all trials, weak ones first

    def cost(self, metric: str) -> float:
        """Compute the ratio of the attack's distortion to the mark's own, by a metric that was measured.

        It is infinite if the attack does not succeed, and NaN if its distortion is unknown or the mark has none.
        """
        if self.weakest is None:
            return math.inf
        attacked, marked = (getattr(one, metric) for one in (self.weakest.distortion, self.embedding))
        return math.nan if attacked is None or not marked else attacked / marked


NOTHING = Outcome(False, False, 0.5, 0.0, 0.0)  # the reading of a refused suspect


def compare_with(message: bytes, marker: Marker, found: Detection) -> Outcome:
    """Compare what a marker read with the message that was written."""
    guess, wrong = marker.guess(found), 0.5
    if guess is not None:
        read, written = (np.unpackbits(np.frombuffer(one, np.uint8)) for one in (guess, message))
        wrong = float(np.mean(read != written))
    other = found.message not in (None, message)
    return Outcome(found.message == message, other, wrong, found.log10_p, found.evidence.log10_p_unfloored)


def robustness(
    marker: Marker,
    marked: Mesh,
    message: bytes,
    kind: Kind,
    strengths: Sequence[float] | None = None,
    *,
    samples: int = 5,
) -> Robustness:
    """Attack a marked mesh at several strengths, and read each suspect.

    Args:
        marker: the reader: original, key, payload and scheme.
        marked: the mesh with the message in it.
        message: the message that was written.
        kind: a name in `ATTACKS`, or an `Attack` of your own.
        strengths: in the attack's unit; by default its usual ones.
        samples: number of attacks at each strength, with the seeds 0, 1, …

    Raises:
        JaxmarkError: if there is no such attack, no strength, or no sample.
    """
    entry = get_attack(kind)
    strengths = entry.strengths if strengths is None else tuple(strengths)
    if samples < 1 or not strengths:
        raise JaxmarkError(f"robustness needs a strength and a sample, got {len(strengths)} and {samples}.")

    def try_attack(strength: float, seed: int) -> tuple[Outcome, str]:
        try:
            found = marker.detect(attack(marked, entry, strength, seed=seed))
            return compare_with(message, marker, found), ""
        except JaxmarkError as error:
            return NOTHING, str(error)

    rows = [[try_attack(strength, seed) for seed in range(samples)] for strength in strengths]

    def column(name: str) -> np.ndarray:
        return np.array([[getattr(reading, name) for reading, _ in row] for row in rows])

    refusals = tuple(tuple(sentence for _, sentence in row) for row in rows)
    numbers = map(column, ("read", "bit_errors", "log10_p", "log10_p_unfloored"))
    return Robustness(np.array(strengths, float), *numbers, refusals=refusals)


def minimum_distortion(
    marker: Marker,
    marked: Mesh,
    message: bytes,
    kind: Kind,
    *,
    alpha: float = 1e-6,
    metrics: Collection[str] = ("rms", "dame", "msdm2"),
    seed: int = 0,
    tolerance: float = 0.05,
) -> Breaking:
    """Find the least distortion at which an attack brings a mark below detection, by bisection of its strength.

    The attack succeeds if not even a claim of the message is proven, or if the suspect is refused. Success is assumed
    to be monotonic between the weakest and the strongest usual strength, which holds for one seed.

    The reader detects at the false-positive probability `alpha`, in (0, 1). The bisection, between the usual strengths
    of the attack, ends at a ratio of strengths of 1 + `tolerance`, or at a difference of 1 if they are whole numbers.
    Metrics are names in `distortion.METRICS`; `seed` is that of the attack's random choices. For the other parameters
    see `robustness`.

    Raises:
        JaxmarkError: if there is no such attack or metric, or a number is out of range.
    """
    if not (0 < alpha < 1 and tolerance > 0):
        raise JaxmarkError(f"alpha is in (0, 1) and tolerance positive, got {alpha:g} and {tolerance:g}.")
    strengths = get_attack(kind).strengths
    weak, strong = strengths[0], strengths[-1]
    if not min(weak, strong) > 0:
        raise JaxmarkError(f"The usual strengths of the attack must be positive to be bisected, got {strengths}.")
    whole = all(float(one).is_integer() for one in strengths)
    trials: list[Trial] = []

    def detects(strength: float) -> bool:
        log10_p, suspect = 0.0, attack(marked, kind, strength, seed=seed)
        with suppress(JaxmarkError):  # a suspect that cannot be aligned is not detected
            log10_p = marker.detect(suspect, message).log10_p
        trials.append(Trial(strength, compare(marked, suspect, metrics), log10_p))
        return log10_p <= math.log10(alpha)

    if not detects(strong) and detects(weak):
        held, broken = weak, strong
        while abs(math.log(broken / held)) > math.log1p(tolerance):
            middle = float(round(math.sqrt(held * broken))) if whole else math.sqrt(held * broken)
            if middle in (held, broken):
                break
            held, broken = (middle, broken) if detects(middle) else (held, middle)
    trials.sort(key=lambda one: one.strength, reverse=strong < weak)
    weakest = next((one for one in trials if one.log10_p > math.log10(alpha)), None)
    return Breaking(compare(marker.original.mesh, marked, metrics), weakest, tuple(trials))
