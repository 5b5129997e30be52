"""The capacity of a mesh: the bits that it can carry, by the dimensions of the pass band and their energy in noise."""

import math
from collections.abc import Callable, Hashable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64
from scipy.special import log_ndtr, ndtri  # scipy.stats takes long to import

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import KEY_BYTES, Choices, Key
from jaxmark.watermark.coding.message import TAG_BITS
from jaxmark.watermark.interfaces import Carrier, FreeDimensions, Reader, Scheme
from jaxmark.watermark.perception.budget import Bounds, displace_within, reference_of

_MAX_PAYLOAD_BYTES = 2**20  # the limit if nothing else limits the payload

# Energy in decibels that the polar code needs above the theoretical minimum, at a message error rate of 1e-3, as
# measured by `benchmarks/theory/limit.py --code-only`.
_CODE_GAP_DB = 1.0

NOISE = 0.005  # half width over the mean distance to the centre: the strongest noise of the SMI 2010 protocol
COVERAGE = 0.5  # share of the vertices that may be left

_ROUGH = 0.8  # share of a limit that must be reached for an estimate
_PROBES = 5  # number of marks from which the strength that limits allow is measured
_SPREADS, _MIN_SPREAD = 3, 0.007  # standard deviations of the log strengths to subtract, and their lower limit


def _root(function: Callable[[float], float], bracket: tuple[float, float]) -> float:
    """Find a root of a function that changes its sign in the bracket."""
    from scipy import optimize  # takes long to import

    return optimize.root_scalar(function, bracket=bracket).root


def least_energy(bits: int, error: float = 1e-3) -> float:
    """Compute the least E/N0 with which any code can carry bits in white noise at a message error rate.

    It is the solution of the converse 2^-bits = Q(√(2E/N0) + Q⁻¹(1 - error)) of Polyanskiy, Poor, Verdú, "Minimum
    energy to send k bits through the Gaussian channel with and without feedback", IEEE Trans. Inf. Theory 57, 2011,
    Theorem 2.

    Args:
        bits: number of bits.
        error: message error rate.
    """

    def excess(root: float) -> float:
        return float(log_ndtr(-(root + ndtri(error)))) + bits * math.log(2)

    root = _root(excess, (0.0, 10.0 + 4.0 * math.sqrt(bits)))
    return root**2 / 2


def needed_energy(bits: int) -> float:
    """Compute the E/N0 with which a payload is read in noise alone, at a message error rate of about 1e-3.

    The code needs `_CODE_GAP_DB` more than the least energy for message and tag. A presence mark is to be detected at
    1e-6 by a score that noise reduces by three standard deviations.
    """
    if bits == 0:
        return (math.sqrt(2 * math.log(1e6)) + 3) ** 2 / 2
    return 10 ** (_CODE_GAP_DB / 10) * least_energy(bits + TAG_BITS)


def worth(ratio: Float64[np.ndarray, " bands"], dimensions: Float64[np.ndarray, " bands"]) -> float:
    """Compute the effective E/N0 if the other bits act as noise on each bit: Σ_j n_j x_j/(1 + x_j).

    Joint decoding removes half of that noise.

    Args:
        ratio: x_j, the E/N0 of each dimension of band j, `[bands]`.
        dimensions: n_j, the number of dimensions of each band, `[bands]`.
    """
    return float(np.sum(dimensions * ratio / (1 + ratio)))


def needed_dimensions(bits: int) -> float:
    """Compute the number of dimensions that a payload needs for proving its message without a tag, and for decoding it.

    Without noise, the squared score over its squared norm is about the number of dimensions n. The union bound
    2^bits exp(-n/2) is then at most 1e-6 for n = 1.39 bits + 28. The code needs two dimensions for each bit of message
    and tag.
    """
    return max(2 * math.log(2) * bits + 28, 2.0 * (bits + TAG_BITS) if bits else 0.0)


class Survival(NamedTuple):
    """The strongest uniform noise that a mark survives: half width over the mean distance of vertices to the centre.

    It is infinite for schemes whose readers have no model of noise.
    """

    whole: float  # the noise if all vertices are left
    half: float  # the noise if half of them are lost


class Conditions(NamedTuple):
    """The conditions under which a message must still be readable."""

    bounds: Bounds  # bounds on the distortion by the mark
    noise: float  # half width of uniform noise over the mean distance of the vertices to their centre
    coverage: float  # share of the vertices that are left


