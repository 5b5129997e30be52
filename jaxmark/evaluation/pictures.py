"""Pictures by matplotlib: ROC curves, p-values, success, curves of studies, visibility of bands. Extra `plot`."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.alignment.original import Original
from jaxmark.attacks.attack import unit_of_length
from jaxmark.confidence import clopper_pearson
from jaxmark.distortion import Metric, name_of
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation._rates import LOG10_LEVEL, Control, Row, rates
from jaxmark.evaluation._robustness import Robustness
from jaxmark.plot._spectra import FREQUENCY
from jaxmark.plot.figures import BOUND, COLOURS, MARKERS, Picture, draw_aside, finish, panels, styles
from jaxmark.spectral.bands import nodes, scaling
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.perception.visibility import band_visibility as measure_visibility

Suspects = Float[np.ndarray, " suspects"]
Measure = Literal["read", "log10_p", "log10_p_unfloored"]
Series = tuple[str, Control | None, list[dict[str, Any]]]  # name of a line, its control if any, its rates over strength

_CURVE_POINTS = 241  # values of log10 α
_MIN_LOG_RATIO = 10.0  # largest over least strength, from which the axis is logarithmic
_LINE_STYLES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)))
_CONTROLS: dict[Control, tuple[str, dict[str, Any]]] = {
    "unmarked": ("unmarked", {"color": "0.45", "linestyle": ":", "marker": "x"}),
    "wrong-key": ("another key", {"color": "0.45", "linestyle": "--", "marker": "+"}),
}
_ENDS = {"read": ("_low", "_high"), **dict.fromkeys(("log10_p", "log10_p_unfloored"), ("_least", "_largest"))}
_MAX_COLUMNS = 3
_LETTER_WIDTH, _LINE_WIDTH, _LEGEND_LINE = 0.065, 0.5, 0.18  # inches in a legend of 8 points


def roc(log10_p: Mapping[str, Suspects], *, lowest: float = -20.0, confidence: float = 0.95) -> Picture:
    """Plot the share of suspects that are detected at each nominal false-positive probability α.

    A suspect is detected at α if its `log10_p` is at most log10 α. Detected suspects are true positives if they are
    marked, and false positives if they are unmarked or read with a wrong key; the share of the latter must stay below
    the dashed line.

    Args:
        log10_p: `log10_p` of the suspects, by the name of their kind.
        lowest: log10 of the smallest α.
        confidence: confidence level of the shaded Clopper-Pearson intervals, at each α separately.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or a number is out of range.
    """
    if not -np.inf < lowest < 0:
        raise JaxmarkError(f"lowest is a negative number, the log10 of a probability, got {lowest:g}.")
    labels = {"xlabel": "log10 of the nominal false-positive probability α", "ylabel": "share of suspects detected"}
    return _frequencies(log10_p, lowest, confidence, "α itself", **labels)


def p_values(log10_p: Mapping[str, Suspects], *, confidence: float = 0.95) -> Picture:
    """Plot how often p is at most 10^x for suspects without a mark, beside the bound that p claims.

    A proof says that P(log10 p ≤ x) ≤ 10^x for suspects without the mark: the curve of a sound p lies below the dashed
    line, up to chance, which the shaded Clopper-Pearson intervals show at each x separately. The p-values are those of
    suspects without a mark, or read with a wrong key, by the way in which p was computed.

    Raises:
        JaxmarkError: if matplotlib is missing, there is no suspect of a kind, or the confidence is out of range.
    """
    most = max((len(values) for values in log10_p.values()), default=1)
    labels = {"xlabel": "x, a log10 p", "ylabel": "share of suspects with log10 p ≤ x"}
    scale = {"yscale": "log", "ylim": (0.3 / max(most, 10), 1.5)}
    return _frequencies(log10_p, -np.log10(max(most, 10)) - 1, confidence, "the bound, 10^x", **labels, **scale)


def _frequencies(
    log10_p: Mapping[str, Suspects], lowest: float, confidence: float, bound: str, **labels: Any
) -> Picture:
    """Plot the share of values that are at most x for each x from `lowest` to 0, with the line 10^x as a bound."""
    grid = np.linspace(lowest, 0, _CURVE_POINTS)
    figure, (axes,) = panels()
    for (name, values), style in zip(log10_p.items(), styles(len(grid)), strict=False):
        if len(values) == 0 or np.isnan(values).any():
            raise JaxmarkError(f"A curve needs one log10 p or more, and no NaN, got {len(values)} values.")
        hits = np.searchsorted(np.sort(values), grid, side="right")
        interval = clopper_pearson(hits, len(values), confidence)
        axes.plot(grid, hits / len(values), label=f"{name} ({len(values)})", **style)
        axes.fill_between(grid, interval.low, interval.high, color=style["color"], alpha=0.2, linewidth=0)
    axes.plot(grid, 10**grid, label=bound, **BOUND)
    finish(axes, **labels)
    return Picture(figure)


def success(curves: Mapping[str, Robustness], unit: str, *, confidence: float = 0.95) -> Picture:
    """Plot how often the exact message is read after an attack over its strength, with Clopper-Pearson intervals.

    Args:
        curves: results of `jaxmark.evaluation.robustness` for one attack, by the name of the line.
        unit: unit of the attack's strength, as `jm.adversaries.ATTACKS` has it.
        confidence: confidence level of the intervals, at each strength separately.

    Raises:
        JaxmarkError: if matplotlib is missing, or the confidence is out of range.
    """
    figure, (axes,) = panels()
    strengths = np.concatenate([curve.strengths for curve in curves.values()])
    for place, ((name, curve), style) in enumerate(zip(curves.items(), styles(1), strict=False)):
        read, samples = curve.success.sum(axis=1), curve.success.shape[1]
        lines = curve.strengths, read / samples, *clopper_pearson(read, samples, confidence)
        draw_aside(axes, lines, place, len(curves), len(np.unique(strengths)), label=name, **style)
    wide = strengths.min() > 0 and strengths.max() >= _MIN_LOG_RATIO * strengths.min()
    finish(axes, xlabel=f"strength: {unit}", ylabel="share of messages read", xscale="log" if wide else "linear")
    first = next(iter(curves.values())).strengths
    if first[0] > first[-1]:  # fewer bits are a stronger attack; weak attacks stay on the left
        axes.invert_xaxis()
    axes.set_ylim(-0.05, 1.05)
    return Picture(figure)


def band_visibility(original: Original, metrics: Sequence[Metric], bands: int = 64) -> Picture:
    """Plot by how much metrics increase per unit of displacement in each of several Jackson-damped scaling functions.

    The values are those of `jaxmark.watermark.perception.visibility.band_visibility`; metrics are names in
    `distortion.METRICS`, or functions of your own.

    Raises:
        JaxmarkError: if matplotlib is missing, or a metric is refused (see `distortion.measure`).
    """
    found = measure_visibility(original, scaling(bands, damping="jackson"), metrics)
    figure, (axes,) = panels()
    for name, row, style in zip(metrics, found, styles(bands), strict=False):
        axes.plot(nodes(bands), row, label=name_of(name), **style)
    finish(axes, xlabel=FREQUENCY, ylabel="metric / (RMS displacement / diagonal)", yscale="log")
    return Picture(figure)


def curves(rows: Sequence[Row], of: Measure = "read") -> Picture:
    """Plot one panel for each attack of a study, with weak strengths on the left.

    Each scheme has a line, or each scheme with a mesh, a payload and a budget where these vary; seeds are pooled.
    Strengths that are lengths, and budgets that are numbers, are fractions of the diagonal; the labels say so. Controls
    are grey, and pooled over all of these. Lines stand beside each other, so that equal ones are visible.

    Args:
        rows: the rows of a study.
        of: `"read"`, the share of messages that were read, and for controls the share that was detected, with 95 %
            Clopper-Pearson intervals; or `"log10_p"`, the median with bars from the least to the largest, upwards the
            more evidence there is, and the level at which a mark counts as detected; or `"log10_p_unfloored"`, the
            same without the floor of the bound, which is drawn as a line.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    attacks = list(dict.fromkeys(row.attack for row in rows))
    varied = (one for one in ("mesh", "bits", "budget") if len({getattr(row, one) for row in rows}) > 1)
    names = ("scheme", *varied)
    figure, axes = panels(len(attacks), 4.2, 3.2, columns=_MAX_COLUMNS)
    for panel, attack in zip(axes, attacks, strict=False):
        _draw(panel, [row for row in rows if row.attack == attack], names, of)
    for panel in axes[len(attacks) :]:
        panel.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    width, height = figure.get_size_inches()
    columns = max(1, min(len(labels), int(width / (_LINE_WIDTH + _LETTER_WIDTH * max(map(len, labels))))))
    figure.set_figheight(height + _LEGEND_LINE * (1 + math.ceil(len(labels) / columns)))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8)
    return Picture(figure)


