"""Smoothing."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import make_laplacian
from jaxmark.mesh import Mesh, boundary_vertices

# The step of the SMI 2010 benchmark.
_STEP = 0.1


def laplacian_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Move each vertex towards the mean of its neighbours, all at once: v ← v + 0.1 (mean of neighbours - v).

    As in the SMI 2010 benchmark (Wang et al.), boundary vertices stay.

    Args:
        mesh: any mesh.
        strength: how many steps, a whole number; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole or negative.
    """
    if strength != int(strength) or strength < 0:
        raise JaxmarkError(f"Smoothing takes a whole number of steps, got {strength}.")
    vertices = jnp.asarray(mesh.vertices)
    operator = make_laplacian(mesh)
    moving = np.ones((len(vertices), 1), bool)
    moving[boundary_vertices(np.asarray(mesh.faces))] = False

    def step(v: jax.Array, _: None) -> tuple[jax.Array, None]:
        return v - jnp.where(moving, _STEP * operator.apply(v), 0), None

    return Mesh(jax.lax.scan(step, vertices, None, length=int(strength))[0], mesh.faces)
