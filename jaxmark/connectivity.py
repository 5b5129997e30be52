"""Vertices recognised by the connectivity around them, whatever became of their order and positions.

Each vertex is coloured by its neighbourhood, ring by ring (colour refinement: Weisfeiler, Leman 1968). A colour that
one vertex has in either mesh names that vertex; from those, matches spread face by face. It finds what was reordered,
cropped, merged into a scene or moved, but not what was remeshed.
"""

import numpy as np
from jaxtyping import Int64, UInt64

from jaxmark.mesh import Mesh, edges, sides, used_vertices

_LEAST, _MOST = 3, 40  # rings: with fewer, chance alike; with more, still not alike
_TRUSTED = 0.2  # share of the smaller mesh that must be alone of its kind; remeshed regular surfaces have up to a tenth
Colours = UInt64[np.ndarray, " vertices"]


def matching_vertices(mesh: Mesh, other: Mesh) -> Int64[np.ndarray, " vertices"]:
    """For each vertex of a mesh, the vertex of the other with the same surroundings, or -1.

    No two vertices get the same one; none gets one if few surroundings are alike. Mirrored faces are not recognised.
    """
    found = np.full(len(mesh.vertices), -1)
    mine, theirs = _Rings(mesh), _Rings(other)
    for ring in range(1, _MOST + 1):
        first, second = mine.grow(), theirs.grow()
        if ring >= _LEAST:
            alone, there = _alone(first), _alone(second)
            _, i, j = np.intersect1d(first[alone], second[there], assume_unique=True, return_indices=True)
            # A wider neighbourhood tells more than a narrower one.
            found[alone[i]] = there[j]
            if len(i) == 0 or len(i) == len(found):
                break
    found = _once(found, len(other.vertices))
    if np.sum(found >= 0) < _TRUSTED * min(used_vertices(mesh).sum(), used_vertices(other).sum()):
        return np.full_like(found, -1)
    # Across vertices of another valence nothing spreads, or a few chance likenesses would flood a regular mesh.
    return _spread(found, mesh, other, mine.valence, theirs.valence)


class _Rings:
    """The colours of a mesh's vertices by ever wider neighbourhoods."""

    def __init__(self, mesh: Mesh) -> None:
        pairs, size = edges(mesh.faces), len(mesh.vertices)
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
        self._neighbour, degree = pairs[:, 1], np.bincount(pairs[:, 0], minlength=size)
        self._some = np.flatnonzero(degree)
        self._start = np.concatenate([[0], np.cumsum(degree[self._some])[:-1]]).astype(np.int64)
        incident = np.bincount(np.ravel(mesh.faces), minlength=size)
        self.valence = degree + (incident << 20)
        self._colours = _mix(self.valence.astype(np.uint64))

    def grow(self) -> Colours:
        """The colours with one ring more."""
        around = np.zeros_like(self._colours)
        if len(self._neighbour):
            around[self._some] = np.add.reduceat(_mix(self._colours)[self._neighbour], self._start)
        self._colours = _mix(self._colours * np.uint64(3) + around)
        return self._colours


def _mix(values: Colours) -> Colours:
    """A 64-bit finaliser (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014)."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _alone(colours: Colours) -> Int64[np.ndarray, " alone"]:
    """Vertices whose colour no other has."""
    _, first, count = np.unique(colours, return_index=True, return_counts=True)
    return first[count == 1]


def _once(found: Int64[np.ndarray, " vertices"], size: int) -> Int64[np.ndarray, " vertices"]:
    """Without the matches that are not one to one."""
    taken = np.bincount(found[found >= 0], minlength=size)
    return np.where((found >= 0) & (taken[found] == 1), found, -1)


def _spread(
    found: Int64[np.ndarray, " vertices"],
    mesh: Mesh,
    other: Mesh,
    valence: Int64[np.ndarray, " vertices"],
    valence_there: Int64[np.ndarray, " others"],
) -> Int64[np.ndarray, " vertices"]:
    """Where two corners of a face have matches, the third matches what completes their face there."""
    corners, wanted = sides(mesh.faces)
    there, completes = sides(other.faces)
    codes = there[:, 0] * len(other.vertices) + there[:, 1]
    order = np.argsort(codes, kind="stable")
    codes, completes = codes[order], completes[order]
    # A side that two faces have in the same direction says nothing.
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
        # One each way.
        _, first = np.unique(new, return_index=True)
        new, match = new[first], match[first]
        _, first = np.unique(match, return_index=True)
        found[new[first]], taken[match[first]] = match[first], True
