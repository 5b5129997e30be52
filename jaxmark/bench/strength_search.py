"""Search for the largest strength of a mark within distortion limits; it is the same for every method."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxmark.bench.method import Bits, Method
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, Weld, diagonal, weld
from jaxmark.geometry.pose import similarity
from jaxmark.watermark.perception.budget import largest_within

_REFUSED = 2.0  # ratio of distortion to limit that is assumed for a strength that the method refuses
_TORN = 1e-9  # largest distance of vertices of one point after embedding, over the diagonal; it allows for rounding
SHARE = 0.95  # least fraction of a limit that a mark must reach; the search then ends, as each trial is an embedding


class Fitted(NamedTuple):
    """A mark as strong as the limits allow."""

    mesh: Mesh
    strength: float  # in the method's own unit
    reached: Mapping[str, float]  # values of the limited metrics
    tries: int  # number of embeddings


def fit(method: Method, mesh: Mesh, message: Bits, key: bytes, limits: Mapping[str, float]) -> Fitted:
    """Embed with the largest strength that is within the distortion limits.

    Each marked mesh is aligned with the original by a similarity before its distortion is measured. Otherwise, a method
    could hide a message in the pose, which the metrics do not count as distortion.

    Args:
        method: the method; its `strengths` bound the search.
        mesh: the original.
        message: the message to embed.
        key: 32 bytes.
        limits: largest values of metrics of `jaxmark.distortion.METRICS`.

    Raises:
        JaxmarkError: if even the weakest mark exceeds the limits, or the method refuses the mesh, changes a
            connectivity that a metric needs, or separates vertices that share a position.
    """
    reference, welded, (weakest, strongest) = Reference(mesh), weld(mesh.vertices), method.strengths
    fitted: list[Fitted] = []
    tries, refusal = 0, ""

    def ratio(strength: float) -> float:
        nonlocal tries, refusal
        if strength < weakest:
            return math.inf  # ends the search
        tries += 1
        try:
            marked = _in_pose_of(mesh, method.embed(mesh, message, key, strength), welded)
        except JaxmarkError as error:  # perhaps the mark is too strong; if not, the weakest one is refused, too
            refusal = str(error)
            return _REFUSED
        reached = {}
        for name, value in reference.measure(marked, limits.keys()).items():
            if value is None:
                raise JaxmarkError(f"The metric {name!r} needs the original's connectivity, which the mark changes.")
            reached[str(name)] = value
        worst = max(reached[name] / limit for name, limit in limits.items())
        if worst <= 1:
            fitted.append(Fitted(marked, strength, reached, tries))
        return worst

    largest_within(ratio, strongest, math.sqrt(weakest * strongest), SHARE)
    # The search may end before the weakest mark is tested, which may be within the limits.
    if not fitted and ratio(weakest) > 1:
        raise JaxmarkError(refusal or f"Even the weakest mark, of strength {weakest:g}, exceeds the limits.")
    return max(fitted, key=lambda mark: mark.strength)._replace(tries=tries)


def _in_pose_of(mesh: Mesh, marked: Mesh, welded: Weld) -> Mesh:
    """Register a marked mesh to its original; refuse it if vertices of one point are no longer at one position."""
    if len(marked.vertices) != len(mesh.vertices):
        return marked  # metrics refuse it
    before, after = (np.asarray(each.vertices, np.float64) for each in (mesh, marked))
    points = after[welded.first]
    if np.abs(points[welded.point] - after).max() > _TORN * diagonal(mesh):
        raise JaxmarkError("The mark tears vertices apart that share a position in the original.")
    return Mesh(similarity(after, before)(points)[welded.point], marked.faces)
