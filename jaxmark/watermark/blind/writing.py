"""The least displacement that gives anchors their values and leaves a mesh's own pose where it is."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, Int

from jaxmark.geometry.moments import Moments, surface_moments, volume_moments
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.anchors import Anchors, Pieces, look
from jaxmark.watermark.visibility import apply_mask

_RIDGE = 3e-3  # of the mean square of a row: values that contradict each other are met halfway
_POSE_RIDGE = 1e-4  # of the pose's rows, which are scaled to the others' size
_STEPS, _TOLERANCE = 60, 1e-2  # of conjugate gradients


class Shape(NamedTuple):
    """What the values of a mesh are computed from, but its vertices; a pytree."""

    matrix: Float[Array, "3 3"]  # to the mesh's own pose
    shift: Float[Array, " 3"]
    faces: Int[Array | np.ndarray, "faces 3"]
    pieces: Pieces
    anchors: Anchors
    width: Float[Array, ""]  # of the narrow Gaussian
    outwards: Float[Array, ""]  # 1 where normals point outwards, -1 where inwards


@partial(jax.jit, static_argnames="closed")
def measure(
    shape: Shape, vertices: Float[Array, "rows 3"], *, closed: bool
) -> tuple[Float[Array, " anchors"], Float[Array, " nine"]]:
    """Values of the anchors, and the centre and covariance of the mesh, in its own pose as it was."""
    placed = matmul(vertices, shape.matrix.T) + shape.shift
    nowhere = jnp.zeros(shape.anchors.places.shape, vertices.dtype)
    surface = shape.pieces.of(placed)
    surface = surface._replace(normals=surface.normals * shape.outwards)
    values = look(surface, shape.anchors, nowhere, shape.width, jnp.zeros_like(shape.width)).values
    found: Moments = (volume_moments if closed else surface_moments)(placed[shape.faces])
    upper = jnp.triu_indices(3)
    return values, jnp.concatenate([found.centre, found.covariance[upper]])


@partial(jax.jit, static_argnames="closed")
def improve(
    shape: Shape,
    vertices: Float[Array, "rows 3"],
    moved: Float[Array, "rows 3"],
    free: Float[Array, " rows"],
    mask: Float[Array, "rows 3 3"],
    targets: tuple[Float[Array, " anchors"], Float[Array, " nine"]],
    counted: Float[Array, " anchors"],
    *,
    closed: bool,
) -> Float[Array, "rows 3"]:
    """One step of Gauss and Newton towards the least displacement whose values are `targets`.

    Args:
        shape: of the mesh.
        vertices: its vertices where they were.
        moved: their displacement so far.
        free: how far each vertex moves for its part in a value: the inverse of its area.
        mask: of displacements, see `apply_mask`.
        targets: the values, and the pose, to reach.
        counted: 1 for each anchor whose value is to be reached, else 0.
        closed: whether the mesh encloses a volume.
    """
    (values, pose), push = jax.linearize(partial(measure, shape, closed=closed), vertices + moved)
    pull = jax.linear_transpose(push, vertices)

    def rows(of: tuple[Float[Array, " anchors"], Float[Array, " nine"]]) -> Float[Array, "rows 3"]:
        (back,) = pull((counted * of[0], of[1]))
        return apply_mask(mask, free[:, None] * apply_mask(mask, back))

    nine, none = jnp.eye(len(pose), dtype=vertices.dtype), jnp.zeros_like(values)
    # The pose's rows are made as long as the others are on average, by which conjugate gradients converge soon.
    signs = jnp.where(jnp.arange(len(values)) * 7919 % 13 % 2 == 0, 1.0, -1.0).astype(values.dtype)
    energy = jnp.vdot(counted * signs, push(rows((signs, jnp.zeros_like(pose))))[0]) / counted.sum()
    length = jax.vmap(lambda one: jnp.vdot(one, push(rows((none, one)))[1]))(nine)
    factor = jnp.sqrt(energy / length)

    def gram(of: tuple[Float[Array, " anchors"], Float[Array, " nine"]]) -> tuple[Array, Array]:
        there = push(rows((of[0], factor * of[1])))
        return counted * there[0] + _RIDGE * energy * of[0], factor * there[1] + _POSE_RIDGE * energy * of[1]

    before = push(moved)
    wanted = (counted * (targets[0] - values + before[0]), factor * (targets[1] - pose + before[1]))
    found, _ = cg(gram, wanted, tol=_TOLERANCE, maxiter=_STEPS)
    return rows((found[0], factor * found[1]))
