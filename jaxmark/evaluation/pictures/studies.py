"""Pictures of studies: what is read over the strength of each attack."""

from collections.abc import Sequence
from typing import Any, Literal

from jaxmark.evaluation._rates import LOG10_LEVEL, Row, rates
from jaxmark.extras import require
from jaxmark.plot.figures import COLOURS, MARKERS, Picture
from jaxmark.watermark.evidence import MIN_LOG10_P

_LINE_STYLES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)))
_CONTROL_STYLES = {"unmarked": ("unmarked, detected", ":", "x"), "wrong-key": ("another key, detected", "--", "+")}
_MAX_COLUMNS = 3


Measure = Literal["read", "log10_p", "log10_p_unfloored"]


def curves(rows: Sequence[Row], of: Measure = "read") -> Picture:
    """Plot one panel for each attack, with weak strengths on the left.

    Each scheme has a line, or each scheme with a payload and a budget where these vary; meshes and seeds are pooled.
    Controls are grey, and pooled over all schemes.

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
    wide = len(strengths) > 1 and min(strengths) > 0
    for name, (label, line, marker) in _CONTROL_STYLES.items():
        found = [rate for rate in rates(rows, ["control", "strength"]) if rate["control"] == name]
        style = {"color": "0.6", "linestyle": line, "marker": marker, "zorder": 1}
        _line(panel, [rate["strength"] for rate in found], found, of, "detected", label=label, **style)
    groups: dict[str, list[dict[str, Any]]] = {}
    for rate in rates(rows, [*names, "control", "strength"]):
        if rate["control"] == "marked":
            groups.setdefault(", ".join(_format(name, rate[name]) for name in names), []).append(rate)
    for place, (label, found) in enumerate(groups.items()):
        # Moved aside a little, so that lines that agree are all visible.
        aside = (max(strengths) / min(strengths)) ** (0.015 * place) if wide else 1.0
        style = {
            "color": _pick(COLOURS, place),
            "marker": _pick(MARKERS, place),
            "linestyle": _pick(_LINE_STYLES, place),
        }
        _line(panel, [aside * rate["strength"] for rate in found], found, of, "read", label=label, zorder=2, **style)
    if wide:
        panel.set_xscale("log")
    panel.set_xticks(strengths, [f"{strength:g}" for strength in strengths], fontsize=8)
    panel.minorticks_off()
    if strengths[0] > strengths[-1]:
        panel.invert_xaxis()
    panel.set_title(first.attack, fontsize=10)
    panel.set_xlabel("\n".join(_wrap(first.unit)), fontsize=8)
    if of == "read":
        panel.set_ylim(-0.04, 1.04)
        panel.set_ylabel("share read, 95 % interval", fontsize=8)
    else:
        _level(panel, LOG10_LEVEL, "detected")
        if of == "log10_p_unfloored":
            _level(panel, MIN_LOG10_P, "floor of what a key can prove")
        panel.invert_yaxis()
        floor = ", without floor" if of == "log10_p_unfloored" else ""
        panel.set_ylabel(f"log10 p{floor}, median and range", fontsize=8)


def _level(panel: Any, log10_p: float, label: str) -> None:
    """A grey line at a level of evidence, which says what is reached there."""
    panel.axhline(log10_p, color="0.7", linewidth=1, linestyle=":", zorder=0)
    panel.annotate(
        label, (0.01, log10_p), xycoords=("axes fraction", "data"), fontsize=7, color="0.4", va="bottom", zorder=0
    )


def _line(panel: Any, x: list[float], rates: list[dict[str, Any]], of: str, success: str, **style: Any) -> None:
    if of == "read":
        y = [rate[success] / rate["trials"] for rate in rates]
        low, high = ([rate[f"{success}_{end}"] for rate in rates] for end in ("low", "high"))
    else:
        y = [rate[of] for rate in rates]
        low, high = ([rate[f"{of}_{end}"] for rate in rates] for end in ("least", "largest"))
    # Rounding must not make a bar negative.
    below = [max(0.0, one - end) for one, end in zip(y, low, strict=True)]
    above = [max(0.0, end - one) for one, end in zip(y, high, strict=True)]
    panel.errorbar(x, y, yerr=[below, above], capsize=3, linewidth=1.4, elinewidth=1, markersize=5, **style)


def _format(name: str, value: Any) -> str:
    return f"{value} bits" if name == "bits" else str(value)


def _pick(choices: Sequence[Any], place: int) -> Any:
    return choices[place % len(choices)]


def _wrap(text: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, 44) or [""]
