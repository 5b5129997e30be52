"""Schemes: what is fixed about a mark besides key, message and strength. A name stands for the defaults.

A scheme's fields go into the record of a mark, so a mark made with other fields stays readable.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from jaxmark.bands import scaling
from jaxmark.carriers import Carrier, ModulatedCarrier, eigenspaces, host_bands
from jaxmark.carriers.carrier import Components
from jaxmark.errors import JaxmarkError
from jaxmark.message import TAG_BITS
from jaxmark.original import Original
from jaxmark.sequences import orthogonal_sequences
from jaxmark.spectrum import eigenpairs


@runtime_checkable
class Scheme(Protocol):
    """A dataclass that makes a carrier from an original, a key and a number of bits; a record stores its fields."""

    name: ClassVar[str]  # what records and the command line call it
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def carrier(self, original: Original, key: bytes, code_bits: int) -> Carrier:
        """The carrier of so many bits on this original under this key."""
        ...


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

    def carrier(self, original: Original, key: bytes, code_bits: int) -> Carrier:
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

    def carrier(self, original: Original, key: bytes, code_bits: int) -> Carrier:
        """See `Scheme`."""
        pairs = eigenpairs(original.operator, self.pairs)
        components = eigenspaces(original.operator, original.signal, pairs)
        return _modulated(self.name, components, self.pairs, original, key, code_bits)


SCHEMES: Mapping[str, type[HostScheme] | type[EigenScheme]] = {
    scheme.name: scheme for scheme in (HostScheme, EigenScheme)
}


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
    given = dict(parameters or {})
    if any(name not in known or type(value) is not known[name] for name, value in given.items()):
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
    if code_bits > slots:
        raise JaxmarkError(
            f"The scheme {name!r} has {slots} places for bits, of which the tag takes {TAG_BITS}: the payload is at"
            f" most {max(0, slots - TAG_BITS) // 8 * 8} bits."
        )
    sequences = orthogonal_sequences(key, original.geometry, code_bits, slots, label=name).reshape(code_bits, bands, 3)
    used = components.gram.shape[-1]  # a small mesh has fewer eigenvectors than the layout has places for
    return ModulatedCarrier(components, np.ascontiguousarray(sequences[:, :used]))
