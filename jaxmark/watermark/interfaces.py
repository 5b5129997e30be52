"""The interfaces of carriers, their readers and schemes, which carriers and schemes of your own implement.

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


#: A function that computes one soft decision per bit, from a reader, the `Received` of a suspect, and the relative
#: strengths of the bands as embedded.
Detector = Callable[[Any, Any, Strength], Float[Array, " bits"]]


class Claim(NamedTuple):
    """The evidence for a claimed codeword: a score S = Σ s·a over the keyed signs s, and the norm ‖a‖.

    The vector a must be independent of the signs, as the bounds in `jaxmark.watermark.evidence.bounds` require.
    """

    score: Float[Array, ""]  # S
    norm: Float[Array, ""]  # ‖a‖


class FreeDimensions(NamedTuple):
    """The part of a carrier's mark that is left in each band when a reader has projected off the nuisance.

    The capacity is computed from it.
    """

    dimensions: Float64[np.ndarray, " bands"]  # number of dimensions left in each band; 0 if the mark does not use it
    energy: Float64[np.ndarray, " bands"]  # energy of each of these dimensions if the mean square displacement is 1


@runtime_checkable
class Received(Protocol):
    """The data that a reader extracts from a suspect without using the key; `Observation` is the simplest type."""

    @property
    def observed(self) -> Observation:
        """The observation that the reader was given."""
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

    @property
    def detector(self) -> Detector:
        """The detector of the carrier's bits, unless the caller chooses another one."""
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
        """Compute the D inner products of the displacements of single bits.

        Returns:
            The matrix `[k, k]` whose column j is adjoint(displacement(e_j)).
        """
        ...

    def claim(self, observation: Observation, bits: Float[Array, " bits"]) -> Claim:
        """Compute the score and the norm of a claimed codeword.

        Args:
            observation: the observed displacement of each vertex of a suspect.
            bits: the codeword, ±1, `[k]`.
        """
        ...

    def redraw(self, seed: Seed) -> "Carrier":
        """Replace the keyed signs by random ones.

        A keyless attacker computes expectations over such carriers.

        Args:
            seed: an integer or a JAX random key.
        """
        ...

    def reader(self) -> "Reader":
        """Make the reader of this carrier; it computes once everything that does not depend on the suspect."""
        ...


@runtime_checkable
class ChipCarrier(Carrier, Protocol):
    """A carrier that spreads bits over chips, which band filters turn into a displacement; a vertex has several."""

    @property
    def host(self) -> Any:
        """The original prepared for writing, a `jaxmark.watermark.reading.reception.Host`."""
        ...

    @property
    def chips(self) -> Any:
        """The keyed signs of the chips, and the bit that each chip belongs to."""
        ...

    def coefficients(self, beta: Strength, weight: Float[Array, " bands"] | None = None) -> Float[Array, "..."]:
        """Compute the Chebyshev coefficients of the filter Σ_j weight_j β_j f_j."""
        ...

    def modulate(self, bits: Float[Array, " bits"], coefficients: Float[Array, "..."]) -> Displacement:
        """Spread the bits over their chips, and filter the chips into a displacement."""
        ...

    def correlate(self, residual: Displacement, coefficients: Float[Array, "..."]) -> Float[Array, " bits"]:
        """Apply the adjoint of `modulate` for inner products without D, Σ_v ⟨modulate(a)_v, r_v⟩."""
        ...

    def filter_chips(self, chips: Float[Array, "vertices channels"], coefficients: Float[Array, "..."]) -> Displacement:
        """Filter any chips into a displacement."""
        ...

    def match_chips(
        self, residual: Displacement, coefficients: Float[Array, "..."]
    ) -> Float[Array, "vertices channels"]:
        """Apply the adjoint of `filter_chips` for inner products without D, which is a matched filter."""
        ...


@runtime_checkable
class Reader(Protocol):
    """A reader of the bits of a carrier from suspects; a pytree whose methods can be traced.

    `PlainReader` can read any carrier. The results of `receive` and `ways` must not depend on the key.
    """

    @property
    def carrier(self) -> Carrier:
        """The carrier whose bits are read."""
        ...

    def receive(self, observation: Observation) -> Any:
        """Extract from a suspect all data that do not depend on the key.

        Returns:
            A `Received`, in a type of the reader's own, which the other methods take.
        """
        ...

    def ways(self, received: Any) -> Sequence[Any]:
        """Return one version of `received` for each way of weighting the suspect.

        Each version gives a claim of its own, and the number of versions is charged in
        `jaxmark.watermark.evidence.ledger`.
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
        """Compute the score of a claim for another residual; weights and filters stay those of the suspect.

        Args:
            received: the data extracted from the suspect.
            residual: the displacement that replaces that of the suspect, `[N, 3]`.
            bits: the codeword, ±1, `[k]`.

        Returns:
            The score, a linear function of `residual`.
        """
        ...

    def read_quickly(self, observation: Observation, beta: Strength = 1.0) -> Float[Array, " bits"] | None:
        """Estimate soft decisions with little computation; they suffice for a suspect that was not attacked.

        Returns:
            One soft decision per bit, `[k]`; None if the reader has no such shortcut.
        """
        ...

    def correlate(self, received: Any) -> Float[Array, " bits"] | None:
        """Correlate the suspect's residual with the displacement of each bit, with the bands weighted for the suspect.

        Returns:
            One soft decision per bit, `[k]`, in which the other bits act as noise; None if the scheme's detector does
            no more than that.
        """
        ...

    def free_dimensions(self, moving: Float[Array, " vertices"]) -> FreeDimensions | None:
        """Measure the dimensions and the energy of the mark that remain in each band.

        Args:
            moving: 1 for each vertex that may move, else 0, `[N]`.

        Returns:
            Dimensions and energy per band; None if the reader has no model of noise.
        """
        ...

    def with_carrier(self, carrier: Any) -> "Reader":
        """Return the reader for a carrier of the same scheme and original with another key; nothing is recomputed."""
        ...


@runtime_checkable
class Scheme(Protocol):
    """A scheme: a dataclass that makes a carrier for an original, a key and a payload size.

    The record of a mark stores the fields of its scheme. A scheme of your own inherits from this class and defines
    `name`, `code_length` and `carrier`; `layout`, `dimensions` and `tunable` have defaults.
    """

    name: ClassVar[str]  # the scheme's name in records and on the command line
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def code_length(self, original: Original, bits: int) -> int:
        """Choose the number of code bits that carry a payload; see `jaxmark.watermark.coding.message.code_length`.

        Args:
            original: the mesh to mark.
            bits: size of the payload in bits.

        Raises:
            JaxmarkError: if the payload is too large for this original (`capacity` relies on this error), or is no
                positive multiple of 8.
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
        """Return a hashable key; payloads with equal keys have equal free dimensions, which are then measured once.

        See `Reader.free_dimensions`.
        """
        return None

    def dimensions(self, original: Original, bits: int) -> int:
        """Count the dimensions of the pass band for a payload; 0 if the scheme has none and carries no fingerprints."""
        return 0

    def tunable(self) -> Any:
        """Return the scheme in the form that `tune` needs: a `jaxmark.watermark.schemes.keyed.KeyedScheme`.

        Raises:
            JaxmarkError: if the scheme has no bands whose strengths could be tuned.
        """
        raise JaxmarkError(f"The scheme {self.name!r} has no bands whose strengths could be tuned.")
