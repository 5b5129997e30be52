"""Landmarks: vertices that are identified by the connectivity around them, with their positions.

Most copies have the connectivity of their original, even if pose, positions and order have changed, and if parts were
removed or added. Vertices with a unique neighbourhood (`jaxmark.geometry.connectivity`) then correspond in suspect and
original. A similarity is fitted to these pairs; its residual is smaller for the original than for near duplicates with
the same connectivity. The neighbourhood of a vertex is described by a number, its colour. The landmarks of least colour
are stored for each original, because they are the same in all copies (Broder, "On the resemblance and containment of
documents", 1997).
"""

import numpy as np
from jaxtyping import Float64

from jaxmark.geometry.connectivity import distinct_vertices
from jaxmark.geometry.mesh import Mesh, weld, weld_mesh
from jaxmark.geometry.pose import Points, similarity

LANDMARK = np.dtype([("colour", "<u8"), ("place", "<f8", (3,))])
KEPT = np.dtype([("colour", "<u8"), ("place", "<f4", (3,))])  # the same, as stored in catalogues
MOST = 256  # most landmarks that are stored for each original
_RINGS = 2  # rings of a neighbourhood: with one, few vertices are unique; with more, cropping changes too many
_LEAST, _LEAST_SHARE = 8, 0.2  # least number and fraction of common landmarks; remeshing leaves up to a tenth of them
_FAR = 0.15  # larger distances are reduced to this one, in RMS distances of an original to its centre
_ROUNDS, _KEPT_SHARE = 5, 0.7  # rounds of fitting, and fraction of the closest pairs in each
_CANDIDATES = 1000  # originals to which a suspect is fitted, the ones with the most pairs


def landmarks(mesh: Mesh) -> np.ndarray:
    """Find all landmarks of a mesh, in the order of their colours, as an array of `LANDMARK`."""
    points = weld_mesh(mesh, weld(mesh.vertices))
    vertices, colours = distinct_vertices(points, _RINGS)
    result = np.empty(len(vertices), LANDMARK)
    result["colour"], result["place"] = colours, np.asarray(points.vertices)[vertices]
    return result


def is_whole(data: bytes) -> bool:
    """Whether bytes are landmarks as a catalogue stores them."""
    if len(data) % KEPT.itemsize or len(data) > MOST * KEPT.itemsize:
        return False
    return bool(np.isfinite(np.frombuffer(data, KEPT)["place"]).all())


class LandmarkIndex:
    """A search index of the landmarks of many originals."""

    def __init__(self, kept: list[np.ndarray]) -> None:
        """Sort the landmarks of all originals.

        Args:
            kept: an array of `KEPT` for each original, with positions in units of its RMS distance to its centre.
        """
        every = np.concatenate(kept) if kept else np.empty(0, KEPT)
        order = np.argsort(every["colour"], kind="stable")
        self._colours, self._places = every["colour"][order], every["place"][order]
        # An original with fewer than MOST landmarks has stored all of them; otherwise, all up to its last colour.
        self._last = np.array(
            [stored["colour"][-1] if len(stored) == MOST else np.iinfo(np.uint64).max for stored in kept], np.uint64
        )
        self._owner = np.repeat(np.arange(len(kept), dtype=np.int32), [len(stored) for stored in kept])[order]

    def off(self, seen: np.ndarray) -> dict[int, float]:
        """Find the originals that share landmarks with a suspect, and their mean distances after a similarity.

        Args:
            seen: the landmarks of the suspect, from `landmarks`.

        Returns:
            Mean distance of the pairs by the number of the original, in RMS distances to its centre.
        """
        first, end = (np.searchsorted(self._colours, seen["colour"], side) for side in ("left", "right"))
        count = end - first
        suspect = np.repeat(np.arange(len(seen)), count)
        stored = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
        order = np.argsort(self._owner[stored], kind="stable")
        suspect, stored = suspect[order], stored[order]
        owners, start, pairs = np.unique(self._owner[stored], return_index=True, return_counts=True)
        distances: dict[int, float] = {}
        expected = np.searchsorted(seen["colour"], self._last[owners], "right")  # pairs if the connectivity is equal
        enough = np.flatnonzero((pairs >= _LEAST) & (pairs >= _LEAST_SHARE * expected))
        for place in enough[np.argsort(-pairs[enough], kind="stable")[:_CANDIDATES]]:
            rows = slice(start[place], start[place] + pairs[place])
            distance = _residuals(seen["place"][suspect[rows]].astype(float), self._places[stored[rows]].astype(float))
            agree = np.count_nonzero(distance < _FAR)
            if agree >= max(_LEAST, len(distance) / 2):
                distances[int(owners[place])] = float(np.minimum(distance, _FAR).mean())
        return distances


def _residuals(source: Points, target: Points) -> Float64[np.ndarray, " pairs"]:
    """Compute the distances of pairs after a robust fit of a similarity, which may be a reflection."""
    inliers = np.arange(len(source))
    distance = np.zeros(len(source))
    for _ in range(_ROUNDS):
        distance = np.linalg.norm(similarity(source[inliers], target[inliers], None)(source) - target, axis=1)
        inliers = np.argsort(distance, kind="stable")[: max(_LEAST, round(_KEPT_SHARE * len(source)))]
    return distance
