"""Remeshing: nearly the same surface with other vertices and faces; on the host, by other programs.

All raise `JaxmarkError` if the program fails or would leave no face, or if the mesh has no extent.
"""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.attacks.support import check_share, on_host, whole_number
from jaxmark.errors import JaxmarkError, require
from jaxmark.geometry.mesh import Mesh, area, compact, edges, simplify
from jaxmark.geometry.pose import Points
from jaxmark.seeds import Randomness, generator

_SAMPLES_PER_VERTEX = 30
_CELLS_PER_BLOCK = 4  # cells along each side of a block; a coarse grid of blocks shows where the surface may be


@on_host
def simplification(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Collapse edges, those of least quadric error first, until only a share of the faces is left.

    The program is fast-simplification (`jaxmark.geometry.mesh.simplify`). The protocol of SMI 2010 (Wang et al.) has
    the same strengths, but uses the simplifier of CGAL, that of Lindstrom and Turk, "Fast and memory efficient
    polygonal simplification", 1998. The strength is the share of the edges to collapse, in [0, 1). The same share of
    the faces goes with them, rounded to a whole number of faces.
    """
    check_share(strength, "edges to collapse")
    count = len(mesh.faces)
    left = round((1 - strength) * count)
    if left == 0:
        raise JaxmarkError(f"Of {count} faces none would be left; ask for a share of at most {1 - 1 / count:g}.")
    return simplify(mesh, left)


@on_host
def isotropic(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Remesh with edges of about one length and vertices on the surface, by MeshLab.

    The strength is the target length, relative to the mean length of the mesh's edges, in [0.1, 100].
    """
    if not 0.1 <= strength <= 100:
        raise JaxmarkError(f"Remeshing takes an edge length of 0.1 to 100 mean ones, got {strength:g}.")
    mesh = compact(mesh)
    ends = np.asarray(mesh.vertices)[edges(mesh.faces)]
    mean = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())
    length = require("pymeshlab", "attacks").PureValue(strength * mean)
    return apply_filter("meshing_isotropic_explicit_remeshing", mesh, targetlen=length)


@on_host
def iso_surface(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Extract the surface again from a grid of signed distances, by libigl and the marching cubes of scikit-image.

    At holes the winding number decides what is inside. The strength is the number of cells along the longest side of
    the bounding box, a whole number from 4 to 512. The mesh must have an inside.
    """
    whole_number(strength, 4, 512, "A grid takes a whole number of 4 to 512 cells a side")
    measure, mesh = require("skimage.measure", "attacks"), compact(mesh)
    low, extent = np.asarray(mesh.vertices).min(axis=0), np.ptp(mesh.vertices, axis=0)
    cell = float(extent.max()) / strength
    if cell == 0:
        raise JaxmarkError("All vertices of the mesh are at one point; there is no surface to extract.")
    low = low - _CELLS_PER_BLOCK * cell
    mesh = mesh._replace(vertices=(mesh.vertices - low) / cell)  # libigl's winding numbers are in single precision
    coarse = np.ceil(extent / cell / _CELLS_PER_BLOCK).astype(int) + 3
    rough = _signed_distance(mesh, _CELLS_PER_BLOCK * np.argwhere(np.ones(coarse))).reshape(coarse)
    # The distance at the nearest coarse point shows where the surface may be: it changes no faster than the position.
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
def poisson(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Reconstruct the surface from random points with normals, 30 for each vertex, by MeshLab.

    This is the screened Poisson reconstruction of Kazhdan and Hoppe, ACM Transactions on Graphics 32(3), 2013, which
    closes holes. The strength is the depth of the octree, a whole number from 1 to 12.
    """
    import trimesh  # takes long to import

    depth = whole_number(strength, 1, 12, "An octree has a whole depth from 1 to 12")
    mesh = compact(mesh)
    if not area(mesh) > 0:
        raise JaxmarkError("The mesh has no area; there is no surface to reconstruct.")
    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    count = _SAMPLES_PER_VERTEX * len(mesh.vertices)
    points, face = trimesh.sample.sample_surface(surface, count, seed=generator(seed))[:2]
    normals = np.asarray(surface.face_normals)[face]
    name = "generate_surface_reconstruction_screened_poisson"
    # One thread, because several would add up in no fixed order.
    return apply_filter(name, Mesh(np.asarray(points), mesh.faces), normals, depth=depth, threads=1)


def _signed_distance(mesh: Mesh, points: Int64[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Return the signed distance from points to a mesh, negative inside by the winding number."""
    igl = require("igl", "attacks")
    sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return igl.signed_distance(points.astype(np.float64), np.asarray(mesh.vertices), np.asarray(mesh.faces), sign)[0]


def apply_filter(name: str, mesh: Mesh, normals: Points | None = None, **options: Any) -> Mesh:
    """Apply a filter of MeshLab, by its name and options in pymeshlab, to a mesh, or to its vertices with normals."""
    rest = {"face_matrix": np.asarray(mesh.faces)} if normals is None else {"v_normals_matrix": normals}
    meshlab = require("pymeshlab", "attacks")
    filters = meshlab.MeshSet()
    filters.add_mesh(meshlab.Mesh(vertex_matrix=np.asarray(mesh.vertices), **rest))
    try:
        filters.apply_filter(name, **options)
        made = filters.current_mesh()
        points, faces = made.vertex_matrix(), made.face_matrix()
    except Exception as error:  # whatever type pymeshlab raises
        raise JaxmarkError(
            f"MeshLab could not do this to the mesh ({name}): {' '.join(str(error).split())}."
        ) from error
    if len(faces) == 0:
        raise JaxmarkError(f"MeshLab left no face of this mesh ({name}).")
    return Mesh(points, faces.astype(np.int64))
