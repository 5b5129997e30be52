"""Start here: `align` attempts the ways of `by_vertices`, `by_cloud` and `by_surface` in their order, until one works.

They find the displacement of each point of the original; on the host, without the key. An affine attack moves the mark
with the host, so that its map is inverted first, by least squares on the points that agree with it. Points that lie far
off were cut away, replaced or lost, and are masked. Every map may mirror, where that fits better.
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
    original: Original, suspect: Mesh, align: Align = "auto", *, reflections: Sequence[bool] = EITHER
) -> Alignment:
    """Register a suspect to the original, and find the displacement of each point that remains.

    Args:
        original: from `make_original`.
        suspect: any mesh.
        align: `"same"` demands the original's vertices and faces in the same order; `"similarity"` and `"affine"` align
            surfaces, up to such a map; `"auto"` takes the first way that works: vertices by their order, vertices by
            connectivity, surfaces up to a similarity; for point clouds, points by their order, else the nearest ones
            where they are or up to a similarity. Each map may mirror, and faces may be reversed.
        reflections: whether the pose of a surface may be one that does not mirror (False), one that mirrors (True), or
            either; the surface of a shape that is nearly its own mirror image does not tell.

    Raises:
        JaxmarkError: if the suspect does not share the original's connectivity under `"same"`, cannot be aligned (the
            residual is over 1 % of the diagonal, or over 0.5 % where less than half of the original is seen, or less
            than 5 % is seen), or libigl is missing, which surfaces need.
    """
    if align not in get_args(Align):
        raise JaxmarkError(f"A suspect is aligned by {', '.join(get_args(Align))}, not {align!r}.")
    start = time.perf_counter()
    ready = make_suspect(original, suspect)
    found = _attempt(original, ready, align, reflections)
    return found._replace(pose=ready.pose.then(found.pose), seconds=time.perf_counter() - start, align=align)


def _attempt(original: Original, suspect: PreparedSuspect, align: Align, reflections: Sequence[bool]) -> Alignment:
    """Attempt the ways of aligning in their order, until one works."""
    if align == "same":
        return align_in_order(original, suspect.mesh)
    if suspect.is_cloud or len(original.points.faces) == 0:
        in_order = align_cloud_in_order(original, suspect) if align == "auto" else None
        return in_order or align_cloud(original, suspect, align, reflections)
    if align == "auto":
        if suspect.has_order_of(original):
            return align_in_order(original, suspect.mesh)
        if (found := align_by_connectivity(original, suspect)) is not None:
            return found
    return align_surfaces(original, suspect, reflections, by_affine=align == "affine")
