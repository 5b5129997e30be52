"""The schemes by their names, and schemes as records store them.

The name of a scheme stands for its default fields. The record of a mark stores the fields, so that a mark that was made
with other fields stays readable.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.local import LocalScheme
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme

#: The schemes that are read with the original.
SCHEMES: Mapping[str, type[KeyedScheme] | type[HostScheme] | type[EigenScheme]] = {
    scheme.name: scheme for scheme in (KeyedScheme, HostScheme, EigenScheme)
}
#: The schemes that are read without the original, the fastest first.
BLIND_SCHEMES: Mapping[str, BlindScheme] = {LocalScheme.name: LocalScheme(), FieldScheme.name: FieldScheme()}
NAMES = (*SCHEMES, *BLIND_SCHEMES)  # of all schemes
DEFAULT_SCHEME = KeyedScheme.name

#: A scheme, its name, or the names of one that is read with the original and of blind ones, which mark a mesh together.
AnyScheme = str | Scheme | BlindScheme | tuple[str, ...]

_MAX_COMPONENTS = 512  # bands or eigenpairs that a record may ask for: no file decides how much time is spent

# Values of the fields that are missing from a record because it was written before they existed; by scheme.
_FIELDS_OF_OLD_RECORDS: Mapping[str, Mapping[str, Any]] = {"keyed": {"passband": "narrow", "hiding": False}}
# Fields that schemes had, and the one value of each that is still read; keyed choices stay bound to them.
_RETIRED_FIELDS: Mapping[str, Mapping[str, Any]] = {"keyed": {"masking": False}}


@runtime_checkable
class Named(Protocol):
    """A dataclass with a name, such as a scheme of either kind."""

    name: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]


def find_blind(scheme: str | Scheme | BlindScheme) -> BlindScheme | None:
    """Return the blind scheme of a name; a blind scheme as it is, and None for any other."""
    if isinstance(scheme, str):
        return BLIND_SCHEMES.get(scheme)
    return scheme if isinstance(scheme, BlindScheme) else None


def get_nonblind(scheme: str | Scheme | BlindScheme) -> Scheme:
    """Return the scheme of a name that is read with the original; such a scheme is returned as it is.

    Raises:
        JaxmarkError: if there is no scheme of that name, or it is blind.
    """
    if not isinstance(scheme, str | BlindScheme):
        return scheme
    name = name_of(scheme)
    if name not in SCHEMES:
        kind = "scheme that is read with the original" if name in NAMES else "scheme"
        raise JaxmarkError(f"There is no {kind} {name!r}; the schemes are {', '.join(NAMES)}.")
    return SCHEMES[name]()


def make_scheme(name: str, parameters: Mapping[str, Any]) -> Scheme:
    """Make a scheme of the library that is read with the original from its fields in a record.

    Args:
        name: one of `SCHEMES`.
        parameters: the fields, as `parameters_of` returns them.

    Raises:
        JaxmarkError: if there is no such scheme, or it has no such fields.
    """
    get_nonblind(name)  # refuses other names
    known = {field.name: type(field.default) for field in fields(SCHEMES[name])}
    # JSON stores tuples as lists.
    given: dict[str, Any] = {
        field: tuple(value) if isinstance(value, list) else value for field, value in parameters.items()
    }
    for field, value in _RETIRED_FIELDS.get(name, {}).items():
        if given.pop(field, value) != value:
            raise JaxmarkError(f"Marks of the scheme {name!r} with {field} other than {value} are no longer read.")
    if any(
        field not in known
        or type(value) is not known[field]
        or (isinstance(value, tuple) and not all(isinstance(item, float) for item in value))
        for field, value in given.items()
    ):
        raise JaxmarkError(f"The scheme {name!r} takes the parameters {', '.join(known)}, not {given}.")
    if any(not 0 < given.get(field, 1) <= _MAX_COMPONENTS for field in ("bands", "pairs")):
        raise JaxmarkError(f"A record's scheme has 1 to {_MAX_COMPONENTS} bands or pairs, not {given}.")
    return SCHEMES[name](**{**_FIELDS_OF_OLD_RECORDS.get(name, {}), **given})


def make_blind_scheme(name: str, parameters: Mapping[str, Any]) -> BlindScheme:
    """Make a blind scheme with the width and the step that a record names.

    Raises:
        JaxmarkError: if there is no such scheme, or they are not among those that it may have.
    """
    scheme, width, step = BLIND_SCHEMES.get(name), parameters.get("width"), parameters.get("step")
    if scheme is None or width not in scheme.widths or step not in scheme.steps:
        raise JaxmarkError(f"The record is not one of the scheme {name!r} that this jaxmark reads.")
    return scheme.fixed(width, step)


def parameters_of(scheme: Named) -> dict[str, Any]:
    """Return the fields of a scheme as a record stores them, and as keyed choices are bound to them."""
    return {**_RETIRED_FIELDS.get(scheme.name, {}), **asdict(scheme)}


def split(scheme: AnyScheme) -> tuple[str | Scheme | None, tuple[BlindScheme, ...]]:
    """Split what marks one mesh: the scheme that is read with the original, or its name, if any; and the blind ones.

    Raises:
        JaxmarkError: unless of several names the first is read with the original and the others are blind, each once.
    """
    if not isinstance(scheme, tuple):
        if (blind := find_blind(scheme)) is not None:
            return None, (blind,)
        return scheme if isinstance(scheme, str) else get_nonblind(scheme), ()
    if len(scheme) < 2 or scheme[0] not in SCHEMES or any(name not in BLIND_SCHEMES for name in scheme[1:]):
        raise JaxmarkError(
            f"Several marks in one mesh are one that is read with the original ({', '.join(SCHEMES)}) and then blind"
            f" ones ({', '.join(BLIND_SCHEMES)}), not {', '.join(scheme)}."
        )
    if len(set(scheme)) < len(scheme):
        raise JaxmarkError(f"Each scheme marks a mesh once, but one is twice among {', '.join(scheme)}.")
    return scheme[0], tuple(BLIND_SCHEMES[name] for name in scheme[1:])


def name_of(scheme: AnyScheme) -> str:
    """Return the name of a scheme, or of several with commas between."""
    if isinstance(scheme, tuple):
        return ",".join(scheme)
    return scheme if isinstance(scheme, str) else scheme.name
