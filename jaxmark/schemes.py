"""Schemes: what is fixed about a mark besides key, message and strength. A name stands for the defaults.

A scheme's fields go into the record of a mark, so a mark made with other fields stays readable.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

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

    The pass band is as narrow as the payload allows, for the eye and for smoothing: 1,024 dimensions and 12 for each
    bit of message and tag, but at most what lies below λ = 0.44 unless the payload needs it. Dimensions are counted as
    on a regular triangle mesh, √3/2π · λ for each coordinate of each vertex. The nuisance that is projected off has at
    most a sixth of them, apart from affine maps.

    With a profile, the mark is written in the bands that it names, whatever the payload.
    """

    name: ClassVar[str] = "keyed"
    bands: int = 64  # Jackson-damped scaling functions over the whole spectrum, of which the lowest pass
    direction: Literal["coordinates", "normals"] = "coordinates"
    profile: tuple[float, ...] = ()  # relative strengths of the lowest bands, from `tune`; all alike unless given
    masking: bool = False  # whether rough regions are moved more than smooth ones; see `jaxmark.visibility.masking`

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return joint

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; beyond 12 code bits a bit, the code gains less than 0.1 dB."""
        return code_length(bits, self.dimensions(original, bits), 12)

    def dimensions(self, original: Original, bits: int) -> int:
        """How many dimensions the pass band for a payload has, as they are counted here."""
        return int(self._written(original, self._passing(original, bits)))

    def layout(self, original: Original, bits: int) -> Layout:
        """Pass band and nuisance for a payload, free of the key."""
        passing = self._passing(original, bits)
        columns = self._written(original, passing) / self._channels
        # Affine maps are 4 columns; each scale has one for each coordinate.
        scales = min(9, max(0, int(columns / 3 - 4) // 3))
        degree = 1
        while degree < 8 and math.comb(degree + 4, 3) + 3 * scales <= columns / 6:
            degree += 1
        return Layout(passing, scales, degree)

    def carrier(self, original: Original, key: bytes, bits: int, code_bits: int) -> KeyedCarrier:
        """See `Scheme`."""
        layout, dtype = self.layout(original, bits), original.signal.dtype
        host = make_host(
            original.operator,
            original.signal,
            jnp.asarray(original.positions, dtype),
            scaling(self.bands, damping="jackson")[: layout.passing],
            scales=layout.scales,
            degree=layout.degree,
        )
        chips = make_chips(key, original.geometry, original.used, code_bits, channels=self._channels)
        carrier = KeyedCarrier(host, chips)
        if self.direction == "normals":
            normals = vertex_normals(Mesh(original.positions, original.weld.point[np.asarray(original.mesh.faces)]))
            carrier = carrier._replace(normals=jnp.asarray(normals, dtype))
        if self.profile:
            carrier = carrier._replace(profile=np.array(self.profile, dtype))
        return carrier._replace(masking=masking(original)) if self.masking else carrier

    @property
    def _channels(self) -> int:
        match self.direction:
            case "coordinates":
                return 3
            case "normals":
                return 1
        raise JaxmarkError(f"direction must be 'coordinates' or 'normals', got {self.direction!r}.")

    def _passing(self, original: Original, bits: int) -> int:
        """How many bands the mark is written in: six at least, for narrower bands leak too much."""
        if self.profile:
            if len(self.profile) > self.bands or not min(self.profile) >= 0 < max(self.profile) < math.inf:
                raise JaxmarkError(f"A profile is up to {self.bands} numbers, none negative and not all 0.")
            return len(self.profile)
        information = bits + TAG_BITS
        usual = self._dimensions(original, round(self.bands * 0.31))
        wanted = max(min(1024 + 12 * information, usual), 6 * information)
        passing = min(6, self.bands)
        while passing < self.bands and self._dimensions(original, passing) < wanted:
            passing += 1
        return passing

    def _written(self, original: Original, passing: int) -> float:
        """Dimensions of the bands that are written in."""
        if not self.profile:
            return self._dimensions(original, passing)
        each = np.diff([self._dimensions(original, band) for band in range(passing + 1)])
        return float(np.sum(each[np.array(self.profile) > 0]))

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


SCHEMES: Mapping[str, type[KeyedScheme] | type[HostScheme] | type[EigenScheme]] = {
    scheme.name: scheme for scheme in (KeyedScheme, HostScheme, EigenScheme)
}
DEFAULT_SCHEME = KeyedScheme.name


def get_scheme(scheme: str | Scheme, parameters: Mapping[str, Any] | None = None) -> Scheme:
    """A scheme by its name, with its defaults or the given fields; a scheme itself is returned as it is.

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
    return SCHEMES[scheme](**given)


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
