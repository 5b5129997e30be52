"""The blind scheme `rooted`: values in lattices that begin at landmarks; any part with such a landmark can be read.

Some landmarks of the original are *roots*, each with a lattice in its own frame (`jaxmark.watermark.blind.roots`). A
reader takes each landmark of a suspect for each root in turn, and finds the right ones by the key's offsets: with them,
the values fit better than by chance. Roots are found one by one, so that the suspect may be a part of the shape, in any
pose, and remeshed. All lengths are in widths of the narrow Gaussian. The width is a share of a public unit: the power
of √2 that is nearest to the diagonal of the original in the unit of its file.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int64

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.geometry.pose import Pose
from jaxmark.spectral.padding import pad_rows
from jaxmark.watermark.blind.anchors import alike, anchors_at, encloses, moments_of, turned
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.landmarks import Landmarks
from jaxmark.watermark.blind.lattices import CHANGES, CutSurface, Frames, Lattices, find_roots
from jaxmark.watermark.blind.roots import CLASSES, REGION, make_regions, names_of
from jaxmark.watermark.blind.scheme import AnchoredHost, BlindScheme, Look, measure
from jaxmark.watermark.blind.search import Found, random_changes, search
from jaxmark.watermark.blind.shape import Shape, inverse_areas, smoothing_of
from jaxmark.watermark.coding.keys import Choices

_UNITS = (0, 1, -1, 2, 3)  # half powers of 2 by which the unit may differ from the diagonal of a suspect, likely first
_FIRST_STEP = 0.05  # quantisation step that is tried first
#: Standard deviations of the small changes of a frame: turns in radians about its axes, and shifts along them.
_SPREAD = (0.015, 0.015, 0.05, 0.13, 0.13, 0.05)
_STARTS = 512  # small changes that are tried for each landmark
_CLOSER, _FEWER = 0.4, 64  # factor on the changes, and their number, for landmarks that are looked at again
_CORE = (10.0, 14.0)  # distances from a landmark up to which anchors must fit: either is enough
#: The same for landmarks that are looked at again, and how many are kept for each root.
_FARTHER = (((10.0, 14.0, 20.0), 3), ((14.0, 20.0, 25.0, REGION), 1))
_CANDIDATES = 12  # landmarks that are looked at again for each root
_FEWEST = 12  # least number of anchors that can fit
_BY_CHANCE = 5.0  # fits up to this one occur by chance
_AROUND = 4.0  # width of the Gaussian over which the fit around an anchor is averaged
_FITS, _FALL = 1.2, 1.5  # fit around an anchor with which it counts half, and how fast its weight falls
_IS_ROOT, _ROOT_FALL = 5.3, 4.0  # the same for the fit of a whole root
_RIVAL, _BEHIND = 6.0, 3.0  # anchors belong to the nearest root that fits so well, and so much less than another
_LEAST_WEIGHT = 0.02


@dataclass(frozen=True)
class RootedScheme(BlindScheme):
    """A blind scheme that writes values in lattices that begin at landmarks; read from parts, also remeshed ones.

    Raises:
        JaxmarkError: if the unit is no power of √2.
    """

    name: ClassVar[str] = "rooted"
    in_parts: ClassVar[bool] = True
    by_key: ClassVar[bool] = True
    # The offsets must be met well, because roots are found by them.
    least_alpha: ClassVar[float] = 0.84
    remembered: ClassVar[tuple[str, ...]] = ("unit",)
    widths: tuple[float, ...] = (0.01,)  # width of the narrow Gaussian, in units
    steps: tuple[float, ...] = tuple(0.02 * 2 ** (rung / 4) for rung in range(15))  # quantisation steps, in widths
    hiding: bool = False  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`
    unit: str = ""  # the unit of a record, for reading

    def __post_init__(self) -> None:
        """Check the unit, and see `BlindScheme`."""
        super().__post_init__()
        try:
            is_power = not self.unit or _unit_of(float(self.unit)) == float(self.unit)
        except (ValueError, OverflowError):  # zero, negative, infinite, or no number
            is_power = False
        if not is_power:
            raise JaxmarkError("The record is damaged: its unit is no power of √2. Use an unedited copy.")

    @property
    def looks(self) -> int:
        """See `BlindScheme`."""
        return 4 * (1 if self.unit else len(_UNITS))

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: if the surface is too large.
        """
        dtype, rows, hosts = original.signal.dtype, original.to_traced(original.positions), {}
        free, mesh = inverse_areas(original), outward(Mesh(original.positions, np.asarray(original.points.faces)))
        for width in self.widths:
            size = width * _unit_of(original.diagonal) / original.diagonal
            scaled = mesh._replace(vertices=np.asarray(mesh.vertices) / size)
            surface = CutSurface(scaled)
            regions = make_regions(scaled, surface)
            anchors = alike([anchors_at(surface.patches, regions.lattices.places, 1.0)])[0]
            to_widths, no_shift = jnp.eye(3, dtype=dtype) / size, jnp.zeros(3, dtype)
            faces, one = np.asarray(mesh.faces), jnp.ones((), dtype)
            shape = Shape(to_widths, no_shift, faces, surface.pieces, anchors, one, encloses(mesh))
            values, held = measure(shape, rows)
            count = len(anchors.cells)
            good = pad_rows(np.ones(len(regions.names)), count)
            names, smoothing = pad_rows(regions.names, count), smoothing_of(original, size)
            hosts[width] = AnchoredHost(
                shape, names, np.asarray(values, np.float64), held, good, free, smoothing, _FIRST_STEP
            )
        return hosts

    def recorded(self, original: Original) -> dict[str, str]:
        """See `BlindScheme`: the unit."""
        return {"unit": repr(_unit_of(original.diagonal))}

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[list[Look]]:
        """See `BlindScheme`; open surfaces are also seen with their faces reversed.

        Raises:
            JaxmarkError: if the suspect has no extent, or its surface is too large.
        """
        usual = _unit_of(diagonal(suspect))
        units = [float(self.unit)] if self.unit else [usual * 2 ** (power / 2) for power in _UNITS]
        is_closed, suspect = encloses(suspect), outward(suspect)
        vertices = np.asarray(suspect.vertices, np.float64)
        centre = vertices.mean(axis=0)
        for unit, width in product(units, self.widths):
            size = width * unit
            mesh, pose = Mesh((vertices - centre) / size, suspect.faces), Pose(np.eye(3) / size, -centre / size)
            surface, landmarks = CutSurface(mesh), find_roots(mesh)
            reader = _Reader(surface, choices, np.asarray(self.steps))
            for inside_out, mirrored in product((False,) if is_closed else (False, True), (False, True)):
                seen = landmarks.seen(Pose(np.eye(3), np.zeros(3)), inside_out=inside_out)
                yield reader.read(seen, width, pose, inside_out=inside_out, mirrored=mirrored)


