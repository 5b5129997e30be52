"""The schemes by name, and the conversion of schemes to and from records.

The name of a scheme stands for its default fields. The record of a mark stores the fields, so that marks with other
fields stay readable.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.local import LocalScheme
from jaxmark.watermark.blind.rooted import RootedScheme
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from jaxmark.watermark.schemes.own_bands import OwnBandsScheme

#: The schemes that are read with the original.
SCHEMES: Mapping[str, type[KeyedScheme] | type[HostScheme] | type[EigenScheme]] = {
    scheme.name: scheme for scheme in (KeyedScheme, HostScheme, EigenScheme)
}
#: The blind schemes, the fastest first.
BLIND_SCHEMES: Mapping[str, BlindScheme] = {
    scheme.name: scheme for scheme in (LocalScheme(), FieldScheme(), RootedScheme())
}
#: The blind schemes that are read if none is named. Those that are found by the key take long, and must be named.
USUAL_BLIND_SCHEMES = tuple(scheme for scheme in BLIND_SCHEMES.values() if not scheme.by_key)
# Schemes that only records name, because they have no usual fields.
_BY_RECORD: Mapping[str, type[Scheme]] = {**SCHEMES, OwnBandsScheme.name: OwnBandsScheme}
NAMES = (*SCHEMES, *BLIND_SCHEMES)  # the names of all schemes
DEFAULT_SCHEME = KeyedScheme.name

#: A scheme, its name, or names for several marks in one mesh: one that is read with the original, then blind ones.
AnyScheme = str | Scheme | BlindScheme | tuple[str, ...]

_MOST_EXACT = 2**53  # largest whole number up to which floats have all
_MAX_COMPONENTS = 512  # the most bands or eigenpairs that a record may ask for, which limits the time of reading

# The values, by scheme, of fields that are missing from records that were written before the fields existed.
_FIELDS_OF_OLD_RECORDS: Mapping[str, Mapping[str, Any]] = {"keyed": {"passband": "narrow", "hiding": False}}
# Former fields of schemes, and the only value of each that can still be read; keyed choices stay bound to them.
_RETIRED_FIELDS: Mapping[str, Mapping[str, Any]] = {"keyed": {"masking": False}}


@runtime_checkable
class Named(Protocol):
    """A dataclass with a name, such as a blind or non-blind scheme."""

    name: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]


def is_builtin(scheme: Scheme | BlindScheme) -> bool:
    """Whether a scheme is one of this library; a subclass may do anything, and is not."""
    return type(scheme) in (*_BY_RECORD.values(), *map(type, BLIND_SCHEMES.values()))


def find_blind(scheme: str | Scheme | BlindScheme) -> BlindScheme | None:
    """Return the blind scheme of a name; a blind scheme is returned unchanged, and anything else gives None."""
    if isinstance(scheme, str):
        return BLIND_SCHEMES.get(scheme)
    return scheme if isinstance(scheme, BlindScheme) else None


def get_nonblind(scheme: str | Scheme | BlindScheme) -> Scheme:
    """Return the scheme of a name that is read with the original; such a scheme is returned unchanged.

    Raises:
        JaxmarkError: if there is no scheme of that name, or it is blind.
    """
    if not isinstance(scheme, str | BlindScheme):
        if not isinstance(scheme, Scheme):
            raise JaxmarkError(f"A scheme is a name, or one of `jaxmark.watermark.schemes`; here, it is {scheme!r}.")
        return scheme
    name = name_of(scheme)
    if name not in SCHEMES:
        if name in BLIND_SCHEMES:
            raise JaxmarkError(f"Marks of the scheme {name!r} are read without the original: leave it out.")
        raise JaxmarkError(f"There is no scheme {name!r}; the schemes are {', '.join(NAMES)}.")
    return SCHEMES[name]()


def make_scheme(name: str, parameters: Mapping[str, Any]) -> Scheme:
    """Make a scheme that is read with the original from its fields in a record.

    Args:
        name: one of `SCHEMES`, or that of `OwnBandsScheme`.
        parameters: the fields, as `parameters_of` returns them.

    Raises:
        JaxmarkError: if there is no such scheme, or it does not have these fields.
    """
    if name not in _BY_RECORD:
        get_nonblind(name)  # raises an error
    types = {field.name: type(field.default) for field in fields(_BY_RECORD[name])}
    values: dict[str, Any] = {field: _as_tuples(value) for field, value in parameters.items()}
    for field, value in _RETIRED_FIELDS.get(name, {}).items():
        if values.pop(field, value) != value:
            raise JaxmarkError(f"Marks of the scheme {name!r} with {field} other than {value} are no longer read.")
    if wrong := [
        field
        for field, value in values.items()
        if field not in types or type(value) is not types[field] or not _fits(field, value)
    ]:
        raise JaxmarkError(
            f"The scheme {name!r} takes the parameters {', '.join(types)}; there is none of this form:"
            f" {', '.join(map(repr, wrong))}."
        )
    if any(not 0 < values.get(field, 1) <= _MAX_COMPONENTS for field in ("bands", "pairs")):
        raise JaxmarkError(f"The scheme in a record has 1 to {_MAX_COMPONENTS} bands or pairs, not {values}.")
    return _BY_RECORD[name](**{**_FIELDS_OF_OLD_RECORDS.get(name, {}), **values})


def _as_tuples(value: Any) -> Any:
    """Convert lists, as which JSON stores tuples."""
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


def _fits(field: str, value: Any) -> bool:
    """Whether a value, if it is a tuple, has only numbers; `filters` are tuples of numbers."""
    if not isinstance(value, tuple):
        return True
    lists = value if field == "filters" else (value,)
    return all(isinstance(one, tuple) and all(map(_is_number, one)) for one in lists)


def _is_number(value: Any) -> bool:
    """Whether a value is a float, or a whole number that a float holds exactly."""
    return isinstance(value, float) or (type(value) is int and abs(value) <= _MOST_EXACT)


def make_blind_scheme(name: str, parameters: Mapping[str, Any]) -> BlindScheme:
    """Make a blind scheme with the width and the quantisation step of a record.

    Raises:
        JaxmarkError: if there is no such scheme, or it does not have this width and step.
    """
    scheme, width, step = BLIND_SCHEMES.get(name), parameters.get("width"), parameters.get("step")
    if scheme is None or width not in scheme.widths or step not in scheme.steps:
        raise JaxmarkError(f"This jaxmark cannot read the record: no scheme {name!r} has its width and step.")
    further = {name: value for name, value in parameters.items() if name not in ("width", "step")}
    if not further.keys() <= set(scheme.remembered) or not all(isinstance(text, str) for text in further.values()):
        raise JaxmarkError(f"This jaxmark cannot read the record: the scheme {name!r} has other parameters.")
    return scheme.fixed(width, step, **further)


def parameters_of(scheme: Named) -> dict[str, Any]:
    """Return the fields of a scheme as a record stores them, and as keyed choices are bound to them."""
    return {**_RETIRED_FIELDS.get(scheme.name, {}), **asdict(scheme)}


def split(scheme: AnyScheme) -> tuple[str | Scheme | None, tuple[BlindScheme, ...]]:
    """Split the schemes of one mesh into the one that is read with the original, if any, and the blind ones.

    Returns:
        The scheme that is read with the original, or its name; None if there is none. Then the blind schemes.

    Raises:
        JaxmarkError: if several names are not one scheme that is read with the original, followed by different blind
            schemes.
    """
    if not isinstance(scheme, tuple):
        if (blind := find_blind(scheme)) is not None:
            return None, (blind,)
        return scheme if isinstance(scheme, str) else get_nonblind(scheme), ()
    first, *others = scheme or ("",)
    known = all(isinstance(name, str) for name in scheme) and first in SCHEMES and set(others) <= BLIND_SCHEMES.keys()
    if not others or not known:
        raise JaxmarkError(
            f"Several marks in one mesh need one scheme that is read with the original ({', '.join(SCHEMES)}), followed"
            f" by blind schemes ({', '.join(BLIND_SCHEMES)}), not {scheme!r}."
        )
    if len(set(scheme)) < len(scheme):
        raise JaxmarkError(f"Each scheme can mark a mesh once, but one is named twice: {', '.join(scheme)}.")
    return first, tuple(BLIND_SCHEMES[name] for name in others)


def name_of(scheme: AnyScheme) -> str:
    """Return the name of a scheme, or the names of several, separated by commas."""
    if isinstance(scheme, tuple):
        return ",".join(scheme)
    return scheme if isinstance(scheme, str) else (find_blind(scheme) or get_nonblind(scheme)).name
