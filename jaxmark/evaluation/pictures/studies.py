"""Pictures of studies: what is read over the strength of each attack."""

from collections.abc import Sequence
from typing import Any, Literal

from jaxmark.evaluation._rates import LOG10_LEVEL, Control, Row, rates
from jaxmark.extras import require
from jaxmark.plot.figures import COLOURS, MARKERS, Picture, move_aside
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P

_LINE_STYLES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)))
_CONTROLS: dict[Control, str] = {"unmarked": "unmarked", "wrong-key": "another key"}
_CONTROL_STYLES = {
    "unmarked": {"color": "0.45", "linestyle": ":", "marker": "x"},
    "wrong-key": {"color": "0.45", "linestyle": "--", "marker": "+"},
}
_MAX_COLUMNS = 3


Measure = Literal["read", "log10_p", "log10_p_unfloored"]


def curves(rows: Sequence[Row], of: Measure = "read") -> Picture:
    """Plot one panel for each attack, with weak strengths on the left.

    Each scheme has a line, or each scheme with a payload and a budget where these vary; meshes and seeds are pooled.
    Controls are grey, and pooled over all schemes. Lines stand beside each other, so that those that agree are visible.

    Args:
        rows: the rows of a study.
        of: `"read"`, the share of messages that were read, and for controls the share that was detected, with 95 %
            Clopper-Pearson intervals; or `"log10_p"`, the median with bars from the least to the largest, upwards the
            more evidence there is, and the level at which a mark counts as detected; or `"log10_p_unfloored"`, the
            same where the bound has its floor, too, which is a line there.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    attacks = list(dict.fromkeys(row.attack for row in rows))
    columns = min(_MAX_COLUMNS, len(attacks))
    count = -(-len(attacks) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.2 * count + 0.6), layout="constrained")
    panels = figure.subplots(count, columns, squeeze=False).ravel()
    names = _names(rows)
    for panel, attack in zip(panels, attacks, strict=False):
        _draw(panel, [row for row in rows if row.attack == attack], names, of)
    for panel in panels[len(attacks) :]:
        panel.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), _MAX_COLUMNS), fontsize=8)
    return Picture(figure)


def _names(rows: Sequence[Row]) -> tuple[str, ...]:
    """The fields by which lines differ: the scheme, and payload or budget if they vary."""
    return ("scheme", *(one for one in ("bits", "budget") if len({getattr(row, one) for row in rows}) > 1))


def _draw(panel: Any, rows: Sequence[Row], names: Sequence[str], of: str) -> None:
    first = rows[0]
    strengths = list(dict.fromkeys(row.strength for row in rows))
    series = _series(rows, names)
    for place, (label, control, found) in enumerate(series):
        success, style = ("detected", _CONTROL_STYLES[control]) if control else ("read", _style(place))
        label = f"{label}, detected" if control and of == "read" else label
        x = [rate["strength"] for rate in found]
        drawn = _line(panel, x, found, of, success, label=label, **style)
        move_aside(drawn, place, len(series), len(strengths))
    if len(strengths) > 1 and min(strengths) > 0:
        panel.set_xscale("log")
    panel.margins(x=0.12, y=0.08)  # room for the markers beside the outermost strengths
    panel.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=8)
    panel.minorticks_off()
    if strengths[0] > strengths[-1]:
        panel.invert_xaxis()
    panel.set_title(first.attack, fontsize=10)
    panel.set_xlabel("\n".join(_wrap(first.unit)), fontsize=8)
    if of == "read":
        panel.set_ylim(-0.04, 1.04)
        panel.set_ylabel(f"share read of {_trials(series)}, 95 % interval", fontsize=8)
    else:
        _level(panel, LOG10_LEVEL, "detected from here up")
        if of == "log10_p_unfloored":
            _level(panel, MIN_LOG10_P, "floor of what a key can prove")
        panel.invert_yaxis()
        floor = ", without floor" if of == "log10_p_unfloored" else ""
        panel.set_ylabel(f"log10 p{floor}, median and range of {_trials(series)}", fontsize=8)


def _series(rows: Sequence[Row], names: Sequence[str]) -> list[tuple[str, Control | None, list[dict[str, Any]]]]:
    """The name of each line, which control it is if any, and its rates over strength; controls are last."""
    marked: dict[str, list[dict[str, Any]]] = {}
    for rate in rates(rows, [*names, "control", "strength"]):
        if rate["control"] == "marked":
            marked.setdefault(", ".join(_format(name, rate[name]) for name in names), []).append(rate)
    found: list[tuple[str, Control | None, list[dict[str, Any]]]] = [(one, None, marked[one]) for one in marked]
    pooled = rates(rows, ["control", "strength"])
    for control, label in _CONTROLS.items():
        found.append((label, control, [rate for rate in pooled if rate["control"] == control]))
    return found


def _style(place: int) -> dict[str, Any]:
    return {"color": _pick(COLOURS, place), "marker": _pick(MARKERS, place), "linestyle": _pick(_LINE_STYLES, place)}


def _trials(series: Sequence[tuple[str, Control | None, list[dict[str, Any]]]]) -> str:
    """From how many readings a point of a line is, controls apart."""
    counts = sorted({rate["trials"] for _, control, found in series if control is None for rate in found})
    return f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}" if counts else "none"


def _level(panel: Any, log10_p: float, label: str) -> None:
    """A grey line at a level of evidence, which says what is reached there."""
    panel.axhline(log10_p, color="0.5", linewidth=1, linestyle=":", zorder=0)
    panel.annotate(
        label, (0.01, log10_p), xycoords=("axes fraction", "data"), fontsize=7, color="0.3", va="bottom", zorder=0
    )


def _line(panel: Any, x: list[float], rates: list[dict[str, Any]], of: str, success: str, **style: Any) -> Any:
    if of == "read":
        y = [rate[success] / rate["trials"] for rate in rates]
        low, high = ([rate[f"{success}_{end}"] for rate in rates] for end in ("low", "high"))
    else:
        y = [rate[of] for rate in rates]
        low, high = ([rate[f"{of}_{end}"] for rate in rates] for end in ("least", "largest"))
    # Rounding must not make a bar negative.
    below = [max(0.0, one - end) for one, end in zip(y, low, strict=True)]
    above = [max(0.0, end - one) for one, end in zip(y, high, strict=True)]
    return panel.errorbar(x, y, yerr=[below, above], capsize=3, linewidth=1.4, elinewidth=1, markersize=5, **style)


def _format(name: str, value: Any) -> str:
    return f"{value} bits" if name == "bits" else str(value)


def _pick(choices: Sequence[Any], place: int) -> Any:
    return choices[place % len(choices)]


def _wrap(text: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, 44) or [""]
