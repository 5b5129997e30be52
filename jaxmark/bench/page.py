"""The page of a benchmark: robustness curves, ROCs and all tables in one HTML file without external resources."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

import os
from collections.abc import Iterator
from itertools import cycle
from typing import Any

from jaxmark.bench.readings import BenchResults
from jaxmark.bench.robustness_curves import RANGES, axis, curve
from jaxmark.bench.summary import points
from jaxmark.bench.tables import tables
from jaxmark.errors import require
from jaxmark.plot import Picture
from jaxmark.plot.figures import COLOURS, panels, write_page


def markdown(results: BenchResults, title: str, about: str) -> str:
    """Format all tables as Markdown."""
    return "\n\n".join([f"# {title}", about, *(table.markdown() for table in tables(results))]) + "\n"


def save_page(results: BenchResults, path: str | os.PathLike[str], title: str, about: str) -> None:
    """Write one HTML page with curves and tables. Needs the extra `plot`.

    Args:
        results: the results of a benchmark.
        path: file for the page.
        title: title of the page.
        about: a sentence on how the results were made.

    Raises:
        JaxmarkError: if matplotlib or Jinja2 is missing, or the page cannot be written.
    """
    require("jinja2", "plot")
    tracks = dict.fromkeys(task.track for task, _ in results.tasks)
    pictures = {f"{track}: marks detected, by the attack's distortion": _survival(results, track) for track in tracks}
    pictures["Marks detected, by the false-positive rate, after all attacks"] = _rocs(results)
    write_page(path, title, pictures, about=about, tables=tables(results))


def _survival(results: BenchResults, track: str) -> Picture:
    """Draw a panel for each metric of distortion, with a line for each method."""
    figure, (first, *others) = panels(len(RANGES), 4.2, 3.8)
    for panel, metric in zip((first, *others), RANGES, strict=True):
        for name, style in _styles(results):
            of_method = [suspect for suspect in results.suspects if suspect.task.method == name]
            of_track = [suspect for suspect in of_method if suspect.task.track == track]
            if (survival := curve(points(results, of_track), metric)) is not None:
                panel.plot(axis(metric), survival, label=results.methods[name].name, **style)
        panel.set(xscale="log", xlabel=metric.upper(), ylim=(-0.03, 1.03))
        panel.tick_params(axis="x", which="minor", labelbottom=False)
    first.set_ylabel("fraction detected")
    return _with_legend(figure, first)


def _rocs(results: BenchResults) -> Picture:
    """Draw the ROC of every method."""
    figure, (panel,) = panels(1, 5.5, 4.6)
    for name, style in _styles(results):
        for (method, payload), calibration in results.calibrations.items():
            if method == name:
                label = f"{results.methods[name].name}, {payload} bits"
                panel.step(*zip(*calibration.points, strict=True), where="post", label=label, **style)
    panel.set(xlabel="false-positive rate, counted", ylabel="fraction detected, after all attacks", xlim=(-0.02, 1.02))
    return _with_legend(figure, panel)


def _styles(results: BenchResults) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield a colour and a line style for each method."""
    styles = [{"color": colour, "linestyle": line} for line in ("-", "--", ":") for colour in COLOURS]
    return zip(results.methods, cycle(styles), strict=False)


def _with_legend(figure: Any, panel: Any) -> Picture:
    handles, labels = panel.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), fontsize=8)
    return Picture(figure)
