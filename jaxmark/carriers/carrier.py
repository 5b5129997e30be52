"""What a carrier is, and the one that modulates components of the host by keyed sequences."""

from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxmark.observation import Observation
from jaxmark.precision import einsum, sum_and_norm

Displacement = Float[Array, "vertices 3"]
Strength = (
    float | Float[Array | np.ndarray, ""] | Float[Array | np.ndarray, " bands"] | Float[Array | np.ndarray, "bands 3"]
)


@runtime_checkable
class Carrier(Protocol):
    """A linear map from k bits to a displacement [N, 3]; a pytree whose methods can be traced.

    `beta` is the embedding strength: one number, one per band `[bands]`, or one per band and coordinate `[bands, 3]`.
    """

    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """Move the vertices so that they carry `bits` (±1, or any real amplitudes): linear in `bits` and in `beta`."""
        ...

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """Apply the D-adjoint: ⟨displacement(a), r⟩_D, summed over coordinates, is the dot product of a and this."""
        ...

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """D inner products of the bits' displacements: adjoint(displacement(e_j)), column by column."""
        ...

    def claim(self, seen: Observation, bits: Float[Array, " bits"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Score S of a claimed codeword, and the norm ‖a‖ with S = Σ s·a over the keyed signs s (a is key-free)."""
        ...


@runtime_checkable
class Components(Protocol):
    """Directions [N] per band and coordinate, in which a carrier writes: fixed by the original, free of the key."""

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """D inner products of the components, per coordinate."""
        ...

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Displacement:
        """Σ_j amplitude_jc · component_jc for each coordinate c."""
        ...

    def analyse(self, residual: Displacement) -> Float[Array, "bands 3"]:
        """⟨residual_c, component_jc⟩_D: the D-adjoint of `synthesise`."""
        ...


class ModulatedCarrier(NamedTuple):
    """Bits on components x_j of the host by sequences p: w = Σ_i bit_i Σ_j β_j p_j^(i) x_j (Sohn et al., 2.2).

    With polynomial bands as components it is the paper's scheme, with eigenspaces Ohbuchi's. It computes in the dtype
    of the components. Polynomial bands have no forward mode (see `jaxmark.chebyshev.filter`).
    """

    components: Components
    sequences: Int[Array | np.ndarray, "bits bands 3"] | Int[Array | np.ndarray, "bits bands 1"]

    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """See `Carrier`."""
        amplitudes = einsum("k,kjc->jc", self._as_real(bits), self._sequences)
        return self.components.synthesise(self._per_band(beta) * amplitudes)

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Carrier`."""
        found = self._per_band(beta) * self.components.analyse(self._as_real(residual))
        return einsum("kjc,jc->k", self._sequences, found)

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """See `Carrier`."""
        weighted = self._per_band(beta) * self._sequences
        return einsum("ajc,cjl,blc->ab", weighted, self.components.gram, weighted)

    def claim(self, seen: Observation, bits: Float[Array, " bits"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """See `Carrier`; one sign per band and coordinate, or per band where coordinates share their sequences."""
        found = self.components.analyse(self._as_real(seen.weigh(seen.residual)))
        if self.sequences.shape[-1] == 1:
            found = found.sum(axis=1, keepdims=True)
        return sum_and_norm(einsum("k,kjc->jc", self._as_real(bits), self._as_real(self.sequences)) * found)

    @property
    def _sequences(self) -> Float[Array, "bits bands 3"]:
        signs = self._as_real(self.sequences)
        return jnp.broadcast_to(signs, (*signs.shape[:2], 3))

    def _per_band(self, beta: Strength) -> Array:
        """β shaped to broadcast against `[bands, 3]`."""
        strength = self._as_real(beta)
        return strength[:, None] if strength.ndim == 1 else strength

    def _as_real(self, values: ArrayLike) -> Array:
        """Anything in the dtype of the host."""
        return jnp.asarray(values).astype(self.components.gram.dtype)
