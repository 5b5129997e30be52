"""All metrics of a pair of meshes at once, on the host."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmark.distortion.curvature import curvature_tensor, tensor_distance
from jaxmark.distortion.dihedral import dame, make_hinges
from jaxmark.distortion.displacement import maximum, rms
from jaxmark.distortion.geometric_laplacian import gl
from jaxmark.distortion.msdm import msdm, msdm2, msdm2_views, msdm_views
from jaxmark.distortion.roughness import fmpd, local_roughness
from jaxmark.distortion.surface import surface_distance
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import (
    Mesh,
    Weld,
    area,
    diagonal,
    edges,
    host_mesh,
    make_mesh,
    same_connectivity,
    used_vertices,
    weld,
    welded_mesh,
)
from jaxmark.original import displacement


class Moved(NamedTuple):
    """How far welded vertices that faces use were moved, unweighted, over the original's bounding-box diagonal."""

    rms: float
    max: float


class Comparison(NamedTuple):
    """Distortions of a mesh; None where a metric needs the same connectivity, and it differs.

    Lengths are over the original's bounding-box diagonal.
    """

    rms: float | None  # displacement of the welded vertices that faces use, unweighted
    max: float | None
    mrms: float  # root mean square distance between the surfaces, the larger of both directions
    hausdorff: float  # their largest distance
    gl: float | None  # change of position and geometric Laplacian (Karni, Gotsman)
    dame: float | None  # mean masked change of dihedral angles, in radians (Váša, Rus)
    fmpd: float  # difference of roughness, 0 to 1 (Wang, Torkhani, Montanvert)
    msdm: float | None  # difference of structure, 0 to 1 (Lavoué et al. 2006)
    msdm2: float  # the same at three scales (Lavoué 2011)
    curvature: float | None  # change of curvature tensors, 0 to 1 (in the manner of Torkhani et al.)


def moved(original: Mesh, distorted: Mesh) -> Moved:
    """Measure how far vertices were moved from the original's.

    Raises:
        JaxmarkError: if the meshes do not share their connectivity, or one is unusable (see `make_mesh`, `diagonal`).
    """
    mesh = host_mesh(original)
    welded = weld(mesh.vertices)
    change = displacement(mesh, distorted, welded, diagonal(mesh))[used_vertices(welded_mesh(mesh, welded))]
    with np.errstate(over="ignore"):  # a vertex thrown to the end of the number range is infinitely far
        return Moved(float(rms(change)), float(maximum(change)))


def compare(original: Mesh, distorted: Mesh) -> Comparison:
    """Measure how far a mesh was distorted, by all metrics; seconds for 35,000 vertices.

    Points at the same position count as one; by the original's, where the connectivity is the same.

    Raises:
        JaxmarkError: if a mesh has no area or is unusable (see `make_mesh`, `diagonal`), or libigl is missing.
    """
    first, second = host_mesh(original), host_mesh(distorted)
    same = same_connectivity(first, second)
    length, welded = diagonal(first), weld(first.vertices)
    centre = np.asarray(first.vertices, np.float64).mean(axis=0)
    meshes = [
        _plain(mesh._replace(vertices=(np.asarray(mesh.vertices, np.float64) - centre) / length), points)
        for mesh, points in ((first, welded), (second, welded if same else weld(second.vertices)))
    ]
    for which, mesh in zip(("original", "distorted mesh"), meshes, strict=True):
        if not 0 < area(mesh) < np.inf:
            raise JaxmarkError(f"The {which} has an area of {area(mesh):g}; its shape cannot be compared.")
    x, y = (jnp.asarray(mesh.vertices, jnp.float32) for mesh in meshes)
    faces = [np.asarray(mesh.faces) for mesh in meshes]
    views = msdm2_views(*meshes)
    answer = {
        **dict(zip(("mrms", "hausdorff"), surface_distance(*meshes), strict=True)),
        "fmpd": fmpd(local_roughness(x, faces[0]), local_roughness(y, faces[1])),
        "msdm2": msdm2(x, y, views),
    }
    if same:
        hinges, largest = make_hinges(faces[0]), views.scales[-1]
        tensors = [curvature_tensor(p, hinges, balls) for p, balls in ((x, largest.original), (y, largest.distorted))]
        answer |= moved(original, distorted)._asdict() | {
            "gl": gl(x, y, edges(faces[0])),
            "dame": dame(x, y, hinges),
            "msdm": msdm(x, y, msdm_views(*meshes)),
            "curvature": tensor_distance(tensors[0], tensors[1]),
        }
    return Comparison(*(None if name not in answer else float(answer[name]) for name in Comparison._fields))  # pyright: ignore


def _plain(mesh: Mesh, welded: Weld) -> Mesh:
    """Distinct points that faces use."""
    points = welded_mesh(mesh, welded)
    used = used_vertices(points)
    return make_mesh(np.asarray(points.vertices)[used], (np.cumsum(used) - 1)[np.asarray(points.faces)])
