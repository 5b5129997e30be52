"""Deformation by dragged handles, as in a modelling tool; on the host."""

import numpy as np
from jaxtyping import Float64

from jaxmark.attacks.support import on_host
from jaxmark.errors import JaxmarkError, require
from jaxmark.geometry.mesh import Mesh, compact, component_of, diagonal, face_normals, used_vertices
from jaxmark.geometry.pose import Points
from jaxmark.seeds import Randomness, generator

_HANDLE_SHARE = 0.05  # of the vertices, at either end
_ARAP_STEPS = 50


@on_host
def as_rigid_as_possible(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Drag one end of the mesh sideways while the other is held; the rest follows as rigidly as possible.

    libigl takes 50 steps of Sorkine and Alexa, "As-rigid-as-possible surface modeling", SGP 2007 (with spokes and
    rims), starting from a shear. It fits rotations in single precision, so that some 1e-5 of the diagonal is rounding.
    The ends are the 5 % of the vertices that lie farthest out on either side along the axis of largest spread; which
    end is dragged is random. Connected parts without a vertex at either end stay where they are, and so do vertices
    that only faces without area use. The strength is the length of the drag, in a random direction perpendicular to
    that axis, relative to the diagonal of the bounding box.

    Raises:
        JaxmarkError: if no face has an area, or libigl finds no deformation.
    """
    faces = np.asarray(mesh.faces, np.int64)[face_normals(mesh).any(axis=1)]
    if len(faces) == 0:
        raise JaxmarkError("No face of the mesh has an area; there is no surface to deform.")
    if strength == 0:
        return mesh
    random, vertices = generator(seed), np.array(mesh.vertices, np.float64)
    used = np.flatnonzero(used_vertices(Mesh(vertices, faces)))
    share, axis = _ends(vertices[used], random)
    direction = np.cross(axis, random.normal(size=3))
    shift = strength * diagonal(mesh) * direction / np.linalg.norm(direction)
    part = component_of(Mesh(vertices, faces))
    held = np.isin(part, part[used[(share == 0) | (share == 1)]])
    moving = compact(Mesh(vertices, faces[held[faces[:, 0]]]))
    place, share = used[held[used]], share[held[used]]
    vertices[place] = _relax(moving, vertices[place] + share[:, None] * shift, share)
    return Mesh(vertices, mesh.faces)


def _ends(
    points: Points, random: np.random.Generator
) -> tuple[Float64[np.ndarray, " points"], Float64[np.ndarray, "3"]]:
    """Return the place of each point between the held end, 0, and the dragged end, 1; and the axis between them."""
    spread = points - points.mean(axis=0)
    axis = np.linalg.eigh(spread.T @ spread)[1][:, 2] * random.choice([-1.0, 1.0])
    along = spread @ axis
    order, count = np.argsort(along, kind="stable"), max(1, round(_HANDLE_SHARE * len(points)))
    low, high = along[order[count - 1]], along[order[-count]]
    share = np.clip((along - low) / (high - low), 0, 1) if high > low else np.full(len(points), 0.5)
    share[order[:count]], share[order[-count:]] = 0, 1
    return share, axis


def _relax(mesh: Mesh, start: Points, share: Float64[np.ndarray, " points"]) -> Points:
    """Relax a deformation from initial positions; vertices whose share is 0 or 1 are fixed to theirs."""
    igl = require("igl", "attacks")
    handles, data = np.flatnonzero((share == 0) | (share == 1)), igl.ARAPData()
    data.max_iter = _ARAP_STEPS
    try:
        igl.arap_precomputation(*map(np.asarray, mesh), 3, handles.astype(np.int32), data)
        found = np.asarray(igl.arap_solve(start[handles], data, start))
    except Exception as error:  # whatever type libigl raises
        raise JaxmarkError(f"libigl could not deform the mesh: {error}.") from error
    if not np.isfinite(found).all():
        raise JaxmarkError("libigl could not deform the mesh; remove its nearly degenerate faces.")
    return found
