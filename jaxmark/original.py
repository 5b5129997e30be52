"""An original made ready for filtering, and suspects seen from it. Host side: float64 in, the computing dtype out."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.keys import points_hash
from jaxmark.laplacian import Laplacian, centre
from jaxmark.mesh import Mesh, Weld, diagonal, host_mesh, same_connectivity, used_vertices, weld, welded_mesh
from jaxmark.shapes import common_laplacian, fill


@dataclass(frozen=True, eq=False)
class Original:
    """What embedding and detection need of an original; lengths are in units of its bounding-box diagonal.

    Traced arrays have some rows more than there are points, of isolated vertices: see `jaxmark.shapes`.
    """

    mesh: Mesh  # as in its file
    weld: Weld
    used: Bool[np.ndarray, " points"]  # which points faces use
    diagonal: float  # in the file's units
    geometry: bytes  # hash of the canonical geometry
    operator: Laplacian  # on the welded points, traced
    positions: Float64[np.ndarray, "points 3"]  # welded points, centred as a whole, in diagonals
    signal: Float[Array, "rows 3"]  # the same, centred per component, traced

    @property
    def moving(self) -> Bool[np.ndarray, " rows"]:
        """Which rows of traced arrays are of points that faces use."""
        return fill(self.used, len(self.signal))

    def traced(self, values: Shaped[np.ndarray, " points *columns"]) -> Float[Array, " rows *columns"]:
        """Values of each point for traced code, in its dtype."""
        return jnp.asarray(fill(values, len(self.signal)), self.signal.dtype)

    def on_host(self, values: Float[Array, " rows *columns"]) -> Float64[np.ndarray, " points *columns"]:
        """Values of each point, back from traced code."""
        return np.asarray(values[: len(self.used)], np.float64)


def prepare(mesh: Mesh) -> Original:
    """Weld, hash, centre and scale a mesh, and build its operator.

    Computes in float32, or in float64 where jax has it enabled.

    Raises:
        JaxmarkError: see `make_mesh` and `diagonal`.
    """
    mesh = host_mesh(mesh)
    welded = weld(mesh.vertices)
    points = welded_mesh(mesh, welded)
    length, geometry = diagonal(mesh), points_hash(points)
    operator = common_laplacian(points)
    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    used = used_vertices(points)
    positions = np.asarray(points.vertices, np.float64)
    positions = (positions - positions[used].mean(axis=0)) / length
    positions[~used] = 0
    signal = jnp.asarray(centre(operator, fill(positions, len(operator.degree))), dtype)
    traced = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype if leaf.dtype == np.float64 else None), operator)
    return Original(mesh, welded, used, length, geometry, traced, positions, signal)


def displaced(original: Original, shift: Float64[np.ndarray, "points 3"]) -> Mesh:
    """The original with its welded points moved (in diagonals); copies of a point move together."""
    moved = original.mesh.vertices + original.diagonal * shift[original.weld.point]
    return Mesh(moved, original.mesh.faces)


def residual(original: Original, suspect: Mesh) -> Float64[np.ndarray, "points 3"]:
    """How far a suspect's points lie from the original's; see `displacement`."""
    return displacement(original.mesh, suspect, original.weld, original.diagonal)


def displacement(mesh: Mesh, suspect: Mesh, welded: Weld, length: float) -> Float64[np.ndarray, "points 3"]:
    """How far a suspect's points lie from a mesh's, over `length`; copies of a point are averaged.

    The mesh's weld decides, not the suspect's own positions: quantisation makes vertices coincide. A point that no face
    uses is no part of the surface: wherever it went, it counts as unmoved.

    Raises:
        JaxmarkError: if the suspect does not share the mesh's connectivity, index by index.
    """
    suspect = host_mesh(suspect)
    if not same_connectivity(suspect, mesh):
        raise JaxmarkError(
            f"The suspect ({len(suspect.vertices)} vertices, {len(suspect.faces)} triangles) does not share the"
            f" connectivity of the original ({len(mesh.vertices)} vertices, {len(mesh.faces)} triangles), in the same"
            " vertex and face order, as this comparison needs it."
        )
    difference = (np.asarray(suspect.vertices) - np.asarray(mesh.vertices)) / length
    used = used_vertices(mesh)
    difference[~used] = 0
    count = len(welded.first)
    copies = np.bincount(welded.point[used], minlength=count)
    sums = [np.bincount(welded.point, column, count) for column in difference.T]
    return np.stack(sums, axis=1) / np.maximum(copies, 1)[:, None]
