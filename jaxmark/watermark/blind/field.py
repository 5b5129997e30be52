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
from jaxmark.watermark.blind.reading import NAME, STEPS, TAG_BITS, WIDTHS, code_length, codeword, context, detect
from jaxmark.watermark.blind.writing import Shape, improve, measure
from jaxmark.watermark.budget import Budget, Limits, Visibility, make_budget, visibility_of, write
from jaxmark.watermark.coding.keys import KEY_BYTES, Choices, Key, commitment
from jaxmark.watermark.coding.message import TAG_BITS as _TAG_BITS
from jaxmark.watermark.hiding import hiding_directions
from jaxmark.watermark.marking import DEFAULT_BITS, NOISE, EmbedInfo, Survival
from jaxmark.watermark.payload import needed_energy
from jaxmark.watermark.record import Record, commit

_LEAST_ALPHA = 0.6  # part of the way to the lattice that is gone at least; up to √2 of it, as steps are so far apart
_FIRST_STEP = 0.05  # of the lattice of values, in widths, that is tried first
_LEAST_AREA = 0.2  # of the mean: what vertices of smaller area count as
_MIN_GAP = 0.02  # difference of the variances along two axes, over the largest, from which on they are told apart
_ROUNDS = 2  # of Gauss and Newton
_SPARE = 1.3  # energy that a width should leave, over what the payload needs
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
    variances = np.diag(placed.moments.covariance)
    if (-np.diff(variances) < _MIN_GAP * variances[0]).any():
        raise JaxmarkError(
            "This shape is as wide in one direction as in another, or nearly, so that its pose cannot be told without"
            " the original; use the scheme 'keyed'."
        )
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


class Plan(NamedTuple):
    """How a mark is written in one original."""

    width: float  # of the narrow Gaussian
    step: float  # of the lattice of values
    alpha: float  # part of the way to the lattice that is gone
    host: Host
    dither: Dither

    def energy(self, spread: float) -> float:
        """Predicted nρ², where ρ is the mean cosine of what n values are off, after something that spreads them.

        What is off is uniform over the rest of the way, and then Gaussian.
        """
        kept = float(np.sinc(1 - min(self.alpha, 1.0))) * math.exp(-2 * (math.pi * spread / self.step) ** 2)
        return self.host.size * kept**2


class Written(NamedTuple):
    """A displacement that writes a codeword, as far as a budget allows."""

    mesh: Mesh
    moved: distortion.DisplacementSize
    plan: Plan


def needed(bits: int) -> float:
    """nρ² with which a payload is read: the energy that it needs with the longer tag of blind marks."""
    return needed_energy(bits + TAG_BITS - _TAG_BITS) if bits else needed_energy(0)


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

    def plan(
        self,
        word: Float64[np.ndarray, " code"],
        choices: Choices,
        budget: Budget,
        reference: distortion.Reference,
        bits: int,
    ) -> Plan:
        """Choose the width that is predicted to be read best, and how strong a budget allows the mark to be.

        Of the widths that leave room for the payload, the one of most energy after noise or smoothing is taken.

        Raises:
            JaxmarkError: if there is nothing to write in, or the budget allows not even the least step.
        """
        found = [self._try(width, word, choices, budget, reference) for width in self.scheme.widths]
        fitting = [one for one in found if one is not None]
        if not fitting:
            raise JaxmarkError(
                f"This mesh, or the budget for it, leaves the scheme {self.scheme.name!r} nothing to write in; use a"
                " larger budget or the scheme 'keyed'."
            )
        enough = _SPARE * needed(bits)
        return max(fitting, key=lambda one: (one.energy(0.0) >= enough, min(self.energies(one))))

    def write(
        self,
        word: Float64[np.ndarray, " code"],
        choices: Choices,
        budget: Budget,
        bits: int,
        reference: distortion.Reference | None = None,
    ) -> Written:
        """Write a codeword as far as a budget allows.

        Args:
            word: the code bits, ±1.
            choices: the keyed choices.
            budget: the bounds to keep.
            bits: size of the payload in bits.
            reference: what limits are measured against, if not the original.

        Raises:
            JaxmarkError: see `plan`.
        """
        reference = reference or distortion.Reference(self.original.mesh)
        plan = self.plan(word, choices, budget, reference, bits)
        targets = plan.host.values - plan.alpha * plan.step * self.off(plan.host, plan.dither, word, plan.step)
        shift = self.shift(plan.host, targets, _ROUNDS)
        written = write(self.original, shift, budget, reference)
        return Written(written.mesh, written.moved, plan._replace(alpha=plan.alpha * written.scale))

    def _try(
        self,
        width: float,
        word: Float64[np.ndarray, " code"],
        choices: Choices,
        budget: Budget,
        reference: distortion.Reference,
    ) -> Plan | None:
        """The step, and the part of the way, that a budget allows with a width; None if not even the least step."""
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
        return Plan(width, max(steps), min(allowed / max(steps), 1.0), host, dither) if steps else None

    def energies(self, plan: Plan) -> tuple[float, float]:
        """Predicted nρ² after each of the reference disturbances, see `Plan.energy`."""
        noise, smoothing = self._spreads(plan.host)
        return plan.energy(noise), plan.energy(smoothing)

    def survives(self, plan: Plan, bits: int) -> Survival:
        """Predict the strongest noise in which a mark reads: until nρ² is what the payload needs; cut, it does not."""
        kept = plan.energy(0.0) / needed(bits)
        if kept <= 1:
            return Survival(0.0, 0.0)
        spread = self._spreads(plan.host)[0] / NOISE  # for each unit of noise
        return Survival(float(plan.step * math.sqrt(math.log(kept)) / (2 * math.pi * spread)), 0.0)

    def capacity(self, budget: Budget, noise: float) -> int:
        """The largest payload in bits, a multiple of 8, that is predicted to read in noise; 0 if not even 8.

        Args:
            budget: bounds on the distortion by the mark.
            noise: half width of uniform noise over the mean distance of the vertices to their centre.
        """
        choices = context(bytes(KEY_BYTES), DEFAULT_BITS)
        word = codeword(bytes(DEFAULT_BITS // 8), choices)
        try:
            plan = self.plan(word, choices, budget, distortion.Reference(self.original.mesh), 0)
        except JaxmarkError:
            return 0
        energy, bits = plan.energy(self._spreads(plan.host)[0] * noise / NOISE), 0
        while needed(bits + 8) <= energy and code_length(bits + 8) <= plan.host.size:
            bits += 8
        return bits

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
        reference: distortion.Reference | None = None,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `embed`.

        Pass `read_back=False` if you verify the written file yourself, and `reference` if limits are against another
        mesh than the original.
        """
        bounds = make_budget(budget, limits, visibility, named=visibility_of(self.original.mesh))
        choices = context(self.key, self.bits)
        word = codeword(message, choices)
        written = self.writer.write(word, choices, bounds, self.bits, reference)
        survives = self.writer.survives(written.plan, self.bits)
        if noise is not None and survives.whole < noise:
            raise JaxmarkError(
                f"This mark would survive noise of {survives.whole:.2g}, not {noise:g}; use a larger budget, a shorter"
                " message or another scheme."
            )
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=float(written.plan.alpha),
            original="",
            key=commitment(self.key),
            parameters={"width": written.plan.width, "step": written.plan.step},
            content="message" if self.bits else "presence",
            told=commit(message, choices) if message else "",
        ).sealed(self.key)
        info = EmbedInfo(written.moved.rms, written.moved.max, record.beta, record, survives)
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
