"""How well marked suspects are detected: ROC curves, p-values beside their bound, success over attack strength."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.confidence import Interval, clopper_pearson
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation._robustness import Robustness
from jaxmark.plot.figures import BOUND, Picture, band, finish, move_aside, panels, styles

_CURVE_POINTS = 241  # values of log10 α
_MIN_LOG_RATIO = 10.0  # largest over least strength, from which the axis is logarithmic


def roc(
    log10_p: Mapping[str, Float[np.ndarray, " suspects"]], *, lowest: float = -20.0, confidence: float = 0.95
) -> Picture:
    """Plot the share of suspects that are detected at each nominal false-positive probability α.

    A suspect is detected at α if its `log10_p` is at most log10 α. Detected suspects are true positives if they are
    marked, and false positives if they are unmarked or read with a wrong key; the share of the latter must stay below
    the dashed line.

    Args:
        log10_p: `log10_p` of the suspects, by the name of their kind.
        lowest: log10 of the smallest α.
        confidence: confidence level of the shaded Clopper-Pearson intervals, at each α by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or a number is out of range.
    """
    if not -np.inf < lowest < 0:
        raise JaxmarkError(f"lowest is a negative number, the log10 of a probability, got {lowest:g}.")
    grid = np.linspace(lowest, 0, _CURVE_POINTS)
    figure, (axes,) = panels(1, 6.5, 4.2)
    _frequencies(axes, log10_p, grid, confidence)
    axes.plot(grid, 10**grid, label="α itself", **BOUND)
    finish(axes, xlabel="log10 of the nominal false-positive probability α", ylabel="share of suspects detected")
    return Picture(figure)


def p_values(log10_p: Mapping[str, Float[np.ndarray, " suspects"]], *, confidence: float = 0.95) -> Picture:
    """Plot how often p is at most 10^x for suspects without a mark, beside the bound that p claims.

    A proof says that P(log10 p ≤ x) ≤ 10^x for suspects without the mark: the curve of a sound p lies below the dashed
    line, up to chance, which the shaded intervals show.

    Args:
        log10_p: `log10_p` of suspects without a mark, or read with a wrong key, by the way in which p was computed.
        confidence: confidence level of the shaded Clopper-Pearson intervals, at each x by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or the confidence is out of range.
    """
    most = max((len(values) for values in log10_p.values()), default=1)
    grid = np.linspace(-np.log10(max(most, 10)) - 1, 0, _CURVE_POINTS)
    figure, (axes,) = panels(1, 6.5, 4.2)
    _frequencies(axes, log10_p, grid, confidence)
    axes.plot(grid, 10**grid, label="the bound, 10^x", **BOUND)
    finish(
        axes,
        xlabel="x, a log10 p",
        ylabel="share of suspects with log10 p ≤ x",
        yscale="log",
        ylim=(0.3 / max(most, 10), 1.5),
    )
    return Picture(figure)


def success(curves: Mapping[str, Robustness], unit: str, *, confidence: float = 0.95) -> Picture:
    """Plot how often the exact message is read after an attack over its strength, with Clopper-Pearson intervals.

    Args:
        curves: results of `jaxmark.evaluation.robustness` for one attack, by the name of the line.
        unit: unit of the attack's strength, as `jm.adversaries.ATTACKS` has it.
        confidence: confidence level of the intervals, at each strength by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, or the confidence is out of range.
    """
    figure, (axes,) = panels(1, 6.5, 4.2)
    strengths = np.concatenate([curve.strengths for curve in curves.values()])
    for place, ((name, curve), style) in enumerate(zip(curves.items(), styles(1), strict=False)):
        read, samples = curve.success.sum(axis=1), curve.success.shape[1]
        rate, interval = read / samples, clopper_pearson(read, samples, confidence)
        bars = np.maximum([rate - interval.low, interval.high - rate], 0)
        drawn = axes.errorbar(curve.strengths, rate, bars, label=name, capsize=3, **style)
        move_aside(drawn, place, len(curves), len(np.unique(strengths)))
    wide = strengths.min() > 0 and strengths.max() >= _MIN_LOG_RATIO * strengths.min()
    finish(axes, xlabel=f"strength: {unit}", ylabel="share of messages read", xscale="log" if wide else "linear")
    first = next(iter(curves.values())).strengths
    if first[0] > first[-1]:  # fewer bits are a stronger attack; weak attacks stay on the left
        axes.invert_xaxis()
    axes.set_ylim(-0.05, 1.05)
    return Picture(figure)


def frequency(
    log10_p: Float[np.ndarray, " suspects"], grid: Float64[np.ndarray, " points"], confidence: float
) -> tuple[Float64[np.ndarray, " points"], Interval]:
    """The share of values that are at most each value of a grid, and its confidence interval.

    Raises:
        JaxmarkError: if there is no value, one is NaN, or the confidence is out of range.
    """
    if len(log10_p) == 0 or np.isnan(log10_p).any():
        raise JaxmarkError(f"A curve needs one log10 p or more, and no NaN, got {len(log10_p)} values.")
    hits = np.searchsorted(np.sort(log10_p), grid, side="right")
    return hits / len(log10_p), clopper_pearson(hits, len(log10_p), confidence)


def _frequencies(axes, log10_p, grid: np.ndarray, confidence: float) -> None:
    for (name, values), style in zip(log10_p.items(), styles(len(grid)), strict=False):
        share, interval = frequency(values, grid, confidence)
        axes.plot(grid, share, label=f"{name} ({len(values)})", **style)
        band(axes, grid, interval, style["color"])
