"""How many bits a mesh carries: room for them in the pass band, and energy for them in noise."""

import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy import optimize, stats

from jaxmark.budget import Budget, write
from jaxmark.carriers import KeyedCarrier
from jaxmark.channels import band_energies
from jaxmark.errors import JaxmarkError
from jaxmark.keys import KEY_BYTES
from jaxmark.message import TAG_BITS
from jaxmark.observation import observe
from jaxmark.original import Original
from jaxmark.reception import clean, receive
from jaxmark.schemes import KeyedScheme, Layout

_GAP = 1.0  # decibel, of the polar code at a message error rate of 1e-3; `benchmarks/limit.py --code-only` measures it


class Room(NamedTuple):
    """What the projection leaves of a carrier's mark."""

    dimensions: float  # equivalent number of equally strong ones
    energy: float  # share of the mark's
    bands: Float64[np.ndarray, " bands"]  # dimensions left in each band
    strength: Float64[np.ndarray, " bands"]  # β² for a mean square displacement of 1, by the carrier's profile


def room(carrier: KeyedCarrier, original: Original) -> Room:
    """Measure a carrier by one probe of random signs in place of the keyed ones."""
    energies, bands = _probe(carrier, jnp.asarray(original.used, carrier.host.signal.dtype))
    kept, written, again = map(float, energies)
    whole, left = np.asarray(bands, np.float64).clip(0)
    relative = np.square(np.ones(len(whole)) if carrier.profile is None else np.asarray(carrier.profile, np.float64))
    # Three coordinates, or one along normals, of each vertex make a band's whole.
    displaced = whole @ relative / original.used.sum()
    return Room(
        kept**2 / again if again > 0 else 0.0,
        kept / written if written > 0 else 0.0,
        left,
        relative / displaced if displaced > 0 else relative,
    )


@jax.jit
def _probe(carrier: KeyedCarrier, moving: Float[Array, " vertices"]) -> tuple[Array, Array]:
    """Energies of a probe of random signs: of what the projection leaves of it, as written, and of what is matched.

    And of the signs themselves in each band, before and after projection.
    """
    host, shape = carrier.host, carrier.shape(1.0)
    signs = jax.random.rademacher(jax.random.key(2), carrier.chips.signs.shape, moving.dtype) * moving[:, None]
    probe = carrier.shaped(signs, shape)
    received = receive(host, observe(jnp.zeros_like(host.signal), moving))
    kept = clean(host, received.seen, received.factor, probe)
    again = carrier.match(kept, shape) * moving[:, None]
    white = signs if carrier.normals is None else carrier.normals * signs
    energies = partial(band_energies, host.operator, host.coefficients)
    bands = [energies(x, x) for x in (white, clean(host, received.seen, received.factor, white))]
    return jnp.stack([jnp.sum(probe * kept), jnp.sum(probe**2), jnp.sum(again**2)]), jnp.stack(bands)


def least_energy(bits: int, error: float = 1e-3) -> float:
    """E/N0 that any code needs for so many bits at a message error rate in white noise.

    The converse 2^-bits = Q(√(2E/N0) + Q⁻¹(1 - error)) of Polyanskiy, Poor, Verdú, "Minimum energy to send k bits
    through the Gaussian channel with and without feedback", IEEE Trans. Inf. Theory 57, 2011, Theorem 2.
    """

    def excess(root: float) -> float:
        return float(stats.norm.logsf(root + stats.norm.ppf(error))) + bits * math.log(2)

    root = optimize.root_scalar(excess, bracket=(0.0, 10.0 + 4.0 * math.sqrt(bits))).root
    return root**2 / 2


def needed_energy(bits: int, dimensions: float) -> float:
    """E/N0 with which the whole chain reads so many bits, but for about one message in a thousand.

    The code takes `_GAP` more than the least for message and tag. To one bit, the others are noise of E in all the
    dimensions, of which joint decoding takes off half: E/N0 is worth (E/N0)/(1 + (E/N0)/dimensions). Infinite where
    that is never enough.
    """
    alone = 10 ** (_GAP / 10) * least_energy(bits + TAG_BITS)
    crowded = 1 - alone / dimensions
    return alone / crowded if crowded > 0 else math.inf


def needed_dimensions(bits: int) -> float:
    """Dimensions that must be left for a payload: to prove its message without a tag, and to tell its code bits apart.

    Without noise the squared score over its squared norm is about the number of dimensions n, so that the union bound
    2^bits exp(-n/2) is at most 1e-6 for n = 1.39 bits + 28; two for each bit and the tag's are the code's.
    """
    return max(2 * math.log(2) * bits + 28, 2.0 * (bits + TAG_BITS))


