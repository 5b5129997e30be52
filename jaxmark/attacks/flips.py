"""Changes of faces on the same points: edge flips (Sohn et al.), and reordering; on the host."""

import math

import numpy as np
from jaxtyping import Bool, Int64

from jaxmark.attacks.support import check_share, on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, edges, sides, unit, used_vertices
from jaxmark.geometry.pose import Points
from jaxmark.seeds import Randomness, generator

_MIN_HEIGHT_RATIO = 0.01  # height of a new face over its longest side
Pairs = Int64[np.ndarray, "edges 2"]
Quads = Int64[np.ndarray, "edges 4"]
Codes = Int64[np.ndarray, " _"]  # one integer for each pair of vertices


@on_host
def edge_flips(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Replace edges between two faces by the other diagonals of their quadrilaterals.

    An edge is flipped only if exactly two faces of consistent orientation share it, and if neither new face is thin
    (height below 1 % of the longest side) nor turned by 90 degrees or more from the mean of the old faces' unit
    normals. No flip makes an edge that exists or existed before, and no new edge is flipped again. So the numbers of
    vertices, edges and faces stay, no edge gets a third face, and exactly the share of the edges that was asked for is
    replaced. Unchanged faces keep their places. Vertices are not welded: an edge between two copies of a point has no
    second face. The strength is the share of the edges to flip, in [0, 1]; which ones is random.

    Raises:
        JaxmarkError: if fewer edges than that can be flipped.
    """
    check_share(strength, "edges to flip", closed=True)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    random, present = generator(seed), _codes(edges(faces), len(vertices))
    total, made, wanted = len(present), np.zeros(0, np.int64), round(strength * len(present))
    while len(made) < wanted:
        quads, beside = _flippable(vertices, faces, np.concatenate([present, made]), made)
        if len(quads) == 0:
            share = math.floor(1000 * len(made) / total) / 1000
            raise JaxmarkError(
                f"Only {len(made)} of the mesh's {total} edges can be flipped with this seed, not {wanted}; ask for a"
                f" share of at most {share:g}."
            )
        a, b, c, d = quads.T
        new = _codes(quads[:, 2:], len(vertices))
        chosen = _choose_independent(beside, new, len(faces), random)[: wanted - len(made)]
        faces[beside[chosen, 0]] = np.stack([a, d, c], axis=1)[chosen]
        faces[beside[chosen, 1]] = np.stack([d, b, c], axis=1)[chosen]
        made = np.concatenate([made, new[chosen]])
    return Mesh(mesh.vertices, faces)


def _codes(pairs: Pairs, size: int) -> Codes:
    """Return one integer for each pair of vertices, whatever their order in the pair."""
    return pairs.min(axis=1) * size + pairs.max(axis=1)


def _flippable(vertices: Points, faces: np.ndarray, taken: Codes, made: Codes) -> tuple[Quads, Pairs]:
    """Find edges that could be flipped: corners a, b, c, d of the faces abc and bad at each, and these faces."""
    corners, apex = sides(faces)
    (tail, head), code = corners.T, _codes(corners, len(vertices))
    order = np.argsort(code, kind="stable")
    _, first, count = np.unique(code[order], return_index=True, return_counts=True)
    forth, back = order[first[count == 2]], order[first[count == 2] + 1]
    quads = np.stack([tail[forth], head[forth], apex[forth], apex[back]], axis=1)
    beside = np.stack([forth, back], axis=1) % len(faces)
    good = (tail[forth] == head[back]) & ~np.isin(code[forth], made)
    good &= ~np.isin(_codes(quads[:, 2:], len(vertices)), taken)
    good[good] = _stays_smooth(vertices, quads[good])
    return quads[good], beside[good]


def _stays_smooth(vertices: Points, quads: Quads) -> Bool[np.ndarray, " edges"]:
    """Return whether both new faces are neither thin nor turned; a face that names a corner twice has no height."""
    a, b, c, d = vertices[quads.T]
    normal = unit(np.cross(b - a, c - a)) + unit(np.cross(a - b, d - b))
    good = np.ones(len(quads), bool)
    for i, j, k in ((a, d, c), (d, b, c)):
        area = np.cross(j - i, k - i)  # twice the face's, along its normal
        longest = np.max([np.sum(side**2, axis=1) for side in (j - i, k - j, i - k)], axis=0)
        good &= (np.sum(area * normal, axis=1) > 0) & (np.linalg.norm(area, axis=1) > _MIN_HEIGHT_RATIO * longest)
    return good


def _choose_independent(beside: Pairs, new: Codes, size: int, random: np.random.Generator) -> Codes:
    """Choose random edges, no two of which share a face or become the same edge, in random order (Luby, 1986)."""
    rank = random.permutation(len(beside))
    least = np.full(size, len(beside))
    np.minimum.at(least, beside.ravel(), np.repeat(rank, 2))
    chosen = np.flatnonzero((least[beside] == rank[:, None]).all(axis=1))
    chosen = chosen[np.argsort(rank[chosen])]
    return chosen[np.sort(np.unique(new[chosen], return_index=True)[1])]


@on_host
def reordering(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Permute random vertices among themselves, and random faces among themselves; the surface stays.

    Each of these faces also starts at a random corner; its orientation stays. A vertex that no face uses keeps its
    place. The strength is the share of the vertices and of the faces that change places, in [0, 1]; 1 for all of them.
    """
    check_share(strength, "vertices and faces to reorder", closed=True)
    random, faces = generator(seed), np.asarray(mesh.faces, np.int64)
    here, there = _cycle(np.flatnonzero(used_vertices(mesh)), strength, random)
    vertices, place = np.array(mesh.vertices), np.arange(len(mesh.vertices))
    vertices[there], place[here] = vertices[here], there
    faces = place[faces]
    here, there = _cycle(np.arange(len(faces)), strength, random)
    corner = (random.integers(3, size=(len(here), 1)) + np.arange(3)) % 3
    faces[there] = np.take_along_axis(faces[here], corner, axis=1)
    return Mesh(vertices, faces)


def _cycle(
    indices: Int64[np.ndarray, " indices"], share: float, random: np.random.Generator
) -> tuple[Int64[np.ndarray, " chosen"], Int64[np.ndarray, " chosen"]]:
    """Draw a fraction of some indices, and a cyclic permutation of them."""
    chosen = random.permutation(indices)[: round(share * len(indices))]
    return chosen, np.roll(chosen, 1)