def outward(mesh: Mesh) -> Mesh:
    """Reverse the faces of a mesh that encloses a volume, if they are inward."""
    if encloses(mesh) and moments_of(mesh).mass < 0:
        return Mesh(mesh.vertices, turned(np.asarray(mesh.faces)))
    return mesh


def _unit_of(length: float) -> float:
    """Return the power of √2 that is nearest to a length."""
    return 2.0 ** (round(2 * math.log2(length)) / 2)


class _Rooted(NamedTuple):
    """Frames that are taken for roots."""

    frames: Frames
    classes: Int64[np.ndarray, " frames"]
    fits: Float64[np.ndarray, " frames"]  # in standard deviations of the fit by chance

    def best(self, count: int) -> "_Rooted":
        """Return the frames that fit best, so many for each root."""
        roots = CLASSES * self.frames.kinds + self.classes
        order = np.argsort(-self.fits, kind="stable")
        return self.pick(np.concatenate([order[roots[order] == root][:count] for root in np.unique(roots)]))

    def pick(self, chosen: Int64[np.ndarray, " chosen"]) -> "_Rooted":
        """Return some of the frames."""
        return _Rooted(self.frames.pick(chosen), self.classes[chosen], self.fits[chosen])


class _Reader:
    """A reader of one surface, with the keyed choices of a mark."""

    def __init__(self, surface: CutSurface, choices: Choices, steps: Float64[np.ndarray, " steps"]) -> None:
        self._surface, self._choices, self._steps = surface, choices, steps

    def read(self, landmarks: Landmarks, width: float, pose: Pose, *, inside_out: bool, mirrored: bool) -> list[Look]:
        """Find the roots among landmarks, and return what is seen from them; nothing if there is no landmark."""
        if not len(landmarks.places):
            return []
        frames = Frames.of(landmarks, mirrored=mirrored).both_ways()
        step, rooted = self._candidates(frames, inside_out)
        for radii, count in _FARTHER:
            lattices = self._surface.lattices(rooted.frames, radii[-1], rough=True, inside_out=inside_out)
            offsets = self._offsets(names_of(rooted.frames.kinds, rooted.classes, lattices))
            fit = _fit(lattices, offsets[None], len(rooted.classes), np.array([step]), radii, _CLOSER, _FEWER)
            moved = rooted.frames.moved(fit.change[:, 0, 0])
            rooted = _Rooted(moved, rooted.classes, fit.pilot[:, 0, 0]).best(count)
        # Others have weights that are too small to count.
        rooted = rooted.pick(np.flatnonzero(_root_weight(rooted.fits) > _LEAST_WEIGHT))
        lattices = self._surface.lattices(rooted.frames, REGION, inside_out=inside_out)
        names = names_of(rooted.frames.kinds, rooted.classes, lattices)
        weights = _weights(rooted, lattices, np.cos(4 * np.pi * (lattices.values / step - self._offsets(names))))
        counted = weights > _LEAST_WEIGHT
        # The error with which the reader gives an anchor its weight, see `reliability`.
        error = step / np.pi * np.sqrt(-np.log(weights[counted]) / 2)
        count, dtype = len(error), jnp.result_type(float)
        return [
            Look(
                names[counted][None],
                jnp.asarray(lattices.values[counted], dtype),
                np.ones(count, bool),
                jnp.zeros((count, 1), dtype),
                (1.0,),
                width,
                pose,
                0,
                np.array([mirrored]),
                error=error,
                starts=1,
                steps=(step,),
            )
        ]

    def _candidates(self, frames: Frames, inside_out: bool) -> tuple[float, _Rooted]:
        """Find the likeliest step, and the frames that are likeliest roots with it."""
        lattices = self._surface.lattices(frames, _CORE[-1], rough=True, inside_out=inside_out)
        each = [np.full(len(frames.kinds), one) for one in range(CLASSES)]
        offsets = np.stack([self._offsets(names_of(frames.kinds, one, lattices)) for one in each])
        fit = _fit(lattices, offsets, len(frames.kinds), self._steps, _CORE, 1.0, _STARTS)
        # The step with which most roots fit better than by chance.
        step = int(np.argmax(np.maximum(fit.pilot.max(axis=1) - _BY_CHANCE, 0).sum(axis=0)))
        parts = [
            _Rooted(frames.moved(fit.change[:, index, step]), one, fit.pilot[:, index, step])
            for index, one in enumerate(each)
        ]
        joined = Frames(*map(np.concatenate, zip(*(part.frames for part in parts), strict=True)))
        both = _Rooted(joined, np.concatenate(each), np.concatenate([part.fits for part in parts]))
        return float(self._steps[step]), both.best(_CANDIDATES)

    def _offsets(self, names: Int64[np.ndarray, "anchors parts"]) -> Float64[np.ndarray, " anchors"]:
        """Derive the keyed offsets of names, each once."""
        distinct, index = np.unique(names, axis=0, return_inverse=True)
        return make_dither(self._choices, RootedScheme.name, distinct, 1).offset[index.ravel()]