class Conditions(NamedTuple):
    """Under which a message must still read."""

    budget: Budget
    noise: float  # half width of uniform noise over the mean distance of the vertices to their centre
    coverage: float  # share of the vertices that are left


class Capacity:
    """How many bits an original carries by the keyed scheme; measures each layout once."""

    def __init__(
        self, original: Original, scheme: KeyedScheme, known: Mapping[int, KeyedCarrier] | None = None
    ) -> None:
        """Carriers that exist already, by their payload, need not be made again."""
        self._original, self._scheme = original, scheme
        self._rooms: dict[Layout, Room] = {
            scheme.layout(original, bits): room(carrier, original) for bits, carrier in (known or {}).items()
        }
        self._reached: dict[Layout, float] = {}

    def least_budget(self, bits: int, conditions: Conditions) -> float:
        """With which budget so many bits are carried; infinite where the dimensions do not suffice.

        Uniform noise on three coordinates has the RMS displacement ν = noise · radius, and E/N0 = 3N (budget/ν)² / 2
        for N vertices, times what coverage and projection leave.
        """
        original, scheme = self._original, self._scheme
        try:
            code = scheme.code_length(original, bits)
        except JaxmarkError:
            return math.inf
        layout = scheme.layout(original, bits)
        if layout not in self._rooms:
            self._rooms[layout] = room(self._carrier(bits, code), original)
        left = self._rooms[layout]
        if scheme.profile:
            return self._least_by_bands(bits, left, conditions)
        if conditions.coverage * left.dimensions < needed_dimensions(bits):
            return math.inf
        if conditions.noise == 0:
            return 0.0
        needed = needed_energy(bits, conditions.coverage * left.dimensions)
        vertices = conditions.coverage * left.energy * int(original.used.sum())
        return conditions.noise * self._radius() * math.sqrt(needed / (1.5 * vertices))

    def _least_by_bands(self, bits: int, left: Room, conditions: Conditions) -> float:
        """The same for a profile: each band's E/N0 is worth what `needed_energy` says, in the band's dimensions."""
        dimensions = conditions.coverage * left.bands * (left.strength > 0)
        alone = 10 ** (_GAP / 10) * least_energy(bits + TAG_BITS)
        if dimensions.sum() < max(needed_dimensions(bits), alone):
            return math.inf
        if conditions.noise == 0:
            return 0.0
        # Of one dimension, in units of the squared budget.
        energy = left.strength / (2 * (conditions.noise * self._radius()) ** 2 / 3)

        def excess(logarithm: float) -> float:
            each = math.exp(2 * logarithm) * energy
            return float(np.sum(dimensions * each / (1 + each))) - alone

        return math.exp(optimize.root_scalar(excess, bracket=(-100.0, 100.0)).root)

    def _radius(self) -> float:
        points = self._original.positions[self._original.used]
        return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean())

    def reach(self, bits: int, budget: Budget) -> float:
        """The RMS displacement that a budget surely allows a mark of so many bits."""
        if budget.rms is not None and not budget.limits:
            return budget.rms
        layout = self._scheme.layout(self._original, bits)
        if layout not in self._reached:
            carrier = self._carrier(bits, self._scheme.code_length(self._original, bits))
            probe = carrier.displacement(jnp.ones(len(carrier.chips.population), carrier.host.signal.dtype))
            reached = write(self._original, np.asarray(probe, np.float64), budget).moved.rms
            # Two marks under the same limits differ by a percent or so.
            self._reached[layout] = 0.98 * reached
        return self._reached[layout]

    def _carrier(self, bits: int, code: int) -> KeyedCarrier:
        return self._scheme.carrier(self._original, bytes(KEY_BYTES), bits, code)

    def bits(self, conditions: Conditions) -> int:
        """The largest payload, a multiple of 8 bits; 0 if not even 8."""

        def fits(size: int) -> bool:
            least = self.least_budget(8 * size, conditions)
            return math.isfinite(least) and least <= self.reach(8 * size, conditions.budget)

        least, most = 0, 1
        while fits(most):
            least, most = most, 2 * most
        while most - least > 1:
            middle = (least + most) // 2
            least, most = (middle, most) if fits(middle) else (least, middle)
        return 8 * least
