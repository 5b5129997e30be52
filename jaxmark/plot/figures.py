"""What all pictures share: figures that need no screen, styles of lines, and PNG files."""

import io
import os
from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.confidence import Interval
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # the palette of Okabe and Ito
MARKERS = "os^Dvx"
BOUND = {"color": "black", "linestyle": "--"}  # the line of a bound that is proven, not counted
FIELD = "cividis"  # the colour map of values on meshes
_MARKERS_PER_LINE = 12
_ASIDE = 0.1  # inches between series that are drawn beside each other, at most
_ASIDE_IN_ALL = 1.5  # inches that they take of the width


class Picture(NamedTuple):
    """A figure, which a notebook shows if it is the last expression of a cell."""

    figure: Any  # `matplotlib.figure.Figure`, for changes of your own

    def png(self) -> bytes:
        """The picture as the bytes of a PNG file, the same each time."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.figure.draw_without_rendering()  # colour bars find their places in the second pass
        buffer = io.BytesIO()
        FigureCanvasAgg(self.figure).print_figure(buffer, format="png", dpi=130)
        return buffer.getvalue()

    def save(self, path: str | os.PathLike[str]) -> "Picture":
        """Write a PNG file, whole or not at all, and return the picture, which a notebook then shows, too.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, self.png())
        return self

    def _repr_png_(self) -> bytes:
        return self.png()


def panels(count: int, width: float, height: float, **options: Any) -> tuple[Any, Iterable[Any]]:
    """Make a figure of panels side by side.

    Args:
        count: number of panels.
        width: width of each panel, in inches.
        height: height of each panel, in inches.
        options: options of matplotlib's `Figure.subplots`.

    Returns:
        The figure, and the axes of its panels.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, count, **options))


def styles(points: int) -> Iterator[dict[str, Any]]:
    """Yield colours and markers for one line after the other; on a long line about a dozen points are marked."""
    for colour, marker in cycle(zip(COLOURS, MARKERS, strict=True)):
        yield {"color": colour, "marker": marker, "markevery": max(1, points // _MARKERS_PER_LINE), "markersize": 5}


def band(axes: Any, x: Float[np.ndarray, " points"], interval: Interval, colour: str) -> None:
    """Shade a confidence interval about a line."""
    axes.fill_between(x, interval.low, interval.high, color=colour, alpha=0.2, linewidth=0)


def move_aside(drawn: Any, place: int, count: int, points: int) -> None:
    """Move one of several series aside on the page, whatever the scale of its axes, so that all are visible.

    Args:
        drawn: the series, matplotlib's `ErrorbarContainer`; limits of the axes are taken from where it was drawn.
        place: place of the series among all, from 0.
        count: number of series.
        points: number of values of x, which share the width of the axes.
    """
    from matplotlib.transforms import ScaledTranslation

    step = min(_ASIDE, _ASIDE_IN_ALL / (count * points))
    for artist in drawn.get_children():
        inches = artist.get_figure().dpi_scale_trans
        artist.set_transform(artist.axes.transData + ScaledTranslation(step * (place - (count - 1) / 2), 0, inches))


def finish(axes: Any, **labels: Any) -> None:
    """Label the axes; add a grid and, if lines have names, a legend."""
    axes.set(**labels)
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