def _weights(
    rooted: _Rooted, lattices: Lattices, cosines: Float64[np.ndarray, " anchors"]
) -> Float64[np.ndarray, " anchors"]:
    """Compute the weight of each anchor from how well the offsets fit around it; independent of the key's signs.

    Args:
        rooted: the frames.
        lattices: their anchors.
        cosines: fit of the offset at each anchor, from -1 to 1.
    """
    weights, places, of_roots = np.zeros(len(cosines)), rooted.frames.places, _root_weight(rooted.fits)
    for index, fit in enumerate(rooted.fits):
        own = np.flatnonzero(lattices.frame == index)
        at = lattices.places[own]
        square = ((at[:, None] - at) ** 2).sum(axis=2)
        kernel = np.exp(-square / 2 / _AROUND**2)
        around = kernel @ cosines[own] / np.sqrt((kernel**2).sum(axis=1) / 2)
        rivals = (rooted.fits > _RIVAL) & (rooted.fits > fit - _BEHIND)
        rivals[index] = True
        distance = np.linalg.norm(at[:, None] - places[rivals], axis=2).min(axis=1)
        is_own = np.linalg.norm(at - places[index], axis=1) <= distance
        weights[own] = is_own * of_roots[index] / (1 + np.exp(-_FALL * (around - _FITS)))
    return weights


