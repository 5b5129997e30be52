"""One page of a benchmark: curves over the attacks' cost, ROCs, and all tables; it loads nothing."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import base64
import os
from importlib import resources
from itertools import cycle

from jaxmark.bench.quality import RANGES, curve
from jaxmark.bench.results import BenchResults
from jaxmark.bench.summary import points
from jaxmark.bench.tables import tables
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.plot import Picture
from jaxmark.plot.figures import COLOURS

_STYLES = ("-", "--", ":")


def markdown(results: BenchResults, title: str, about: str) -> str:
    """All tables, as Markdown."""
    return "\n\n".join([f"# {title}", about, *(table.markdown() for table in tables(results))]) + "\n"


def save_page(results: BenchResults, path: str | os.PathLike[str], title: str, about: str) -> None:
    """Write one HTML page with curves and tables. Needs the extra `plot`.

    Args:
        results: what a benchmark found.
        path: file for the page.
        title: its title.
        about: a sentence on how it came about.

    Raises:
        JaxmarkError: if matplotlib or Jinja2 is missing, or the page cannot be written.
    """
    jinja2 = require("jinja2", "plot")
    template = resources.files("jaxmark.bench").joinpath("page.html").read_text(encoding="utf-8")
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template)
    leagues = dict.fromkeys(task.league for task, _ in results.tasks)
    drawn = {f"{league}: detected, over what the attack costs": survival(results, league) for league in leagues}
    drawn["Marks found over false positives, after all attacks"] = rocs(results)
    pictures = {name: base64.b64encode(picture.png()).decode() for name, picture in drawn.items()}
    write_atomically(path, page.render(title=title, about=about, pictures=pictures, tables=tables(results)).encode())


def survival(results: BenchResults, league: str) -> Picture:
    """A panel for each metric of cost, with a line for each method.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(RANGES), 3.8), layout="constrained")
    panels = figure.subplots(1, len(RANGES), squeeze=False).ravel()
    for panel, metric in zip(panels, RANGES, strict=True):
        for name, colour, style in _lines(results):
            some = [one for one in results.suspects if (one.task.method, one.task.league) == (name, league)]
            if (found := curve(points(results, some), metric)) is not None:
                panel.plot(found.cost, found.success, style, color=colour, label=results.methods[name].name)
        panel.set(xscale="log", xlabel=metric.upper(), ylim=(-0.03, 1.03))
        panel.tick_params(axis="x", which="minor", labelbottom=False)
    panels[0].set_ylabel("share detected")
    _legend(figure, panels[0])
    return Picture(figure)


def rocs(results: BenchResults) -> Picture:
    """True over false positives of every method.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5, 4.6), layout="constrained")
    panel = figure.subplots()
    for name, colour, style in _lines(results):
        for (method, payload), found in results.calibrations.items():
            if method == name:
                false, true = zip(*found.points, strict=True)
                panel.step(
                    false,
                    true,
                    style,
                    where="post",
                    color=colour,
                    label=f"{results.methods[name].name}, {payload} bits",
                )
    panel.set(xlabel="false-positive rate, counted", ylabel="share detected, after all attacks", xlim=(-0.02, 1.02))
    _legend(figure, panel)
    return Picture(figure)


def _lines(results: BenchResults) -> list[tuple[str, str, str]]:
    """A colour and a style for each method."""
    styles = [style for style in _STYLES for _ in COLOURS]
    return list(zip(results.methods, cycle(COLOURS), cycle(styles), strict=False))


def _legend(figure: object, panel: object) -> None:
    handles, labels = panel.get_legend_handles_labels()  # pyright: ignore[reportAttributeAccessIssue]
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), fontsize=8)  # pyright: ignore[reportAttributeAccessIssue]
