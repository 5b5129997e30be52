"""Writing of blind marks: the least displacement that gives anchors their values, as far as a budget allows.

Each anchor's value is moved towards a lattice of numbers, which is shifted by its keyed dither and its code bit. This
is dither modulation with distortion compensation: values go only a fraction α of the way (Chen, Wornell, "Quantization
index modulation", IEEE Trans. Inf. Theory 47, 2001). The host then causes no noise, so that the original is not needed
for reading.
"""

import math
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, Float64

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
from jaxmark.watermark.perception.budget import Bounds, displace_within, reference_of
from jaxmark.watermark.perception.capacity import NOISE, Survival
from jaxmark.watermark.perception.masking import apply_mask, masking_tensors

_RIDGE = 3e-3  # relative to the mean square of a row; values that contradict each other are met halfway
_HELD_RIDGE = 1e-4  # the same for the held quantities, whose rows are scaled to the size of the others
_STEPS, _TOLERANCE = 60, 1e-2  # of the conjugate gradients
_ROUNDS = 2  # number of Gauss-Newton steps
_ENOUGH = 0.9  # share of the limits that must be reached for choosing a width and a step
_SURE, _READS = 3.0, 1.0  # margins in standard deviations: for choosing a payload, and for predicting that it is read
_CODE_GAP = 1.12  # half a decibel: of 180 values, 152 bits were decoded, and 160 were not


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
    """Take one Gauss-Newton step towards the least displacement with the values `targets`.

    Args:
        shape: the mesh, prepared for measuring values.
        vertices: its original vertices.
        moved: their present displacement.
        operator: the mesh's Laplacian.
        smoothing: Chebyshev series of the filter for displacements, see `filter`.
        free: weight of each vertex's displacement for its contribution to a value: the inverse of its area.
        mask: mask of displacements, see `apply_mask`.
        targets: the values and held quantities to reach.
        counted: 1 for each anchor whose value is to be reached, else 0.
    """
    (values, held), push = jax.linearize(shape.measure, vertices + moved)
    pull = jax.linear_transpose(push, vertices)

    def adjoint(dual: tuple[Float[Array, " anchors"], Float[Array, " held"]]) -> Float[Array, "rows 3"]:
        (pulled,) = pull((counted * dual[0], dual[1]))
        wanted = free[:, None] * transpose(operator, smoothing, apply_mask(mask, pulled))
        return apply_mask(mask, filter(operator, smoothing, wanted))

    # Rows of held quantities are scaled to the mean length of the others, so that conjugate gradients converge fast.
    signs = jnp.where(jnp.arange(len(values)) * 7919 % 13 % 2 == 0, 1.0, -1.0).astype(values.dtype)
    firsts = jnp.zeros((1 + len(held), len(values)), values.dtype).at[0].set(counted * signs)
    seconds = jnp.eye(1 + len(held), dtype=values.dtype)[:, 1:]
    squares = jax.lax.map(lambda dual: sum(map(jnp.vdot, dual, push(adjoint(dual)))), (firsts, seconds))
    energy = squares[0] / counted.sum()
    factor = jnp.sqrt(energy / squares[1:])

    def gram(dual: tuple[Float[Array, " anchors"], Float[Array, " held"]]) -> tuple[Array, Array]:
        products = push(adjoint((dual[0], factor * dual[1])))
        return counted * products[0] + _RIDGE * energy * dual[0], factor * products[1] + _HELD_RIDGE * energy * dual[1]

    linear = push(moved)
    wanted = (counted * (targets[0] - values + linear[0]), factor * (targets[1] - held + linear[1]))
    solution, _ = cg(gram, wanted, tol=_TOLERANCE, maxiter=_STEPS)
    return adjoint((solution[0], factor * solution[1]))


class Plan(NamedTuple):
    """The parameters of a mark in one original."""

    width: float  # width of the narrow Gaussian
    step: float  # quantisation step of the values
    alpha: float  # fraction of the way to the lattice
    size: float  # RMS of the displacement, in diagonals
    host: AnchoredHost
    dither: Dither
    note: str  # see `jaxmark.watermark.perception.budget.Written`

    def margin(self, spread: float, bits: int) -> Margin:
        """Compute the margin of information after an attack that changes values by `spread` (root mean square)."""
        return margin(self.host.size, mean_cosine(spread, self.step, self.alpha), carried(bits))


class Allowance(NamedTuple):
    """The strength that a budget allows with anchors of one width."""

    width: float  # width of the narrow Gaussian
    allowed: float  # the largest allowed α · step
    size: float  # RMS displacement with it, in diagonals
    host: AnchoredHost
    dither: Dither
    note: str  # see `jaxmark.watermark.perception.budget.Written`

    def plan(self, step: float) -> Plan:
        """Plan a mark with a quantisation step, with the largest α that is allowed."""
        alpha = min(self.allowed / step, 1.0)
        size = self.size * alpha * step / self.allowed
        return Plan(self.width, step, alpha, size, self.host, self.dither, self.note)


