"""The least displacement that gives anchors their values, as far as a budget allows.

Each anchor's value is brought to a lattice of numbers that its keyed dither and its code bit shift (dither modulation:
Chen, Wornell, "Quantization index modulation", IEEE Trans. Inf. Theory 47, 2001, with distortion compensation: only a
part of the way). The host itself is no noise then, so the original is not needed for reading.
"""

import math
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, Float64
from scipy import optimize

from jaxmark import distortion
from jaxmark.alignment.original import Original, displace, shift_of
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.chebyshev import filter, transpose
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.watermark.blind.dither import Dither, make_dither
from jaxmark.watermark.blind.prediction import Margin, margin, mean_cosine
from jaxmark.watermark.blind.reading import TAG_BITS, codeword
from jaxmark.watermark.blind.scheme import AnchoredHost, BlindScheme, Measured, measure
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import DEFAULT_BITS
from jaxmark.watermark.perception.budget import Bounds, displace_within
from jaxmark.watermark.perception.capacity import NOISE, Survival
from jaxmark.watermark.perception.masking import apply_mask, masking_directions

_RIDGE = 3e-3  # of the mean square of a row: values that contradict each other are met halfway
_HELD_RIDGE = 1e-4  # of the rows of what is held, which are scaled to the others' size
_STEPS, _TOLERANCE = 60, 1e-2  # of conjugate gradients
_LEAST_ALPHA = 0.6  # part of the way to the lattice that is gone at least; up to √2 of it, as steps are so far apart
_ROUNDS = 2  # of Gauss and Newton
_ENOUGH = 0.9  # share of the limits that is enough to choose a width and a step by
_SURE, _READS = 3.0, 1.0  # standard deviations by which a payload should read, and by which it is said to
_CODE_GAP = 1.12  # half a decibel: from 180 values, 152 bits read, and 160 do not


@jax.jit
def improve(
    shape: Measured,
    vertices: Float[Array, "rows 3"],
    moved: Float[Array, "rows 3"],
    operator: Laplacian,
    smoothing: Float[Array | np.ndarray, " terms"],
    free: Float[Array, " rows"],
    mask: Float[Array, "rows 3 3"],
    targets: tuple[Float[Array, " anchors"], Float[Array, " held"]],
    counted: Float[Array, " anchors"],
) -> Float[Array, "rows 3"]:
    """One step of Gauss and Newton towards the least displacement whose values are `targets`.

    Args:
        shape: of the mesh.
        vertices: its vertices where they were.
        moved: their displacement so far.
        operator: the mesh's Laplacian.
        smoothing: Chebyshev series of the filter that displacements go through, see `filter`.
        free: how far each vertex moves for its part in a value: the inverse of its area.
        mask: of displacements, see `apply_mask`.
        targets: the values, and what is held, to reach.
        counted: 1 for each anchor whose value is to be reached, else 0.
    """
    (values, held), push = jax.linearize(shape.measure, vertices + moved)
    pull = jax.linear_transpose(push, vertices)

    def rows(of: tuple[Float[Array, " anchors"], Float[Array, " held"]]) -> Float[Array, "rows 3"]:
        (back,) = pull((counted * of[0], of[1]))
        wanted = free[:, None] * transpose(operator, smoothing, apply_mask(mask, back))
        return apply_mask(mask, filter(operator, smoothing, wanted))

    # Rows of what is held are made as long as the others are on average, by which conjugate gradients converge soon.
    signs = jnp.where(jnp.arange(len(values)) * 7919 % 13 % 2 == 0, 1.0, -1.0).astype(values.dtype)
    firsts = jnp.zeros((1 + len(held), len(values)), values.dtype).at[0].set(counted * signs)
    seconds = jnp.eye(1 + len(held), dtype=values.dtype)[:, 1:]
    squares = jax.lax.map(lambda of: sum(map(jnp.vdot, of, push(rows(of)))), (firsts, seconds))
    energy = squares[0] / counted.sum()
    factor = jnp.sqrt(energy / squares[1:])

    def gram(of: tuple[Float[Array, " anchors"], Float[Array, " held"]]) -> tuple[Array, Array]:
        there = push(rows((of[0], factor * of[1])))
        return counted * there[0] + _RIDGE * energy * of[0], factor * there[1] + _HELD_RIDGE * energy * of[1]

    before = push(moved)
    wanted = (counted * (targets[0] - values + before[0]), factor * (targets[1] - held + before[1]))
    found, _ = cg(gram, wanted, tol=_TOLERANCE, maxiter=_STEPS)
    return rows((found[0], factor * found[1]))


