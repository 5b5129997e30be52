"""Pictures of meshes by pixels: flat and smooth shading, and reflections of stripes, which show small dents."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float64

from jaxmark.distortion.rendered import LIGHTS, lambert
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, host_mesh
from jaxmark.geometry.raster import SIDES, Frame, Raster, cast
from jaxmark.plot.figures import Picture, panels
from jaxmark.plot.meshes import rotation

Style = Literal["flat", "smooth", "zebra"]
_STRIPES = 24  # number of dark stripes around the mesh
_EDGE = 0.15  # width of a stripe's soft edge, over half a stripe
_GLOSS = 0.75  # fraction of the reflected stripes in the shading; the rest is diffuse light
_LIGHT = LIGHTS[0]


class Rendering(NamedTuple):
    """One panel of a picture that is drawn pixel by pixel."""

    title: str
    mesh: Mesh
    style: Style = "smooth"
    side: str | tuple[float, float] = "front"  # in `SIDES`, or the eye's elevation and azimuth in degrees, as in `draw`
    frame: Frame | None = None  # share one between meshes to be compared; the mesh's own unless given


def render(rendering: Rendering, size: int = 600) -> Float64[np.ndarray, "rows columns"]:
    """Render a mesh as grey values from 0 to 1 on a white background, with `size` pixels on each side.

    `"flat"` and `"smooth"` are lit from the upper left. `"zebra"` is smooth and glossy, and reflects bands of light
    around it, as in the inspection of car bodies: where normals turn by an angle, stripes move by twice that angle.

    Raises:
        JaxmarkError: if libigl is missing, or there is no such style or side.
    """
    if rendering.style not in get_args(Style):
        raise JaxmarkError(f"Meshes are rendered {', '.join(get_args(Style))}, not {rendering.style!r}.")
    mesh = host_mesh(rendering.mesh)
    raster = cast(mesh, _camera(rendering.side), rendering.frame or Frame.of(mesh), size)
    shade = 0.15 + 0.85 * lambert(raster, _LIGHT, smooth=rendering.style != "flat")
    if rendering.style == "zebra":
        shade = (1 - _GLOSS) * shade + _GLOSS * _stripes(raster)
    return np.where(raster.shown, shade, 1.0)


def draw_renderings(renderings: Sequence[Rendering], size: int = 600) -> Picture:
    """Draw renderings side by side, left to right, each of `size` pixels on a side.

    Raises:
        JaxmarkError: if matplotlib is missing; or see `render`.
    """
    figure, axes = panels(len(renderings), 4.2, 4.4)
    for panel, rendering in zip(axes, renderings, strict=True):
        panel.imshow(render(rendering, size), cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
        panel.set_title(rendering.title, fontsize=10)
        panel.set_axis_off()
    return Picture(figure)


def _camera(side: str | tuple[float, float]) -> Float64[np.ndarray, "3 3"]:
    if not isinstance(side, str):
        return rotation(*np.radians(side))
    if side not in SIDES:
        raise JaxmarkError(f"There is no side {side!r}; there are {', '.join(SIDES)}.")
    return SIDES[side]


def _stripes(raster: Raster) -> Float64[np.ndarray, "rows columns"]:
    """Compute the stripes that a mirror shows, from the height at which the reflected line of sight ends."""
    normals = raster.normals(smooth=True)
    # The eye is far away at +z: its line of sight is reflected to 2 (n·z) n - z.
    height = np.clip(2 * normals[:, :, 2] * normals[:, :, 1], -1, 1)
    # Surfaces that face the viewer show the middle of a stripe, so that a plane is uniform.
    return 0.5 + 0.5 * np.tanh(np.cos(_STRIPES * np.arcsin(height)) / _EDGE)
