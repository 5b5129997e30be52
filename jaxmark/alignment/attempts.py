"""`align`, the entry point: tries registration by vertices, by point clouds and by surfaces, until one works.

Registration finds the displacement of each point of the original. It runs on the host, without the key. An affine
attack moves the mark together with the mesh; therefore the affine map is fitted to the points that agree with it, by
least squares, and inverted first. Points with a large residual were cropped, replaced or lost, and are masked. Every
map may be a reflection, if that fits better.
"""

import time
from collections.abc import Sequence
from typing import get_args

from jaxmark.alignment.by_cloud import align_cloud, align_cloud_in_order
from jaxmark.alignment.by_surface import align_surfaces
from jaxmark.alignment.by_vertices import align_by_connectivity, align_in_order
from jaxmark.alignment.features import EITHER
from jaxmark.alignment.original import Original
from jaxmark.alignment.result import Align, Alignment
from jaxmark.alignment.suspect import PreparedSuspect, make_suspect
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh


def align(
    original: Original,
    suspect: Mesh,
    align: Align = "auto",
    *,
    reflections: Sequence[bool] = EITHER,
    in_parts: bool = True,
) -> Alignment:
    """Register a suspect to the original, and find the displacement of each point that remains.

    Args:
        original: from `make_original`.
        suspect: any mesh.
        align: `"same"` requires the original's vertices and faces in the same order. `"similarity"` and `"affine"`
            align surfaces, up to such a map. `"auto"` takes the first way that works: vertices by their order, vertices
            by connectivity, surfaces up to a similarity. For point clouds, `"auto"` takes points by their order, else
            nearest points, first in the pose of the file, then up to a similarity. Each map may be a reflection, and
            faces may be reversed.
        reflections: whether the pose of a surface may be a rotation (False), a reflection (True), or either. A shape
            that is nearly its own mirror image fits both.
        in_parts: whether a surface may also be a part of the original, or several parts that were moved.

    Raises:
        JaxmarkError: if the suspect does not have the original's connectivity under `"same"`; if it cannot be aligned,
            which means that the residual is over 1 % of the diagonal, or over 0.5 % with a coverage of less than half,
            or the coverage is less than 5 %; or if libigl is missing, which surfaces need.
    """
    if align not in get_args(Align):
        raise JaxmarkError(f"A suspect is aligned by {', '.join(get_args(Align))}, not {align!r}.")
    start = time.perf_counter()
    ready = make_suspect(original, suspect)
    result = _attempt(original, ready, align, reflections, in_parts)
    return result._replace(pose=ready.pose.then(result.pose), seconds=time.perf_counter() - start, align=align)


def _attempt(
    original: Original, suspect: PreparedSuspect, align: Align, reflections: Sequence[bool], in_parts: bool
) -> Alignment:
    """Try the ways of registration one after another, until one works."""
    if align == "same":
        return align_in_order(original, suspect.mesh)
    if suspect.is_cloud or len(original.points.faces) == 0:
        in_order = align_cloud_in_order(original, suspect) if align == "auto" else None
        return in_order or align_cloud(original, suspect, align, reflections)
    if align == "auto":
        if suspect.has_order_of(original):
            return align_in_order(original, suspect.mesh)
        if (by_connectivity := align_by_connectivity(original, suspect)) is not None:
            return by_connectivity
    return align_surfaces(original, suspect, reflections, by_affine=align == "affine", in_parts=in_parts)