class Capacity:
    """The capacity of an original with a scheme; each layout of the pass band is measured only once.

    If the scheme's reader has no model of noise (see `Reader.free_dimensions`), only the number of code bits limits
    the payload.
    """

    def __init__(
        self,
        original: Original,
        scheme: Scheme,
        known: Mapping[int, Callable[[], Reader]] | None = None,
    ) -> None:
        """Prepare to measure the capacity of an original with a scheme.

        Args:
            original: the mesh to mark.
            scheme: the scheme to mark it with.
            known: functions that return available readers, by the size of their payload; other readers are made.
        """
        self.original, self.scheme = original, scheme
        self._known = {scheme.layout(original, bits): make for bits, make in (known or {}).items()}
        self._free: dict[Hashable, FreeDimensions | None] = {}
        self._reached: dict[Hashable, float] = {}

    def least_budget(self, bits: int, conditions: Conditions) -> float:
        """Compute the least RMS displacement, in diagonals, with which a payload is readable.

        N0/2 is the variance ν²/3 of uniform noise of half width ν = noise · radius. The energy is that of the mark
        after cropping and projection.

        Args:
            bits: size of the payload in bits.
            conditions: the noise and the coverage; the bounds have no effect.

        Returns:
            The displacement; 0 if there is no noise or no model of it, infinite if there are too few dimensions.
        """
        try:
            self.scheme.code_length(self.original, bits)
        except JaxmarkError:
            return math.inf
        free, needed = self._free_dimensions(bits), needed_energy(bits)
        if free is None:
            return 0.0
        dimensions = conditions.coverage * free.dimensions
        if dimensions.sum() <= max(needed_dimensions(bits), needed):
            return math.inf
        if conditions.noise == 0:
            return 0.0
        ratio = free.energy / (2 * (conditions.noise * self.original.radius) ** 2 / 3)

        def excess(logarithm: float) -> float:
            return worth(math.exp(2 * logarithm) * ratio, dimensions) - needed

        return math.exp(_root(excess, (-100.0, 100.0)))

    def noise(self, bits: int, reached: float, conditions: Conditions) -> float:
        """Predict the strongest noise, in the unit of `Conditions`, that a payload survives at an RMS displacement.

        Args:
            bits: size of the payload in bits.
            reached: the displacement, in diagonals.
            conditions: the coverage; bounds and noise have no effect.

        Returns:
            The noise; 0 if the payload needs more dimensions, infinite without a model of noise.
        """
        least = self.least_budget(bits, conditions._replace(noise=1.0))  # proportional to the noise
        return reached / least if least > 0 else math.inf

    def evidence(self, bits: int, reached: float, noise: float) -> float:
        """Predict the evidence for a claimed message in noise, S²/2‖a‖² in nats: ½ Σ_j n_j s_j/(1 + s_j).

        s_j is the ratio of the mark's energy to the noise's in each of the n_j dimensions of band j.

        Args:
            bits: size of the payload in bits.
            reached: the RMS displacement, in diagonals.
            noise: as in `Conditions`, positive.

        Returns:
            The evidence; 0 if the reader has no model of noise.
        """
        free = self._free_dimensions(bits)
        if free is None:
            return 0.0
        ratio = reached**2 * free.energy / ((noise * self.original.radius) ** 2 / 3)
        return float(np.sum(free.dimensions * ratio / (1 + ratio))) / 2

    def needed(self, bits: int, evidence: float, noise: float) -> float:
        """Compute the RMS displacement, in diagonals, predicted to give this evidence; infinite if none does."""
        if self.evidence(bits, 1.0, noise) <= evidence:
            return math.inf

        def excess(logarithm: float) -> float:
            return self.evidence(bits, math.exp(logarithm), noise) - evidence

        return math.exp(_root(excess, (-100.0, 0.0)))

    def _free_dimensions(self, bits: int) -> FreeDimensions | None:
        """Return the free dimensions for a payload."""
        layout = self.scheme.layout(self.original, bits)
        if layout not in self._free:
            make = self._known.get(layout) or self._carrier(bits).reader
            self._free[layout] = make().free_dimensions(self.original.to_traced(self.original.used))
        return self._free[layout]

    def reach(self, bits: int, bounds: Bounds) -> float:
        """Compute the RMS displacement, in diagonals, that bounds certainly allow for a mark with a payload."""
        if bounds.rms is not None and not bounds.limits:
            return bounds.rms
        layout = self.scheme.layout(self.original, bits)
        if layout not in self._reached:
            carrier = self._carrier(bits)
            reached = [self._write(carrier, word, bounds) for word in range(_PROBES)]
            # Marks under the same limits differ: by 1 % if a limit is a mean, and by 10 % if it is a percentile.
            logs = np.log(reached)
            spread = max(float(logs.std(ddof=1)), _MIN_SPREAD)
            self._reached[layout] = math.exp(logs.mean() - _SPREADS * spread)
        return self._reached[layout]

    def estimate_reach(self, bits: int, bounds: Bounds, enough: float = math.inf) -> float:
        """Estimate the RMS displacement, in diagonals, that bounds allow for a mark, from few displacements.

        Args:
            bits: size of the payload in bits.
            bounds: the bounds on the distortion.
            enough: a displacement that need not be exceeded.
        """
        most = min(enough, bounds.rms or math.inf)
        bounds = bounds._replace(rms=most if most < 1 else None)
        return self._write(self._carrier(bits), 0, bounds, share=_ROUGH) if bounds.limits else most

    def _write(self, carrier: Carrier, word: int, bounds: Bounds, **options: float) -> float:
        """Measure the RMS displacement of a mark with one of several codewords."""
        signs = np.random.default_rng(word).choice([-1.0, 1.0], carrier.code_bits)
        probe = self.original.to_host(carrier.displacement(jax.device_put(signs.astype(self.original.signal.dtype))))
        return displace_within(self.original, probe, bounds, reference_of(self.original), **options).moved.rms

    def _carrier(self, bits: int) -> Carrier:
        code = self.scheme.code_length(self.original, bits)
        return self.scheme.carrier(self.original, Choices(Key(bytes(KEY_BYTES)), b""), bits, code)

    def bits(self, conditions: Conditions) -> int:
        """Compute the largest payload in bits, a multiple of 8; 0 if the mesh cannot carry 8 bits."""

        def fits(size: int) -> bool:
            least = self.least_budget(8 * size, conditions)
            return least == 0 or (math.isfinite(least) and least <= self.reach(8 * size, conditions.bounds))

        least, most = 0, 1
        while fits(most) and most < _MAX_PAYLOAD_BYTES:
            least, most = most, 2 * most
        while most - least > 1:
            middle = (least + most) // 2
            least, most = (middle, most) if fits(middle) else (least, middle)
        return 8 * least
