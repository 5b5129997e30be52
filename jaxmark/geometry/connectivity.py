"""Recognise vertices by the connectivity around them, whatever became of their order and positions.

Each vertex is coloured by its neighbourhood, ring by ring (colour refinement: Weisfeiler, Leman 1968). A colour that
exactly one vertex of each mesh has matches these two vertices; from such pairs, matches spread face by face. Vertices
that were reordered, cropped, merged into a scene or moved are found; those of a remeshed surface are not.
"""

import numpy as np
from jaxtyping import Int64, UInt64

from jaxmark.geometry.hashing import mix
from jaxmark.geometry.mesh import Mesh, edges, sides, used_vertices

_MIN_RINGS, _MAX_RINGS = 3, 40  # narrower neighbourhoods are alike by chance; wider ones tell no more vertices apart
_MIN_MATCHED_SHARE = 0.2  # share of the smaller mesh that colours must match; up to a tenth match after remeshing
Colours = UInt64[np.ndarray, " vertices"]


def matching_vertices(mesh: Mesh, other: Mesh) -> Int64[np.ndarray, " vertices"]:
    """Match each vertex of a mesh with the vertex of another mesh that has the same surroundings.

    Matches are one to one; there are none at all if only few surroundings are alike. Mirrored faces are not
    recognised.

    Returns:
        For each vertex of `mesh`, the index of the matching vertex of `other`, or -1.
    """
    found = np.full(len(mesh.vertices), -1)
    mine, theirs = _Rings(mesh), _Rings(other)
    for ring in range(1, _MAX_RINGS + 1):
        first, second = mine.grow(), theirs.grow()
        if ring >= _MIN_RINGS:
            unique, unique_there = _unique(first), _unique(second)
            _, i, j = np.intersect1d(first[unique], second[unique_there], assume_unique=True, return_indices=True)
            # A match by a wider neighbourhood replaces one by a narrower.
            found[unique[i]] = unique_there[j]
            if len(i) == 0 or len(i) == len(found):
                break
    found = _one_to_one(found, len(other.vertices))
    if np.sum(found >= 0) < _MIN_MATCHED_SHARE * min(used_vertices(mesh).sum(), used_vertices(other).sum()):
        return np.full_like(found, -1)
    # Only vertices of equal valence match as matches spread, or a few chance matches would flood a regular mesh.
    return _spread(found, mesh, other, mine.valence, theirs.valence)


class _Rings:
    """Colours of a mesh's vertices, by neighbourhoods that grow ring by ring."""

    def __init__(self, mesh: Mesh) -> None:
        pairs, size = edges(mesh.faces), len(mesh.vertices)
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
        self._neighbour, degree = pairs[:, 1], np.bincount(pairs[:, 0], minlength=size)
        self._linked = np.flatnonzero(degree)
        self._start = np.concatenate([[0], np.cumsum(degree[self._linked])[:-1]]).astype(np.int64)
        incident = np.bincount(np.ravel(mesh.faces), minlength=size)
        self.valence = degree + (incident << 20)
        self._colours = mix(self.valence.astype(np.uint64))

    def grow(self) -> Colours:
        """Widen the neighbourhoods by one ring and return their colours."""
        around = np.zeros_like(self._colours)
        if len(self._neighbour):
            around[self._linked] = np.add.reduceat(mix(self._colours)[self._neighbour], self._start)
        self._colours = mix(self._colours * np.uint64(3) + around)
        return self._colours


def _unique(colours: Colours) -> Int64[np.ndarray, " unique"]:
    """Vertices whose colour no other vertex has."""
    _, first, count = np.unique(colours, return_index=True, return_counts=True)
    return first[count == 1]


def _one_to_one(found: Int64[np.ndarray, " vertices"], size: int) -> Int64[np.ndarray, " vertices"]:
    """Drop all matches with a vertex that is matched more than once."""
    taken = np.bincount(found[found >= 0], minlength=size)
    return np.where((found >= 0) & (taken[found] == 1), found, -1)


def _spread(
    found: Int64[np.ndarray, " vertices"],
    mesh: Mesh,
    other: Mesh,
    valence: Int64[np.ndarray, " vertices"],
    valence_there: Int64[np.ndarray, " others"],
) -> Int64[np.ndarray, " vertices"]:
    """Spread matches over faces: where two corners have matches, the third matches the apex of the side between these.

    Directed sides of the other mesh are looked up by a code of their two vertices.
    """
    corners, wanted = sides(mesh.faces)
    sides_there, completes = sides(other.faces)
    codes = sides_there[:, 0] * len(other.vertices) + sides_there[:, 1]
    order = np.argsort(codes, kind="stable")
    codes, completes = codes[order], completes[order]
    # A side that two faces have in the same direction is ambiguous.
    single = np.r_[True, codes[1:] != codes[:-1]] & np.r_[codes[1:] != codes[:-1], True]
    codes, completes = codes[single], completes[single]
    taken = np.zeros(len(other.vertices), bool)
    taken[found[found >= 0]] = True
    while True:
        corners, wanted = corners[found[wanted] < 0], wanted[found[wanted] < 0]
        ready = (found[corners] >= 0).all(axis=1)
        asked = found[corners[ready, 0]] * len(other.vertices) + found[corners[ready, 1]]
        place = np.minimum(np.searchsorted(codes, asked), len(codes) - 1)
        new, match = wanted[ready], completes[place]
        good = (codes[place] == asked) & ~taken[match] & (valence[new] == valence_there[match])
        new, match = new[good], match[good]
        if len(new) == 0:
            return found
        # Keep one match for each vertex, on either side.
        _, first = np.unique(new, return_index=True)
        new, match = new[first], match[first]
        _, first = np.unique(match, return_index=True)
        found[new[first]], taken[match[first]] = match[first], True
