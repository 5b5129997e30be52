"""Carriers that multiply components, which are fixed displacements of the vertices, by keyed sequences of signs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxmark.alignment.observation import Observation
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.precision import einsum, sum_and_norm
from jaxmark.watermark.carriers.components import Components
from jaxmark.watermark.interfaces import Claim, Detector, Displacement, Strength, check_strength
from jaxmark.watermark.reading.detectors import decorrelate


class PlainReader(NamedTuple):
    """The reader of a carrier that does not use its host: it reads suspects without preprocessing; see `Reader`."""

    carrier: Any  # a `Carrier`

    def receive(self, observation: Observation) -> Observation:
        """See `Reader`; returns the observation itself."""
        return observation

    def ways(self, received: Observation) -> Sequence[Observation]:
        """See `Reader`; the only way is the observation itself."""
        return (received,)

    def claim(self, received: Observation, bits: Float[Array, " bits"]) -> Claim:
        """See `Reader`; this is `Carrier.claim`."""
        return self.carrier.claim(received, bits)

    def linear_score(
        self, received: Observation, residual: Displacement, bits: Float[Array, " bits"]
    ) -> Float[Array, ""]:
        """See `Reader`; a plain correlation is already linear."""
        return self.carrier.claim(received._replace(residual=residual), bits).score

    def read_quickly(self, observation: Observation, beta: Strength = 1.0) -> None:
        """See `Reader`; there is no shortcut, because the detectors of plain carriers are fast."""
        return None

    def correlate(self, received: Observation) -> None:
        """See `Reader`; there is no shortcut, because the detectors of plain carriers are fast."""
        return None

    def free_dimensions(self, moving: Float[Array, " vertices"]) -> None:
        """See `Reader`; there is no noise model."""
        return None

    def with_carrier(self, carrier: Any) -> "PlainReader":
        """See `Reader`."""
        return PlainReader(carrier)


class ModulatedCarrier(NamedTuple):
    """A carrier that writes bits on components x_j of the host: w = Σ_i bit_i Σ_j β_j p_j^(i) x_j (Sohn et al., 2.2).

    Each bit i has a sequence p^(i), with a sign per band and coordinate, or a sign per band for all three coordinates.
    With polynomial bands as components this is the paper's scheme, with eigenspaces Ohbuchi's. Results have the dtype
    of the components.
    """

    components: Components
    sequences: Int[Array | np.ndarray, "bits bands 3"] | Int[Array | np.ndarray, "bits bands 1"]  # of ±1

    @property
    def code_bits(self) -> int:
        """See `Carrier`."""
        return len(self.sequences)

    @property
    def detector(self) -> Detector:
        """See `Carrier`; the components are not orthogonal, so all bits are solved for at once."""
        return decorrelate

    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """See `Carrier`."""
        amplitudes = einsum("k,kjc->jc", self._as_real(bits), self._sequences)
        return self.components.synthesise(self._per_band(beta) * amplitudes)

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Carrier`."""
        products = self._per_band(beta) * self.components.analyse(self._as_real(residual))
        return einsum("kjc,jc->k", self._sequences, products)

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """See `Carrier`."""
        weighted = self._per_band(beta) * self._sequences
        return einsum("ajc,cjl,blc->ab", weighted, self.components.gram, weighted)

    def claim(self, observation: Observation, bits: Float[Array, " bits"]) -> Claim:
        """See `Carrier`; there is one keyed sign per band and coordinate, or one per band if coordinates share them."""
        products = self.components.analyse(self._as_real(observation.weigh(observation.residual)))
        if self.sequences.shape[-1] == 1:
            products = products.sum(axis=1, keepdims=True)
        return Claim(*sum_and_norm(einsum("k,kjc->jc", self._as_real(bits), self._as_real(self.sequences)) * products))

    def redraw(self, seed: Seed) -> "ModulatedCarrier":
        """See `Carrier`."""
        return self._replace(sequences=jax.random.rademacher(random_key(seed), jnp.shape(self.sequences), jnp.int8))

    def reader(self) -> PlainReader:
        """See `Carrier`."""
        return PlainReader(self)

    @property
    def _sequences(self) -> Float[Array, "bits bands 3"]:
        signs = self._as_real(self.sequences)
        return jnp.broadcast_to(signs, (*signs.shape[:2], 3))

    def _per_band(self, beta: Strength) -> Array:
        """Give β a shape that broadcasts against `[bands, 3]`."""
        strength = check_strength(self._as_real(beta), self.sequences.shape[1])
        return strength[:, None] if strength.ndim == 1 else strength

    def _as_real(self, values: ArrayLike) -> Array:
        """Convert to an array in the dtype of the components."""
        return jnp.asarray(values).astype(self.components.gram.dtype)
