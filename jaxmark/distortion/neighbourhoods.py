"""Find the edges that lie in balls around vertices and are reached from their centres, on the host.

They are found by a breadth-first search that only goes outward, as in MEPP's metrics; the search depends on the
positions, but traced code computes the share of each edge in its ball (`share_inside`).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.geometry.mesh import edges

# Pairs of a centre and a vertex that one search keeps track of, a byte and an int32 each: what fits into caches.
_MAX_PAIRS_AT_ONCE = 2**22


class Neighbourhoods(NamedTuple):
    """Pieces of edges that run outward in balls around vertices.

    Padding at the end belongs to no vertex. It lets balls of different meshes and radii often have the same shape, so
    that compiled code serves again.
    """

    centre: Int[np.ndarray, "*scales pieces"]  # the ball's centre vertex, ascending; padding is past the last vertex
    tail: Int[np.ndarray, "*scales pieces"]  # vertex inside the ball
    head: Int[np.ndarray, "*scales pieces"]  # vertex inside the ball or beyond
    edge: Int[np.ndarray, "*scales pieces"]  # index into `jaxmark.geometry.mesh.edges`; -1 for a point
    radius: float | np.ndarray | Float[Array, "*scales"]  # radius of the balls, in the units of the positions


def make_neighbourhoods(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    radius: float,
    centres: Int[np.ndarray, " centres"] | None = None,
) -> tuple[Neighbourhoods, Neighbourhoods]:
    """Find the edges in balls around vertices, and the points in them: vertices inside, and where edges leave.

    The balls lie around all vertices unless `centres` are given; their radius is in the units of the positions. A point
    is stored as an edge that ends at it; a vertex as an edge from and to itself.
    """
    pairs = edges(faces)
    tail, head = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.argsort(tail, kind="stable")
    first = np.searchsorted(tail[order], np.arange(len(vertices) + 1))
    graph = _Graph(np.asarray(vertices), first, head[order], np.tile(np.arange(len(pairs)), 2)[order])
    centre = np.arange(len(vertices)) if centres is None else np.sort(centres)
    blocks = np.array_split(centre, max(1, len(centre) * len(vertices) // _MAX_PAIRS_AT_ONCE))
    found, reached = zip(*(_search(graph, block, radius) for block in blocks), strict=True)
    *pieces, inside = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    centre_of, vertex = (np.concatenate(arrays) for arrays in zip(*reached, strict=True))
    within = centre_of, vertex, vertex, np.full(len(vertex), -1)
    points = [np.concatenate([own, leaving[~inside]]) for own, leaving in zip(within, pieces, strict=True)]
    return _sorted(len(vertices), radius, *pieces), _sorted(len(vertices), radius, *points)


class _Graph(NamedTuple):
    """Directed edges, sorted by the vertex that they leave."""

    vertices: np.ndarray  # positions
    first: np.ndarray  # index of each vertex's first directed edge
    head: np.ndarray  # the vertex that each directed edge reaches
    edge: np.ndarray  # index of the undirected edge


def _search(graph: _Graph, centres: np.ndarray, radius: float) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Search breadth-first from several centres at once.

    Returns:
        The edges (centre, tail, head, edge, whether the head is inside), and the vertices inside (centre, vertex).
    """
    vertices, count = graph.vertices, len(graph.vertices)
    row, at = np.arange(len(centres)), centres
    reached = np.zeros(len(centres) * count, bool)
    reached[row * count + at] = True
    # If several edges reach a vertex in one step, the last one that is written here is taken.
    last = np.empty(len(reached), np.int32)
    found, points = [], [(centres, centres)]
    while len(row):
        degree = graph.first[at + 1] - graph.first[at]
        item = np.repeat(np.arange(len(at)), degree)
        place = np.arange(len(item)) + np.repeat(graph.first[at] - (np.cumsum(degree) - degree), degree)
        r, p, q, e = row[item], at[item], graph.head[place], graph.edge[place]
        c = centres[r]
        outward = (p == c) | (np.sum((vertices[q] - vertices[p]) * (vertices[p] - vertices[c]), axis=1) > 0)
        r, c, p, q, e = (array[outward] for array in (r, c, p, q, e))
        inside = np.sum((vertices[q] - vertices[c]) ** 2, axis=1) < radius**2
        found.append((c, p, q, e, inside))
        code = (r * count + q)[inside]
        code = code[~reached[code]]
        last[code] = np.arange(len(code))
        code = code[last[code] == np.arange(len(code))]
        reached[code] = True
        row, at = code // count, code % count
        points.append((centres[row], at))
    return tuple(map(np.concatenate, zip(*found, strict=True))), tuple(map(np.concatenate, zip(*points, strict=True)))


def _sorted(count: int, radius: float, *pieces: np.ndarray) -> Neighbourhoods:
    """Sort pieces by their centres, and pad them to one of four sizes per octave."""
    order = np.argsort(pieces[0], kind="stable")
    step = 1 << max(0, len(order).bit_length() - 3)
    balls = Neighbourhoods(*(array[order].astype(np.int32) for array in pieces), radius=radius)
    return filled(balls, -(-len(order) // step) * step, count)


def filled(balls: Neighbourhoods, pieces: int, count: int) -> Neighbourhoods:
    """Pad neighbourhoods to `pieces` pieces, on a mesh of `count` vertices."""
    fill = zip(balls[:4], (count, 0, 0, -1), strict=True)
    padded = (np.pad(array, (0, pieces - len(array)), constant_values=value) for array, value in fill)
    return Neighbourhoods(*padded, radius=balls.radius)


def share_inside(x: Float[Array, "vertices 3"], pieces: Neighbourhoods) -> Float[Array, " pieces"]:
    """Compute the fraction of each edge inside its ball, 0 to 1, at positions near those of `pieces`."""
    along, out = x[pieces.head] - x[pieces.tail], x[pieces.tail] - x[pieces.centre]
    a, b = jnp.sum(along**2, axis=1), jnp.sum(along * out, axis=1)
    c = jnp.sum(out**2, axis=1) - jnp.asarray(pieces.radius).astype(x.dtype) ** 2
    discriminant = b**2 - a * c
    sound = (a > 0) & (discriminant > 0)
    root = jnp.sqrt(jnp.where(sound, discriminant, 1))
    return jnp.where(sound, jnp.clip((root - b) / jnp.where(sound, a, 1), 0, 1), 1)
