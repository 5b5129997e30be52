"""Remeshing: nearly the same surface with other vertices and faces; host side, by other programs."""

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.attacks.host import on_host
from jaxmark.attacks.meshlab import apply_filter, apply_filter_to_points
from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.geometry.mesh import Mesh, area, compact, edges
from jaxmark.seeds import Randomness, generator

_CELL_RANGE = 4, 512  # along the longest side
_DEPTH_RANGE = 1, 12  # of the octree
_SAMPLES_PER_VERTEX = 30
_CELLS_PER_BLOCK = 4  # along each side of a block; a coarse grid of blocks tells where the surface may be


@on_host
def isotropic(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Remesh with edges of about one length and vertices on the surface, by MeshLab.

    Args:
        mesh: any mesh, concrete.
        strength: the target length, relative to the mean length of the mesh's edges, in [0.1, 100].
        key: not used; attacks share one signature.

    Returns:
        A mesh with other vertices and faces.

    Raises:
        JaxmarkError: if the length is out of range, MeshLab fails, or pymeshlab is missing.
    """
    if not 0.1 <= strength <= 100:
        raise JaxmarkError(f"Remeshing takes an edge length of 0.1 to 100 mean ones, got {strength:g}.")
    mesh = compact(mesh)
    ends = np.asarray(mesh.vertices)[edges(mesh.faces)]
    mean = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())
    length = require("pymeshlab", "attacks").PureValue(strength * mean)
    return apply_filter("meshing_isotropic_explicit_remeshing", mesh, targetlen=length)


@on_host
def iso_surface(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Extract the surface again from a grid of signed distances, by libigl and the marching cubes of scikit-image.

    Where holes leave open what is inside, the winding number decides.

    Args:
        mesh: any mesh, concrete.
        strength: cells along the longest side of the bounding box, a whole number from 4 to 512.
        key: not used; attacks share one signature.

    Returns:
        A mesh with other vertices and faces.

    Raises:
        JaxmarkError: if the number of cells is out of range, the mesh has no inside, or libigl or scikit-image is
            missing.
    """
    least, most = _CELL_RANGE
    if not least <= strength <= most or strength != int(strength):
        raise JaxmarkError(f"A grid takes a whole number of {least} to {most} cells a side, got {strength:g}.")
    measure, mesh = require("skimage.measure", "attacks"), compact(mesh)
    low, extent = np.asarray(mesh.vertices).min(axis=0), np.ptp(mesh.vertices, axis=0)
    cell = float(extent.max()) / strength
    if cell == 0:
        raise JaxmarkError("All vertices of the mesh are at one point; there is no surface to extract.")
    low = low - _CELLS_PER_BLOCK * cell
    mesh = mesh._replace(vertices=(mesh.vertices - low) / cell)  # libigl's winding numbers are in single precision
    coarse = np.ceil(extent / cell / _CELLS_PER_BLOCK).astype(int) + 3
    rough = _signed_distance(mesh, _CELLS_PER_BLOCK * np.argwhere(np.ones(coarse))).reshape(coarse)
    # The distance at the nearest coarse point tells where the surface may be: it changes no faster than the position.
    near = [
        (np.arange(_CELLS_PER_BLOCK * (count - 1) + 1) + _CELLS_PER_BLOCK // 2) // _CELLS_PER_BLOCK for count in coarse
    ]
    values = rough[np.ix_(*near)]
    close = np.argwhere(np.abs(values) < 1.5 * _CELLS_PER_BLOCK)
    values[tuple(close.T)] = _signed_distance(mesh, close)
    if not values.min() < 0 < values.max():
        raise JaxmarkError("The mesh has no inside, or none that the grid meets; take more cells, or close its holes.")
    points, faces = measure.marching_cubes(values, 0, gradient_direction="descent")[:2]
    return Mesh(low + cell * points.astype(np.float64), faces.astype(np.int64))


@on_host
def poisson(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Reconstruct the surface from random points with normals, 30 for each vertex, by MeshLab.

    This is the screened Poisson reconstruction of Kazhdan and Hoppe, ACM Transactions on Graphics 32(3), 2013, which
    closes holes.

    Args:
        mesh: any mesh, concrete.
        strength: depth of the octree, a whole number from 1 to 12.
        key: a JAX random key or a NumPy generator, which determines the points.

    Returns:
        A mesh with other vertices and faces.

    Raises:
        JaxmarkError: if the depth is out of range, the mesh has no area, MeshLab fails, or pymeshlab is missing.
    """
    import trimesh  # takes long to import

    least, most = _DEPTH_RANGE
    if not least <= strength <= most or strength != int(strength):
        raise JaxmarkError(f"An octree has a whole depth from {least} to {most}, got {strength:g}.")
    mesh = compact(mesh)
    if not area(mesh) > 0:
        raise JaxmarkError("The mesh has no area; there is no surface to reconstruct.")
    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    points, face = trimesh.sample.sample_surface(
        surface, _SAMPLES_PER_VERTEX * len(mesh.vertices), seed=generator(key)
    )[:2]
    normals = np.asarray(surface.face_normals)[face]
    name = "generate_surface_reconstruction_screened_poisson"
    # One thread, because several would add up in no fixed order.
    return apply_filter_to_points(name, np.asarray(points), normals, depth=int(strength), threads=1)


def _signed_distance(mesh: Mesh, points: Int64[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Signed distance from points to a mesh, negative inside by the winding number."""
    igl = require("igl", "attacks")
    sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return igl.signed_distance(points.astype(np.float64), np.asarray(mesh.vertices), np.asarray(mesh.faces), sign)[0]
