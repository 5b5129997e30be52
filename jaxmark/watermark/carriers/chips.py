"""Keyed carriers: a keyed sign for every vertex and coordinate, shaped by band filters (direct-sequence spreading).

The displacement is w = Σ_j β_j f_j(Δ) r with r[v, c] = s[v, c] · bit[slot(v, c)]; the signs s and the slots are derived
from the key. Writing needs one filter, and reading one filter and one segment sum, whatever the number of bits: time
and memory do not grow with the payload.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Int64

from jaxmark.alignment.observation import Observation, observe
from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed, probe_signs, random_key
from jaxmark.spectral.chebyshev import energy_moments, filter, transpose
from jaxmark.spectral.laplacian import per_row
from jaxmark.spectral.precision import matmul, sum_and_norm
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.interfaces import Claim, Detector, Displacement, FreeDimensions, Strength, check_strength
from jaxmark.watermark.perception.masking import apply_mask
from jaxmark.watermark.reading.detectors import joint
from jaxmark.watermark.reading.reception import (
    Host,
    Receiver,
    Reception,
    clean,
    no_filters,
    normal_factor,
    nuisance_basis,
    receive,
    weigh_evenly,
)


class Chips(NamedTuple):
    """The keyed choices of a carrier: three chips per vertex, or one along its normal."""

    signs: Int[Array | np.ndarray, "vertices channels"]  # ±1; 0 on a vertex that does not move
    slots: Int[Array | np.ndarray, "vertices channels"]  # index of the bit that each chip belongs to
    population: Int[Array | np.ndarray, " bits"]  # number of chips of each bit

    def spread(self, bits: Float[Array, " bits"], dtype: DTypeLike) -> Float[Array, "vertices channels"]:
        """Compute the value of each chip: its sign times the bit of its slot."""
        return jnp.asarray(self.signs).astype(dtype) * jnp.asarray(bits).astype(dtype)[self.slots]

    @jax.jit
    def collect(self, matched: Float[Array, "vertices channels"]) -> Float[Array, " bits"]:
        """Apply the transpose of `spread`: add up what matches each bit's chips, times their signs."""
        products = jnp.asarray(self.signs).astype(matched.dtype) * matched
        return jax.ops.segment_sum(products.ravel(), jnp.asarray(self.slots).ravel(), len(self.population))

    def redraw(self, seed: Seed) -> "Chips":
        """Replace the signs by random ones; the slots are unchanged, and signs of 0, on vertices that stay, stay 0."""
        moving = jnp.abs(jnp.asarray(self.signs)).astype(jnp.int8)
        return self._replace(signs=moving * jax.random.rademacher(random_key(seed), moving.shape, jnp.int8))


def make_chips(
    choices: Choices,
    places: Int64[np.ndarray, " vertices"],
    bits: int,
    *,
    channels: int = 3,
    count: int | None = None,
) -> Chips:
    """Draw the signs, and assign the chips of all moving points to the bits; the numbers per bit differ by at most one.

    Args:
        choices: the keyed choices of the mark.
        places: index of each vertex among the points that may move, or -1 for a vertex that may not move, `[N]`.
        bits: number of bits to carry.
        channels: chips per vertex: 3, or 1 along normals.
        count: number of points that may move; by default, the number of indices in `places` that are not -1.
    """
    moving = places >= 0
    total = channels * (int(moving.sum()) if count is None else count)
    sign = np.zeros((len(places), channels), np.int8)
    slot = np.zeros((len(places), channels), np.int32)
    sign[moving] = choices.signs(f"keyed/{bits}/{channels}/signs", total).reshape(-1, channels)[places[moving]]
    order = choices.permutation(f"keyed/{bits}/{channels}/slots", total)
    slot[moving] = (order % bits).reshape(-1, channels)[places[moving]]
    return Chips(sign, slot, np.bincount(order % bits, minlength=bits).astype(np.int32))


