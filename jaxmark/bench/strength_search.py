"""The strength of a mark under limits of distortion, the same search for every method."""

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

_REFUSED = 2.0  # the distortion over the limits that a refused strength counts as
_TORN = 1e-9  # of the diagonal: rounding
SHARE = 0.95  # of the limits that a mark must reach: each further trial is an embedding


class Fitted(NamedTuple):
    """A mark as strong as limits allow."""

    mesh: Mesh
    strength: float  # in the method's own unit
    reached: Mapping[str, float]  # the limited metrics
    tries: int


def fit(method: Method, mesh: Mesh, message: Bits, key: bytes, limits: Mapping[str, float]) -> Fitted:
    """Embed with the largest strength that keeps limits.

    The similarity that fits best is undone: a message in the pose would cost nothing that a metric measures.

    Args:
        method: the method; its `strengths` bound the search.
        mesh: the original.
        message: what is embedded.
        key: 32 bytes.
        limits: the largest values of metrics of `jaxmark.distortion.METRICS`.

    Raises:
        JaxmarkError: if not even the weakest mark keeps the limits, the method changes the connectivity that a metric
            needs, tears copies of a vertex apart, or refuses the mesh.
    """
    reference, welded, (weakest, strongest) = Reference(mesh), weld(mesh.vertices), method.strengths
    fitted: list[Fitted] = []
    tries, refusal = 0, ""

    def ratio(strength: float) -> float:
        nonlocal tries, refusal
        if strength < weakest:
            raise JaxmarkError(refusal or f"Even the weakest mark, of strength {weakest:g}, exceeds the limits.")
        tries += 1
        try:
            marked = _in_pose_of(mesh, method.embed(mesh, message, key, strength), welded)
        except JaxmarkError as error:  # too strong for this mesh, or else the weakest is refused, too
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

    try:
        largest_within(ratio, strongest, math.sqrt(weakest * strongest), SHARE)
    except JaxmarkError:
        # The search stops above a strength that is not within the limits, but the weakest may be.
        if not fitted and ratio(weakest) > 1:
            raise
    return max(fitted, key=lambda one: one.strength)._replace(tries=tries)


def _in_pose_of(mesh: Mesh, marked: Mesh, welded: Weld) -> Mesh:
    """Register a marked mesh to its original; refuse one whose copies of a vertex are no longer at one place."""
    if len(marked.vertices) != len(mesh.vertices):
        return marked  # metrics refuse it
    before, after = (np.asarray(one.vertices, np.float64) for one in (mesh, marked))
    points = after[welded.first]
    if np.abs(points[welded.point] - after).max() > _TORN * diagonal(mesh):
        raise JaxmarkError("The mark tears vertices apart that are copies of one point.")
    return Mesh(similarity(after, before)(points)[welded.point], marked.faces)
