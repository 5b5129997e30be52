"""Shaded pictures of meshes, with or without values on their vertices; without OpenGL."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.alignment.original import Original, shift_of
from jaxmark.distortion import local_roughness, shading_at_vertices
from jaxmark.distortion.roughness import MAX_ROUGHNESS, MIN_ROUGHNESS, POWER
from jaxmark.geometry.mesh import Mesh, check_faces, face_normals, host_mesh
from jaxmark.plot.figures import FIELD, Picture, panels
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import filter

_AVERAGING_SCALE = 5  # roughness is averaged over 2^5 steps of diffusion


class View(NamedTuple):
    """One panel of a picture."""

    title: str
    mesh: Mesh
    values: Float[np.ndarray, " vertices"] | None = None  # shown as colours; plain shading without them
    unit: str = ""  # unit of the values, for the colour bar


def displacement(original: Original, moved: Mesh, title: str = "displacement") -> View:
    """Make a heat map of the displacement of each vertex, in percent of the diagonal.

    Raises:
        JaxmarkError: if the connectivity differs from the original's.
    """
    return _map_percent(original, moved, title, np.ones(len(original.used)))


def visibility(
    original: Original, moved: Mesh, title: str = "visibility: displacement over what roughness hides"
) -> View:
    """Make a heat map of displacement, divided by the displacement that roughness masks; see `roughness_masking`.

    A displacement is more visible where the mesh is smooth.

    Raises:
        JaxmarkError: if the connectivity differs from the original's.
    """
    return _map_percent(original, moved, title, original.to_host(roughness_masking(original)))


def _map_percent(original: Original, moved: Mesh, title: str, masked: Float[np.ndarray, " points"]) -> View:
    percent = 100 * np.linalg.norm(shift_of(original, moved), axis=1)
    shown = np.divide(percent, masked, out=np.zeros_like(percent), where=masked > 0)
    return View(title, original.mesh, shown[original.weld.point], "% of diagonal")


def roughness_masking(original: Original) -> Float[Array, " rows"]:
    """Compute the relative displacement that each point masks: roughness^0.15, averaged around it, with RMS 1.

    Rough regions mask displacement that is visible in smooth ones. The model is that of FMPD (Wang, Torkhani,
    Montanvert, "A fast roughness-based approach to the assessment of 3D mesh visual quality", Computers & Graphics
    36(7), 2012): local roughness, clipped to 5e-4 … 0.2, raised to the power 0.15.

    Raises:
        JaxmarkError: if the original is a point cloud.
    """
    check_faces("Masking by roughness", original.points)
    positions = jnp.asarray(original.positions, original.signal.dtype)
    rough = local_roughness(positions, np.asarray(original.points.faces)).roughness
    masked = np.where(original.used, np.clip(np.asarray(rough), MIN_ROUGHNESS, MAX_ROUGHNESS) ** POWER, 0)
    average = diffusion(_AVERAGING_SCALE + 1, 2**_AVERAGING_SCALE + 1)[_AVERAGING_SCALE]
    averaged = jnp.where(original.moving, filter(original.operator, average, original.to_traced(masked)), 0)
    return averaged / jnp.sqrt(jnp.sum(averaged**2) / int(original.used.sum()))


def shading(original: Mesh, moved: Mesh, title: str = "visible turn of normals") -> View:
    """Make a heat map of the turn of normals, divided by the masked turn; see `jaxmark.distortion.visible_turn`.

    Raises:
        JaxmarkError: if the connectivity differs, or a mesh is unusable.
    """
    return View(title, original, shading_at_vertices(original, moved), "just noticeable differences")


def exaggerate(original: Original, moved: Mesh, factor: float = 10) -> View:
    """Multiply the displacement of each vertex by a factor; `moved` has the original's vertices in their order."""
    vertices = original.mesh.vertices + factor * (moved.vertices - original.mesh.vertices)
    return View(f"{factor:g} × the displacement", original.mesh._replace(vertices=vertices))


def draw(views: Sequence[View], *, elevation: float = 15.0, azimuth: float = 25.0) -> Picture:
    """Draw meshes side by side, left to right, shaded, all from one direction, each as large as fits.

    Values are drawn with a colour bar in their unit, from 0.

    Args:
        views: the panels.
        elevation: elevation of the eye above the horizon, in degrees; +y is up.
        azimuth: azimuth of the eye around the vertical, in degrees; 0 looks along -z.

    Raises:
        JaxmarkError: if matplotlib is missing, or a mesh is unusable.
    """
    figure, axes = panels(len(views), 4.2, 4.4)
    turn = rotation(np.radians(elevation), np.radians(azimuth))
    for panel, view in zip(axes, views, strict=True):
        drawn = _paint(panel, view, turn)
        panel.set_title(view.title, fontsize=10)
        if drawn is not None:
            figure.colorbar(drawn, ax=panel, label=view.unit, shrink=0.7)
    return Picture(figure)


def save_views(views: Sequence[View], path: str | os.PathLike[str], **eye: float) -> None:
    """Write the picture of `draw` to a PNG file, atomically; `eye` are keyword arguments of `draw`.

    Raises:
        JaxmarkError: see `draw`; also if the file cannot be written.
    """
    draw(views, **eye).save(path)


def rotation(elevation: float, azimuth: float) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that rotates the direction of the viewer, given in radians, to +z."""
    around = np.array([[np.cos(azimuth), 0, -np.sin(azimuth)], [0, 1, 0], [np.sin(azimuth), 0, np.cos(azimuth)]])
    down = np.array([[1, 0, 0], [0, np.cos(elevation), -np.sin(elevation)], [0, np.sin(elevation), np.cos(elevation)]])
    return down @ around


def _paint(axes, view: View, turn: np.ndarray):
    """Draw a mesh by the painter's algorithm: faces from back to front, lit from above the eye."""
    from matplotlib.collections import PolyCollection

    mesh = host_mesh(view.mesh)
    corners = (np.asarray(mesh.vertices) @ turn.T)[np.asarray(mesh.faces)]
    normals = face_normals(Mesh(mesh.vertices @ turn.T, mesh.faces))
    light = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    # Both sides are lit, because triangle soups and open surfaces have no inside.
    brightness = (0.35 + 0.65 * np.abs(normals @ light))[:, None]
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    mappable, colours = None, brightness * np.array([0.80, 0.80, 0.84])
    if view.values is not None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        values = np.asarray(view.values, np.float64)
        mappable = ScalarMappable(Normalize(0.0, max(float(values.max()), 1e-300)), cmap=FIELD)
        colours = brightness * mappable.to_rgba(values[mesh.faces].mean(axis=1))[:, :3]
    faces = PolyCollection(list(corners[order][:, :, :2]), facecolors=colours[order], edgecolors="face", linewidths=0.2)
    axes.add_collection(faces)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    return mappable