def _draw(panel: Any, rows: Sequence[Row], names: Sequence[str], of: Measure) -> None:
    series = _series(rows, names)
    # A length depends on the mesh, so the ticks are at the means.
    ticks = {rate["strength"]: _place(rate, rate["strength"]) for rate in rates(rows, ["strength"])}
    strengths = list(ticks.values())
    looks = zip(series, cycle(COLOURS), cycle(MARKERS), cycle(_LINE_STYLES), strict=False)
    for place, ((label, control, found), colour, marker, dashes) in enumerate(looks):
        success = of if of != "read" else "detected" if control else "read"
        y, low, high = (_column(found, success + end) for end in ("", *_ENDS[of]))
        if of == "read":
            y, label = y / _column(found, "trials"), f"{label}, detected" if control else label
        line = np.array([_place(rate, ticks[rate["strength"]]) for rate in found]), y, low, high
        style = _CONTROLS[control][1] if control else {"color": colour, "marker": marker, "linestyle": dashes}
        style = {**style, "label": label, "linewidth": 1.4, "elinewidth": 1, "markersize": 5}
        draw_aside(panel, line, place, len(series), len(strengths), **style)
    if len(strengths) > 1 and min(strengths) > 0:
        panel.set_xscale("log")
    panel.margins(x=0.12, y=0.08)  # space for the markers next to the outermost strengths
    panel.set_xticks(strengths, [f"{strength:.3g}" for strength in strengths], fontsize=8)
    panel.minorticks_off()
    if strengths[0] > strengths[-1]:
        panel.invert_xaxis()
    panel.set_title(rows[0].attack, fontsize=10)
    panel.set_xlabel(textwrap.fill(unit_of_length(rows[0].unit), 44), fontsize=8)
    counts = sorted({rate["trials"] for _, control, found in series if control is None for rate in found})
    trials = " to ".join(map(str, dict.fromkeys([*counts[:1], *counts[-1:]]))) or "none"
    if of == "read":
        panel.set_ylim(-0.04, 1.04)
        panel.set_ylabel(f"share read of {trials}, 95 % interval", fontsize=8)
    else:
        _draw_level(panel, LOG10_LEVEL, "detected from here up")
        if of == "log10_p_unfloored":
            _draw_level(panel, MIN_LOG10_P, "floor of what a key can prove")
        panel.invert_yaxis()
        floor = ", without floor" if of == "log10_p_unfloored" else ""
        panel.set_ylabel(f"log10 p{floor}, median and range of {trials}", fontsize=8)