class Written(NamedTuple):
    """A mesh with a codeword, written as far as a budget allows."""

    mesh: Mesh
    moved: distortion.DisplacementSize
    plan: Plan
    note: str  # see `jaxmark.watermark.perception.budget.Written`


def carried(bits: int) -> float:
    """Compute the information in bits that values must carry: payload and tag times the code's gap; 1 for presence."""
    return _CODE_GAP * (bits + TAG_BITS) if bits else 1.0


def remedies(bits: int) -> str:
    """List what can be done about a mesh that cannot carry a payload."""
    shorter = ", a shorter message, a presence mark" if bits else ""
    return f"a larger budget{shorter} or the scheme 'keyed'"


def sureness(plan: Plan, bits: int) -> float:
    """Compute the margin without any attack, up to the limit above which more is of no use."""
    return min(plan.margin(0.0, bits).sure, _SURE)


class Writer:
    """A writer of codewords in one original, with the keyed choices of one mark; it finds anchors once."""

    def __init__(self, original: Original, scheme: BlindScheme, choices: Choices) -> None:
        self.original, self.scheme, self.choices = original, scheme, choices

    @cached_property
    def hosts(self) -> dict[float, AnchoredHost]:
        """The anchors of the original for each width."""
        return self.scheme.hosts(self.original, self.choices)

    @cached_property
    def _mask(self) -> Float[Array, "rows 3 3"]:
        original = self.original
        if self.scheme.hiding:
            return masking_tensors(original)
        return original.to_traced(np.tile(np.eye(3), (len(original.used), 1, 1)))

    def off(self, host: AnchoredHost, dither: Dither, word: Float64[np.ndarray, " code"], step: float) -> np.ndarray:
        """Compute the distance of each value to the nearest number that its dither and code bit allow, in steps."""
        sign = dither.sign * word[dither.slot]
        away = host.values / step - dither.offset - np.where(sign < 0, 0.5, 0)
        return away - np.round(away)

    def shift(
        self, host: AnchoredHost, targets: Float64[np.ndarray, " anchors"], rounds: int
    ) -> Float64[np.ndarray, "points 3"]:
        """Compute the least displacement, in diagonals, that gives anchors their target values."""
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
        """Choose the width that is predicted to be read best, and the largest strength that a budget allows.

        Among the widths with which the payload is certainly read without an attack, the one with the largest margin
        in noise is taken. Smoothing does not count, because readers undo it.

        Raises:
            JaxmarkError: if the mesh has no anchors, or the budget does not allow the smallest step.
        """
        allowances = self.allowances(word, bounds, reference)
        fitting = [allowance.plan(max(steps)) for allowance in allowances if (steps := self.steps(allowance))]
        if not fitting:
            refusal = (
                f"This mesh, or the budget for it, leaves the scheme {self.scheme.name!r} nothing to write in; use a"
                " larger budget or the scheme 'keyed'."
            )
            # The anchors of different widths meet the same faces, so one note says it.
            notes = [allowance.note for allowance in allowances if allowance.note]
            raise JaxmarkError(" ".join((refusal, *notes[:1])))
        return max(fitting, key=lambda plan: (sureness(plan, bits), plan.margin(self._spread(plan.host), bits).surplus))

    def _check_anchors(self, bits: int) -> None:
        """Check that the mesh has enough anchors for a payload.

        Raises:
            JaxmarkError: if it has not.
        """
        most = max(host.size for host in self.hosts.values())
        if not most:
            raise JaxmarkError(
                f"This mesh has no anchors for the scheme {self.scheme.name!r}: it is too small, too smooth or too"
                " coarse. Use the scheme 'keyed'."
            )
        if bits and most < bits + TAG_BITS:
            raise JaxmarkError(
                f"This mesh has at most {most} anchors for the scheme {self.scheme.name!r}, and each carries at most"
                f" one bit: too few for a message of {bits} bits and its tag of {TAG_BITS}. Use a shorter message, a"
                " presence mark or the scheme 'keyed'."
            )

    def _check_plan(self, plan: Plan, bits: int) -> None:
        """Check that a payload can be read, at least from the marked mesh itself.

        Raises:
            JaxmarkError: if it certainly cannot.
        """
        left = plan.margin(0.0, bits)
        if left.sure < -_SURE:
            held, needed = max(left.surplus / math.log(2) + carried(bits), 0.0), carried(bits)
            payload = f"a message of {bits} bits with its tag" if bits else "a presence mark"
            refusal = (
                f"Within the budget, the {plan.host.size} anchors of this mesh hold about {held:.0f} bits with the"
                f" scheme {self.scheme.name!r}, but {payload} needs about {needed:.0f}. Use {remedies(bits)}."
            )
            raise JaxmarkError(f"{refusal} {plan.note}".strip())

    def write(
        self,
        word: Float64[np.ndarray, " code"],
        bounds: Bounds,
        bits: int,
        reference: distortion.Reference | None = None,
        *,
        to_be_read: bool = True,
    ) -> Written:
        """Write a codeword as far as a budget allows.

        Args:
            word: the code bits, ±1.
            bounds: the bounds on the distortion.
            bits: size of the payload in bits.
            reference: the mesh that limits are measured against; by default the original.
            to_be_read: whether to refuse payloads that cannot be read, before they are written.

        Raises:
            JaxmarkError: see `plan`.
        """
        if to_be_read:
            self._check_anchors(bits)
        reference = reference or reference_of(self.original)
        plan = self.plan(word, bounds, reference, bits)
        if to_be_read:
            self._check_plan(plan, bits)
        targets = plan.host.values - plan.alpha * plan.step * self.off(plan.host, plan.dither, word, plan.step)
        shift = self.shift(plan.host, targets, _ROUNDS)
        written = displace_within(self.original, shift, bounds, reference, first=plan.size)
        mesh, moved, alpha = written.mesh, written.moved, plan.alpha * written.scale
        if alpha > 1:  # beyond the lattice, values would have errors again
            mesh, alpha = displace(self.original, shift / plan.alpha), 1.0
            moved = distortion.DisplacementSize.of(shift_of(self.original, mesh)[self.original.used])
        return Written(mesh, moved, plan._replace(alpha=alpha), written.note)

    def allowances(
        self, word: Float64[np.ndarray, " code"], bounds: Bounds, reference: distortion.Reference
    ) -> list[Allowance]:
        """Measure the strength that a budget allows, for each width that has anchors."""
        allowances: list[Allowance] = []
        for width, host in self.hosts.items():
            if not host.size:
                continue
            dither = make_dither(self.choices, self.scheme.name, host.names, len(word))
            # The displacement is proportional to the step, because distances to the lattice are uniformly distributed.
            shift = self.shift(host, host.values - host.step * self.off(host, dither, word, host.step), 1)
            size = float(distortion.rms(shift[self.original.used]))
            if math.isfinite(size) and size > 0:
                first = allowances[-1].size if allowances else None
                written = displace_within(self.original, shift, bounds, reference, first=first, share=_ENOUGH)
                step, reached = host.step * written.scale, size * written.scale
                allowances.append(Allowance(width, step, reached, host, dither, written.note))
        return allowances

    def steps(self, allowance: Allowance) -> list[float]:
        """List the quantisation steps with which the budget allows at least the least α."""
        return [step for step in self.scheme.steps if allowance.allowed / step >= self.scheme.least_alpha]

    def survives(self, plan: Plan, bits: int) -> Survival:
        """Predict the strongest noise in which a payload is read.

        If half of the vertices are lost, half of the anchors are left, or none if the scheme needs the whole shape.
        """
        from scipy import optimize  # takes long to import

        spread = self._spread(plan.host) / NOISE  # per unit of noise

        def strongest(share: float) -> float:
            def spare(noise: float) -> float:
                cosine = mean_cosine(noise * spread, plan.step, plan.alpha)
                return margin(int(share * plan.host.size), cosine, carried(bits)).sure - _READS

            if spare(0.0) <= 0:
                return 0.0
            return optimize.root_scalar(spare, bracket=(0.0, plan.step / spread), rtol=1e-3).root

        return Survival(strongest(1.0), strongest(0.5 if self.scheme.in_parts else 0.0))

    def capacity(self, bounds: Bounds, noise: float) -> int:
        """Compute the largest payload in bits, a multiple of 8, that is predicted to be read in noise; 0 if below 8.

        Args:
            bounds: the bounds on the distortion.
            noise: half width of uniform noise over the mean distance of the vertices to their centre.
        """
        word = codeword(bytes(DEFAULT_BITS // 8), self.choices)
        try:
            plan = self.plan(word, bounds, reference_of(self.original), 0)
        except JaxmarkError:
            return 0
        spread, bits = self._spread(plan.host) * noise / NOISE, 0
        while plan.margin(spread, bits + 8).sure >= _SURE:
            bits += 8
        return bits

    def _spread(self, host: AnchoredHost) -> float:
        """Measure the root mean square change of the anchors' values by noise of `NOISE` in the original."""
        values, _ = measure(host.shape, self._noisy)
        written = host.good > 0
        return float(np.sqrt(np.mean((np.asarray(values, np.float64) - host.values)[written] ** 2)))

    @cached_property
    def _noisy(self) -> Float[Array, "rows 3"]:
        """The original with noise of `NOISE`."""
        original, points = self.original, self.original.positions
        noise = np.random.default_rng(0).uniform(-1, 1, points.shape) * original.used[:, None]
        return original.to_traced(points + NOISE * original.radius * noise)
