"""The default scheme: keyed chips in a pass band of low frequencies."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float64
from numpy.typing import ArrayLike

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, vertex_normals
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.threads import in_thread
from jaxmark.watermark.carriers.chips import KeyedCarrier, make_chips
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import TAG_BITS, code_length
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.perception.masking import masking_tensors
from jaxmark.watermark.reading.reception import Host, Receiver, make_host, make_receiver

# Relative strengths of the lowest 20 of 64 bands: the mean over meshes that were tuned to noise, smoothing and
# quantisation at the default budget, as printed by `benchmarks/robustness/tuning.py --limit dame=0.008 --train
# blub_7106.obj fertility_12448.obj armadillo_14587.obj kitten.obj`. Marks are read with the same strengths, so other
# strengths would need another name of the pass band.
DERIVED = (
    *(0, 1, 0.93, 0.84, 0.77, 0.7, 0.63, 0.54, 0.47, 0.41),
    *(0.37, 0.32, 0.28, 0.24, 0.21, 0.18, 0.15, 0.11, 0.07, 0.03),
)


class PassBand(NamedTuple):
    """The rules by which the bands of a mark, and the nuisance that is projected off, are chosen."""

    share: float  # share of the lowest bands that the mark is written in; more are used if the payload needs them
    spread: int  # number of dimensions that each bit of message and tag needs
    per_nuisance: int  # least number of dimensions for each column of the nuisance, apart from affine maps
    degree: int  # largest total degree of the polynomials in the nuisance


PASS_BANDS: Mapping[str, PassBand] = {
    "tapered": PassBand(0.31, 12, 12, 6),
    "narrow": PassBand(0.31, 6, 6, 8),
    "low": PassBand(0.19, 6, 12, 6),
    "lowest": PassBand(0.125, 6, 12, 6),
}


class Layout(NamedTuple):
    """The pass band of a keyed carrier, and the nuisance that its receiver projects off."""

    passing: int  # number of bands in the pass band, counted from the lowest
    scales: int  # number of diffusion scales of the host
    degree: int  # total degree of the polynomials of the position


def nuisance_size(columns: float, passband: PassBand) -> tuple[int, int]:
    """Choose the diffusion scales and the degree of polynomials of the nuisance for a mark of so many dimensions."""
    # Affine maps have 4 columns; each diffusion scale has one column for each coordinate.
    scales, degree = min(9, max(0, int(columns / 3 - 4) // 3)), 1
    while degree < passband.degree and math.comb(degree + 4, 3) + 3 * scales <= columns / passband.per_nuisance:
        degree += 1
    return scales, degree


def host_of(original: Original, coefficients: Float64[np.ndarray, "bands terms"], scales: int, degree: int) -> Host:
    """Prepare an original with the bands to write or read in, and with a size of the nuisance."""
    positions = original.to_traced(original.positions)
    return make_host(original.operator, original.signal, positions, coefficients, scales=scales, degree=degree)


@dataclass(frozen=True)
class KeyedScheme(Scheme):
    """A scheme that writes keyed chips in a pass band of low frequencies; its reader projects off the nuisance.

    There are four pass bands:

    - `"tapered"`, the default, reaches to λ = 0.44 with the strengths of `DERIVED`, but omits the lowest bands, which
      consist mostly of nuisance. It is stretched if the payload needs more: 12 dimensions for each bit of message and
      tag.
    - `"narrow"` is flat, and as narrow as the payload allows. It has 1,024 dimensions and 12 more for each bit of
      message and tag, but ends at λ = 0.44 unless the payload needs more.
    - `"low"` and `"lowest"` are flat and end at λ = 0.17 and 0.08, unless the payload needs more than 6 dimensions per
      bit. They are meant for marks that are so weak that fewer dimensions with more energy each give more evidence (see
      `jaxmark.watermark.schemes.passband`).

    With a profile, the mark is written in the bands that have strengths in the profile, whatever the payload.

    Dimensions are counted as on a regular triangle mesh, √3/2π · λ for each coordinate of each vertex, and on point
    clouds by the number of neighbours. The nuisance that is projected off, without affine maps, has at most a twelfth
    of them, or a sixth with the narrow pass band.
    """

    name: ClassVar[str] = "keyed"
    bands: int = 64  # number of Jackson-damped scaling functions over the whole spectrum; the lowest are used
    direction: Literal["coordinates", "normals"] = "coordinates"  # directions in which vertices are displaced
    profile: tuple[float, ...] = ()  # relative strengths of the lowest bands; see `with_profile`; default by `passband`
    passband: Literal["tapered", "narrow", "low", "lowest"] = "tapered"  # the choice of bands and nuisance
    hiding: bool = True  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            JaxmarkError: if the profile has more numbers than there are bands, a negative number or only zeros, or if
                the direction or the pass band is unknown.
        """
        if self.profile and not (
            len(self.profile) <= self.bands and all(0 <= one < math.inf for one in self.profile) and any(self.profile)
        ):
            raise JaxmarkError(
                f"A profile is up to {self.bands} finite numbers, not negative, and not all 0; got {len(self.profile)}."
            )
        for name, allowed in (("direction", ("coordinates", "normals")), ("passband", tuple(PASS_BANDS))):
            if getattr(self, name) not in allowed:
                *others, last = map(repr, allowed)
                raise JaxmarkError(f"{name} must be {', '.join(others)} or {last}, got {getattr(self, name)!r}.")

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; beyond 12 code bits for each bit of message and tag, the code gains less than 0.1 dB."""
        return code_length(bits, self.dimensions(original, bits), 12)

    def dimensions(self, original: Original, bits: int) -> int:
        """Count the dimensions of the pass band for a payload, as described in the class."""
        return int(self._written_dimensions(original, self.strengths(original, bits)))

    def layout(self, original: Original, bits: int) -> Layout:
        """Choose the pass band and the nuisance for a payload, independently of the key."""
        strengths = self._strengths(original, bits)
        columns = self._written_dimensions(original, strengths) / self._channels
        return Layout(len(strengths), *nuisance_size(columns, PASS_BANDS[self.passband]))

    def strengths(self, original: Original, bits: int) -> Float64[np.ndarray, " passing"]:
        """Compute the relative strengths of the bands of the pass band for a payload."""
        strengths = self._strengths(original, bits)
        if self.profile or self.passband != "tapered":
            return strengths
        # In a band that is mostly nuisance, a mark is visible but can hardly be read.
        layout = self.layout(original, bits)
        nuisance = math.comb(layout.degree + 3, 3) + 3 * layout.scales
        cumulative = np.array([self._dimensions(original, band + 1) for band in range(len(strengths))]) / self._channels
        return np.where(cumulative > min(nuisance, cumulative[-1]) / 2, strengths, 0)

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> KeyedCarrier:
        """See `Scheme`."""
        masking = in_thread(partial(self.mask, original))  # takes longer than all else together
        layout, dtype = self.layout(original, bits), original.signal.dtype
        host = host_of(original, self.family()[: layout.passing], layout.scales, layout.degree)
        chips = make_chips(choices, original.chip_places, code_bits, channels=self._channels, count=original.count)
        carrier = KeyedCarrier(host, chips, profile=self.strengths(original, bits).astype(dtype))
        if self.direction == "normals":
            check_faces("A mark along normals", original.points)
            normals = vertex_normals(Mesh(original.positions, original.points.faces))
            carrier = carrier._replace(normals=original.to_traced(normals))
        return carrier._replace(masking=masking.result())

    def tunable(self) -> "KeyedScheme":
        """See `Scheme`."""
        if self.direction != "coordinates":
            raise JaxmarkError(f"tune needs marks along coordinates, not along {self.direction}.")
        return self

    def family(self) -> Float64[np.ndarray, "bands terms"]:
        """Compute the Chebyshev coefficients of all bands, which are non-negative and add up to 1 on the spectrum."""
        return scaling(self.bands, damping="jackson")

    def mask(self, original: Original) -> Float[Array, "rows 3 3"] | None:
        """Compute a symmetric matrix `[3, 3]` on each vertex's displacement; None if it is 1 everywhere."""
        if not self.hiding or self.direction != "coordinates":
            return None
        return masking_tensors(original)

    def receiver(self, original: Original, bits: int) -> Receiver:
        """Make the receiver of marks with a payload size, with all bands of `family`."""
        layout = self.layout(original, bits)
        return make_receiver(host_of(original, self.family(), layout.scales, layout.degree))

    def with_profile(self, profile: ArrayLike) -> "KeyedScheme":
        """Return the scheme with other relative strengths of the lowest bands, such as trained ones; see `profile`.

        The record of a mark stores them, and its keyed choices depend on them.

        Args:
            profile: one number for each of the lowest bands, `[bands]`, at most as many as the scheme has; of a trained
                carrier, the argument of `KeyedCarrier.with_bands`.

        Raises:
            JaxmarkError: if it is no such list, or a number is negative or not finite, or all are 0.
        """
        values = np.asarray(profile, np.float64)
        if values.ndim != 1 or not len(values):
            raise JaxmarkError(f"A profile is one number for each of the lowest bands, not an array {values.shape}.")
        return replace(self, profile=tuple(values.tolist()))

    @property
    def _channels(self) -> int:
        """Number of chips per vertex."""
        return 3 if self.direction == "coordinates" else 1

    def _strengths(self, original: Original, bits: int) -> Float64[np.ndarray, " passing"]:
        """Compute relative strengths as in `strengths`, but also in bands that are mostly nuisance."""
        if self.profile:
            return np.array(self.profile, np.float64)
        passband = PASS_BANDS[self.passband]
        default, needed = round(self.bands * passband.share), passband.spread * (bits + TAG_BITS)
        if self.passband == "narrow":
            target = min(1024 + 2 * needed, self._dimensions(original, default))
            return np.ones(self._count_bands(original, max(target, needed), 0))
        passing = self._count_bands(original, needed, default)
        if self.passband != "tapered":
            return np.ones(passing)
        places = (np.arange(passing) + 0.5) / passing
        return np.interp(places, (np.arange(len(DERIVED)) + 0.5) / len(DERIVED), DERIVED)

    def _count_bands(self, original: Original, dimensions: float, least: int) -> int:
        """Count the lowest bands that reach `dimensions`; at least six, because narrower pass bands leak too much."""
        passing = max(least, min(6, self.bands))
        while passing < self.bands and self._dimensions(original, passing) < dimensions:
            passing += 1
        return passing

    def _written_dimensions(self, original: Original, strengths: Float64[np.ndarray, " passing"]) -> float:
        """Count the dimensions of the bands that are written in."""
        each = np.diff([self._dimensions(original, band) for band in range(len(strengths) + 1)])
        return float(np.sum(each[strengths > 0]))

    def _dimensions(self, original: Original, passing: int) -> float:
        """Count the dimensions of the lowest `passing` bands."""
        edge = 1 - math.cos(math.pi * passing / self.bands)
        share = min(1.0, original.density * edge)
        return self._channels * share * int(original.used.sum())
