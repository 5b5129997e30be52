"""Schemes: what is fixed about a mark besides key, message and strength. A name stands for the defaults.

A scheme's fields go into the record of a mark, so a mark made with other fields stays readable.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from jaxmark.bands import scaling
from jaxmark.carriers import Carrier, KeyedCarrier, ModulatedCarrier, eigenspaces, host_bands, make_chips
from jaxmark.carriers.carrier import Components
from jaxmark.detectors import Detector, decorrelate, joint
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, vertex_normals
from jaxmark.message import TAG_BITS, code_length
from jaxmark.original import Original
from jaxmark.reception import make_host
from jaxmark.sequences import orthogonal_sequences
from jaxmark.spectrum import eigenpairs
from jaxmark.visibility import masking

# Strengths of the lowest 20 of 64 bands: the mean over meshes tuned to noise, smoothing and quantisation at the default
# budget. `benchmarks/tuning.py --limit dame=0.008 --train blub_7106.obj fertility_12448.obj armadillo_14587.obj
# kitten.obj` prints them. Marks are read with them: others would need another name for the pass band.
DERIVED = (
    *(0, 1, 0.93, 0.84, 0.77, 0.7, 0.63, 0.54, 0.47, 0.41),
    *(0.37, 0.32, 0.28, 0.24, 0.21, 0.18, 0.15, 0.11, 0.07, 0.03),
)

# Dimensions of the mark to each of the nuisance that is projected off, apart from affine maps.
_NUISANCE = {"tapered": 12, "narrow": 6}

_DEGREE = {"tapered": 6, "narrow": 8}  # of its polynomials, at most

# What records say that were written before a field existed.
_BEFORE: Mapping[str, Mapping[str, Any]] = {"keyed": {"passband": "narrow"}}


@runtime_checkable
class Scheme(Protocol):
    """A dataclass that makes a carrier from an original, a key and a payload; a record stores its fields."""

    name: ClassVar[str]  # what records and the command line call it
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def detector(self) -> Detector:
        """What reads its carriers."""
        ...

    def code_length(self, original: Original, bits: int) -> int:
        """How many code bits carry a payload; see `message.code_length`."""
        ...

    def carrier(self, original: Original, key: bytes, bits: int, code_bits: int) -> Carrier:
        """The carrier of so many code bits for a payload on this original under this key."""
        ...


class Layout(NamedTuple):
    """What a keyed carrier writes in, and what its receiver projects off."""

    passing: int  # bands, from the lowest
    scales: int  # diffusion scales of the host
    degree: int  # of the polynomials of the position


@dataclass(frozen=True)
class KeyedScheme:
    """Keyed chips in a pass band of low frequencies; the host's part is projected off when reading.

    The pass band is tapered: it reaches to λ = 0.44 with the strengths of `DERIVED`, but for the lowest bands, of which
    the nuisance takes most. It is stretched where the payload needs more, 12 dimensions for each bit of message and
    tag. A narrow one is flat, and as narrow as the payload allows: 1,024 dimensions and 12 for each bit of message and
    tag, but at most to λ = 0.44 unless the payload needs it. With a profile, the mark is written in the bands that it
    names, whatever the payload.

    Dimensions are counted as on a regular triangle mesh, √3/2π · λ for each coordinate of each vertex. The nuisance
    that is projected off has at most a twelfth of them, apart from affine maps; with a narrow band, a sixth.
    """

    name: ClassVar[str] = "keyed"
    bands: int = 64  # Jackson-damped scaling functions over the whole spectrum, of which the lowest pass
    direction: Literal["coordinates", "normals"] = "coordinates"
    profile: tuple[float, ...] = ()  # relative strengths of the lowest bands, from `tune`; by `passband` unless given
    masking: bool = False  # whether rough regions are moved more than smooth ones; see `jaxmark.visibility.masking`
    passband: Literal["tapered", "narrow"] = "tapered"  # how bands and nuisance are chosen

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return joint

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; beyond 12 code bits a bit, the code gains less than 0.1 dB."""
        return code_length(bits, self.dimensions(original, bits), 12)

    def dimensions(self, original: Original, bits: int) -> int:
        """How many dimensions the pass band for a payload has, as they are counted here."""
        return int(self._written(original, self.strengths(original, bits)))

    def layout(self, original: Original, bits: int) -> Layout:
        """Pass band and nuisance for a payload, free of the key."""
        strengths = self._strengths(original, bits)
        columns = self._written(original, strengths) / self._channels
        # Affine maps are 4 columns; each scale has one for each coordinate.
        scales = min(9, max(0, int(columns / 3 - 4) // 3))
        degree = 1
        while (
            degree < _DEGREE[self.passband]
            and math.comb(degree + 4, 3) + 3 * scales <= columns / _NUISANCE[self.passband]
        ):
            degree += 1
        return Layout(len(strengths), scales, degree)

    def strengths(self, original: Original, bits: int) -> Float64[np.ndarray, " passing"]:
        """Relative strengths of the bands of the pass band for a payload."""
        strengths = self._strengths(original, bits)
        if self.profile or self.passband == "narrow":
            return strengths
        # What is written where most is nuisance is seen by the eye only.
        layout = self.layout(original, bits)
        nuisance = math.comb(layout.degree + 3, 3) + 3 * layout.scales
        held = np.array([self._dimensions(original, band + 1) for band in range(len(strengths))]) / self._channels
        return np.where(held > min(nuisance, held[-1]) / 2, strengths, 0)

    def carrier(self, original: Original, key: bytes, bits: int, code_bits: int) -> KeyedCarrier:
        """See `Scheme`."""
        layout, dtype = self.layout(original, bits), original.signal.dtype
        host = make_host(
            original.operator,
            original.signal,
            original.traced(original.positions),
            scaling(self.bands, damping="jackson")[: layout.passing],
            scales=layout.scales,
            degree=layout.degree,
        )
        chips = make_chips(key, original.geometry, original.moving, code_bits, channels=self._channels)
        carrier = KeyedCarrier(host, chips, profile=self.strengths(original, bits).astype(dtype))
        if self.direction == "normals":
            normals = vertex_normals(Mesh(original.positions, original.weld.point[np.asarray(original.mesh.faces)]))
            carrier = carrier._replace(normals=original.traced(normals))
        return carrier._replace(masking=masking(original)) if self.masking else carrier

    @property
    def _channels(self) -> int:
        match self.direction:
            case "coordinates":
                return 3
            case "normals":
                return 1
        raise JaxmarkError(f"direction must be 'coordinates' or 'normals', got {self.direction!r}.")

    def _strengths(self, original: Original, bits: int) -> Float64[np.ndarray, " passing"]:
        """`strengths`, whatever the nuisance."""
        if self.profile:
            if len(self.profile) > self.bands or not min(self.profile) >= 0 < max(self.profile) < math.inf:
                raise JaxmarkError(f"A profile is up to {self.bands} numbers, none negative and not all 0.")
            return np.array(self.profile)
        information = bits + TAG_BITS
        usual = round(self.bands * 0.31)
        match self.passband:
            case "tapered":
                passing = self._reaching(original, 12 * information, usual)
                places = (np.arange(passing) + 0.5) / passing
                return np.interp(places, (np.arange(len(DERIVED)) + 0.5) / len(DERIVED), DERIVED)
            case "narrow":
                wanted = min(1024 + 12 * information, self._dimensions(original, usual))
                return np.ones(self._reaching(original, max(wanted, 6 * information), 0))
        raise JaxmarkError(f"passband must be 'tapered' or 'narrow', got {self.passband!r}.")

    def _reaching(self, original: Original, dimensions: float, least: int) -> int:
        """So many bands have them: six at least, for narrower bands leak too much."""
        passing = max(least, min(6, self.bands))
        while passing < self.bands and self._dimensions(original, passing) < dimensions:
            passing += 1
        return passing

    def _written(self, original: Original, strengths: Float64[np.ndarray, " passing"]) -> float:
        """Dimensions of the bands that are written in."""
        each = np.diff([self._dimensions(original, band) for band in range(len(strengths) + 1)])
        return float(np.sum(each[strengths > 0]))

    def _dimensions(self, original: Original, passing: int) -> float:
        edge = 1 - math.cos(math.pi * passing / self.bands)
        share = min(1.0, math.sqrt(3) / (2 * math.pi) * edge)
        return self._channels * share * int(original.used.sum())


@dataclass(frozen=True)
class HostScheme:
    """The paper's scheme: polynomial bands of the host, each of bands x 3 coordinates with a keyed sign.

    The defaults are its working form: Jackson-damped bands at unit norm. `kernel="printed", damping="none",
    unit_norm=False` is the form the paper prints, in which the components of natural meshes are nearly collinear.
    There is a Hadamard matrix of order 3 · bands for `bands` a power of two from 4 on, and some others.
    """

    name: ClassVar[str] = "host"
    bands: int = 128
    kernel: Literal["halved", "printed"] = "halved"
    damping: Literal["none", "jackson", "lanczos"] = "jackson"
    unit_norm: bool = True

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return decorrelate

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; the more code bits share the places, the worse they are told apart."""
        return code_length(bits, 3 * self.bands, 2)

    def carrier(self, original: Original, key: bytes, bits: int, code_bits: int) -> Carrier:
        """See `Scheme`."""
        family = scaling(self.bands, kernel=self.kernel, damping=self.damping)
        components = host_bands(original.operator, original.signal, family, unit_norm=self.unit_norm)
        return _modulated(self.name, components, self.bands, original, key, code_bits)


@dataclass(frozen=True)
class EigenScheme:
    """Ohbuchi's scheme: the lowest eigenpairs of the Laplacian, each of pairs x 3 coordinates with a keyed sign.

    `pairs` as `HostScheme.bands`.
    """

    name: ClassVar[str] = "eigen"
    pairs: int = 64

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return decorrelate

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; the more code bits share the places, the worse they are told apart."""
        return code_length(bits, 3 * self.pairs, 2)

    def carrier(self, original: Original, key: bytes, bits: int, code_bits: int) -> Carrier:
        """See `Scheme`."""
        pairs = eigenpairs(original.operator, self.pairs)
        components = eigenspaces(original.operator, original.signal, pairs)
        return _modulated(self.name, components, self.pairs, original, key, code_bits)


#: The schemes that have names.
SCHEMES: Mapping[str, type[KeyedScheme] | type[HostScheme] | type[EigenScheme]] = {
    scheme.name: scheme for scheme in (KeyedScheme, HostScheme, EigenScheme)
}
DEFAULT_SCHEME = KeyedScheme.name


def get_scheme(scheme: str | Scheme, parameters: Mapping[str, Any] | None = None) -> Scheme:
    """A scheme by its name, with its defaults or the fields of a record; a scheme itself is returned as it is.

    Raises:
        JaxmarkError: if there is no such scheme, or it has no such field.
    """
    if not isinstance(scheme, str):
        return scheme
    if scheme not in SCHEMES:
        raise JaxmarkError(f"There is no scheme {scheme!r}; there are {', '.join(SCHEMES)}.")
    known = {field.name: type(field.default) for field in fields(SCHEMES[scheme])}
    # JSON has lists for tuples.
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in (parameters or {}).items()
    }
    if any(
        name not in known
        or type(value) is not known[name]
        or (isinstance(value, tuple) and not all(isinstance(item, float) for item in value))
        for name, value in given.items()
    ):
        raise JaxmarkError(f"The scheme {scheme!r} takes the parameters {', '.join(known)}, not {given}.")
    before = {} if parameters is None else _BEFORE.get(scheme, {})
    return SCHEMES[scheme](**{**before, **given})


def parameters_of(scheme: Scheme) -> dict[str, Any]:
    """The fields of a scheme, as a record stores them."""
    return asdict(scheme)


def _modulated(
    name: str, components: Components, bands: int, original: Original, key: bytes, code_bits: int
) -> ModulatedCarrier:
    """One keyed sequence per bit over all pairs of a band and a coordinate."""
    slots = 3 * bands
    sequences = orthogonal_sequences(key, original.geometry, code_bits, slots, label=name).reshape(code_bits, bands, 3)
    used = components.gram.shape[-1]  # a small mesh has fewer eigenvectors than the layout has places for
    return ModulatedCarrier(components, np.ascontiguousarray(sequences[:, :used]))
