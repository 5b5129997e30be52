"""The lengths that strengths of traced attacks are relative to, and displacements of a given size."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh, used_vertices


def surface(mesh: Mesh) -> Float[Array, "used 3"]:
    """Positions of the vertices that faces use."""
    return jnp.asarray(mesh.vertices)[np.flatnonzero(used_vertices(mesh))]


def diagonal(points: Float[Array, "points 3"]) -> Float[Array, ""]:
    """Length of the diagonal of the points' axis-aligned bounding box."""
    return jnp.linalg.norm(jnp.ptp(points, axis=0))


def displace(mesh: Mesh, shift: Float[Array, "vertices 3"]) -> Mesh:
    """Move the vertices that faces use by a shift; leave the others alone."""
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(used_vertices(mesh)[:, None], shift, 0), mesh.faces)


def displace_by(mesh: Mesh, shift: Float[Array, "vertices 3"], size: float | Float[Array, ""]) -> Mesh:
    """Move as `displace` does, with the shift rescaled to an RMS of `size` diagonals over the vertices that faces use.

    A shift of zero stays zero.
    """
    found = rms(shift[np.flatnonzero(used_vertices(mesh))])
    wanted = jnp.asarray(size).astype(shift.dtype) * diagonal(surface(mesh))
    return displace(mesh, wanted / jnp.where(found > 0, found, 1) * shift)
