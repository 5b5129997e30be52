"""Retrieve the originals that look most like a shape, exactly, among all of a catalogue's."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.catalogue import descriptors
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.landmarks import KEPT, LandmarkIndex, is_whole
from jaxmark.errors import JaxmarkError

#: Shares of an original's area that a part may have; a ball's radius is within a twentieth for those between.
SHARES = tuple(0.8**step for step in range(1, 7))
_BLOCK = 1024  # originals that are compared at a time
_KEPT_BALLS = 0.5  # share of a part's balls, the most similar ones, that count: the others reach beyond its rim
_ALIKE = 0.5  # share of the median distance to the likeliest candidate, up to which two are of one kind


class Near(NamedTuple):
    """An original that looks like a suspect."""

    shape: int
    distance: float  # of descriptors; comparable for one suspect only


class Index:
    """The descriptors of all meshes in a catalogue, in memory: about 20 kilobytes each."""

    def __init__(self, database: Database) -> None:
        """Read the descriptors.

        Raises:
            JaxmarkError: if there are none, they are damaged, or of another version.
        """
        self.state = state_of(database)
        count, sizes = self.state[0], (descriptors.WHOLE_SIZE, descriptors.CENTRES * descriptors.LOCAL_SIZE)
        shapes = np.empty(count, np.int64)
        whole, parts = (np.empty((count, size), "<f2") for size in sizes)
        known: list[np.ndarray] = []
        rows = database.each("SELECT id, described, whole, parts, landmarks FROM shapes ORDER BY id LIMIT ?", count)
        for place, row in enumerate(rows):
            if row["described"] != descriptors.VERSION:
                raise JaxmarkError("The originals were described by another jaxmark; add their files again.")
            if (len(row["whole"]), len(row["parts"])) != (2 * sizes[0], 2 * sizes[1]):
                raise JaxmarkError(f"The catalogue {database.path} is damaged: a descriptor is not whole.")
            if not is_whole(row["landmarks"]):
                raise JaxmarkError(f"The catalogue {database.path} is damaged: landmarks are not whole.")
            shapes[place] = row["id"]
            whole[place], parts[place] = np.frombuffer(row["whole"], "<f2"), np.frombuffer(row["parts"], "<f2")
            known.append(np.frombuffer(row["landmarks"], KEPT))
        if not known:
            raise JaxmarkError(f"The catalogue {database.path} is empty; add originals first.")
        self.shapes, self._whole, self._parts = (array[: len(known)] for array in (shapes, whole, parts))
        self._landmarks = LandmarkIndex(known)

    def by_landmarks(self, seen: np.ndarray) -> list[Near]:
        """Retrieve the originals with the meshing of a suspect, the best fitting first; none if it was remeshed.

        Args:
            seen: from `landmarks.landmarks`.
        """
        off = self._landmarks.off(seen)
        return [Near(int(self.shapes[place]), off[place]) for place in sorted(off, key=off.__getitem__)]

    def by_whole(self, shape: Float[np.ndarray, " numbers"], count: int) -> list[Near]:
        """Retrieve the originals whose whole shape is most similar, the most similar first.

        Args:
            shape: from `descriptors.whole`.
            count: number of originals.
        """
        blocks = range(0, len(self.shapes), _BLOCK)
        off = [np.abs(self._whole[i : i + _BLOCK].astype(np.float32) - shape).sum(axis=1) for i in blocks]
        return self._nearest(np.concatenate(off), count)

    def by_parts(self, part: descriptors.Locals, count: int) -> list[Near]:
        """Retrieve the originals of which a part looks most like this one, the most similar first.

        Each ball about a point of the part is compared with all balls of each original; the nearest one counts.
        """
        balls = [part.describe(share) for share in SHARES]
        sought = np.concatenate(balls)
        squares, kept = (sought**2).sum(axis=1), max(1, round(_KEPT_BALLS * len(balls[0])))
        off = np.empty(len(self.shapes), np.float32)
        for start in range(0, len(off), _BLOCK):
            known = self._parts[start : start + _BLOCK].astype(np.float32).reshape(-1, descriptors.LOCAL_SIZE)
            square = (known**2).sum(axis=1) - 2 * sought @ known.T + squares[:, None]
            nearest = square.reshape(len(SHARES), len(balls[0]), -1, descriptors.CENTRES).min(axis=3)
            best = np.sort(np.sqrt(np.maximum(nearest, 0)), axis=1)[:, :kept].mean(axis=1)
            off[start : start + _BLOCK] = best.min(axis=0)
        return self._nearest(off, count)

    def like(self, shape: int, count: int) -> list[int]:
        """Retrieve the originals whose whole shape is most like that of one of them, itself first."""
        (place,) = np.flatnonzero(self.shapes == shape)
        return [near.shape for near in self.by_whole(self._whole[place].astype(np.float32), count)]

    def unlike(self, near: Sequence[Near], count: int) -> list[Near]:
        """Select some of the originals that look like a suspect, the first of each kind of shape first."""
        place = {int(shape): number for number, shape in enumerate(self.shapes)}
        whole = np.stack([self._whole[place[one.shape]].astype(np.float32) for one in near])
        chosen, apart = [0], np.abs(whole - whole[0]).sum(axis=1)
        alike = _ALIKE * float(np.median(apart))
        while len(chosen) < min(count, len(near)):
            other = np.flatnonzero(apart > alike)
            left = [number for number in (*other[:1], *range(len(near))) if number not in chosen]
            chosen.append(int(left[0]))
            apart = np.minimum(apart, np.abs(whole - whole[chosen[-1]]).sum(axis=1))
        return [near[number] for number in chosen]

    def _nearest(self, off: Float[np.ndarray, " shapes"], count: int) -> list[Near]:
        return [Near(int(self.shapes[place]), float(off[place])) for place in np.argsort(off, kind="stable")[:count]]


def state_of(database: Database) -> tuple[int, int]:
    """Return numbers that change when meshes are added or removed: their count, and that of the last one."""
    (row,) = database.rows("SELECT count(*) AS count, coalesce(max(id), 0) AS last FROM shapes")
    return row["count"], row["last"]
