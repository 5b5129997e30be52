"""Recognise vertices by the connectivity around them, independently of their order and positions.

Each vertex is coloured by its neighbourhood, ring by ring (colour refinement: Weisfeiler, Leman 1968). A colour that
exactly one vertex of each mesh has matches these two vertices; from such pairs, matches spread face by face. Vertices
that were reordered, cropped, merged into a scene or moved are found; those of a remeshed surface are not.
"""

import numpy as np
from jaxtyping import Int64, UInt64

from jaxmark.geometry.canonical import mix
from jaxmark.geometry.mesh import Mesh, edges, sides, used_vertices

_MIN_RINGS, _MAX_RINGS = 3, 40  # narrower neighbourhoods are alike by chance; wider ones tell no more vertices apart
_MIN_MATCHED_SHARE = 0.2  # share of the smaller mesh that colours must match; up to a tenth match after remeshing
Colours = UInt64[np.ndarray, " vertices"]


def matching_vertices(mesh: Mesh, other: Mesh) -> Int64[np.ndarray, " vertices"]:
    """Match each vertex of a mesh with the vertex of another mesh that has the same surroundings.

    Matches are one to one; there are none at all if only few surroundings are alike. The faces of the other mesh may
    all be turned round, as programs do that mirror a mesh, so that normals point outwards again.

    Returns:
        For each vertex of `mesh`, the index of the matching vertex of `other`, or -1.
    """
    found = np.full(len(mesh.vertices), -1)
    mine, theirs = Rings(mesh), Rings(other)
    for ring in range(1, _MAX_RINGS + 1):
        first, second = mine.grow(), theirs.grow()
        if ring >= _MIN_RINGS:
            unique, unique_there = _unique(first), _unique(second)
            _, i, j = np.intersect1d(first[unique], second[unique_there], assume_unique=True, return_indices=True)
            # A match by a wider neighbourhood replaces one by a narrower.
            found[unique[i]] = unique_there[j]
            if len(i) == 0 or len(i) == len(found):
                break
    taken = np.bincount(found[found >= 0], minlength=len(other.vertices))
    found = np.where((found >= 0) & (taken[found] == 1), found, -1)  # drop vertices that are matched more than once
    if np.sum(found >= 0) < _MIN_MATCHED_SHARE * min(used_vertices(mesh).sum(), used_vertices(other).sum()):
        return np.full_like(found, -1)
    # Only vertices of equal valence match as matches spread, or a few chance matches would flood a regular mesh.
    apexes, (corners, wanted) = _Apexes(other), sides(mesh.faces)
    as_they_are, turned_round = (
        np.sum((found[wanted] >= 0) & (apexes(found[way]) == found[wanted])) for way in (corners, corners[:, ::-1])
    )
    corners = corners[:, ::-1] if turned_round > as_they_are else corners
    return _spread(found, corners, wanted, apexes, mine.valence, theirs.valence)


def distinct_vertices(mesh: Mesh, rings: int) -> tuple[Int64[np.ndarray, " distinct"], UInt64[np.ndarray, " distinct"]]:
    """Find vertices whose neighbourhood of `rings` rings is unique, and their colours, in the order of these."""
    grown = Rings(mesh)
    colours = np.zeros(len(mesh.vertices), np.uint64)
    for _ in range(rings):
        colours = grown.grow()
    found = _unique(colours)
    found = found[used_vertices(mesh)[found]]
    return found, colours[found]


class Rings:
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

    def least(self, numbers: Int64[np.ndarray, " vertices"]) -> Int64[np.ndarray, " vertices"]:
        """Return the least number of each vertex and its neighbours."""
        found = numbers.copy()
        if len(self._neighbour):
            around = np.minimum.reduceat(numbers[self._neighbour], self._start)
            found[self._linked] = np.minimum(numbers[self._linked], around)
        return found


def _unique(colours: Colours) -> Int64[np.ndarray, " unique"]:
    """Return the vertices whose colour no other vertex has."""
    _, first, count = np.unique(colours, return_index=True, return_counts=True)
    return first[count == 1]


class _Apexes:
    """The corner opposite to each directed side of a mesh, looked up by a code of the side's two vertices."""

    def __init__(self, mesh: Mesh) -> None:
        corners, apex = sides(mesh.faces)
        self._size = len(mesh.vertices)
        codes = corners[:, 0] * self._size + corners[:, 1]
        order = np.argsort(codes, kind="stable")
        codes, apex = codes[order], apex[order]
        # A side that two faces have in the same direction is ambiguous.
        single = np.r_[True, codes[1:] != codes[:-1]] & np.r_[codes[1:] != codes[:-1], True]
        self._codes = np.append(codes[single], np.iinfo(np.int64).max)  # the last is no side's
        self._apex = apex[single]

    def __call__(self, corners: Int64[np.ndarray, "sides 2"]) -> Int64[np.ndarray, " sides"]:
        """Return the apex of each side; -1 if there is none, or an end of the side is -1."""
        apex = np.full(len(corners), -1)
        known = np.flatnonzero((corners >= 0).all(axis=1))
        asked = corners[known, 0] * self._size + corners[known, 1]
        place = np.searchsorted(self._codes, asked)
        there = self._codes[place] == asked
        apex[known[there]] = self._apex[place[there]]
        return apex


def _spread(
    found: Int64[np.ndarray, " vertices"],
    corners: Int64[np.ndarray, "sides 2"],
    wanted: Int64[np.ndarray, " sides"],
    apexes: _Apexes,
    valence: Int64[np.ndarray, " vertices"],
    valence_there: Int64[np.ndarray, " others"],
) -> Int64[np.ndarray, " vertices"]:
    """Spread matches over faces: where two corners have matches, the third matches the apex of the side between these.

    `corners` are the directed sides of the faces, `wanted` the third corner of each, `apexes` those of the other mesh.
    """
    taken = np.zeros(len(valence_there), bool)
    taken[found[found >= 0]] = True
    while True:
        corners, wanted = corners[found[wanted] < 0], wanted[found[wanted] < 0]
        new, match = wanted, apexes(found[corners])
        good = (match >= 0) & ~taken[match] & (valence[new] == valence_there[match])
        new, match = new[good], match[good]
        if len(new) == 0:
            return found
        # Keep one match for each vertex, on either side.
        _, first = np.unique(new, return_index=True)
        new, match = new[first], match[first]
        _, first = np.unique(match, return_index=True)
        found[new[first]], taken[match[first]] = match[first], True
