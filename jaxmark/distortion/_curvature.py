"""Curvature of a mesh, averaged over balls, as MEPP2 computes it for MSDM2.

Reference: Cohen-Steiner, Morvan, "Restricted Delaunay triangulations and normal cycle", SoCG 2003.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.distortion.dihedral import Hinges, dihedral_sine_cosine
from jaxmark.distortion.neighbourhoods import Neighbourhoods, share_inside
from jaxmark.distortion.roots import root


@jax.jit
def curvature_tensor(
    x: Float[Array, "vertices 3"], hinges: Hinges, balls: Neighbourhoods
) -> Float[Array, "vertices 3 3"]:
    """The tensor T = 1/(πr²) Σ β_e/|e| e eᵀ over the pieces e of edges in the ball around each vertex.

    β_e is the dihedral angle. As in MEPP2, whose values are published, it is computed by the inverse sine, and so at
    most π/2 however sharp the edge is, and edges across the direction of the search from the centre do not count.

    Args:
        x: positions.
        hinges: from `make_hinges`.
        balls: edges in balls of radius r, from `make_neighbourhoods`.
    """
    sine, cosine = dihedral_sine_cosine(x, hinges)
    angle = jnp.arctan2(sine, jnp.abs(cosine))
    along = share_inside(x, balls)[:, None] * (x[balls.head] - x[balls.tail])
    square = jnp.sum(along**2, axis=1)
    weight = jnp.where(square > 0, angle[balls.edge] * jax.lax.rsqrt(jnp.where(square > 0, square, 1)), 0)
    products = weight[:, None, None] * along[:, :, None] * along[:, None, :]
    total = jax.ops.segment_sum(products, balls.centre, len(x), indices_are_sorted=True)
    return total / (np.pi * jnp.asarray(balls.radius).astype(x.dtype) ** 2)


@jax.jit
def curvature(tensor: Float[Array, "vertices 3 3"]) -> Float[Array, " vertices"]:
    """(|K_max| + |K_min|)/2, the mean size of the two largest eigenvalues of the tensor by size."""
    sizes = jnp.sort(jnp.abs(_eigenvalues(tensor)), axis=1)
    return (sizes[:, 1] + sizes[:, 2]) / 2


def _eigenvalues(matrix: Float[Array, "matrices 3 3"]) -> Float[Array, "matrices 3"]:
    """Eigenvalues of symmetric matrices, in closed form (Smith, Communications of the ACM 4, 1961).

    LAPACK is avoided, for the determinant, too: on processors, several of its batched calls at once can deadlock.
    """
    mean = jnp.trace(matrix, axis1=1, axis2=2) / 3
    rest = matrix - mean[:, None, None] * jnp.eye(3, dtype=matrix.dtype)
    square = jnp.sum(rest**2, axis=(1, 2)) / 6
    round_ = square <= 0
    size = jnp.sqrt(jnp.where(round_, 1, square))
    first, second, third = jnp.moveaxis(rest / size[:, None, None], 1, 0)
    half = jnp.where(round_, 0, jnp.sum(first * jnp.cross(second, third), axis=1) / 2)
    # The arc cosine's slope at ±1, where two eigenvalues meet, is infinite: stop just before it.
    limit = 1 - 4 * jnp.finfo(matrix.dtype).eps
    angle = jnp.arccos(jnp.clip(half, -limit, limit)) / 3
    turns = angle[:, None] + 2 * np.pi / 3 * jnp.arange(3, dtype=matrix.dtype)
    return mean[:, None] + jnp.where(round_, 0, 2 * size)[:, None] * jnp.cos(turns).astype(matrix.dtype)


@jax.jit
def tensor_distance(
    original: Float[Array, "vertices 3 3"], distorted: Float[Array, "vertices 3 3"]
) -> Float[Array, ""]:
    """Change of curvature in size and direction, 0 to 1: the cubic mean of ‖T - T'‖/(‖T‖ + ‖T'‖ + ε) over vertices.

    This follows TPDM (Torkhani, Wang, Chassery, "A curvature-tensor-based perceptual quality metric for 3D triangular
    meshes", Machine Graphics & Vision 2014) in comparing tensors relative to their size, but has none of its visibility
    weights. ε is 5 % of the mean of the original's ‖T‖.
    """

    def norm(tensor: Array) -> Array:
        return root(jnp.sum(tensor**2, axis=(1, 2)))

    before, after = norm(original), norm(distorted)
    whole = before + after + 0.05 * before.mean()
    sound = whole > 0
    local = jnp.where(sound, norm(distorted - original) / jnp.where(sound, whole, 1), 0)
    return jnp.cbrt(jnp.mean(local**3))
