"""Guess what went wrong where nothing was detected: the files exchanged, another payload, another scheme.

What is tried here uses the key, and is not paid for: it is a hint where to look, never evidence.
"""

from collections.abc import Iterator
from itertools import product

from jaxmark.alignment.alignment import Align, align
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.imprint import restore
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.marking import Marker, make_marker
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes.scheme import SCHEMES, EigenScheme, Scheme, get_scheme, stands_for

_PAYLOADS = (16, 32, 64, 128)  # sizes that people choose
_MAX_EIGEN_POINTS = 20_000  # more points have eigenpairs that take minutes


def is_original(suspect: Mesh, record: Record, key: bytes) -> bool:
    """Whether a suspect is the original that a record was made for, as some file has it."""
    try:
        record.check(record.content, key)
        return record.version > 1 and restore(suspect, record.open_imprint(key)).exact
    except JaxmarkError:
        return False


def guess_mistakes(suspect: Mesh, marker: Marker, how: Align) -> tuple[str, ...]:
    """Say what a suspect looks like in which a marker, made without a record, has found nothing.

    Args:
        suspect: the suspect's mesh.
        marker: the marker that found nothing.
        how: how suspects are aligned.
    """
    mine, version = (marker.scheme.name, marker.bits), marker.choices.version
    schemes = [one for name in SCHEMES for one in stands_for(get_scheme(name, version=version))]
    try:
        exchanged = make_marker(suspect, marker.key, bits=marker.bits, scheme=marker.scheme, version=version)
        own = [one for one in schemes if one.name == marker.scheme.name] or [marker.scheme]
        if any(_heard(exchanged, marker.original.mesh, own, [marker.bits], how)):
            return ("The files look exchanged: a mark reads in the original, if the suspect is taken for it.",)
    except JaxmarkError:
        pass  # no mesh that can be marked
    if len(marker.original.positions) > _MAX_EIGEN_POINTS:
        schemes = [one for one in schemes if not isinstance(one, EigenScheme)]
    for scheme, bits in _heard(marker, suspect, schemes, sorted({*_PAYLOADS, marker.bits}), how):
        if (scheme.name, bits) != mine:
            return (f"A message of {bits} bits reads with the scheme {scheme.name!r}: give these, or the record.",)
    return ("Without its record, a mark reads only with the original's numbers as they were marked, in their order.",)


def _heard(
    marker: Marker, suspect: Mesh, schemes: list[Scheme], payloads: list[int], how: Align
) -> Iterator[tuple[Scheme, int]]:
    """Schemes and payloads with which anything reads at a glance; a suspect is aligned only once."""
    try:
        seen = marker.observe(align(marker.original, suspect, how))
    except JaxmarkError:
        return
    for scheme, bits in product(schemes, payloads):
        try:
            if marker.with_scheme(scheme, bits).glance(seen) is not None:
                yield scheme, bits
        except JaxmarkError:
            continue  # this payload does not fit
