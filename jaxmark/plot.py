"""Pictures of meshes by matplotlib: headless, deterministic, without OpenGL. Needs the extra `plot`."""

import io
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.mesh import Mesh, host_mesh


class View(NamedTuple):
    """One panel of a picture."""

    title: str
    mesh: Mesh
    values: Float[np.ndarray, " vertices"] | None = None  # colours, per vertex; plain shading without
    unit: str = ""  # of the values, for the colour bar


def save_views(
    views: Sequence[View], path: str | os.PathLike[str], *, elevation: float = 15.0, azimuth: float = 25.0
) -> None:
    """Draw meshes side by side, shaded, all from one direction and at one scale, into a PNG file.

    Values are drawn in a colour map that colour-blind readers can tell apart, with a colour bar in their unit.

    Args:
        views: the panels, left to right.
        path: of the PNG file, written whole or not at all.
        elevation: of the eye above the horizon, degrees; +y is up.
        azimuth: of the eye around the vertical, degrees; 0 looks along -z.

    Raises:
        JaxmarkError: if matplotlib is missing, a mesh is unusable, or the file cannot be written.
    """
    require("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(views), 4.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(views)))
    turn = _rotation(np.radians(elevation), np.radians(azimuth))
    for panel, view in zip(axes, views, strict=True):
        drawn = _draw(panel, view, turn)
        panel.set_title(view.title, fontsize=10)
        if drawn is not None:
            figure.colorbar(drawn, ax=panel, label=view.unit, shrink=0.7)
    save_figure(figure, path)


def save_figure(figure: Any, path: str | os.PathLike[str]) -> None:
    """Draw a figure of matplotlib into a PNG file, written whole or not at all, without a screen.

    Raises:
        JaxmarkError: if the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(buffer, format="png", dpi=130)
    write_atomically(path, buffer.getvalue())


def _rotation(elevation: float, azimuth: float) -> np.ndarray:
    around = np.array([[np.cos(azimuth), 0, -np.sin(azimuth)], [0, 1, 0], [np.sin(azimuth), 0, np.cos(azimuth)]])
    down = np.array([[1, 0, 0], [0, np.cos(elevation), -np.sin(elevation)], [0, np.sin(elevation), np.cos(elevation)]])
    return down @ around


def _draw(axes, view: View, turn: np.ndarray):
    """Painter's algorithm: faces from back to front, lit from above the eye."""
    from matplotlib.collections import PolyCollection

    mesh = host_mesh(view.mesh)
    corners = (np.asarray(mesh.vertices) @ turn.T)[np.asarray(mesh.faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    light = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    # Soups and open surfaces have no inside: light both sides.
    brightness = (0.35 + 0.65 * np.abs(normals @ light))[:, None]
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    mappable = None
    if view.values is None:
        colours = brightness * np.array([0.80, 0.80, 0.84])
    else:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        values = np.asarray(view.values, np.float64)
        mappable = ScalarMappable(Normalize(0.0, max(float(values.max()), 1e-300)), cmap="cividis")
        colours = brightness * mappable.to_rgba(values[mesh.faces].mean(axis=1))[:, :3]
    faces = PolyCollection(list(corners[order][:, :, :2]), facecolors=colours[order], edgecolors="face", linewidths=0.2)
    axes.add_collection(faces)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    return mappable
