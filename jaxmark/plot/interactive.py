"""Interactive views of meshes: trimesh's viewer, an HTML page that contains three.js and needs no network."""

import html
import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh, diagonal, host_mesh
from jaxmark.plot.figures import FIELD


class Viewer(NamedTuple):
    """An interactive view of a mesh, which a notebook shows if it is the last expression of a cell."""

    page: str  # HTML with nothing loaded from outside
    legend: str  # HTML of the colour scale beneath the page

    def save(self, path: str | os.PathLike[str]) -> "Viewer":
        """Write an HTML file for any browser, whole or not at all, and return the view, which a notebook then shows.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, self.page.replace("</body>", f"{self.legend}</body>").encode())
        return self

    def _repr_html_(self) -> str:
        frame = f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="480" style="border:none"></iframe>'
        return f"<div>{frame}{self.legend}</div>"


def show(mesh: Mesh, values: Float[np.ndarray, " vertices"] | None = None, unit: str = "") -> Viewer:
    """Make an interactive view of a mesh, which notebooks and browsers show without network.

    Args:
        mesh: any mesh.
        values: one number for each vertex, shown as colours from 0 to the largest; without them the mesh is plain.
        unit: unit of the values, for the legend.

    Raises:
        JaxmarkError: if matplotlib is missing, there is not one finite value for each vertex, or the mesh has no extent
            (see `jaxmark.geometry.mesh.diagonal`).
    """
    require("matplotlib", "plot")
    import trimesh  # takes long to import
    from trimesh.scene import Camera, Scene
    from trimesh.viewer.notebook import scene_to_html

    mesh = host_mesh(mesh)
    colours, legend = None, ""
    if values is not None:
        from matplotlib import colormaps

        if values.shape != (len(mesh.vertices),) or not np.isfinite(values).all():
            raise JaxmarkError(f"A viewer needs {len(mesh.vertices)} finite values, one for each vertex.")
        most = max(float(values.max()), 1e-300)
        colours = colormaps[FIELD](np.clip(np.asarray(values, np.float64) / most, 0, 1), bytes=True)
        legend = _legend([colormaps[FIELD](step) for step in np.linspace(0, 1, 9)], most, unit)
    # A mesh of unit size lies between the near and the far plane of the viewer's camera.
    points = (mesh.vertices - np.mean(mesh.vertices, axis=0)) / diagonal(mesh)
    solid = trimesh.Trimesh(points, mesh.faces, vertex_colors=colours, process=False)
    # Without names of our own, trimesh would choose random ones.
    scene = Scene({"mesh": solid}, camera=Camera("camera", fov=(60, 45)))
    scene.set_camera()
    return Viewer(scene_to_html(scene), legend)


def _legend(colours: list[tuple[float, ...]], most: float, unit: str) -> str:
    steps = ", ".join(f"rgb({', '.join(str(round(255 * part)) for part in colour[:3])})" for colour in colours)
    bar = f'<div style="height:12px;background:linear-gradient(to right, {steps})"></div>'
    ends = f'<span>0</span><span style="float:right">{most:.3g} {html.escape(unit)}</span>'
    return f'<div style="width:320px;font:12px sans-serif">{bar}{ends}</div>'
