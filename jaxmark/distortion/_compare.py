"""Compute all metrics of a pair of meshes at once, on the host."""

from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.distortion._shading import Masking, make_masking, shading, vertex_means, visible_turn
from jaxmark.distortion.dihedral import Angles, Hinges, dame_from, make_hinges, weighted_angles
from jaxmark.distortion.geometric import PointPlanes, SurfaceDistance, gl, point_to_plane, stretch, surface_distance
from jaxmark.distortion.norms import maximum, rms, with_dtype
from jaxmark.distortion.rendered import flip, ssim
from jaxmark.distortion.roughness import fmpd, local_roughness
from jaxmark.distortion.structural import Views, curvature_tensor, msdm, msdm2, msdm2_views, msdm_views, tensor_distance
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import (
    Mesh,
    Weld,
    area,
    check_faces,
    check_mesh,
    compact,
    diagonal,
    displacement,
    edges,
    has_area,
    host_mesh,
    same_connectivity,
    used_vertices,
    weld,
    weld_mesh,
)
from jaxmark.spectral.padding import SURFACE_VALENCE, common_edges, common_size, pad_rows
from jaxmark.spectral.threads import in_thread

Metric = str | Callable[[Mesh, Mesh], float]  # a name in `METRICS` or `RENDERED`, or a function: see `measure`


class DisplacementSize(NamedTuple):
    """Size of the displacement of the welded vertices that faces use, over the original's bounding-box diagonal."""

    rms: float  # root mean square, unweighted
    max: float

    @classmethod
    def of(cls, displacement: Float[np.ndarray, "points 3"]) -> "DisplacementSize":
        """Return the size of a displacement of these vertices, given in diagonals."""
        with np.errstate(over="ignore"):  # very large coordinates give an infinite displacement
            return cls(float(rms(displacement)), float(maximum(displacement)))


class Comparison(NamedTuple):
    """Distortions of a mesh, by all metrics; lengths are over the original's bounding-box diagonal.

    A metric is None if it was not requested, if it needs meshes of the same connectivity and these differ in it, or if
    it needs faces and the meshes are point clouds.
    """

    rms: float | None  # displacement of the welded vertices that faces use, root mean square, unweighted
    max: float | None  # the largest displacement of these vertices
    mrms: float | None  # root mean square distance between the surfaces, the larger of both directions
    hausdorff: float | None  # largest distance between the surfaces
    gl: float | None  # change of position and geometric Laplacian (Karni, Gotsman)
    dame: float | None  # mean masked change of dihedral angles, in radians (Váša, Rus)
    fmpd: float | None  # difference of roughness, 0 to 1 (Wang, Torkhani, Montanvert)
    msdm: float | None  # difference of structure, 0 to 1 (Lavoué et al. 2006)
    msdm2: float | None  # difference of structure at three scales, 0 to 1 (Lavoué 2011)
    curvature: float | None  # change of curvature tensors, 0 to 1 (in the manner of Torkhani et al.)
    stretch: float | None  # change of length that 1 % of the edges exceed, over their lengths
    shading: float | None  # visible turn of normals that 1 % of the area exceed, in just noticeable differences
    point_to_plane: float | None  # displacement across the surface that 5 % of the points exceed, over their spacing
    flip: float | None = None  # difference of pictures by FLIP that 1 % of their pixels exceed, 0 to 1; see `RENDERED`
    ssim: float | None = None  # the same by structural similarity, as 1 - SSIM


def displacement_size(original: Mesh, distorted: Mesh) -> DisplacementSize:
    """Measure how far a mesh's vertices were moved.

    Raises:
        JaxmarkError: if the meshes do not share their connectivity, or one is unusable (see `make_mesh`, `diagonal`).
    """
    mesh = host_mesh(original)
    welded, length = weld(mesh.vertices), diagonal(mesh)
    return DisplacementSize.of(displacement(mesh, distorted, welded, length)[used_vertices(weld_mesh(mesh, welded))])


