"""Meshes with fewer faces, by edge collapses of least quadric error, on the host."""

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.geometry.mesh import Mesh, compact, diagonal

# Diagonal to which meshes are scaled for fast-simplification. Its thresholds are absolute: in smaller meshes it
# collapses many edges in arbitrary order, in much larger ones too few.
_INPUT_DIAGONAL = 100


def simplify(mesh: Mesh, faces: int) -> Mesh:
    """Collapse edges, those of least quadric error first, until about a number of faces is left.

    The program is fast-simplification, which uses the quadrics of Garland and Heckbert, "Surface simplification using
    quadric error metrics", SIGGRAPH 1997.

    Args:
        mesh: any mesh, concrete.
        faces: the number of faces, positive.

    Raises:
        JaxmarkError: if no face is left, all vertices are at one point, or fast-simplification is missing.
    """
    if faces >= len(mesh.faces):
        return mesh
    simplifier = require("fast_simplification", "attacks").simplify
    vertices, indices = map(np.asarray, compact(mesh))
    centre, length = vertices.mean(axis=0), diagonal(mesh) / _INPUT_DIAGONAL
    points, indices = simplifier((vertices - centre) / length, indices, target_count=faces)
    if len(indices) == 0:
        raise JaxmarkError("fast-simplification left no face of this mesh; ask for a smaller share.")
    return Mesh(centre + length * points, indices.astype(np.int64))
