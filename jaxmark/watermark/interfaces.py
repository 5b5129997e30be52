"""The interfaces of carriers and of their readers: what a carrier of your own implements.

D is the diagonal matrix of the vertex degrees of the original's Laplacian, and ⟨x, y⟩_D = xᵀDy (see
`jaxmark.spectral.laplacian`). N is the number of vertices, k the number of code bits.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed
from jaxmark.watermark.coding.keys import Choices

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


#: A function of a reader, what it received from a suspect, and the strengths' profile as embedded; returns one soft
#: value per bit.
Detector = Callable[[Any, Any, Strength], Float[Array, " bits"]]


class Claim(NamedTuple):
    """The evidence for a claimed codeword: a score S = Σ s·a over the keyed signs s, and the norm ‖a‖.

    The vector a must be independent of the signs: the bounds in `jaxmark.watermark.evidence.bounds` need that.
    """

    score: Float[Array, ""]  # S
    norm: Float[Array, ""]  # ‖a‖


class FreeDimensions(NamedTuple):
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

    def claim(self, observation: Observation, bits: Float[Array, " bits"]) -> Claim:
        """Compute the score and the norm of a claimed codeword.

        Args:
            observation: what a suspect shows of each vertex's displacement.
            bits: the codeword, ±1, `[k]`.
        """
        ...

    def redraw(self, seed: Seed) -> "Carrier":
        """Replace the keyed signs by random ones.

        An attacker without the key computes expectations over such carriers.

        Args:
            seed: a whole number or a JAX random key.
        """
        ...

    def reader(self) -> "Reader":
        """Make the reader of this carrier; it computes once what reading any number of suspects needs."""
        ...


@runtime_checkable
class ChipCarrier(Carrier, Protocol):
    """A carrier that spreads bits over chips, several a vertex, which band filters shape into a displacement."""

    @property
    def host(self) -> Any:
        """The original prepared for writing, a `jaxmark.watermark.reading.reception.Host`."""
        ...

    @property
    def chips(self) -> Any:
        """The keyed signs of the chips and the bits that they belong to."""
        ...

    def coefficients(self, beta: Strength, weight: Float[Array, " bands"] | None = None) -> Float[Array, "..."]:
        """Chebyshev coefficients of the filter: Σ_j weight_j β_j f_j."""
        ...

    def modulate(self, bits: Float[Array, " bits"], coefficients: Float[Array, "..."]) -> Displacement:
        """Spread the bits over their chips, and filter these into a displacement."""
        ...

    def correlate(self, residual: Displacement, coefficients: Float[Array, "..."]) -> Float[Array, " bits"]:
        """Apply the plain adjoint of `modulate`: Σ_v ⟨modulate(a)_v, r_v⟩ is the dot product of a and this."""
        ...

    def filter_chips(self, chips: Float[Array, "vertices channels"], coefficients: Float[Array, "..."]) -> Displacement:
        """Filter any chips into a displacement."""
        ...

    def match_chips(
        self, residual: Displacement, coefficients: Float[Array, "..."]
    ) -> Float[Array, "vertices channels"]:
        """Apply the plain adjoint of `filter_chips`, which is a matched filter."""
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

    def receive(self, observation: Observation) -> Any:
        """Learn all that can be learned from a suspect without the key.

        Returns:
            A `Received`, in a type of the reader's own, which the other methods take.
        """
        ...

    def ways(self, received: Any) -> Sequence[Any]:
        """Return one version of `received` for each way of weighting the suspect.

        Each version gives a claim of its own, which is charged in `jaxmark.watermark.evidence.ledger`.
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

    def read_quickly(self, observation: Observation, beta: Strength = 1.0) -> Float[Array, " bits"] | None:
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

    def free_dimensions(self, moving: Float[Array, " vertices"]) -> FreeDimensions | None:
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


@runtime_checkable
class Scheme(Protocol):
    """A dataclass that makes a carrier for an original, a key and a payload; the record of a mark stores its fields.

    A scheme of your own inherits from this class and defines `name`, `detector`, `code_length` and `carrier`; `layout`,
    `dimensions` and `tunable` have defaults.
    """

    name: ClassVar[str]  # the scheme's name in records and on the command line
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def detector(self) -> Detector:
        """The detector that reads marks of this scheme, unless another one is chosen."""
        ...

    def code_length(self, original: Original, bits: int) -> int:
        """Choose the number of code bits that carry a payload; see `jaxmark.watermark.coding.message.code_length`.

        Args:
            original: the mesh to mark.
            bits: size of the payload in bits.

        Raises:
            JaxmarkError: if the payload is too large for this original, which `capacity` relies on, or is no positive
                multiple of 8.
        """
        ...

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> Carrier:
        """Make the carrier of a mark.

        Args:
            original: the mesh to mark.
            choices: the keyed choices of the mark.
            bits: size of the payload in bits.
            code_bits: number of code bits to carry: `code_length`, or the number of slots of a fingerprint.
        """
        ...

    def layout(self, original: Original, bits: int) -> Hashable:
        """Return a key for what the free dimensions depend on: payloads of equal layout have the same ones.

        They (see `Reader.free_dimensions`) are then measured only once for all of these payloads.
        """
        return None

    def dimensions(self, original: Original, bits: int) -> int:
        """Number of dimensions of the pass band for a payload; 0 if the scheme has none and carries no fingerprints."""
        return 0

    def tunable(self) -> Any:
        """Return the scheme in the form that `tune` needs: a `jaxmark.watermark.schemes.keyed.KeyedScheme`.

        Raises:
            JaxmarkError: if the scheme has no bands whose strengths could be tuned.
        """
        raise JaxmarkError(f"The scheme {self.name!r} has no bands whose strengths could be tuned.")
