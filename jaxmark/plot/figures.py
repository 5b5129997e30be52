"""Common parts of all pictures: figures that need no screen, line styles, PNG files and HTML pages."""

import base64
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from jaxmark.errors import require
from jaxmark.files.atomic import write_atomically

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # the palette of Okabe and Ito
MARKERS = "os^Dvx"
BOUND = {"color": "black", "linestyle": "--"}  # the line of a bound that is proven, not counted
FIELD = "cividis"  # the colour map of values on meshes
_MARKERS_PER_LINE = 12
_ASIDE = 0.1  # largest distance, in inches, of series that are drawn next to each other
_ASIDE_IN_ALL = 1.5  # largest total of these distances, in inches


class Picture(NamedTuple):
    """A figure, which a notebook shows if it is the last expression of a cell."""

    figure: Any  # `matplotlib.figure.Figure`, for changes of your own

    def png(self) -> bytes:
        """Return the picture as the bytes of a PNG file, which are deterministic."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.figure.draw_without_rendering()  # colour bars find their places in the second pass
        buffer = io.BytesIO()
        FigureCanvasAgg(self.figure).print_figure(buffer, format="png", dpi=130)
        return buffer.getvalue()

    def save(self, path: str | os.PathLike[str]) -> "Picture":
        """Write a PNG file atomically; returns the picture, so that a notebook shows it.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, self.png())
        return self

    def _repr_png_(self) -> bytes:
        return self.png()


def panels(
    count: int = 1,
    width: float = 6.5,
    height: float = 4.2,
    *,
    columns: int | None = None,
    **options: Any,
) -> tuple[Any, Any]:
    """Make a figure of panels side by side; sizes are in inches.

    Args:
        count: number of panels.
        width: of each panel.
        height: of each panel.
        columns: the largest number of panels in a row; all of them unless given.
        options: options of matplotlib's `Figure.subplots`.

    Returns:
        The figure, and the axes of its panels; the last row may have some more.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    columns = min(count, columns or count)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).ravel()


def styles(points: int) -> Iterator[dict[str, Any]]:
    """Yield colours and markers for one line after the other; on a long line about a dozen points are marked."""
    for colour, marker in cycle(zip(COLOURS, MARKERS, strict=True)):
        yield {"color": colour, "marker": marker, "markevery": max(1, points // _MARKERS_PER_LINE), "markersize": 5}


def draw_aside(axes: Any, line: Sequence[Any], place: int, count: int, points: int, **style: Any) -> None:
    """Draw one of several lines with error bars, shifted on the page so that lines do not hide each other.

    Args:
        axes: matplotlib's axes, of any scale; their limits are those of the line before the shift.
        line: x, y, and the lower and upper ends of the bars.
        place: place of the line among all, from 0.
        count: number of lines.
        points: number of values of x, which share the width of the axes.
        style: options of matplotlib's `Axes.errorbar`.
    """
    from matplotlib.transforms import ScaledTranslation

    x, y, low, high = line
    # Rounding must not make a bar negative.
    drawn = axes.errorbar(x, y, np.maximum([y - low, high - y], 0), capsize=3, **style)
    inches, step = axes.figure.dpi_scale_trans, min(_ASIDE, _ASIDE_IN_ALL / (count * points))
    for artist in drawn.get_children():
        artist.set_transform(axes.transData + ScaledTranslation(step * (place - (count - 1) / 2), 0, inches))


def fill_template(package: str, name: str, **values: Any) -> str:
    """Fill the HTML template of a package with values, which are escaped.

    Raises:
        JaxmarkError: if Jinja2 is missing.
    """
    jinja2 = require("jinja2", "plot")
    template = resources.files(package).joinpath(name).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(values)


def write_page(path: str | os.PathLike[str], title: str, pictures: Mapping[str, Picture], **parts: Any) -> None:
    """Write an HTML page of pictures and tables, without external resources. Needs the extra `plot`.

    Args:
        path: file for the page.
        title: title of the page.
        pictures: pictures by their headings.
        parts: `tables`, objects with `title`, `note`, `heads` and `lines`; and optionally `about`, a sentence below the
            title; `alt`, the end of each picture's description; sentences as `notes` and `refusals`; and `nowrap`,
            whether cells stay on one line.

    Raises:
        JaxmarkError: if Jinja2 is missing, or the page cannot be written.
    """
    shown = {"about": "", "alt": "", "notes": (), "refusals": (), "nowrap": False, "title": title, **parts}
    shown["pictures"] = {name: base64.b64encode(picture.png()).decode() for name, picture in pictures.items()}
    write_atomically(path, fill_template("jaxmark.plot", "page.html", **shown).encode())


def finish(axes: Any, **labels: Any) -> None:
    """Label the axes; add a grid and, if lines have names, a legend."""
    axes.set(**labels)
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
