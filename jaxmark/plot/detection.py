"""How well marks are told from none: ROC curves, p-values beside their bound, success over an attack's strength."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.intervals import Interval, clopper_pearson
from jaxmark.plot.figures import BOUND, Picture, band, finish, panels, styles
from jaxmark.robustness import Robustness

_GRID = 241  # values of log10 α on a curve
_DECADE = 10.0  # strengths that span so much are drawn by their logarithms


def roc(
    log10_p: Mapping[str, Float[np.ndarray, " suspects"]], *, lowest: float = -20.0, confidence: float = 0.95
) -> Picture:
    """How many suspects are detected at each nominal false-positive probability α.

    What is detected at α is what has a `log10_p` of at most log10 α. Of marked suspects these are true positives; of
    unmarked ones, or of those read with a wrong key, false positives, which must stay below the dashed line.

    Args:
        log10_p: of the suspects, by what they are.
        lowest: log10 of the least α.
        confidence: of the shaded Clopper-Pearson intervals, at each α by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or a number is out of range.
    """
    if not -np.inf < lowest < 0:
        raise JaxmarkError(f"lowest is a negative number, the log10 of a probability, got {lowest:g}.")
    grid = np.linspace(lowest, 0, _GRID)
    figure, (axes,) = panels(1, 6.5, 4.2)
    _frequencies(axes, log10_p, grid, confidence)
    axes.plot(grid, 10**grid, label="α itself", **BOUND)
    finish(axes, xlabel="log10 of the nominal false-positive probability α", ylabel="share of suspects detected")
    return Picture(figure)


def p_values(log10_p: Mapping[str, Float[np.ndarray, " suspects"]], *, confidence: float = 0.95) -> Picture:
    """How often probabilities as small as each are met where there is no mark, beside the bound that is claimed.

    P(log10 p ≤ x) ≤ 10^x is what a proof says of suspects without the mark: the curve of a sound one lies below the
    dashed line, up to chance, which the shaded intervals show.

    Args:
        log10_p: of suspects without a mark, or read with a wrong key, by how p was computed.
        confidence: of the shaded Clopper-Pearson intervals, at each x by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or the confidence is out of range.
    """
    most = max((len(values) for values in log10_p.values()), default=1)
    grid = np.linspace(-np.log10(max(most, 10)) - 1, 0, _GRID)
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
    """How often the exact message is read after an attack, over its strength, with Clopper-Pearson intervals.

    Args:
        curves: what `jaxmark.robustness` found, for one attack, by what was marked or how.
        unit: of the attack's strength, as `jm.ATTACKS` has it.
        confidence: of the intervals, at each strength by itself.

    Raises:
        JaxmarkError: if matplotlib is missing, or the confidence is out of range.
    """
    figure, (axes,) = panels(1, 6.5, 4.2)
    strengths = np.concatenate([curve.strengths for curve in curves.values()])
    for (name, curve), style in zip(curves.items(), styles(1), strict=False):
        read, samples = curve.success.sum(axis=1), curve.success.shape[1]
        rate, interval = read / samples, clopper_pearson(read, samples, confidence)
        bars = np.maximum([rate - interval.low, interval.high - rate], 0)
        axes.errorbar(curve.strengths, rate, bars, label=name, capsize=3, **style)
    wide = strengths.min() > 0 and strengths.max() >= _DECADE * strengths.min()
    finish(axes, xlabel=f"strength: {unit}", ylabel="share of messages read", xscale="log" if wide else "linear")
    first = next(iter(curves.values())).strengths
    if first[0] > first[-1]:  # fewer bits are a stronger attack: weak ones stay on the left
        axes.invert_xaxis()
    axes.set_ylim(-0.05, 1.05)
    return Picture(figure)


def frequency(
    log10_p: Float[np.ndarray, " suspects"], grid: Float64[np.ndarray, " points"], confidence: float
) -> tuple[Float64[np.ndarray, " points"], Interval]:
    """The share of values that are at most each of the grid's, and its interval.

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
