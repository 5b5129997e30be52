"""Filters of MeshLab."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.mesh import Mesh


def filtered(name: str, mesh: Mesh, **options: Any) -> Mesh:
    """What a filter makes of a mesh.

    Args:
        name: of the filter, as pymeshlab has it.
        mesh: of which MeshLab uses all vertices.
        options: of the filter.

    Raises:
        JaxmarkError: if the filter fails or leaves no face, or pymeshlab is missing.
    """
    return _applied(name, options, vertex_matrix=np.asarray(mesh.vertices), face_matrix=np.asarray(mesh.faces))


def filtered_points(
    name: str, points: Float64[np.ndarray, "points 3"], normals: Float64[np.ndarray, "points 3"], **options: Any
) -> Mesh:
    """What a filter makes of points with normals; see `filtered`."""
    return _applied(name, options, vertex_matrix=points, v_normals_matrix=normals)


def _applied(name: str, options: dict[str, Any], **arrays: np.ndarray) -> Mesh:
    meshlab = require("pymeshlab", "attacks")
    filters = meshlab.MeshSet()
    filters.add_mesh(meshlab.Mesh(**arrays))
    try:
        filters.apply_filter(name, **options)
        made = filters.current_mesh()
        points, faces = made.vertex_matrix(), made.face_matrix()
    except Exception as error:  # of whatever type the program has for it
        raise JaxmarkError(
            f"MeshLab could not do this to the mesh ({name}): {' '.join(str(error).split())}."
        ) from error
    if len(faces) == 0:
        raise JaxmarkError(f"MeshLab left no face of this mesh ({name}).")
    return Mesh(points, faces.astype(np.int64))