def _root_weight(fits: Float64[np.ndarray, " frames"]) -> Float64[np.ndarray, " frames"]:
    """Compute the weight of roots from how well they fit."""
    return 1 / (1 + np.exp(-_ROOT_FALL * (fits - _IS_ROOT)))


class _Fit(NamedTuple):
    """The small changes of frames for which values fit the offsets best."""

    change: Float64[np.ndarray, "frames turns steps changes"]
    pilot: Float64[np.ndarray, "frames turns steps"]  # in standard deviations of the fit by chance


def _fit(
    lattices: Lattices,
    offsets: Float64[np.ndarray, "turns anchors"],
    frames: int,
    steps: Float64[np.ndarray, " steps"],
    radii: Sequence[float],
    factor: float,
    starts: int,
) -> _Fit:
    """Find the small changes of frames for which values fit the offsets best, see `search`.

    Args:
        lattices: the anchors of all frames.
        offsets: δ of each anchor, for each turn.
        frames: number of frames.
        steps: quantisation steps.
        radii: distances up to which anchors are counted; the best one is taken.
        factor: factor on the small changes that are tried.
        starts: number of them.
    """
    place = np.arange(len(lattices.frame)) - np.searchsorted(lattices.frame, np.arange(frames))[lattices.frame]
    # Powers of two, so that few programs are compiled.
    shape = tuple(max(1 << (int(size) - 1).bit_length(), 64) for size in (frames, place.max(initial=0) + 1))
    dtype = jnp.result_type(float)

    def by_frame(column: np.ndarray) -> np.ndarray:
        table = np.zeros((*shape, *column.shape[1:]), dtype)
        table[lattices.frame, place] = column
        return table

    weights = np.stack([by_frame(lattices.distances <= radius) for radius in radii], axis=1)
    found = _search_each(
        by_frame(lattices.values),
        by_frame(lattices.slopes),
        np.tile(weights, (1, len(steps), 1)),
        np.stack(list(map(by_frame, offsets)), axis=1),
        jnp.asarray(np.repeat(steps, len(radii)), dtype),
        jnp.asarray(factor * np.array(_SPREAD), dtype),
        jnp.asarray(random_changes(starts, CHANGES), dtype),
    )
    is_enough = weights.sum(axis=2) >= _FEWEST
    sizes = (shape[0], len(offsets), len(steps), len(radii))
    pilot = np.where(is_enough[:, None, None], np.asarray(found.pilot, np.float64).reshape(sizes), -np.inf)[:frames]
    best = pilot.argmax(axis=3)[..., None]
    change = np.asarray(found.change, np.float64).reshape(*sizes, CHANGES)[:frames]
    chosen = np.take_along_axis(change, best[..., None], axis=3)[:, :, :, 0]
    return _Fit(chosen, np.take_along_axis(pilot, best, axis=3)[..., 0])


@jax.jit
def _search_each(
    values: Float[Array | np.ndarray, "frames anchors"],
    changes: Float[Array | np.ndarray, "frames anchors changes"],
    weights: Float[Array | np.ndarray, "frames steps anchors"],
    offsets: Float[Array | np.ndarray, "frames turns anchors"],
    steps: Float[Array, " steps"],
    spread: Float[Array, " changes"],
    starts: Float[Array, "starts changes"],
) -> Found:
    """See `search`, for each frame."""
    return jax.lax.map(
        lambda frame: search(*frame, steps, spread, starts), (values, changes, weights, offsets), batch_size=16
    )
