"""Lattices in frames on a surface, as the scheme `rooted` uses them, and the values at their points.

A frame is a place on the surface with three axes; its lattice has the frame's place as the origin. All lengths are in
widths of the narrow Gaussian, see `jaxmark.watermark.blind.anchors`. All functions run on the host.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.padding import common_size, pad_rows
from jaxmark.watermark.blind.anchors import SPACING, Anchors, Patches, alike, anchors_at, cut, patches, slopes
from jaxmark.watermark.blind.landmarks import Border, Landmarks, find_landmarks

RIM = 2.2  # least distance of anchors from a border
CHANGES = 6  # small changes of a frame: turns and shifts
_SCALES = tuple(2 ** (power / 3) for power in (1, 2, 3))  # widths of the Gaussians of landmarks
_MOST = 400  # largest number of landmarks that may be roots
_COARSER = 1.3  # rough values are those of pieces so much larger: they differ by about 0.0015 widths
_NEAR = 0.75  # distance of lattice points from the surface, in spacings, up to which values are measured
_CHUNK = 2048  # places that are measured at once, to limit the memory
_TINY = 1e-12  # area below which there is no surface

_Places = Float64[np.ndarray, "places 3"]


def find_roots(mesh: Mesh) -> Landmarks:
    """Find the landmarks of a surface that may be roots, no more than writer and reader can try: the clearest first.

    Raises:
        JaxmarkError: if the surface is too large.
    """
    return find_landmarks(mesh, _SCALES).clearest(_MOST)


class Frames(NamedTuple):
    """Places on a surface, each with axes."""

    places: Float64[np.ndarray, "frames 3"]
    axes: Float64[np.ndarray, "frames 3 3"]  # the axes as columns, the last one along the normal
    kinds: Int64[np.ndarray, " frames"]  # the kinds of their landmarks

    @classmethod
    def of(cls, landmarks: Landmarks, *, mirrored: bool = False) -> "Frames":
        """Return the frames of landmarks; of the mirror image of the surface, if so asked."""
        axes = landmarks.frames * np.array([1.0, -1.0 if mirrored else 1.0, 1.0])
        return cls(landmarks.places, axes, landmarks.kinds)

    def both_ways(self) -> "Frames":
        """Return the frames, and then the same after half turns about the normals: signs of tangents are arbitrary."""
        turned = self.axes * np.array([-1.0, -1.0, 1.0])
        return Frames(*map(np.concatenate, zip(self, (self.places, turned, self.kinds), strict=True)))

    def pick(self, chosen: Int64[np.ndarray, " chosen"]) -> "Frames":
        """Return some of the frames."""
        return Frames(*(column[chosen] for column in self))

    def moved(self, change: Float64[np.ndarray, "frames changes"]) -> "Frames":
        """Turn and shift each frame by a small change, which is given along its axes."""
        turn, shift = (np.einsum("fdc,fc->fd", self.axes, part) for part in (change[:, :3], change[:, 3:]))
        axes = Rotation.from_rotvec(turn).as_matrix() @ self.axes
        return self._replace(places=self.places + shift, axes=axes)


class Lattices(NamedTuple):
    """The anchors of some frames: the lattice points near the surface."""

    frame: Int64[np.ndarray, " anchors"]  # index of the frame, ascending
    cells: Int64[np.ndarray, "anchors 3"]  # indices of the lattice point
    places: Float64[np.ndarray, "anchors 3"]
    values: Float64[np.ndarray, " anchors"]
    slopes: Float64[np.ndarray, "anchors changes"]  # derivatives of the values with respect to changes of the frame

    @property
    def distances(self) -> Float64[np.ndarray, " anchors"]:
        """Distances of the anchors from their frames' places."""
        return SPACING * np.linalg.norm(self.cells, axis=1)

    def pick(self, chosen: Int64[np.ndarray, " chosen"] | Bool[np.ndarray, " anchors"]) -> "Lattices":
        """Return some of the anchors."""
        return Lattices(*(column[chosen] for column in self))


class CutSurface:
    """A surface that is prepared for measuring the values of lattices; its mesh is in widths."""

    def __init__(self, mesh: Mesh) -> None:
        """Cut the surface into pieces.

        Raises:
            JaxmarkError: if it is too large.
        """
        vertices = jnp.asarray(mesh.vertices, jnp.result_type(float))
        self.pieces, rough = (alike([cut(mesh, width)])[0] for width in (1.0, _COARSER))
        self.patches, self._rough = patches(self.pieces, vertices), patches(rough, vertices)
        area = np.asarray(self.patches.area, np.float64)
        self.area = float(area.sum())
        self.points = np.asarray(self.patches.points, np.float64)[area > _TINY]
        self._tree = KDTree(self.points)
        self._border = Border(mesh)

    def lattices(self, frames: Frames, radius: float, *, rough: bool = False, inside_out: bool = False) -> Lattices:
        """Measure the lattices of frames up to a distance from each; with the sign for outward faces."""
        cells = _cells(radius)
        places = (frames.places[:, None] + SPACING * np.einsum("gc,fdc->fgd", cells, frames.axes)).reshape(-1, 3)
        distance, _ = self._tree.query(places, distance_upper_bound=_NEAR * SPACING, workers=-1)
        near = np.flatnonzero(np.isfinite(distance))
        near = near[self._border.spares(places[near], RIM)]
        values, motion, good = self._measure(self._rough if rough else self.patches, places[near])
        near, sign = near[good], -1 if inside_out else 1
        values, motion = sign * values[good], sign * motion[good]
        frame = near // len(cells)
        turns = np.cross(places[near] - frames.places[frame], motion)
        along_axes = [np.einsum("ad,adc->ac", change, frames.axes[frame]) for change in (turns, motion)]
        return Lattices(frame, cells[near % len(cells)], places[near], values, np.concatenate(along_axes, axis=1))

    def _measure(
        self, surface: Patches, places: _Places
    ) -> tuple[Float64[np.ndarray, " places"], _Places, Bool[np.ndarray, " places"]]:
        """Measure the values at places, and their derivatives as the places move, and whether they are good."""
        values, motion, good = np.zeros(len(places)), np.zeros((len(places), 3)), np.zeros(len(places), bool)
        one = jnp.ones((), surface.points.dtype)
        for start in range(0, len(places), _CHUNK):
            some = slice(start, min(start + _CHUNK, len(places)))
            found = anchors_at(surface, places[some], 1.0)
            sizes = (_CHUNK, _CHUNK, *[common_size(len(found.around))] * 2)
            padded = Anchors(*map(pad_rows, found, sizes, Anchors.PADDING))
            shown, slope = slopes(surface, padded, one, 0 * one)
            count = some.stop - start
            values[some] = np.asarray(shown.values)[:count]
            motion[some] = np.asarray(slope)[:count]
            good[some] = np.asarray(shown.good)[:count]
        return values, motion, good


def _cells(radius: float) -> Int64[np.ndarray, "cells 3"]:
    """List the indices of lattice points up to a distance from the origin."""
    reach = int(radius / SPACING)
    grid = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    return grid[SPACING * np.linalg.norm(grid, axis=1) <= radius]
