"""The figures of `paper.py`, drawn by matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from jaxmark.plot.figures import Picture, finish, panels, styles

Curves = dict[str, tuple[list[float], list[float]]]


class Panel(NamedTuple):
    """What a figure shows, or a part of it."""

    figure: int
    x: str
    y: str
    curves: Curves
    scale: Literal["linear", "log x", "log"] = "linear"  # "log" of both axes
    title: str = ""


def pictures(drawn: Sequence[Panel], stem: Path) -> None:
    """One PNG for each figure, its panels side by side."""
    for number in dict.fromkeys(panel.figure for panel in drawn):
        mine = [panel for panel in drawn if panel.figure == number]
        figure, every = panels(len(mine), 5.0, 4.5, sharey=True)
        for axes, panel in zip(every, mine, strict=True):
            for (name, (x, y)), style in zip(panel.curves.items(), styles(0), strict=False):
                axes.plot(x, y, label=name, **style | {"markevery": max(1, len(x) // 12)})
            x_scale, y_scale = panel.scale.split()[0], "log" if panel.scale == "log" else "linear"
            finish(axes, xlabel=panel.x, ylabel=panel.y, title=panel.title, xscale=x_scale, yscale=y_scale)
        Picture(figure).save(stem.with_name(f"{stem.name}-{number}.png"))
