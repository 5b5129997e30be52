"""What all pictures share: a figure without a screen, styles of lines, and a PNG of it."""

import io
import os
from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.intervals import Interval

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # of Okabe and Ito
MARKERS = "os^Dvx"
BOUND = {"color": "black", "linestyle": "--"}  # of what is proven, not counted
FIELD = "cividis"  # the colour map of values on meshes
_MARKED = 12  # places on a line that a marker tells apart


class Picture(NamedTuple):
    """A figure; the last expression of a notebook's cell is shown."""

    figure: Any  # `matplotlib.figure.Figure`, for changes of your own

    def png(self) -> bytes:
        """The picture as a file's bytes; the same each time."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.figure.draw_without_rendering()  # colour bars find their places in the second pass
        buffer = io.BytesIO()
        FigureCanvasAgg(self.figure).print_figure(buffer, format="png", dpi=130)
        return buffer.getvalue()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG file, whole or not at all.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, self.png())

    def _repr_png_(self) -> bytes:
        return self.png()


def panels(count: int, width: float, height: float, **options: Any) -> tuple[Any, Iterable[Any]]:
    """A figure of panels side by side, each of a width and height in inches, and their axes.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, count, **options))


def styles(points: int) -> Iterator[dict[str, Any]]:
    """Colours and markers of lines, one after the other; of long lines a dozen points are marked."""
    for colour, marker in cycle(zip(COLOURS, MARKERS, strict=True)):
        yield {"color": colour, "marker": marker, "markevery": max(1, points // _MARKED), "markersize": 5}


def band(axes: Any, x: Float[np.ndarray, " points"], interval: Interval, colour: str) -> None:
    """Shade an interval of confidence about a line."""
    axes.fill_between(x, interval.low, interval.high, color=colour, alpha=0.2, linewidth=0)


def finish(axes: Any, **labels: Any) -> None:
    """Axes, grid and, where lines have names, a legend."""
    axes.set(**labels)
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