class Plan(NamedTuple):
    """How a mark is written in one original."""

    width: float  # of the narrow Gaussian
    step: float  # of the lattice of values
    alpha: float  # part of the way to the lattice that is gone
    size: float  # RMS of the displacement, in diagonals
    host: AnchoredHost
    dither: Dither

    def margin(self, spread: float, bits: int) -> Margin:
        """By how much the information that is left after something that spreads values exceeds what is needed."""
        return margin(self.host.size, mean_cosine(spread, self.step, self.alpha), carried(bits))


class Allowance(NamedTuple):
    """How much a budget allows to be written with anchors of one width."""

    width: float  # of the narrow Gaussian
    allowed: float  # the largest α · step
    size: float  # RMS of the displacement then, in diagonals
    host: AnchoredHost
    dither: Dither

    def plan(self, step: float) -> Plan:
        """As far to the lattice of a step as is allowed."""
        alpha = min(self.allowed / step, 1.0)
        return Plan(self.width, step, alpha, self.size * alpha * step / self.allowed, self.host, self.dither)


class Written(NamedTuple):
    """A displacement that writes a codeword, as far as a budget allows."""

    mesh: Mesh
    moved: distortion.DisplacementSize
    plan: Plan


def carried(bits: int) -> float:
    """Bits that values must have room for: the payload and its tag, and what the code needs more; a presence is one."""
    return _CODE_GAP * (bits + TAG_BITS) if bits else 1.0


def sureness(plan: Plan, bits: int) -> float:
    """The margin without any attack, as far as it matters: what is sure is no better if it is surer."""
    return min(plan.margin(0.0, bits).sure, _SURE)