class KeyedCarrier(NamedTuple):
    """A carrier whose bits are spread over keyed chips, which band filters turn into a displacement; see `Carrier`.

    β is the root mean square of the chips before the filter, one per band.
    """

    host: Host
    chips: Chips
    normals: Float[Array, "vertices 3"] | None = None  # direction in which each vertex moves, if it has one chip
    profile: Float[Array | np.ndarray, " bands"] | None = None  # factor on β for each band
    masking: Float[Array | np.ndarray, " vertices *axes"] | None = None  # factor or matrix `[3, 3]` on displacements

    @property
    def code_bits(self) -> int:
        """See `Carrier`."""
        return len(self.chips.population)

    @property
    def detector(self) -> Detector:
        """See `Carrier`."""
        return joint

    @jax.jit
    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """See `Carrier`; needs one filter, whatever the number of bits."""
        return self.modulate(bits, self.coefficients(beta))

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Carrier`."""
        return self.correlate(per_row(self.host.operator.mass, residual) * residual, self.coefficients(beta))

    @jax.jit
    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """See `Carrier`; needs one filter per bit, hence is meant for tests and small codes."""
        unit = jnp.eye(self.code_bits, dtype=self.host.signal.dtype)
        return jax.lax.map(lambda bits: self.adjoint(self.displacement(bits, beta), beta), unit)

    def claim(self, observation: Observation, bits: Float[Array, " bits"]) -> Claim:
        """See `Carrier`, and `KeyedReader.claim`."""
        reader = self.reader()
        return reader.claim(reader.receive(observation), bits)

    def redraw(self, seed: Seed) -> "KeyedCarrier":
        """See `Carrier`, and `Chips.redraw`."""
        return self._replace(chips=self.chips.redraw(seed))

    def with_bands(
        self, strengths: Float[Array, " bands"], bands: Float[Array, "bands terms"] | None = None
    ) -> "KeyedCarrier":
        """Return the same chips with other relative strengths of the bands, or with other bands; a pure function.

        Args:
            strengths: factor on β for each band, `[bands]`.
            bands: Chebyshev coefficients, one band per row; by default the carrier's own.
        """
        host = self.host if bands is None else self.host._replace(coefficients=bands)
        if strengths.shape != (len(host.coefficients),):
            raise JaxmarkError(
                f"with_bands needs {len(host.coefficients)} strengths, one per band; got the shape {strengths.shape}."
            )
        return self._replace(profile=strengths, host=host)

    def reader(self) -> "KeyedReader":
        """See `Carrier`."""
        return KeyedReader(self, nuisance_basis(self.host))

    def coefficients(
        self, beta: Strength, weight: Float[Array, " bands"] | None = None
    ) -> Float[Array, "*channels terms"]:
        """Compute the Chebyshev coefficients of Σ_j weight_j β_j f_j, including the profile."""
        strength = check_strength(jnp.asarray(beta), len(self.host.coefficients)).astype(self.host.signal.dtype)
        if strength.ndim == 0:
            strength = jnp.broadcast_to(strength, len(self.host.coefficients))
        for factor in (weight, self.profile):
            if factor is not None:
                strength = per_row(jnp.asarray(factor), strength) * strength
        return matmul(self.host.coefficients.T, strength).T

    def modulate(self, bits: Float[Array, " bits"], coefficients: Float[Array, "*channels terms"]) -> Displacement:
        """Spread the bits over their chips, and filter the chips into a displacement."""
        return self.filter_chips(self.spread(bits), coefficients)

    def correlate(self, residual: Displacement, coefficients: Float[Array, "*channels terms"]) -> Float[Array, " bits"]:
        """Apply the adjoint of `modulate` for inner products without D, Σ_v ⟨modulate(a)_v, r_v⟩."""
        return self.chips.collect(self.match_chips(residual, coefficients))

    def filter_chips(
        self, chips: Float[Array, "vertices channels"], coefficients: Float[Array, "*channels terms"]
    ) -> Displacement:
        """Filter any chips into a displacement."""
        along = filter(self.host.operator, coefficients, chips)
        return apply_mask(self.masking, along if self.normals is None else self.normals * along)

    def match_chips(
        self, residual: Displacement, coefficients: Float[Array, "*channels terms"]
    ) -> Float[Array, "vertices channels"]:
        """Apply the adjoint of `filter_chips` for inner products without D, which is a matched filter."""
        masked = apply_mask(self.masking, residual)
        along = masked if self.normals is None else jnp.sum(self.normals * masked, axis=1, keepdims=True)
        return transpose(self.host.operator, coefficients, along)

    def spread(self, bits: Float[Array, " bits"]) -> Float[Array, "vertices channels"]:
        """See `Chips.spread`."""
        return self.chips.spread(bits, self.host.signal.dtype)

    def masked_share(self) -> float:
        """Compute the effective share of dimensions under masking: (Σ λ)² / (n Σ λ²) for energies λ of n dimensions."""
        if self.masking is None:
            return 1.0
        root = np.asarray(self.masking, np.float64)
        square = root[:, None] ** 2 * np.ones(3) if root.ndim == 1 else root @ root
        total = square.sum() if root.ndim == 1 else np.trace(square, axis1=1, axis2=2).sum()
        moving = np.count_nonzero(np.asarray(self.chips.signs).any(axis=1))
        return float(total**2 / (3 * moving * np.sum(square**2)))


class KeyedReader(NamedTuple):
    """The reader of keyed carriers, which projects off the nuisance and weights the bands; see `Reader`."""

    carrier: KeyedCarrier
    nuisance: Float[Array, "vertices columns"]  # nearly orthonormal basis that is projected off each coordinate

    @property
    def receiver(self) -> Receiver:
        """The part of the reader that does not depend on the key."""
        host = self.carrier.host
        return Receiver(host.operator, host.signal, host.coefficients, self.nuisance)

    def receive(self, observation: Observation) -> Reception:
        """See `Reader`, and `jaxmark.watermark.reading.reception.receive`."""
        return receive(self.receiver, observation)

    def ways(self, received: Reception) -> Sequence[Reception]:
        """See `Reader`; first the bands are weighted by their gain and noise in the suspect, then they weigh the same.

        The first way gives the most evidence; the second is the hardest to attack.
        """
        return received, weigh_evenly(received)

    def claim(self, received: Reception, bits: Float[Array, " bits"]) -> Claim:
        """See `Reader`; up to the signs of the bits, the vector a is the result of `matched_residual`.

        The computed a, including rounding errors, does not depend on the keyed signs. Only the two sums have errors
        that do, see `jaxmark.spectral.precision.sum_and_norm`.
        """
        return _claim(self.carrier.chips, self.matched_residual(received), bits)

    @jax.jit
    def matched_residual(self, received: Reception) -> Float[Array, "vertices channels"]:
        """Filter the residual with the filter matched to gain and power; the keyed signs multiply the result."""
        return self.carrier.match_chips(matmul(received.residual, received.axes), self._matched_coefficients(received))

    def linear_score(
        self, received: Reception, residual: Displacement, bits: Float[Array, " bits"]
    ) -> Float[Array, ""]:
        """See `Reader`; weights, gain, power and axes are held fixed."""
        rest = matmul(clean(received.receiver, received.observation, received.factor, residual), received.axes)
        return jnp.sum(bits * self.carrier.correlate(matmul(rest, received.axes), self._matched_coefficients(received)))

    @jax.jit
    def read_quickly(self, observation: Observation, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Reader`; plain correlations without the nuisance, in which the other bits act as noise."""
        receiver = self.receiver
        residual = clean(receiver, observation, normal_factor(receiver, observation), observation.residual)
        return self.carrier.correlate(residual, self.carrier.coefficients(beta))

    def correlate(self, received: Reception) -> Float[Array, " bits"]:
        """See `Reader`; the score of a claim is the sum of these values times the signs of its codeword."""
        return self.carrier.chips.collect(self.matched_residual(received))

    def free_dimensions(self, moving: Float[Array, " vertices"]) -> FreeDimensions:
        """See `Reader`; measured with one probe, which has random signs instead of the keyed ones."""
        (signs,) = probe_signs("capacity", self.carrier.chips.signs.shape, dtype=moving.dtype)
        # Without bands and chips, pass bands and payloads of all sizes share a program.
        bands = self.carrier.host.coefficients
        receiver = self.receiver._replace(coefficients=no_filters(bands))
        moments = np.asarray(_probe(receiver, self.carrier.normals, moving, signs), np.float64)
        whole, remaining = (moments @ np.asarray(bands, np.float64).T).clip(0)
        profile = self.carrier.profile
        strength = np.ones(len(whole)) if profile is None else np.asarray(profile, np.float64)
        # The energy of a whole band is summed over the three coordinates of each vertex, or over one along its normal.
        displaced = whole @ strength**2 / np.count_nonzero(moving)
        energy = strength**2 / displaced if displaced > 0 else strength**2
        # With masking, the same energy is concentrated in fewer dimensions.
        share = self.carrier.masked_share()
        return FreeDimensions(share * remaining * (strength > 0), energy / share)

    def with_carrier(self, carrier: KeyedCarrier) -> "KeyedReader":
        """See `Reader`."""
        return self._replace(carrier=carrier)

    def _matched_coefficients(self, received: Reception) -> Float[Array, "*channels terms"]:
        """Compute the Chebyshev coefficients of the filter matched to gain and power."""
        return self.carrier.coefficients(1.0, received.gain / received.power)


@jax.jit
def _claim(chips: Chips, matched: Float[Array, "vertices channels"], bits: Float[Array, " bits"]) -> Claim:
    return Claim(*sum_and_norm(chips.spread(bits, matched.dtype) * matched))


@jax.jit
def _probe(
    receiver: Receiver,
    normals: Float[Array, "vertices 3"] | None,
    moving: Float[Array, " vertices"],
    signs: Float[Array, "vertices channels"],
) -> Float[Array, "2 terms"]:
    """Measure the moments of the energy of random signs, before and after the nuisance is projected off."""
    signs = signs * moving[:, None]
    observation = observe(jnp.zeros_like(receiver.signal), moving)
    factor = normal_factor(receiver, observation)
    white = signs if normals is None else normals * signs
    remaining = clean(receiver, observation, factor, white)
    terms = receiver.coefficients.shape[1]
    # The two are measured one after the other, so that there is less to compile.
    return jax.lax.map(lambda x: energy_moments(receiver.operator, x, terms), jnp.stack([white, remaining]))
