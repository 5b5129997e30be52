"""Keyed carriers: a keyed sign for every vertex and coordinate, shaped by band filters (direct-sequence spreading).

w = Σ_j β_j f_j(Δ) r with r[v, c] = s[v, c] · bit[slot(v, c)]: signs s and slots come from the key. Writing any number
of bits is one filter, reading them one filter and one segment-sum: time and memory do not grow with the payload.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmark.carriers.carrier import Displacement, Strength
from jaxmark.chebyshev import filter, transpose
from jaxmark.keys import permutation, signs
from jaxmark.laplacian import per_row
from jaxmark.observation import Observation
from jaxmark.precision import matmul, sum_and_norm
from jaxmark.reception import Host, Receiver, Reception, make_receiver, receive


class Chips(NamedTuple):
    """The keyed choices of a carrier: three chips a vertex, or one along its normal."""

    signs: Int[Array | np.ndarray, "vertices channels"]  # ±1; 0 on a vertex that does not move
    slots: Int[Array | np.ndarray, "vertices channels"]  # the bit that each chip belongs to
    population: Int[Array | np.ndarray, " bits"]  # how many chips each bit has


def make_chips(
    key: bytes, geometry: bytes, moving: Bool[np.ndarray, " vertices"], bits: int, *, channels: int = 3
) -> Chips:
    """Draw signs, and spread the bits over all chips of the vertices that move, equally many for each within one.

    Args:
        key: 32 bytes.
        geometry: `geometry_hash` of the original.
        moving: which of the N vertices may move.
        bits: how many bits are carried.
        channels: 3, or 1 along normals.
    """
    total = channels * int(moving.sum())
    sign = np.zeros((len(moving), channels), np.int8)
    slot = np.zeros((len(moving), channels), np.int32)
    sign[moving] = signs(key, geometry, f"keyed/{bits}/{channels}/signs", total).reshape(-1, channels)
    order = permutation(key, geometry, f"keyed/{bits}/{channels}/slots", total)
    slot[moving] = (order % bits).reshape(-1, channels)
    return Chips(sign, slot, np.bincount(order % bits, minlength=bits).astype(np.int32))


class KeyedCarrier(NamedTuple):
    """Shaped keyed chips; see `Carrier`. β is the root mean square of the chips before the filter, one per band."""

    host: Host | Receiver
    chips: Chips
    normals: Float[Array, "vertices 3"] | None = None  # with one chip a vertex: where it moves
    profile: Float[Array | np.ndarray, " bands"] | None = None  # factor on β for each band
    masking: Float[Array | np.ndarray, " vertices"] | None = None  # factor on what each vertex is moved by

    @jax.jit
    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """See `Carrier`: one filter, whatever the number of bits."""
        return self.modulate(bits, self.shape(beta))

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Carrier`."""
        return self.correlate(per_row(self.host.operator.degree, residual) * residual, self.shape(beta))

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """See `Carrier`; one filter per bit, for tests and small codes."""
        unit = jnp.eye(len(self.chips.population), dtype=self._signs.dtype)
        return jax.lax.map(lambda bits: self.adjoint(self.displacement(bits, beta), beta), unit)

    def prepared(self) -> "KeyedCarrier":
        """The same, with what only reading needs formed once for all suspects."""
        return self._replace(host=make_receiver(self.host))

    def received(self, seen: Observation | Reception) -> Reception:
        """What its receiver makes of a suspect, unless that has been made."""
        return seen if isinstance(seen, Reception) else receive(self.host, seen)

    def claim(
        self, seen: Observation | Reception, bits: Float[Array, " bits"]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """See `Carrier`: a is what `matched` gives, up to the bits' signs.

        a is free of the key as it is computed, rounding and all: only the two sums can be wrong, see `sum_and_norm`.
        """
        return self._claim(self.received(seen), bits)

    @jax.jit
    def _claim(self, received: Reception, bits: Float[Array, " bits"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return sum_and_norm(self._spread(bits) * self.matched(received))

    def matched(self, received: Reception, beta: Strength = 1.0) -> Float[Array, "vertices channels"]:
        """The vector that the keyed signs multiply: the residual through the filter matched to gain and power."""
        return self.match(matmul(received.residual, received.axes), self.shape(beta, received.gain / received.power))

    def shape(self, beta: Strength, weight: Float[Array, " bands"] | None = None) -> Float[Array, " terms *channels"]:
        """Chebyshev coefficients of Σ_j weight_j β_j f_j."""
        strength = jnp.asarray(beta).astype(self._signs.dtype)
        if strength.ndim == 0:
            strength = jnp.broadcast_to(strength, len(self.host.coefficients))
        for factor in (weight, self.profile):
            if factor is not None:
                strength = per_row(jnp.asarray(factor), strength) * strength
        return matmul(self.host.coefficients.T, strength)

    def modulate(self, bits: Float[Array, " bits"], shape: Float[Array, " terms *channels"]) -> Displacement:
        """The chips of the bits through a filter of the given coefficients."""
        return self.shaped(self._spread(bits), shape)

    def correlate(self, residual: Displacement, shape: Float[Array, " terms *channels"]) -> Float[Array, " bits"]:
        """The plain adjoint of `modulate`: Σ_v ⟨modulate(a)_v, r_v⟩ is the dot product of a and this."""
        return self._despread(self.match(residual, shape))

    def shaped(self, chips: Float[Array, "vertices channels"], shape: Float[Array, " terms *channels"]) -> Displacement:
        """Any chips through a filter, as a displacement."""
        along = filter(self.host.operator, shape, chips)
        if self.masking is not None:
            along = jnp.asarray(self.masking)[:, None] * along
        return along if self.normals is None else self.normals * along

    def match(
        self, residual: Displacement, shape: Float[Array, " terms *channels"]
    ) -> Float[Array, "vertices channels"]:
        """The plain adjoint of `shaped`."""
        along = residual if self.normals is None else jnp.sum(self.normals * residual, axis=1, keepdims=True)
        if self.masking is not None:
            along = jnp.asarray(self.masking)[:, None] * along
        return transpose(self.host.operator, shape, along)

    def _spread(self, bits: Float[Array, " bits"]) -> Float[Array, "vertices channels"]:
        return self._signs * jnp.asarray(bits).astype(self._signs.dtype)[self.chips.slots]

    def _despread(self, matched: Float[Array, "vertices channels"]) -> Float[Array, " bits"]:
        products = self._signs * matched
        return jax.ops.segment_sum(products.ravel(), self.chips.slots.ravel(), len(self.chips.population))

    @property
    def _signs(self) -> Float[Array, "vertices channels"]:
        return jnp.asarray(self.chips.signs).astype(self.host.signal.dtype)
