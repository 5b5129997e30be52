"""Prepare an original for embedding and detection, on the host: float64 in, the computing dtype out."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64, Shaped

from jaxmark.geometry.canonical import grid_spacing, rounded
from jaxmark.geometry.mesh import Mesh, Weld, diagonal, displacement, host_mesh, used_vertices
from jaxmark.spectral.laplacian import Laplacian, centre
from jaxmark.spectral.padding import common_laplacian, pad_rows

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Original:
    """An original, prepared for embedding and detection; lengths are in units of its bounding-box diagonal.

    Arrays for traced code are padded with rows of isolated vertices: see `jaxmark.spectral.padding`.
    """

    mesh: Mesh  # the mesh as in its file, which embedding displaces
    grid: float  # spacing of the grid that points are rounded to, in the file's units
    weld: Weld  # the point of each vertex, as vertices at one position are welded
    points: Mesh  # the canonical geometry with which suspects are compared, in the file's units
    used: Bool[np.ndarray, " points"]  # mask of the points that faces use
    diagonal: float  # of the points, in the file's units
    geometry: bytes  # hash of the canonical geometry
    order: bytes  # hash of the file's order of points and faces, see `jaxmark.geometry.canonical.rounded`
    places: Int64[np.ndarray, " points"]  # number of each point among the points that faces use, or -1
    count: int  # number of points that faces use
    in_order: bool  # whether the file has the order in which it was marked, so that vertices can be compared in order
    operator: Laplacian  # the Laplacian of the points, traced
    positions: Float64[np.ndarray, "points 3"]  # points, centred as a whole, in diagonals
    signal: Float[Array, "rows 3"]  # points, centred per connected component, in diagonals, traced

    @property
    def is_whole(self) -> bool:
        """Whether it has exactly the points of the mesh that was marked; an edited copy has not."""
        return self.count == np.count_nonzero(self.used) and bool((self.places[self.used] >= 0).all())

    @property
    def density(self) -> float:
        """The spectral density: the number of eigenvalues below a small λ, over λ and the number of points.

        For meshes, it is the density of a regular triangular grid. For clouds, it is that of points which are joined to
        all points within a disc.
        """
        if len(self.points.faces):
            return math.sqrt(3) / (2 * math.pi)
        return 2 / float(np.mean(np.asarray(self.operator.degree)[: len(self.used)]))

    @property
    def marked_order(self) -> Mesh:
        """The canonical points in the marked order of vertices and faces; if the file has another, in their own order.

        Unlike `mesh`, it does not depend on how a copy of the original was presented, except for `in_order`. Points
        that no face uses, which the hash does not cover, are at the centroid of the others.
        """
        if not self.in_order:
            return self.points
        points = np.array(self.points.vertices)
        points[~self.used] = points[self.used].mean(axis=0)
        return Mesh(points[self.weld.point], self.mesh.faces)

    @cached_property
    def _derived(self) -> dict[Callable[["Original"], Any], Any]:
        return {}

    def derived(self, compute: Callable[["Original"], Result]) -> Result:
        """Return what a function computes from this original alone, on the host; it is called once."""
        if compute not in self._derived:
            self._derived[compute] = compute(self)
        return self._derived[compute]

    @cached_property
    def radius(self) -> float:
        """Mean distance of the points that faces use to their centre, in diagonals."""
        points = self.positions[self.used]
        return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean())

    @property
    def moving(self) -> Bool[np.ndarray, " rows"]:
        """Mask of the rows of traced arrays that belong to points that faces use."""
        return pad_rows(self.used, len(self.signal))

    @property
    def chip_places(self) -> Int64[np.ndarray, " rows"]:
        """The array `places`, padded to the rows of traced arrays."""
        return pad_rows(self.places + 1, len(self.signal)) - 1

    def to_traced(self, values: Shaped[np.ndarray, " points *columns"]) -> Float[Array, " rows *columns"]:
        """Convert values per point to a padded array in the dtype of traced code."""
        # `jnp.asarray` would compile a program for each shape.
        return jax.device_put(pad_rows(values, len(self.signal)).astype(self.signal.dtype))

    def to_host(self, values: Float[Array, " rows *columns"]) -> Float64[np.ndarray, " points *columns"]:
        """Convert an array of traced code back to values per point."""
        # Slicing the array of JAX would compile a program.
        return np.asarray(values)[: len(self.used)].astype(np.float64)


def make_original(mesh: Mesh, grid: float | None = None) -> Original:
    """Round, weld, hash, centre and scale a mesh, and build its Laplacian.

    Traced code then computes in float32, or in float64 if JAX has it enabled.

    Args:
        mesh: any mesh.
        grid: spacing of the grid that points are rounded to, in the mesh's units, a power of two; by default that of
            new marks, see `jaxmark.geometry.canonical`.

    Raises:
        JaxmarkError: see `make_mesh` and `diagonal`.
    """
    mesh = host_mesh(mesh)
    spacing = grid_spacing(diagonal(mesh)) if grid is None else grid
    points, welded, geometry, order = rounded(mesh, spacing)
    length, used = diagonal(points), used_vertices(points)
    operator = common_laplacian(points)
    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    positions = np.asarray(points.vertices, np.float64)
    positions = (positions - positions[used].mean(axis=0)) / length
    positions[~used] = 0
    signal = jax.device_put(centre(operator, pad_rows(positions, len(operator.degree))).astype(dtype))
    return Original(
        mesh=mesh,
        grid=spacing,
        weld=welded,
        points=points,
        used=used,
        diagonal=length,
        geometry=geometry,
        order=order,
        places=np.where(used, np.cumsum(used) - 1, -1),
        count=int(used.sum()),
        in_order=True,
        operator=jax.tree.map(
            lambda x: jax.device_put(x.astype(dtype if x.dtype == np.float64 else x.dtype)), operator
        ),
        positions=positions,
        signal=signal,
    )


def displace(original: Original, shift: Float64[np.ndarray, "points 3"]) -> Mesh:
    """Displace the points of an original by `shift`, in diagonals.

    Vertices that share a point move together; the result is not rounded to the grid.
    """
    moved = original.mesh.vertices + original.diagonal * shift[original.weld.point]
    return Mesh(moved, original.mesh.faces)


def shift_of(original: Original, displaced: Mesh) -> Float64[np.ndarray, "points 3"]:
    """Compute the displacement of each point from its position in the original's file, in diagonals of that mesh.

    Raises:
        JaxmarkError: see `jaxmark.geometry.mesh.displacement`.
    """
    return displacement(original.mesh, displaced, original.weld, diagonal(original.mesh))


def residual(original: Original, suspect: Mesh) -> Float64[np.ndarray, "points 3"]:
    """Compute the displacement of each point from the original's canonical geometry to a suspect, in diagonals.

    Raises:
        JaxmarkError: see `jaxmark.geometry.mesh.displacement`.
    """
    canonical = Mesh(original.points.vertices[original.weld.point], original.mesh.faces)
    return displacement(canonical, suspect, original.weld, original.diagonal)