def _place(rate: Mapping[str, Any], otherwise: float) -> float:
    """Return the place of a rate on the axis of strengths: in diagonals if the strength is known to be a length."""
    return otherwise if rate["length"] is None else rate["length"]


def _column(rates: Sequence[dict[str, Any]], name: str) -> Float64[np.ndarray, " rates"]:
    return np.array([rate[name] for rate in rates], float)


def _draw_level(panel: Any, log10_p: float, label: str) -> None:
    panel.axhline(log10_p, color="0.5", linewidth=1, linestyle=":", zorder=0)
    place = ("axes fraction", "data")
    panel.annotate(label, (0.01, log10_p), xycoords=place, fontsize=7, color="0.3", va="bottom", zorder=0)


def _series(rows: Sequence[Row], names: Sequence[str]) -> list[Series]:
    """Return the lines of a panel; the last lines are the controls, pooled over all schemes."""
    marked: dict[str, list[dict[str, Any]]] = {}
    for rate in rates(rows, [*names, "strength"]):
        if rate["control"] == "marked":
            label = ", ".join(_label(name, rate[name]) for name in names)
            marked.setdefault(label, []).append(rate)
    pooled = rates(rows, ["strength"])
    found: list[Series] = [(label, None, line) for label, line in marked.items()]
    for control, (label, _) in _CONTROLS.items():
        found.append((label, control, [rate for rate in pooled if rate["control"] == control]))
    return found


def _label(name: str, value: Any) -> str:
    """Return the value of a field as a part of a line's name, with its unit."""
    if name == "bits":
        return f"{value} bits"
    return f"{value:g} of the diagonal" if isinstance(value, float) else str(value)
