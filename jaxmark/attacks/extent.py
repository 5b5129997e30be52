"""What strengths of traced attacks are relative to, and displacements of a given size."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.distortion import rms
from jaxmark.mesh import Mesh, used_vertices


def surface(mesh: Mesh) -> Float[Array, "used 3"]:
    """The vertices that faces use."""
    return jnp.asarray(mesh.vertices)[np.flatnonzero(used_vertices(mesh))]


def diagonal(points: Float[Array, "points 3"]) -> Float[Array, ""]:
    """Length of the diagonal of their axis-aligned box."""
    return jnp.linalg.norm(jnp.ptp(points, axis=0))


def displaced(mesh: Mesh, shift: Float[Array, "vertices 3"]) -> Mesh:
    """The vertices that faces use moved, the others left alone."""
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(used_vertices(mesh)[:, None], shift, 0), mesh.faces)


def displaced_by(mesh: Mesh, shift: Float[Array, "vertices 3"], size: float | Float[Array, ""]) -> Mesh:
    """The same, the shift scaled to a root mean square over the vertices that faces use; size is in diagonals."""
    found = rms(shift[np.flatnonzero(used_vertices(mesh))])
    wanted = jnp.asarray(size).astype(shift.dtype) * diagonal(surface(mesh))
    return displaced(mesh, wanted / jnp.where(found > 0, found, 1) * shift)
