"""What the figures of `paper.py` show, and how they are drawn, by matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from jaxmark.extras import require

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # of Okabe and Ito
Curves = dict[str, tuple[list[float], list[float]]]


class Panel(NamedTuple):
    """What a figure shows, or a part of it."""

    figure: int
    x: str
    y: str
    curves: Curves
    scale: Literal["linear", "log x", "log"] = "linear"  # "log" of both axes
    title: str = ""


def pictures(panels: Sequence[Panel], stem: Path) -> None:
    """One PNG for each figure, its panels side by side."""
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    for number in dict.fromkeys(panel.figure for panel in panels):
        mine = [panel for panel in panels if panel.figure == number]
        figure = Figure(figsize=(1.5 + 4.5 * len(mine), 4.5), layout="constrained")
        for axes, panel in zip(np.atleast_1d(figure.subplots(1, len(mine), sharey=True)), mine, strict=True):
            for (name, (x, y)), colour, marker in zip(panel.curves.items(), COLOURS, "os^Dvx", strict=False):
                axes.plot(x, y, color=colour, label=name, marker=marker if len(x) < 100 else "")
            axes.set(xlabel=panel.x, ylabel=panel.y, title=panel.title)
            axes.set(xscale=panel.scale.split()[0], yscale="log" if panel.scale == "log" else "linear")
            axes.grid(alpha=0.3)
            axes.legend()
        figure.savefig(stem.with_name(f"{stem.name}-{number}.png"), dpi=150)
