"""Smoothing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import Laplacian, make_laplacian
from jaxmark.mesh import Mesh, boundary_vertices

# The step of the SMI 2010 benchmark.
_STEP = 0.1
_MOST_STEPS = 100_000


def laplacian_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Move each vertex towards the mean of its neighbours, all at once: v ← v + 0.1 (mean of neighbours - v).

    As in the SMI 2010 benchmark (Wang et al.), boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many steps, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole, negative or too large.
    """
    if not 0 <= strength <= _MOST_STEPS or strength != int(strength):
        raise JaxmarkError(f"Smoothing takes a whole number of steps from 0 to {_MOST_STEPS}, got {strength:g}.")
    vertices = jnp.asarray(mesh.vertices)
    moving = np.ones((len(vertices), 1), bool)
    moving[boundary_vertices(np.asarray(mesh.faces))] = False
    return Mesh(_smooth(make_laplacian(mesh), moving, vertices, int(strength)), mesh.faces)


@partial(jax.jit, static_argnums=3)
def _smooth(operator: Laplacian, moving: Array, vertices: Array, steps: int) -> Array:
    def step(v: Array, _: None) -> tuple[Array, None]:
        return v - jnp.where(moving, _STEP * operator.apply(v), 0), None

    return jax.lax.scan(step, vertices, None, length=steps)[0]
