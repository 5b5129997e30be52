"""The interfaces of carriers and of their readers: what a carrier of your own implements.

D is the diagonal matrix of the vertex degrees of the original's Laplacian, and ⟨x, y⟩_D = xᵀDy (see
`jaxmark.spectral.laplacian`). N is the number of vertices, k the number of code bits.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.alignment.observation import Observation
from jaxmark.errors import JaxmarkError

Displacement = Float[Array, "vertices 3"]
Strength = (
    float | Float[Array | np.ndarray, ""] | Float[Array | np.ndarray, " bands"] | Float[Array | np.ndarray, "bands 3"]
)


def check_strength(beta: Array, bands: int) -> Array:
    """Check the shape of a strength: one number, one per band, or one per band and coordinate.

    Raises:
        JaxmarkError: if it has another shape.
    """
    if beta.shape not in ((), (bands,), (bands, 3)):
        raise JaxmarkError(
            f"beta is one number, {bands} numbers (one per band), or {bands} × 3; got the shape {beta.shape}."
        )
    return beta


class Claim(NamedTuple):
    """The evidence for a claimed codeword: a score S = Σ s·a over the keyed signs s, and the norm ‖a‖.

    The vector a must be independent of the signs: the bounds in `jaxmark.watermark.evidence.bounds` need that.
    """

    score: Float[Array, ""]  # S
    norm: Float[Array, ""]  # ‖a‖


class Room(NamedTuple):
    """What a reader leaves of a carrier's mark in each band; the capacity is computed from it."""

    dimensions: Float64[np.ndarray, " bands"]  # number of dimensions left in each band; 0 if the mark is not in it
    energy: Float64[np.ndarray, " bands"]  # energy of each of these dimensions if the mean square displacement is 1


@runtime_checkable
class Received(Protocol):
    """What a reader learns from a suspect without the key; an `Observation` is the simplest one."""

    @property
    def observed(self) -> Observation:
        """The suspect as it was given to the reader."""
        ...


@runtime_checkable
class Carrier(Protocol):
    """A linear map from k code bits to a displacement `[N, 3]`; a pytree whose methods can be traced.

    The argument `beta` of its methods is the embedding strength: one number, one per band `[bands]`, or one per band
    and coordinate `[bands, 3]`.
    """

    @property
    def code_bits(self) -> int:
        """Number of code bits that the carrier carries, k."""
        ...

    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """Displace the vertices so that they carry the bits; linear in `bits` and in `beta`.

        Args:
            bits: ±1, or any real amplitudes, `[k]`.
            beta: embedding strength.

        Returns:
            The displacement of each vertex, `[N, 3]`.
        """
        ...

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """Apply the adjoint of `displacement` with respect to the D inner product.

        Args:
            residual: any displacement r, `[N, 3]`.
            beta: embedding strength.

        Returns:
            The vector `[k]` whose dot product with any amplitudes a is ⟨displacement(a), r⟩_D, summed over the three
            coordinates.
        """
        ...

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """D inner products of the displacements of single bits, `[k, k]`: column j is adjoint(displacement(e_j))."""
        ...

    def claim(self, seen: Observation, bits: Float[Array, " bits"]) -> Claim:
        """Compute the score and the norm of a claimed codeword.

        Args:
            seen: what a suspect shows of each vertex's displacement.
            bits: the codeword, ±1, `[k]`.
        """
        ...

    def redraw(self, key: PRNGKeyArray) -> "Carrier":
        """Replace the keyed signs by random ones.

        An attacker without the key computes expectations over such carriers.

        Args:
            key: JAX random key.
        """
        ...

    def reader(self) -> "Reader":
        """Make the reader of this carrier; it computes once what reading any number of suspects needs."""
        ...


@runtime_checkable
class Reader(Protocol):
    """Reads the bits of a carrier from suspects; a pytree whose methods can be traced.

    `PlainReader` can read any carrier. What `receive` and `ways` return must not depend on the key.
    """

    @property
    def carrier(self) -> Carrier:
        """The carrier whose bits are read."""
        ...

    def receive(self, seen: Observation) -> Any:
        """Learn all that can be learned from a suspect without the key.

        Returns:
            A `Received`, in a type of the reader's own, which the other methods take.
        """
        ...

    def ways(self, received: Any) -> Sequence[Any]:
        """Return one version of `received` for each way of weighting the suspect.

        Each version gives a claim of its own; `jaxmark.watermark.evidence.bounds.any_of` takes the best, and every
        one is paid for.
        """
        ...

    def claim(self, received: Any, bits: Float[Array, " bits"]) -> Claim:
        """Compute the score and the norm of a claimed codeword.

        Args:
            received: one of the versions that `ways` returns.
            bits: the codeword, ±1, `[k]`.
        """
        ...

    def linear_score(self, received: Any, residual: Displacement, bits: Float[Array, " bits"]) -> Float[Array, ""]:
        """Compute the score of a claim for another residual, with all that was learned from the suspect held fixed.

        Args:
            received: what was learned from the suspect.
            residual: the displacement that takes the place of the suspect's, `[N, 3]`.
            bits: the codeword, ±1, `[k]`.

        Returns:
            The score, a linear function of `residual`.
        """
        ...

    def glance(self, seen: Observation, beta: Strength = 1.0) -> Float[Array, " bits"] | None:
        """Estimate soft values with little computation, well enough to read a suspect that was not attacked.

        Returns:
            One soft value per bit, `[k]`; None if the reader has no such shortcut.
        """
        ...

    def correlate(self, received: Any) -> Float[Array, " bits"] | None:
        """Correlate what was received with each bit's displacement, band by band as the suspect left them.

        Returns:
            One soft value per bit, `[k]`, in which the bits are noise to each other; None if the scheme's detector does
            no more than that.
        """
        ...

    def room(self, moving: Float[Array, " vertices"]) -> Room | None:
        """Measure what the reader leaves of the mark in each band.

        Args:
            moving: 1 for each vertex that may move, else 0, `[N]`.

        Returns:
            Dimensions and energy per band; None if the reader has no model of noise.
        """
        ...

    def with_carrier(self, carrier: Any) -> "Reader":
        """Return the reader for a carrier of the same scheme and original, but another key; nothing is recomputed."""
        ...
