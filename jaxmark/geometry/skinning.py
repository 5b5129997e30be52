"""Skins: the joints of a skeleton that move each vertex, and the removal of a pose by them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy import linalg, sparse

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal

_RIDGE = 1e-12  # weight, relative to a joint's vertices, of the ridge towards the common map of all joints
_MOST_JOINTS = 1024  # most joints of a skin; solving for so many takes seconds and some 300 MB
_MOST_SLOTS = 16  # most joints that move one vertex
_FLAT = 1e-3  # least volume of a unit cube after a pose that can be inverted


class Skinning(NamedTuple):
    """Linear blend skinning: each vertex moves by a weighted mean of the maps of some joints."""

    joints: Int64[np.ndarray, "vertices slots"]  # numbers of the joints that move each vertex; any, with weight 0
    weights: Float64[np.ndarray, "vertices slots"]  # which sum to 1


def unpose(original: Mesh, skin: Skinning, suspect: Mesh) -> Mesh:
    """Remove the pose of a suspect: move it from another pose of the original's skeleton to the original's pose.

    The pose is fitted by least squares: one affine map per joint, so that the original, blended by its weights, comes
    closest to the suspect. Each vertex of the suspect is then moved by the inverse of its blended map. No key is used.
    The fit has twelve parameters per joint; differences between suspect and original that these parameters explain are
    lost.

    Args:
        original: the mesh as in its file, in the bind pose of its skin.
        skin: skin of the original, from `jaxmark.files.load_skin`.
        suspect: a posed mesh with the same vertices in the same order; the result keeps its faces.

    Raises:
        JaxmarkError: if the numbers of vertices differ, there are too many joints, or the pose flattens the surface, so
            that it cannot be inverted.
    """
    start, posed = (np.array(mesh.vertices, np.float64) for mesh in (original, suspect))
    if not len(start) == len(posed) == len(skin.joints):
        raise JaxmarkError(
            "A pose can only be removed if the numbers of vertices are equal, but the original has"
            f" {len(start)}, its skin {len(skin.joints)} and the suspect {len(posed)}."
        )
    slots = skin.joints.shape[1]
    joints, place = np.unique(skin.joints, return_inverse=True)
    place = place.reshape(-1, slots)
    if len(joints) > _MOST_JOINTS:
        raise JaxmarkError(f"The skin has {len(joints)} joints, more than the limit of {_MOST_JOINTS} for a pose.")
    if slots > _MOST_SLOTS:
        raise JaxmarkError(f"The skin has {slots} joints for each vertex, more than the limit of {_MOST_SLOTS}.")
    if not np.isfinite(posed).all():
        count = int((~np.isfinite(posed)).any(axis=1).sum())
        raise JaxmarkError(f"The suspect has {count} vertices whose coordinates are not finite; remove or repair them.")
    unit, centre = diagonal(original), start.mean(axis=0)
    local = np.c_[(start - centre) / unit, np.ones(len(start))]
    whole = np.linalg.lstsq(local, posed, rcond=None)[0]  # the common map of all joints, from which each joint deviates
    rows = np.repeat(np.arange(len(start)), 4 * slots)
    columns = (4 * place[:, :, None] + np.arange(4)).ravel()
    blended = sparse.csc_array(
        ((skin.weights[:, :, None] * local[:, None]).ravel(), (rows, columns)), (len(start), 4 * len(joints))
    )
    ridge = _RIDGE * len(start) / len(joints)
    square = (blended.T @ blended).toarray() + ridge * np.eye(4 * len(joints))
    deviation = linalg.solve(square, blended.T @ (posed - local @ whole), assume_a="gen", overwrite_a=True)
    maps = whole + np.einsum("vs,vsij->vij", skin.weights, deviation.reshape(-1, 4, 3)[place])
    linear = maps[:, :3]
    volume = np.abs(np.linalg.det(linear / max(np.linalg.norm(whole[:3], 2), np.finfo(np.float64).tiny)))
    if (flat := int((volume < _FLAT).sum())) > 0:
        raise JaxmarkError(f"The pose flattens the surface at {flat} vertices, so that it cannot be inverted there.")
    back = np.linalg.solve(linear.transpose(0, 2, 1), (posed - maps[:, 3])[..., None])[..., 0]
    return Mesh(centre + unit * back, suspect.faces)
