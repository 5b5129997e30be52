"""Landmarks: vertices that are known by the connectivity around them, and where they are.

Most copies have the meshing of their original, whatever became of pose, positions and order, and whatever was cut off
or added. Vertices whose surroundings no other vertex has (`jaxmark.geometry.connectivity`) then pair a suspect with its
original, and a similarity fitted to the pairs leaves less on it than on near duplicates of the same meshing. Those of
the least colours are kept of each original, as they are the same in all copies (Broder, "On the resemblance and
containment of documents", 1997).
"""

import numpy as np
from jaxtyping import Float64

from jaxmark.geometry.connectivity import distinct_vertices
from jaxmark.geometry.mesh import Mesh, weld, weld_mesh
from jaxmark.geometry.pose import Points, similarity

LANDMARK = np.dtype([("colour", "<u8"), ("place", "<f8", (3,))])
KEPT = np.dtype([("colour", "<u8"), ("place", "<f4", (3,))])  # in catalogues
MOST = 256  # landmarks that are kept of each original
_RINGS = 2  # of the neighbourhoods: one tells few vertices apart, more are lost where something was cut off
_LEAST, _LEAST_SHARE = 8, 0.2  # pairs by which an original is known; remeshing leaves up to a tenth
_FAR = 0.15  # the most that a distance counts, in an original's mean distances to its centre
_ROUNDS, _KEPT_SHARE = 5, 0.7  # of fits, and of the closest pairs in each
_CANDIDATES = 1000  # originals that a suspect is fitted to, those with the most pairs


def landmarks(mesh: Mesh) -> np.ndarray:
    """Find all landmarks of a mesh, in the order of their colours, as an array of `LANDMARK`."""
    points = weld_mesh(mesh, weld(mesh.vertices))
    vertices, colours = distinct_vertices(points, _RINGS)
    found = np.empty(len(vertices), LANDMARK)
    found["colour"], found["place"] = colours, np.asarray(points.vertices)[vertices]
    return found


def is_whole(data: bytes) -> bool:
    """Whether bytes are landmarks that a catalogue may keep."""
    if len(data) % KEPT.itemsize or len(data) > MOST * KEPT.itemsize:
        return False
    return bool(np.isfinite(np.frombuffer(data, KEPT)["place"]).all())


class LandmarkIndex:
    """The landmarks of many originals, ready for search."""

    def __init__(self, kept: list[np.ndarray]) -> None:
        """Sort the landmarks of each original, arrays of `KEPT` with places in mean distances to its centre."""
        every = np.concatenate(kept) if kept else np.empty(0, KEPT)
        order = np.argsort(every["colour"], kind="stable")
        self._colours, self._places = every["colour"][order], every["place"][order]
        # All landmarks of an original up to its last one's colour are kept.
        self._last = np.array(
            [one["colour"][-1] if len(one) == MOST else np.iinfo(np.uint64).max for one in kept], np.uint64
        )
        self._owner = np.repeat(np.arange(len(kept), dtype=np.int32), [len(one) for one in kept])[order]

    def off(self, seen: np.ndarray) -> dict[int, float]:
        """Find the originals that share landmarks with a suspect, and the mean distance that a similarity leaves.

        Args:
            seen: from `landmarks`, of the suspect.

        Returns:
            Distances by the number of the original, in mean distances to its centre.
        """
        first, end = (np.searchsorted(self._colours, seen["colour"], side) for side in ("left", "right"))
        count = end - first
        suspect = np.repeat(np.arange(len(seen)), count)
        known = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
        order = np.argsort(self._owner[known], kind="stable")
        suspect, known = suspect[order], known[order]
        owners, start, pairs = np.unique(self._owner[known], return_index=True, return_counts=True)
        found: dict[int, float] = {}
        shared = np.searchsorted(seen["colour"], self._last[owners], "right")  # if the meshing were the same
        enough = np.flatnonzero((pairs >= _LEAST) & (pairs >= _LEAST_SHARE * shared))
        for place in enough[np.argsort(-pairs[enough], kind="stable")[:_CANDIDATES]]:
            rows = slice(start[place], start[place] + pairs[place])
            off = _left(seen["place"][suspect[rows]].astype(float), self._places[known[rows]].astype(float))
            agree = np.count_nonzero(off < _FAR)
            if agree >= max(_LEAST, len(off) / 2):
                found[int(owners[place])] = float(np.minimum(off, _FAR).mean())
        return found


def _left(source: Points, target: Points) -> Float64[np.ndarray, " pairs"]:
    """Compute the distances of pairs after the similarity or reflection that fits most of them best."""
    kept = np.arange(len(source))
    off = np.zeros(len(source))
    for _ in range(_ROUNDS):
        off = np.linalg.norm(similarity(source[kept], target[kept], None)(source) - target, axis=1)
        kept = np.argsort(off, kind="stable")[: max(_LEAST, round(_KEPT_SHARE * len(source)))]
    return off
