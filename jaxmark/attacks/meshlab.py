"""Filters of MeshLab, called through pymeshlab."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.geometry.mesh import Mesh


def apply_filter(name: str, mesh: Mesh, **options: Any) -> Mesh:
    """Apply a filter of MeshLab to a mesh.

    Args:
        name: the filter's name in pymeshlab.
        mesh: any mesh; MeshLab uses all of its vertices, also those that no face uses.
        options: the filter's parameters.

    Returns:
        The mesh that the filter makes.

    Raises:
        JaxmarkError: if the filter fails or leaves no face, or pymeshlab is missing.
    """
    return _run_filter(name, options, vertex_matrix=np.asarray(mesh.vertices), face_matrix=np.asarray(mesh.faces))


def apply_filter_to_points(
    name: str, points: Float64[np.ndarray, "points 3"], normals: Float64[np.ndarray, "points 3"], **options: Any
) -> Mesh:
    """Apply a filter of MeshLab to points with normals; see `apply_filter`."""
    return _run_filter(name, options, vertex_matrix=points, v_normals_matrix=normals)


def _run_filter(name: str, options: dict[str, Any], **arrays: np.ndarray) -> Mesh:
    meshlab = require("pymeshlab", "attacks")
    filters = meshlab.MeshSet()
    filters.add_mesh(meshlab.Mesh(**arrays))
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