class Writer:
    """Writes codewords with the keyed choices of one mark in one original; looks at it once."""

    def __init__(self, original: Original, scheme: BlindScheme, choices: Choices) -> None:
        self.original, self.scheme, self.choices = original, scheme, choices

    @cached_property
    def hosts(self) -> dict[float, AnchoredHost]:
        """The original as its anchors of each width show it."""
        return self.scheme.hosts(self.original, self.choices)

    @cached_property
    def _mask(self) -> Float[Array, "rows 3 3"]:
        original = self.original
        if self.scheme.hiding:
            return original.to_traced(masking_directions(original))
        return original.to_traced(np.tile(np.eye(3), (len(original.used), 1, 1)))

    def off(self, host: AnchoredHost, dither: Dither, word: Float64[np.ndarray, " code"], step: float) -> np.ndarray:
        """How far each value is from the nearest number that its dither and code bit allow, in steps."""
        sign = dither.sign * word[dither.slot]
        away = host.values / step - dither.offset - np.where(sign < 0, 0.5, 0)
        return away - np.round(away)

    def shift(
        self, host: AnchoredHost, targets: Float64[np.ndarray, " anchors"], rounds: int
    ) -> Float64[np.ndarray, "points 3"]:
        """The least displacement by which anchors show these values, in diagonals."""
        original = self.original
        vertices, dtype = original.to_traced(original.positions), original.signal.dtype
        moved = jnp.zeros_like(vertices)
        wanted = (jnp.asarray(targets, dtype), host.held)
        counted = jnp.asarray(host.good, dtype)
        for _ in range(rounds):
            moved = improve(
                host.shape, vertices, moved, original.operator, host.smoothing, host.free, self._mask, wanted, counted
            )
        return original.to_host(moved)

    def plan(
        self,
        word: Float64[np.ndarray, " code"],
        bounds: Bounds,
        reference: distortion.Reference,
        bits: int,
    ) -> Plan:
        """Choose the width that is predicted to be read best, and how strong a budget allows the mark to be.

        Of the widths with which the payload surely reads, the one that noise leaves most of is taken; readers undo
        smoothing.

        Raises:
            JaxmarkError: if there is nothing to write in, or the budget allows not even the least step.
        """
        fitting = []
        for allowance in self.allowances(word, bounds, reference):
            if steps := self.steps(allowance):
                fitting.append(allowance.plan(max(steps)))
        if not fitting:
            raise JaxmarkError(
                f"This mesh, or the budget for it, leaves the scheme {self.scheme.name!r} nothing to write in; use a"
                " larger budget or the scheme 'keyed'."
            )
        return max(fitting, key=lambda one: (sureness(one, bits), one.margin(self._spread(one.host), bits).surplus))

    def write(
        self,
        word: Float64[np.ndarray, " code"],
        bounds: Bounds,
        bits: int,
        reference: distortion.Reference | None = None,
    ) -> Written:
        """Write a codeword as far as a budget allows.

        Args:
            word: the code bits, ±1.
            bounds: the bounds to keep.
            bits: size of the payload in bits.
            reference: what limits are measured against, if not the original.

        Raises:
            JaxmarkError: see `plan`.
        """
        reference = reference or distortion.Reference(self.original.mesh)
        plan = self.plan(word, bounds, reference, bits)
        targets = plan.host.values - plan.alpha * plan.step * self.off(plan.host, plan.dither, word, plan.step)
        shift = self.shift(plan.host, targets, _ROUNDS)
        written = displace_within(self.original, shift, bounds, reference, first=plan.size)
        mesh, moved, alpha = written.mesh, written.moved, plan.alpha * written.scale
        if alpha > 1:  # beyond the lattice, values would be off again
            mesh, alpha = displace(self.original, shift / plan.alpha), 1.0
            moved = distortion.DisplacementSize.of(shift_of(self.original, mesh)[self.original.used])
        return Written(mesh, moved, plan._replace(alpha=alpha))

    def allowances(
        self, word: Float64[np.ndarray, " code"], bounds: Bounds, reference: distortion.Reference
    ) -> list[Allowance]:
        """How much a budget allows with each width that there is anything to write with."""
        found: list[Allowance] = []
        for width, host in self.hosts.items():
            if not host.size:
                continue
            dither = make_dither(self.choices, self.scheme.name, host.names, len(word))
            # How far a mark of one step displaces is how far any does, times its step: what is off is uniform.
            shift = self.shift(host, host.values - host.step * self.off(host, dither, word, host.step), 1)
            size = float(distortion.rms(shift[self.original.used]))
            if math.isfinite(size) and size > 0:
                first = found[-1].size if found else None
                scale = displace_within(self.original, shift, bounds, reference, first=first, share=_ENOUGH).scale
                found.append(Allowance(width, host.step * scale, size * scale, host, dither))
        return found

    def steps(self, allowance: Allowance) -> list[float]:
        """The steps that may be written with: all but those to which a budget does not allow to go far enough."""
        return [step for step in self.scheme.steps if allowance.allowed / step >= _LEAST_ALPHA]

    def survives(self, plan: Plan, bits: int) -> Survival:
        """Predict the strongest noise in which a payload reads.

        Half of the vertices have half of the anchors, or none if the scheme needs the whole shape.
        """
        spread = self._spread(plan.host) / NOISE  # for each unit of noise

        def strongest(share: float) -> float:
            def spare(noise: float) -> float:
                cosine = mean_cosine(noise * spread, plan.step, plan.alpha)
                return margin(int(share * plan.host.size), cosine, carried(bits)).sure - _READS

            if spare(0.0) <= 0:
                return 0.0
            return optimize.root_scalar(spare, bracket=(0.0, plan.step / spread), rtol=1e-3).root

        return Survival(strongest(1.0), strongest(0.5 if self.scheme.in_parts else 0.0))

    def capacity(self, bounds: Bounds, noise: float) -> int:
        """The largest payload in bits, a multiple of 8, that is predicted to read in noise; 0 if not even 8.

        Args:
            bounds: on the distortion by the mark.
            noise: half width of uniform noise over the mean distance of the vertices to their centre.
        """
        word = codeword(bytes(DEFAULT_BITS // 8), self.choices)
        try:
            plan = self.plan(word, bounds, distortion.Reference(self.original.mesh), 0)
        except JaxmarkError:
            return 0
        spread, bits = self._spread(plan.host) * noise / NOISE, 0
        while plan.margin(spread, bits + 8).sure >= _SURE:
            bits += 8
        return bits

    def _spread(self, host: AnchoredHost) -> float:
        """Spread of the anchors' values by noise of `NOISE` in the original."""
        values, _ = measure(host.shape, self._noisy)
        counted = host.good > 0
        return float(np.sqrt(np.mean((np.asarray(values, np.float64) - host.values)[counted] ** 2)))

    @cached_property
    def _noisy(self) -> Float[Array, "rows 3"]:
        """The original with noise of `NOISE`."""
        original, points = self.original, self.original.positions
        noise = np.random.default_rng(0).uniform(-1, 1, points.shape) * original.used[:, None]
        return original.to_traced(points + NOISE * original.radius * noise)
