"""The scheme `field`: quantised values at the anchors of a lattice, which any meshing of the same shape shows.

Each anchor's value is brought to a lattice of numbers that its keyed dither and its code bit shift (dither modulation:
Chen, Wornell, "Quantization index modulation", IEEE Trans. Inf. Theory 47, 2001, with distortion compensation: only a
part of the way). The host itself is no noise then, so the original is not needed for reading.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark import distortion
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces
from jaxmark.watermark.blind.anchors import cut, encloses, look, make_anchors, place
from jaxmark.watermark.blind.dither import Dither, make_dither
from jaxmark.watermark.blind.reading import NAME, STEPS, WIDTHS, code_length, codeword, context, detect
from jaxmark.watermark.blind.writing import Shape, improve, measure
from jaxmark.watermark.budget import Budget, Limits, Visibility, make_budget, visibility_of, write
from jaxmark.watermark.coding.keys import Choices, Key, commitment
from jaxmark.watermark.hiding import hiding_directions
from jaxmark.watermark.marking import DEFAULT_BITS, NOISE, EmbedInfo, Survival
from jaxmark.watermark.payload import needed_energy
from jaxmark.watermark.record import Record, commit

_LEAST_ALPHA = 0.6  # part of the way to the lattice that is gone at least; up to √2 of it, as steps are so far apart
_FIRST_STEP = 0.05  # of the lattice of values, in widths, that is tried first
_LEAST_AREA = 0.2  # of the mean: what vertices of smaller area count as
_ROUNDS = 2  # of Gauss and Newton
_TRIED = (1.0, 0.7, 0.5, 0.3)  # shares of a predicted noise that are tried
_SMOOTHED = 10  # steps of smoothing that widths are chosen by, besides noise


@dataclass(frozen=True)
class FieldScheme:
    """Writes values at anchors in the shape's own pose; read without the original, and after any remeshing.

    Widths and steps are public ladders: of the steps, the largest that keeps the limits is written, and of the widths
    the one that is predicted to survive noise and smoothing best. Whoever reads without a record tries all of them.
    """

    name: ClassVar[str] = NAME
    widths: tuple[float, ...] = WIDTHS  # of the narrow Gaussian
    steps: tuple[float, ...] = STEPS  # of the lattice of values
    hiding: bool = False  # whether points move where and as it is hidden; see `jaxmark.watermark.hiding`


class Host(NamedTuple):
    """An original as its anchors of one width show it."""

    shape: Shape
    values: Float64[np.ndarray, " anchors"]
    pose: Float[Array, " nine"]
    good: Float64[np.ndarray, " anchors"]  # 1 for each anchor that is written, else 0
    closed: bool

    @property
    def size(self) -> int:
        """Number of anchors that are written."""
        return int(self.good.sum())


def make_host(original: Original, width: float) -> Host:
    """Look at an original by anchors of one width."""
    faces = np.asarray(original.points.faces)
    placed = place(Mesh(original.positions, faces))
    closed, dtype = encloses(original.points), original.signal.dtype
    pieces = cut(Mesh(placed.pose(original.positions), faces), width)
    surface = pieces.of(jnp.asarray(placed.pose(original.positions), dtype))
    surface = surface._replace(normals=surface.normals * placed.outwards)
    anchors = make_anchors(surface, width)
    shape = Shape(
        jnp.asarray(placed.pose.matrix, dtype),
        jnp.asarray(placed.pose.shift, dtype),
        faces,
        pieces,
        anchors,
        jnp.asarray(width, dtype),
        jnp.asarray(placed.outwards, dtype),
    )
    nowhere = jnp.zeros(anchors.places.shape, dtype)
    shown = look(surface, anchors, nowhere, shape.width, jnp.zeros((), dtype))
    good = np.asarray(shown.good & (anchors.around[:, 0] >= 0), np.float64)
    _, pose = measure(shape, original.to_traced(original.positions), closed=closed)
    return Host(shape, np.asarray(shown.values, np.float64), pose, good, closed)


class Written(NamedTuple):
    """A displacement that writes a codeword, as far as a budget allows."""

    mesh: Mesh
    moved: distortion.DisplacementSize
    width: float
    step: float
    alpha: float  # part of the way to the lattice that was gone


class Writer:
    """Writes codewords in one original; looks at it once for each width."""

    def __init__(self, original: Original, scheme: FieldScheme) -> None:
        self.original, self.scheme = original, scheme
        self._hosts: dict[float, Host] = {}

    def host(self, width: float) -> Host:
        """The original as its anchors of one width show it."""
        if width not in self._hosts:
            self._hosts[width] = make_host(self.original, width)
        return self._hosts[width]

    @cached_property
    def _mask(self) -> Float[Array, "rows 3 3"]:
        original = self.original
        if self.scheme.hiding:
            return original.to_traced(hiding_directions(original))
        return original.to_traced(np.tile(np.eye(3), (len(original.used), 1, 1)))

    @cached_property
    def _free(self) -> Float[Array, " rows"]:
        """How far each point moves for its part in a value: the inverse of its area, relative to the mean."""
        points, faces = self.original.positions, np.asarray(self.original.points.faces)
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        around = np.bincount(faces.ravel(), np.repeat(area, 3), len(points))
        mean = around[self.original.used].mean()
        return self.original.to_traced(np.where(self.original.used, mean / np.maximum(around, _LEAST_AREA * mean), 0))

    def off(self, host: Host, dither: Dither, word: Float64[np.ndarray, " code"], step: float) -> np.ndarray:
        """How far each value is from the nearest number that its dither and code bit allow, in steps."""
        sign = dither.sign * word[dither.slot]
        away = host.values / step - dither.offset - np.where(sign < 0, 0.5, 0)
        return away - np.round(away)

    def shift(
        self, host: Host, targets: Float64[np.ndarray, " anchors"], rounds: int
    ) -> Float64[np.ndarray, "points 3"]:
        """The least displacement by which anchors show these values, in diagonals."""
        original = self.original
        vertices, dtype = original.to_traced(original.positions), original.signal.dtype
        moved = jnp.zeros_like(vertices)
        wanted = (jnp.asarray(targets, dtype), host.pose)
        counted = jnp.asarray(host.good, dtype)
        for _ in range(rounds):
            moved = improve(host.shape, vertices, moved, self._free, self._mask, wanted, counted, closed=host.closed)
        return original.to_host(moved)

    def write(self, word: Float64[np.ndarray, " code"], choices: Choices, budget: Budget) -> Written:
        """Write a codeword with the width that is predicted to be read best, as far as a budget allows.

        Raises:
            JaxmarkError: if there is nothing to write in, or the budget allows not even the least step.
        """
        reference = distortion.Reference(self.original.mesh)
        found = [self._try(width, word, choices, budget, reference) for width in self.scheme.widths]
        fitting = [one for one in found if one is not None]
        if not fitting:
            raise JaxmarkError(
                "This mesh, or the budget for it, leaves the scheme 'field' nothing to write in: its surface has no"
                " parts as smooth as that; use a larger budget, a smoother mesh or the scheme 'keyed'."
            )
        _, host, dither, width, step, alpha = max(fitting, key=lambda one: one[0])
        targets = host.values - alpha * step * self.off(host, dither, word, step)
        shift = self.shift(host, targets, _ROUNDS)
        written = write(self.original, shift, budget, reference)
        return Written(written.mesh, written.moved, width, step, alpha * written.scale)

    def _try(
        self,
        width: float,
        word: Float64[np.ndarray, " code"],
        choices: Choices,
        budget: Budget,
        reference: distortion.Reference,
    ) -> tuple[float, Host, Dither, float, float, float] | None:
        """What a width promises, and the step and the part of the way that a budget allows with it."""
        host = self.host(width)
        if not host.size:
            return None
        dither = make_dither(choices, host.shape.anchors.cells, len(word))
        # How far a mark of one step displaces is how far any does, times its step: what is off is uniform.
        first = _FIRST_STEP * width
        shift = self.shift(host, host.values - first * self.off(host, dither, word, first), 1)
        size = float(distortion.rms(shift[self.original.used]))
        if not (math.isfinite(size) and size > 0):
            return None
        allowed = first * write(self.original, shift, budget, reference).scale
        steps = [step for step in self.scheme.steps if allowed / step >= _LEAST_ALPHA]
        if not steps:
            return None
        step = max(steps)
        alpha = min(allowed / step, 1.0)
        return min(self.energy(host, step, alpha)), host, dither, width, step, alpha

    def survives(self, written: Written, bits: int) -> Survival:
        """Predict the strongest noise in which a mark reads: until nρ² is what the payload needs; cut, it does not."""
        host = self.host(written.width)
        kept = host.size * np.sinc(1 - min(written.alpha, 1.0)) ** 2 / needed_energy(bits)
        if kept <= 1:
            return Survival(0.0, 0.0)
        spread = self._spreads(host)[0] / NOISE  # for each unit of noise
        return Survival(float(written.step * math.sqrt(math.log(kept)) / (2 * math.pi * spread)), 0.0)

    def energy(self, host: Host, step: float, alpha: float) -> tuple[float, ...]:
        """Predicted nρ² after each of the reference disturbances; ρ is the mean cosine of what is off."""
        compensated = float(np.sinc(1 - alpha))
        return tuple(
            host.size * (compensated * math.exp(-2 * (math.pi * spread / step) ** 2)) ** 2
            for spread in self._spreads(host)
        )

    def _spreads(self, host: Host) -> tuple[float, float]:
        """Spread of the anchors' values by noise and by smoothing of the original; see `_disturbances`."""
        before = host.values[host.good > 0]
        spreads = []
        for points in self._disturbances:
            values, _ = measure(host.shape, points, closed=host.closed)
            after = np.asarray(values, np.float64)[host.good > 0]
            spreads.append(float(np.sqrt(np.mean((after - before) ** 2))))
        return spreads[0], spreads[1]

    @cached_property
    def _disturbances(self) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
        """The original with noise of `NOISE`, and after `_SMOOTHED` steps of smoothing."""
        original, points = self.original, self.original.positions
        noise = np.random.default_rng(0).uniform(-1, 1, points.shape) * original.used[:, None]
        smoothed = original.to_traced(points)
        for _ in range(_SMOOTHED):
            smoothed = smoothed - 0.1 * original.operator.apply(smoothed)
        return original.to_traced(points + NOISE * radius_of(original) * noise), smoothed


