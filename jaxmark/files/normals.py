"""Update a file's normals as its positions move, whatever convention made them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from jaxmark.files.source import Faces, Numbers, Rows
from jaxmark.geometry.mesh import cross_product
from jaxmark.geometry.pose import Points

# Where 1 + cos of a rotation's angle is at most this, the minimal rotation is too ill-defined to be used.
_ANTIPARALLEL = 1e-6


def _area_vectors(points: Points, faces: Faces) -> Float64[np.ndarray, "faces 3"]:
    """Compute normals of faces, as long as twice the face's area."""
    with np.errstate(all="ignore"):  # huge coordinates give infinities, which callers exclude
        first = points[faces[:, 0]]
        return cross_product(points[faces[:, 1]] - first, points[faces[:, 2]] - first)


def _unit(vectors: Rows) -> Rows:
    """Normalise vectors to length 1; zero becomes NaN."""
    with np.errstate(all="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@dataclass
class Transported:
    """Normals that turn with the faces that use them.

    The mean normal of these faces, weighted by area, turns from its old to its new direction by a minimal rotation; the
    file's normal turns by the same one. So smoothing groups, flat normals and any weighting stay as they were, and
    nothing turns where nothing moved.

    Attributes:
        numbers: the normals in the file.
        corners: the index of the normal that each corner of each face uses; -1 for none.
    """

    numbers: Numbers
    corners: Faces

    def _mean(self, points: Points, faces: Faces) -> Rows:
        """Average the normals of the faces that use each normal by area, each face counted once."""
        vectors = _area_vectors(points, faces)
        first, second, third = self.corners.T
        once = np.stack([first >= 0, (second >= 0) & (second != first), (third >= 0) & (third != first)], axis=1)
        once[:, 2] &= third != second
        entries, rows = self.corners[once], np.nonzero(once)[0]
        count = len(self.numbers.values)
        with np.errstate(all="ignore"):
            sums = [np.bincount(entries, vectors[rows, axis], count).astype(float) for axis in range(3)]
        return _unit(np.stack(sums, axis=1))

    def moved(self, old: Points, new: Points, faces: Faces) -> Rows:
        """Turn the normals; a normal that no face uses, or only faces without area, stays."""
        normals = self.numbers.values
        if not len(faces):
            return normals
        before, after = self._mean(old, faces), self._mean(new, faces)
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

    def moved(self, old: Points, new: Points, faces: Faces) -> Rows:
        """Compute the unit normals of the faces that moved; a zero normal stays, and that of a face without area."""
        normals = self.numbers.values
        computed = _unit(_area_vectors(new, faces))
        turns = (old != new).any(axis=1)[faces].any(axis=1) & normals.any(axis=1) & np.isfinite(computed).all(axis=1)
        return np.where(turns[:, None], computed, normals)
