"""Which edges lie in balls around vertices, reached from their centres; host side.

Found by breadth-first search that only goes outward, as in MEPP's metrics. What depends on positions within a given
neighbourhood is computed by `jaxmark.distortion.curvature` and `.structure`, in traced code.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmark.mesh import edges


class Neighbourhoods(NamedTuple):
    """Pieces of edges that run outward in a ball around a vertex, for many balls."""

    centre: Int[np.ndarray, " pieces"]  # a vertex, in rising order
    tail: Int[np.ndarray, " pieces"]  # inside of the ball
    head: Int[np.ndarray, " pieces"]  # inside or beyond
    edge: Int[np.ndarray, " pieces"]  # as `jaxmark.mesh.edges`; -1 for a point
    radius: float | Float[Array, ""]


def make_neighbourhoods(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    radius: float,
    centres: Int[np.ndarray, " centres"] | None = None,
) -> tuple[Neighbourhoods, Neighbourhoods]:
    """The edges in the balls around vertices, and the points in them: vertices inside, and where edges leave.

    Args:
        vertices: positions.
        faces: vertex indices.
        radius: of the balls, in the units of the positions.
        centres: around which vertices; all unless given.

    Returns:
        The edges, and the points as edges of which the far end is meant; a vertex is an edge from and to itself.
    """
    count, pairs = len(vertices), edges(faces)
    tail, head = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.argsort(tail, kind="stable")
    tail, head, edge = tail[order], head[order], np.tile(np.arange(len(pairs)), 2)[order]
    first = np.searchsorted(tail, np.arange(count + 1))
    centre = np.arange(count) if centres is None else np.asarray(centres)
    reached, at, found = centre * count + centre, centre, []
    while len(centre):
        degree = first[at + 1] - first[at]
        here = np.repeat(np.arange(len(at)), degree)
        place = np.arange(len(here)) + np.repeat(first[at] - (np.cumsum(degree) - degree), degree)
        c, p, q = centre[here], at[here], head[place]
        outward = (p == c) | (np.sum((vertices[q] - vertices[p]) * (vertices[p] - vertices[c]), axis=1) > 0)
        c, p, q, e = c[outward], p[outward], q[outward], edge[place][outward]
        inside = np.sum((vertices[q] - vertices[c]) ** 2, axis=1) < radius**2
        found.append((c, p, q, e, inside))
        new = np.setdiff1d(c[inside] * count + q[inside], reached)
        reached = np.concatenate([reached, new])
        centre, at = new // count, new % count
    c, p, q, e, inside = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    reached.sort()
    vertices_inside = (reached // count, reached % count, reached % count, np.full(len(reached), -1))
    c0, p0, q0, e0 = (
        np.concatenate([one, other[~inside]]) for one, other in zip(vertices_inside, (c, p, q, e), strict=True)
    )
    return _sorted(c, p, q, e, radius), _sorted(c0, p0, q0, e0, radius)


def _sorted(centre: np.ndarray, tail: np.ndarray, head: np.ndarray, edge: np.ndarray, radius: float) -> Neighbourhoods:
    order = np.argsort(centre, kind="stable")
    c, p, q, e = (array[order].astype(np.int32) for array in (centre, tail, head, edge))
    return Neighbourhoods(c, p, q, e, radius)


def share_inside(x: Float[Array, "vertices 3"], pieces: Neighbourhoods) -> Float[Array, " pieces"]:
    """How much of each edge lies in its ball, 0 to 1, for positions near those of which the neighbourhoods are."""
    along, out = x[pieces.head] - x[pieces.tail], x[pieces.tail] - x[pieces.centre]
    a, b, c = (
        jnp.sum(along**2, axis=1),
        jnp.sum(along * out, axis=1),
        jnp.sum(out**2, axis=1) - pieces.radius**2,
    )
    discriminant = b**2 - a * c
    sound: Bool[Array, " pieces"] = (a > 0) & (discriminant > 0)
    root = jnp.sqrt(jnp.where(sound, discriminant, 1))
    return jnp.where(sound, jnp.clip((root - b) / jnp.where(sound, a, 1), 0, 1), 1)
