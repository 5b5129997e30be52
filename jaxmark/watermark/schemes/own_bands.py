"""A scheme for band filters of your own, such as trained ones, which are bound to the mark like all its parameters."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float64
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.carriers.chips import KeyedCarrier, make_chips
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.perception.masking import masking_tensors
from jaxmark.watermark.schemes.keyed import PASS_BANDS, host_of, nuisance_size

_MOST = 512  # filters, and terms of each, which limits the time of reading a mark with its record
_LARGEST = 1e6  # coefficient, beyond which float32 would overflow; the budget sets the size of a mark anyway
_GRID = 2048  # values of λ at which responses are integrated


@dataclass(frozen=True)
class OwnBandsScheme(Scheme):
    """A scheme that writes keyed chips in bands of your own, as `KeyedScheme` does in its bands.

    The filters are in the record, and keyed choices depend on them, so a detection is a proof, as with the schemes that
    have names. Make it by `from_arrays`.
    """

    name: ClassVar[str] = "own-bands"
    filters: tuple[tuple[float, ...], ...] = ()  # Chebyshev coefficients of each band, times its strength
    hiding: bool = True  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            JaxmarkError: if there is no filter or more than 512, or one has no or more than 512 terms, or other numbers
                of terms than the others; if a term is no real number; or if the largest coefficient is not from 1e-6
                to 1e6 in size.
        """
        filters = _as_reals(self.filters)
        if filters.ndim != 2 or not all(1 <= size <= _MOST for size in filters.shape):
            raise JaxmarkError(f"Own bands are 1 to {_MOST} filters of equally many terms, 1 to {_MOST}.")
        if not 1 / _LARGEST <= np.abs(filters).max() <= _LARGEST:  # not with NaN either
            raise JaxmarkError(f"Own bands have a largest coefficient of {1 / _LARGEST:g} to {_LARGEST:g} in size.")

    @classmethod
    def from_arrays(
        cls, bands: ArrayLike, strengths: ArrayLike | None = None, *, hiding: bool = True
    ) -> "OwnBandsScheme":
        """Make the scheme from arrays, such as those that `KeyedCarrier.with_bands` was trained with.

        Args:
            bands: Chebyshev coefficients `[bands, degree + 1]`, as in `jaxmark.spectral.bands`.
            strengths: factor on each band, `[bands]`; by default all are 1.
            hiding: see the field.

        Raises:
            JaxmarkError: if they have other shapes, or are not real numbers as described in `__post_init__`.
        """
        filters = _as_reals(bands)
        factors = _as_reals(np.ones(filters.shape[:1]) if strengths is None else strengths)
        if filters.ndim != 2 or factors.shape != filters.shape[:1]:
            raise JaxmarkError(
                f"Own bands are an array [bands, degree + 1] and a strength for each, not {filters.shape} and"
                f" {factors.shape}."
            )
        return cls(tuple(map(tuple, (factors[:, None] * filters).tolist())), hiding)

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; 12 code bits for each bit of message and tag, if there are dimensions for them."""
        return code_length(bits, self.dimensions(original, bits), 12)

    def dimensions(self, original: Original, bits: int) -> int:
        """Count the dimensions that the filters pass, as many as of an ideal pass band with equally peaked energy.

        Their number is (∫r²)²/∫r⁴ of the response r, times the density of eigenvalues.
        """
        frequencies = np.linspace(0, 2, _GRID)
        energy = np.sum(chebyshev.chebval(frequencies - 1, np.transpose(self.filters)) ** 2, axis=0)
        width = 2 * np.mean(energy) ** 2 / np.mean(energy**2)
        return int(3 * min(1.0, original.density * width) * int(original.used.sum()))

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> KeyedCarrier:
        """See `Scheme`."""
        size = nuisance_size(self.dimensions(original, bits) / 3, PASS_BANDS["tapered"])
        # A common factor of the filters changes nothing, but very small ones would be lost in float32. Powers of two
        # are exact.
        scale = 2.0 ** -np.round(np.log2(np.abs(self.filters).max()))
        host = host_of(original, scale * np.array(self.filters), *size)
        chips = make_chips(choices, original.chip_places, code_bits, count=original.count)
        return KeyedCarrier(host, chips, masking=masking_tensors(original) if self.hiding else None)


def _as_reals(values: Any) -> Float64[np.ndarray, "..."]:
    """Convert real numbers to an array.

    Raises:
        JaxmarkError: if they are no array of real numbers.
    """
    try:
        if not np.iscomplexobj(values):
            return np.asarray(values, np.float64)
    except (TypeError, ValueError):
        pass
    raise JaxmarkError("Own bands and their strengths are arrays of real numbers, with rows of equally many terms.")