def radius_of(original: Original) -> float:
    """Mean distance of the points that faces use to their centre, in diagonals."""
    points = original.positions[original.used]
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean())


@dataclass(frozen=True, eq=False)
class FieldMarker:
    """Marks one original with one key and payload size so that it is read without it; see `Marker`."""

    original: Original
    key: Key
    bits: int
    scheme: FieldScheme
    writer: Writer

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
        read_back: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `embed`."""
        bounds = make_budget(budget, limits, visibility, named=visibility_of(self.original.mesh))
        choices = context(self.key, self.bits)
        word = codeword(message, choices)
        written = self.writer.write(word, choices, bounds)
        survives = self.writer.survives(written, self.bits)
        if noise is not None and survives.whole < noise:
            raise JaxmarkError(
                f"This mark would survive noise of {survives.whole:.2g}, not {noise:g}; use a larger budget, a shorter"
                " message or another scheme."
            )
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=written.alpha,
            original="",
            key=commitment(self.key),
            parameters={"width": written.width, "step": written.step},
            content="message" if self.bits else "presence",
            told=commit(message, choices) if message else "",
        ).sealed(self.key)
        info = EmbedInfo(written.moved.rms, written.moved.max, written.alpha * written.step, record, survives)
        if read_back:
            self.with_record(record).check(written.mesh, message)
        return written.mesh, info

    def with_record(self, record: Record) -> "FieldMarker":
        """The marker that reads a mark it has just made, with the width and step that were chosen."""
        return replace(self, scheme=parameters_in(record))

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that a message can be read from a marked mesh that was not attacked.

        Raises:
            JaxmarkError: if it cannot be read.
        """
        if not self.reads(marked, message):
            raise JaxmarkError(
                f"This mesh ({int(self.original.used.sum())} points) cannot carry"
                f" {f'{self.bits} bits' if self.bits else 'a presence mark'} with the scheme {self.scheme.name!r}: it"
                " does not read back, even unattacked. Use a larger budget, a shorter message or the scheme 'keyed'."
            )

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message is read, or without one a presence proven."""
        found = detect(marked, self.key, self.bits, widths=self.scheme.widths, steps=self.scheme.steps)
        return found.message == message if message else found.detected()

    def tried(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival:
        """Try what a mark survives: add noise, and read; see `Marker.tried`."""
        points, rng = np.asarray(marked.vertices, np.float64), np.random.default_rng(0)
        size = radius_of(self.original) * self.original.diagonal
        unit = size * rng.uniform(-1, 1, self.original.positions.shape)[self.original.weld.point]
        for share in _TRIED:
            noise = share * predicted.whole
            if noise and self.reads(Mesh(points + noise * unit, marked.faces), message):
                return Survival(noise, 0.0)
        return Survival(0.0, 0.0)


def parameters_in(record: Record) -> FieldScheme:
    """The scheme with the width and the step that a record names.

    Raises:
        JaxmarkError: if it names none that are on the ladders.
    """
    width, step = (record.parameters.get(name) for name in ("width", "step"))
    if record.scheme != NAME or width not in WIDTHS or step not in STEPS:
        raise JaxmarkError(f"The record is not one of the scheme {NAME!r} that this jaxmark reads.")
    return FieldScheme((width,), (step,))


def make_field_marker(original: Mesh, key: bytes, *, bits: int = DEFAULT_BITS, scheme: FieldScheme) -> FieldMarker:
    """Prepare an original for marks that are read without it.

    Raises:
        JaxmarkError: if the mesh or the key is unusable, or the payload is not a multiple of 8 bits.
    """
    code_length(bits)
    check_faces("A mark that is read without the original", original)
    ready = make_original(original)
    return FieldMarker(ready, Key(key), bits, scheme, Writer(ready, scheme))