class Reference:
    """An original that any number of meshes are compared with; intermediates that depend on it are computed once."""

    def __init__(self, original: Mesh) -> None:
        """Prepare a mesh with an area, or a point cloud; others are refused, see `compare`."""
        self.given = host_mesh(original)
        self.length, self.welded = diagonal(self.given), weld(self.given.vertices)
        self.centre = np.asarray(self.given.vertices, np.float64)[used_vertices(self.given)].mean(axis=0)
        self.used = used_vertices(weld_mesh(self.given, self.welded))  # mask of the distinct points
        self.mesh = self.at_unit_size(_distinct(self.given, self.welded), "original")
        self.faces = np.asarray(self.mesh.faces)

    def begin(self, metrics: Collection[Metric]) -> None:
        """Begin to compute, in other threads, what some metrics need of the original, if it takes long."""
        if "shading" in metrics and not ("masking" in self._begun or "masking" in self.__dict__):
            hinges = self._begun["hinges"] = in_thread(self._make_hinges)
            # One after the other, because both together would need more memory.
            self._begun["masking"] = in_thread(self._make_masking, after=hinges)

    @cached_property
    def _begun(self) -> dict[str, Future[Any]]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Copy and store a reference without what was begun."""
        return {name: value for name, value in self.__dict__.items() if name != "_begun"}

    def at_unit_size(self, mesh: Mesh, name: str) -> Mesh:
        """Move and scale a mesh as the original is moved and scaled to a diagonal of 1."""
        scaled = mesh._replace(vertices=(np.asarray(mesh.vertices) - self.centre) / self.length)
        if len(scaled.faces) and not has_area(scaled):
            raise JaxmarkError(f"The {name} has an area of {area(scaled):g}; its shape cannot be compared.")
        return scaled

    @cached_property
    def hinges(self) -> Hinges:
        # Other threads trace nothing, so that no tracers are kept.
        return (self._begun.pop("hinges", None) or in_thread(self._make_hinges)).result()

    @cached_property
    def masking(self) -> Masking:
        return (self._begun.pop("masking", None) or in_thread(self._make_masking)).result()

    def _make_hinges(self) -> Hinges:
        """Find the hinges, padded with edges of no length, so that programs compiled for one mesh serve others."""
        found = make_hinges(self.faces)
        count = common_edges(len(found.edges), common_size(len(self.mesh.vertices)), SURFACE_VALENCE)
        return with_dtype(Hinges(*(pad_rows(np.asarray(rows), count) for rows in found)), jnp.float32)

    @cached_property
    def common(self) -> Array:
        """The positions, padded to a size that many meshes share."""
        return in_thread(partial(_common, self.mesh)).result()

    @cached_property
    def angles(self) -> Angles:
        return in_thread(partial(weighted_angles, self.common, self.hinges)).result()

    @cached_property
    def around(self) -> PointPlanes:
        return PointPlanes.of(np.asarray(self.mesh.vertices))

    def _make_masking(self) -> Masking:
        return with_dtype(make_masking(np.asarray(self.mesh.vertices), self.faces).padded(), jnp.float32)

    def measure(self, distorted: Mesh, metrics: Collection[Metric]) -> dict[Metric, float | None]:
        """Measure how far a mesh was distorted from this original; see `measure`."""
        for metric in metrics:
            if isinstance(metric, str) and metric not in _METRICS:
                raise JaxmarkError(f"There is no metric {metric!r}; there are {', '.join(_METRICS)}.")
            if isinstance(metric, str) and metric not in OF_POINTS:
                check_faces(f"The metric {metric!r}", self.given)
        pair = _Pair(self, distorted)
        return {metric: pair.measure(metric) for metric in metrics}


class _Pair:
    """Two meshes at unit size, with the intermediates that several metrics share, computed at first use."""

    def __init__(self, reference: Reference, distorted: Mesh) -> None:
        second = host_mesh(distorted)
        self.reference, self.given = reference, (reference.given, second)
        self.same = same_connectivity(*self.given)
        if self.same:  # points are those that are distinct in the original
            points = Mesh(np.asarray(second.vertices)[reference.welded.first[reference.used]], reference.faces)
        else:
            points = _distinct(second, weld(second.vertices))
        self.meshes = reference.mesh, reference.at_unit_size(points, "distorted mesh")
        self.faces = [np.asarray(mesh.faces) for mesh in self.meshes]
        self.x, self.y = (jax.device_put(np.asarray(mesh.vertices, np.float32)) for mesh in self.meshes)

    def measure(self, metric: Metric) -> float | None:
        if isinstance(metric, str):
            return float(_METRICS[metric](self)) if self.same or metric in _ANY_CONNECTIVITY else None
        name, value = name_of(metric), float(metric(*self.given))
        if not 0 <= value < np.inf:
            raise JaxmarkError(f"The metric {name!r} must be a finite number, not negative, got {value:g}.")
        return value

    @cached_property
    def common(self) -> tuple[Array, Array]:
        return self.reference.common, _common(self.meshes[1])

    @cached_property
    def moved(self) -> DisplacementSize:
        return displacement_size(*self.given)

    def point_to_plane(self) -> float:
        first, second = (np.asarray(mesh.vertices, np.float64) for mesh in self.meshes)
        return point_to_plane(second - first, self.reference.around)

    @cached_property
    def surfaces(self) -> SurfaceDistance:
        return surface_distance(*self.meshes)

    @cached_property
    def views(self) -> Views:
        return msdm2_views(*self.meshes)

    def tensor_distance(self) -> Array:
        largest = jax.tree.map(lambda leaf: leaf[-1], self.views.scales)
        balls = (self.x, largest.original), (self.y, largest.distorted)
        return tensor_distance(*(curvature_tensor(points, self.reference.hinges, ball) for points, ball in balls))


_METRICS: Mapping[str, Callable[[_Pair], float | Array]] = {
    "rms": lambda pair: pair.moved.rms,
    "max": lambda pair: pair.moved.max,
    "mrms": lambda pair: pair.surfaces.mrms,
    "hausdorff": lambda pair: pair.surfaces.hausdorff,
    "gl": lambda pair: gl(pair.x, pair.y, edges(pair.faces[0])),
    "dame": lambda pair: dame_from(pair.reference.angles, pair.common[1], pair.reference.hinges),
    "fmpd": lambda pair: fmpd(local_roughness(pair.x, pair.faces[0]), local_roughness(pair.y, pair.faces[1])),
    "msdm": lambda pair: msdm(pair.x, pair.y, msdm_views(*pair.meshes)),
    "msdm2": lambda pair: msdm2(pair.x, pair.y, pair.views),
    "curvature": _Pair.tensor_distance,
    "stretch": lambda pair: stretch(*pair.common, pair.reference.hinges.edges),
    "shading": lambda pair: shading(*pair.common, pair.reference.masking),
    "point_to_plane": _Pair.point_to_plane,
    "flip": lambda pair: flip(*pair.meshes).high,
    "ssim": lambda pair: ssim(*pair.meshes).high,
}
#: Names of the metrics of rendered pictures; each takes many seconds, so that they are only computed on request.
RENDERED = ("flip", "ssim")
#: Names of the metrics of `compare`; limits of distortion are stated in them, too.
METRICS = tuple(name for name in _METRICS if name not in RENDERED)
#: Names of the metrics that need no faces: those of point clouds.
OF_POINTS = ("rms", "max", "point_to_plane")
#: Names of the metrics of single vertices and edges, which are fast.
LOCAL = ("rms", "max", "gl", "dame", "stretch")
_ANY_CONNECTIVITY = {"mrms", "hausdorff", "fmpd", "msdm2", *RENDERED}


def metrics_of(original: Mesh, distorted: Mesh) -> tuple[str, ...]:
    """Return the names in `METRICS` that apply to two meshes; if one is a point cloud, those in `OF_POINTS`."""
    for mesh in (original, distorted):
        check_mesh(mesh)
    return METRICS if len(original.faces) and len(distorted.faces) else OF_POINTS


def measure(original: Mesh, distorted: Mesh, metrics: Collection[Metric]) -> dict[str, float | None]:
    """Measure how far a mesh was distorted, by metrics by name and by functions of your own.

    Args:
        original: any mesh with an area, or a point cloud.
        distorted: another one.
        metrics: names in `METRICS` or `RENDERED`, for clouds in `OF_POINTS`, or functions from (original, distorted) to
            a number that is 0 for equal meshes and rises with distortion. Functions are called with the meshes as
            given, in float64.

    Returns:
        The value of each metric by its name, of a function by the function's; None if a named one needs meshes of the
        same connectivity and these differ in it.

    Raises:
        JaxmarkError: see `compare`; also if a function's value is not a finite number of at least 0, or two metrics
            have one name.
    """
    names = [name_of(metric) for metric in metrics]
    if twice := [name for name in names if names.count(name) > 1]:
        raise JaxmarkError(f"Two metrics are called {twice[0]!r}; define functions with names of their own.")
    return {name_of(metric): value for metric, value in Reference(original).measure(distorted, metrics).items()}


def name_of(metric: Metric) -> str:
    """Return the name of a metric; for a metric of your own, the name of its function."""
    return metric if isinstance(metric, str) else getattr(metric, "__name__", repr(metric))


def compare(original: Mesh, distorted: Mesh, metrics: Collection[str] | None = None) -> Comparison:
    """Measure how far a mesh was distorted, by named metrics; all of them take seconds for 35,000 vertices.

    Vertices at the same position count as one point; if the connectivity is the same, the original's positions decide
    for both meshes.

    Args:
        original: any mesh with an area, or a point cloud.
        distorted: another one.
        metrics: names in `METRICS` or `RENDERED`, by default all of `METRICS`, for clouds of `OF_POINTS`; the other
            metrics are None.

    Raises:
        JaxmarkError: if there is no such metric, it needs faces and a cloud has none, a mesh has no area or is unusable
            (see `make_mesh`, `diagonal`), or libigl is missing: mrms, hausdorff, msdm2 and curvature need it, and so do
            metrics of pictures, which need the extra `render`.
    """
    found = measure(original, distorted, metrics_of(original, distorted) if metrics is None else metrics)
    return Comparison(*(found.get(name) for name in Comparison._fields))


def shading_at_vertices(original: Mesh, distorted: Mesh) -> Float[np.ndarray, " vertices"]:
    """Compute how visible the turn of normals is around each vertex, in just noticeable differences, for heat maps.

    Values are means of `visible_turn` over the faces around, weighted by area; 0 at vertices without faces.

    Raises:
        JaxmarkError: if the connectivity differs, or see `compare`.
    """
    check_faces("Shading", original)
    reference = Reference(original)
    pair, masking = _Pair(reference, distorted), reference.masking
    if not pair.same:
        raise JaxmarkError("The turn of normals needs two meshes of the same connectivity; these meshes differ in it.")
    points = np.zeros(len(reference.used), np.float32)
    points[reference.used] = vertex_means(visible_turn(pair.x, pair.y, masking), masking, len(pair.x))
    return points[reference.welded.point]


def _common(mesh: Mesh) -> Array:
    """Pad the positions of a mesh to a size that many meshes share."""
    points = np.asarray(mesh.vertices, np.float32)
    return jax.device_put(pad_rows(points, common_size(len(points))))


def _distinct(mesh: Mesh, welded: Weld) -> Mesh:
    """Return the mesh of the distinct points that faces use."""
    return host_mesh(compact(weld_mesh(mesh, welded)))
