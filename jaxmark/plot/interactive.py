"""Interactive views of meshes in HTML pages, by trimesh's viewer; they contain three.js and need no network."""

import html
import os
from typing import Any, NamedTuple

import numpy as np

from jaxmark.errors import JaxmarkError, require
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import Mesh, diagonal, host_mesh
from jaxmark.plot.figures import FIELD, fill_template
from jaxmark.plot.meshes import View

_PLAIN = (205, 205, 200, 255)  # the colour of a mesh without values


class Viewer(NamedTuple):
    """An interactive view of meshes, which a notebook shows if it is the last expression of a cell."""

    page: str  # HTML without external resources

    def save(self, path: str | os.PathLike[str]) -> "Viewer":
        """Write an HTML file for any browser, atomically; returns the view, so that a notebook shows it.

        Raises:
            JaxmarkError: if it cannot be written.
        """
        write_atomically(path, self.page.encode())
        return self

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="480" style="border:none"></iframe>'


def show(*views: View | Mesh) -> Viewer:
    """Make an interactive view of meshes, which notebooks and browsers show without network.

    One mesh is shown at a time, and all meshes from the same side, which the mouse changes. To inspect a mark, call
    `show(View("original", original.mesh), View("marked", marked), exaggerate(original, marked))`. Meshes are selected
    by their titles. Values are shown as colours, from 0 to the largest value. Meshes keep their positions relative to
    the first one.

    Raises:
        JaxmarkError: if matplotlib or Jinja2 is missing, there is no view, there is not one finite value for each
            vertex, or the first mesh has no extent (see `jaxmark.geometry.mesh.diagonal`).
    """
    require("matplotlib", "plot")
    require("jinja2", "plot")
    import trimesh  # takes long to import
    from trimesh.scene import Camera, Scene
    from trimesh.viewer.notebook import scene_to_html

    if not views:
        raise JaxmarkError("A viewer needs at least one mesh.")
    named = [view if isinstance(view, View) else View("", view) for view in views]
    meshes = [host_mesh(view.mesh) for view in named]
    # A mesh of unit size lies between the near and the far plane of the viewer's camera.
    centre, size = np.mean(meshes[0].vertices, axis=0), diagonal(meshes[0])
    # The nodes are named here, because trimesh would choose random names.
    scene = Scene(camera=Camera("camera", fov=(60, 45)))
    shown = [_present(view, len(mesh.vertices)) for view, mesh in zip(named, meshes, strict=True)]
    for place, (mesh, (colours, _)) in enumerate(zip(meshes, shown, strict=True)):
        points = (mesh.vertices - centre) / size
        solid = trimesh.Trimesh(points, mesh.faces, vertex_colors=colours, process=False)
        scene.add_geometry(solid, node_name=f"view{place}", geom_name=f"view{place}")
    scene.set_camera()
    title = " / ".join(view.title for view in named if view.title) or "jaxmark"
    controls = fill_template("jaxmark.plot", "viewer.html", title=title, views=[legend for _, legend in shown])
    before, end, after = scene_to_html(scene).rpartition("</body>")
    return Viewer(before + controls + end + after)


def _present(view: View, vertices: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the colours of the vertices, and the legend: the title, and the scale of the colours of values."""
    legend: dict[str, Any] = {"title": view.title, "most": "", "unit": "", "colours": []}
    if view.values is None:
        return np.tile(np.array(_PLAIN, np.uint8), (vertices, 1)), legend
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    values, colours = np.asarray(view.values, np.float64), colormaps[FIELD]
    if values.shape != (vertices,) or not np.isfinite(values).all():
        raise JaxmarkError(f"A viewer needs {vertices} finite values, one for each vertex.")
    most = max(float(values.max()), 1e-300)
    scale = [to_hex(colours(step)) for step in np.linspace(0, 1, 9)]
    legend |= {"most": f"{most:.3g}", "unit": view.unit, "colours": scale}
    return colours(np.clip(values / most, 0, 1), bytes=True), legend
