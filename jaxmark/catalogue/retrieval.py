"""Retrieval of the originals that are most similar to a shape, by an exact search of the whole catalogue."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmark.catalogue import descriptors
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.landmarks import KEPT, LandmarkIndex, is_whole
from jaxmark.errors import JaxmarkError

#: Assumed ratios of a part's area to its original's area. For ratios between these, a ball's radius is wrong by at most
#: a twentieth.
SHARES = tuple(0.8**step for step in range(1, 7))
_BLOCK = 1024  # number of originals that are compared at a time
_KEPT_BALLS = 0.5  # fraction of a part's balls, the most similar ones, that are used; others extend beyond its boundary
_ALIKE = 0.5  # two candidates are of one kind up to this fraction of the median distance to the likeliest candidate


class Near(NamedTuple):
    """An original that is similar to a suspect."""

    shape: int  # number of the mesh
    distance: float  # distance of descriptors; it can be compared for one suspect only


class Index:
    """The descriptors of all meshes in a catalogue, in memory: about 20 kilobytes each."""

    def __init__(self, database: Database) -> None:
        """Read the descriptors.

        Raises:
            JaxmarkError: if there are no descriptors, or they are damaged or have another version.
        """
        self.state = state_of(database)
        count, sizes = self.state[0], (descriptors.WHOLE_SIZE, descriptors.CENTRES * descriptors.LOCAL_SIZE)
        shapes = np.empty(count, np.int64)
        whole, parts = (np.empty((count, size), "<f2") for size in sizes)
        stored: list[np.ndarray] = []
        rows = database.each("SELECT id, described, whole, parts, landmarks FROM shapes ORDER BY id LIMIT ?", count)
        for place, row in enumerate(rows):
            if row["described"] != descriptors.VERSION:
                raise JaxmarkError(
                    "The descriptors of the originals are from another version of jaxmark; add their files again."
                )
            if (len(row["whole"]), len(row["parts"])) != (2 * sizes[0], 2 * sizes[1]):
                raise JaxmarkError(_damage(database, "a descriptor is"))
            if not is_whole(row["landmarks"]):
                raise JaxmarkError(_damage(database, "landmarks are"))
            shapes[place] = row["id"]
            whole[place], parts[place] = np.frombuffer(row["whole"], "<f2"), np.frombuffer(row["parts"], "<f2")
            stored.append(np.frombuffer(row["landmarks"], KEPT))
        if not stored:
            raise JaxmarkError(f"The catalogue {database.path} is empty; add originals first.")
        self.shapes, self._whole, self._parts = (array[: len(stored)] for array in (shapes, whole, parts))
        self._landmarks = LandmarkIndex(stored)

    def by_landmarks(self, seen: np.ndarray) -> list[Near]:
        """Retrieve the originals with the connectivity of a suspect, the best fit first; none if it was remeshed.

        Args:
            seen: the landmarks of the suspect, from `landmarks.landmarks`.
        """
        distances = self._landmarks.off(seen)
        nearest_first = sorted(distances, key=distances.__getitem__)
        return [Near(int(self.shapes[place]), distances[place]) for place in nearest_first]

    def by_whole(self, shape: Float[np.ndarray, " numbers"], count: int) -> list[Near]:
        """Retrieve the originals whose whole shape is most similar, the most similar first.

        Args:
            shape: the descriptor of the suspect, from `descriptors.whole`.
            count: number of originals.
        """
        blocks = range(0, len(self.shapes), _BLOCK)
        distances = [np.abs(self._whole[i : i + _BLOCK].astype(np.float32) - shape).sum(axis=1) for i in blocks]
        return self._nearest(np.concatenate(distances), count)

    def by_parts(self, part: descriptors.Locals, count: int) -> list[Near]:
        """Retrieve the originals that have parts most similar to a given part, the most similar first.

        Each ball of the part is compared with all balls of each original; the distance to the nearest ball is used.
        """
        balls = [part.describe(share) for share in SHARES]
        queries = np.concatenate(balls)
        squares, used = (queries**2).sum(axis=1), max(1, round(_KEPT_BALLS * len(balls[0])))
        distance = np.empty(len(self.shapes), np.float32)
        for start in range(0, len(distance), _BLOCK):
            stored = self._parts[start : start + _BLOCK].astype(np.float32).reshape(-1, descriptors.LOCAL_SIZE)
            square = (stored**2).sum(axis=1) - 2 * queries @ stored.T + squares[:, None]
            nearest = square.reshape(len(SHARES), len(balls[0]), -1, descriptors.CENTRES).min(axis=3)
            best = np.sort(np.sqrt(np.maximum(nearest, 0)), axis=1)[:, :used].mean(axis=1)
            distance[start : start + _BLOCK] = best.min(axis=0)
        return self._nearest(distance, count)

    def like(self, shape: int, count: int) -> list[int]:
        """Retrieve the originals whose whole shape is most similar to that of a given original, itself first."""
        (place,) = np.flatnonzero(self.shapes == shape)
        return [near.shape for near in self.by_whole(self._whole[place].astype(np.float32), count)]

    def unlike(self, near: Sequence[Near], count: int) -> list[Near]:
        """Select some candidates of different shapes: the first candidate of each kind of shape, then others."""
        place = {int(shape): number for number, shape in enumerate(self.shapes)}
        whole = np.stack([self._whole[place[candidate.shape]].astype(np.float32) for candidate in near])
        chosen, distance = [0], np.abs(whole - whole[0]).sum(axis=1)
        limit = _ALIKE * float(np.median(distance))
        while len(chosen) < min(count, len(near)):
            different = np.flatnonzero(distance > limit)
            rest = [number for number in (*different[:1], *range(len(near))) if number not in chosen]
            chosen.append(int(rest[0]))
            distance = np.minimum(distance, np.abs(whole - whole[chosen[-1]]).sum(axis=1))
        return [near[number] for number in chosen]

    def _nearest(self, distance: Float[np.ndarray, " shapes"], count: int) -> list[Near]:
        nearest_first = np.argsort(distance, kind="stable")[:count]
        return [Near(int(self.shapes[place]), float(distance[place])) for place in nearest_first]


def _damage(database: Database, part: str) -> str:
    return (
        f"The catalogue {database.path} is damaged: {part} incomplete; use a backup, or import an export into a new"
        " catalogue."
    )


def state_of(database: Database) -> tuple[int, int]:
    """Return numbers that change when meshes are added or removed: the count of meshes, and the last mesh's number."""
    (row,) = database.rows("SELECT count(*) AS count, coalesce(max(id), 0) AS last FROM shapes")
    return row["count"], row["last"]
