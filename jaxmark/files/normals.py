"""Update a file's normals as its positions move, whatever convention made them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.files.source import Numbers

# Where 1 + cos of a rotation's angle is at most this, the minimal rotation is too ill-defined to be used.
_ANTIPARALLEL = 1e-6


def area_vectors(
    points: Float64[np.ndarray, "points 3"], faces: Int64[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "faces 3"]:
    """Normals of faces, as long as twice the face's area."""
    with np.errstate(all="ignore"):  # huge coordinates give infinities, which callers exclude
        first = points[faces[:, 0]]
        return np.cross(points[faces[:, 1]] - first, points[faces[:, 2]] - first)


def unit(vectors: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "rows 3"]:
    """Normalise vectors to length 1; zero becomes NaN."""
    with np.errstate(all="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@dataclass
class Transported:
    """Normals that turn with the faces that use them.

    The mean normal of these faces, weighted by area, turns from its old to its new direction by a minimal rotation; the
    file's normal turns likewise. So smoothing groups, flat normals and any weighting stay what they were, and nothing
    turns where nothing moved.

    Attributes:
        numbers: the normals in the file.
        corners: `[F, 3]`, the index of the normal that each corner of each face uses; -1 for none.
    """

    numbers: Numbers
    corners: Int64[np.ndarray, "faces 3"]

    def _mean(
        self, points: Float64[np.ndarray, "points 3"], faces: Int64[np.ndarray, "faces 3"]
    ) -> Float64[np.ndarray, "rows 3"]:
        """The area-weighted mean normal of the faces that use each normal, each face counted once."""
        vectors = area_vectors(points, faces)
        first, second, third = self.corners.T
        once = np.stack([first >= 0, (second >= 0) & (second != first), (third >= 0) & (third != first)], axis=1)
        once[:, 2] &= third != second
        rows = np.broadcast_to(np.arange(len(faces))[:, None], once.shape)[once]
        entries = self.corners[once]
        count = len(self.numbers.values)
        with np.errstate(all="ignore"):
            sums = [np.bincount(entries, vectors[rows, axis], count).astype(float) for axis in range(3)]
        return unit(np.stack(sums, axis=1))

    def moved(
        self,
        old: Float64[np.ndarray, "points 3"],
        new: Float64[np.ndarray, "points 3"],
        faces: Int64[np.ndarray, "faces 3"],
    ) -> Float64[np.ndarray, "rows 3"]:
        """The turned normals; a normal that no face uses, or only faces without area, stays."""
        if not len(faces):
            return self.numbers.values
        before, after = self._mean(old, faces), self._mean(new, faces)
        normals = self.numbers.values
        with np.errstate(all="ignore"):
            cosine = np.einsum("ij,ij->i", before, after)
            turns = (before != after).any(axis=1) & (1 + cosine > _ANTIPARALLEL) & np.isfinite(normals).all(axis=1)
        a, b, n = before[turns], after[turns], normals[turns]
        axis = np.cross(a, b)  # the axis of the rotation, times the sine of its angle
        along = np.einsum("ij,ij->i", axis, n) / (1 + cosine[turns])
        result = normals.copy()
        result[turns] = n * cosine[turns, None] + np.cross(axis, n) + axis * along[:, None]
        return result


@dataclass
class PerFace:
    """One normal for each face, as in STL files."""

    numbers: Numbers

    def moved(
        self,
        old: Float64[np.ndarray, "points 3"],
        new: Float64[np.ndarray, "points 3"],
        faces: Int64[np.ndarray, "faces 3"],
    ) -> Float64[np.ndarray, "rows 3"]:
        """The unit normals of the faces that moved; a face without area keeps its normal, and so does a zero normal."""
        normals = self.numbers.values
        fresh = unit(area_vectors(new, faces))
        turns = (old != new).any(axis=1)[faces].any(axis=1) & normals.any(axis=1) & np.isfinite(fresh).all(axis=1)
        return np.where(turns[:, None], fresh, normals)
