"""Prepare an original for embedding and detection, on the host: float64 in, the computing dtype out."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Shaped

from jaxmark.geometry.hashing import points_hash
from jaxmark.geometry.mesh import Mesh, Weld, diagonal, displacement, host_mesh, used_vertices, weld, weld_mesh
from jaxmark.spectral.laplacian import Laplacian, centre
from jaxmark.spectral.shapes import common_laplacian, pad_rows


@dataclass(frozen=True, eq=False)
class Original:
    """An original as embedding and detection need it; lengths are in units of its bounding-box diagonal.

    Traced arrays are padded with rows of isolated vertices beyond the points: see `jaxmark.spectral.shapes`.
    """

    mesh: Mesh  # as in its file
    weld: Weld
    used: Bool[np.ndarray, " points"]  # mask of the points that faces use
    diagonal: float  # in the file's units
    geometry: bytes  # hash of the canonical geometry
    operator: Laplacian  # the Laplacian of the welded points, traced
    positions: Float64[np.ndarray, "points 3"]  # welded points, centred as a whole, in diagonals
    signal: Float[Array, "rows 3"]  # welded points, centred per connected component, in diagonals, traced

    @property
    def moving(self) -> Bool[np.ndarray, " rows"]:
        """Mask of the rows of traced arrays that belong to points that faces use."""
        return pad_rows(self.used, len(self.signal))

    def to_traced(self, values: Shaped[np.ndarray, " points *columns"]) -> Float[Array, " rows *columns"]:
        """Convert one value per point to a padded array in the dtype of traced code."""
        return jnp.asarray(pad_rows(values, len(self.signal)), self.signal.dtype)

    def to_host(self, values: Float[Array, " rows *columns"]) -> Float64[np.ndarray, " points *columns"]:
        """Convert an array of traced code back to one value per point."""
        return np.asarray(values[: len(self.used)], np.float64)


def make_original(mesh: Mesh) -> Original:
    """Weld, hash, centre and scale a mesh, and build its Laplacian.

    Traced code then computes in float32, or in float64 if JAX has it enabled.

    Raises:
        JaxmarkError: see `make_mesh` and `diagonal`.
    """
    mesh = host_mesh(mesh)
    welded = weld(mesh.vertices)
    points = weld_mesh(mesh, welded)
    length, geometry = diagonal(mesh), points_hash(points)
    operator = common_laplacian(points)
    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    used = used_vertices(points)
    positions = np.asarray(points.vertices, np.float64)
    positions = (positions - positions[used].mean(axis=0)) / length
    positions[~used] = 0
    signal = jnp.asarray(centre(operator, pad_rows(positions, len(operator.degree))), dtype)
    traced = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype if leaf.dtype == np.float64 else None), operator)
    return Original(mesh, welded, used, length, geometry, traced, positions, signal)


def displace(original: Original, shift: Float64[np.ndarray, "points 3"]) -> Mesh:
    """Move the welded points of an original by `shift`, in diagonals; copies of a point move together."""
    moved = original.mesh.vertices + original.diagonal * shift[original.weld.point]
    return Mesh(moved, original.mesh.faces)


def residual(original: Original, suspect: Mesh) -> Float64[np.ndarray, "points 3"]:
    """Displacement of each welded point from the original to a suspect, in diagonals.

    Raises:
        JaxmarkError: see `jaxmark.geometry.mesh.displacement`.
    """
    return displacement(original.mesh, suspect, original.weld, original.diagonal)
