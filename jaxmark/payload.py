"""How many bits a mesh carries: room for them in the pass band, and energy for them in noise."""

import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy import optimize
from scipy.special import log_ndtr, ndtri  # scipy.stats takes long to import

from jaxmark.budget import Budget, write
from jaxmark.carriers import KeyedCarrier
from jaxmark.channels import band_energies
from jaxmark.errors import JaxmarkError
from jaxmark.keys import KEY_BYTES
from jaxmark.message import TAG_BITS
from jaxmark.observation import observe
from jaxmark.original import Original
from jaxmark.reception import Receiver, clean, make_receiver, normal_factor
from jaxmark.schemes import KeyedScheme, Layout

_GAP = 1.0  # decibel, of the polar code at a message error rate of 1e-3; `benchmarks/limit.py --code-only` measures it


class Room(NamedTuple):
    """What the projection leaves of a carrier's mark, band by band."""

    dimensions: Float64[np.ndarray, " bands"]  # left of those that are written in
    energy: Float64[np.ndarray, " bands"]  # of each dimension, for a mean square displacement of 1


def room(carrier: KeyedCarrier, original: Original) -> Room:
    """Measure a carrier by one probe of random signs in place of the keyed ones."""
    measured = _probe(carrier, make_receiver(carrier.host), original.traced(original.used))
    whole, left = np.asarray(measured, np.float64).clip(0)
    strength = np.ones(len(whole)) if carrier.profile is None else np.asarray(carrier.profile, np.float64)
    # Three coordinates, or one along normals, of each vertex make a band's whole.
    displaced = whole @ strength**2 / original.used.sum()
    return Room(left * (strength > 0), strength**2 / displaced if displaced > 0 else strength**2)


@jax.jit
def _probe(carrier: KeyedCarrier, host: Receiver, moving: Float[Array, " vertices"]) -> Float[Array, "2 bands"]:
    """Energies of random signs in each band, before and after projection."""
    signs = jax.random.rademacher(jax.random.key(2), carrier.chips.signs.shape, moving.dtype) * moving[:, None]
    everything = observe(jnp.zeros_like(host.signal), moving)
    factor = normal_factor(host, everything)
    white = signs if carrier.normals is None else carrier.normals * signs
    energies = partial(band_energies, host.operator, host.coefficients)
    return jnp.stack([energies(x, x) for x in (white, clean(host, everything, factor, white))])


def least_energy(bits: int, error: float = 1e-3) -> float:
    """E/N0 that any code needs for so many bits at a message error rate in white noise.

    The converse 2^-bits = Q(√(2E/N0) + Q⁻¹(1 - error)) of Polyanskiy, Poor, Verdú, "Minimum energy to send k bits
    through the Gaussian channel with and without feedback", IEEE Trans. Inf. Theory 57, 2011, Theorem 2.
    """

    def excess(root: float) -> float:
        return float(log_ndtr(-(root + ndtri(error)))) + bits * math.log(2)

    root = optimize.root_scalar(excess, bracket=(0.0, 10.0 + 4.0 * math.sqrt(bits))).root
    return root**2 / 2


def needed_energy(bits: int) -> float:
    """E/N0 with which the whole chain reads so many bits alone, but for about one message in a thousand.

    The code takes `_GAP` more than the least for message and tag.
    """
    return 10 ** (_GAP / 10) * least_energy(bits + TAG_BITS)


def worth(ratio: Float64[np.ndarray, " bands"], dimensions: Float64[np.ndarray, " bands"]) -> float:
    """E/N0 to one bit where the others are noise to it: Σ_j n_j x_j/(1 + x_j), for E/N0 of x_j in each dimension.

    Half of that noise is taken off by joint decoding.
    """
    return float(np.sum(dimensions * ratio / (1 + ratio)))


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

        N0/2 is the variance of uniform noise of half width ν = noise · radius, ν²/3, and the energy what coverage and
        projection leave of the mark's.
        """
        original, scheme = self._original, self._scheme
        try:
            code = scheme.code_length(original, bits)
        except JaxmarkError:
            return math.inf
        layout = scheme.layout(original, bits)
        if layout not in self._rooms:
            self._rooms[layout] = room(self._carrier(bits, code), original)
        left, needed = self._rooms[layout], needed_energy(bits)
        dimensions = conditions.coverage * left.dimensions
        if dimensions.sum() <= max(needed_dimensions(bits), needed):
            return math.inf
        if conditions.noise == 0:
            return 0.0
        ratio = left.energy / (2 * (conditions.noise * self._radius()) ** 2 / 3)

        def excess(logarithm: float) -> float:
            return worth(math.exp(2 * logarithm) * ratio, dimensions) - needed

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
            reached = write(self._original, self._original.on_host(probe), budget).moved.rms
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
