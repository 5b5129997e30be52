"""Guess what went wrong where nothing was detected: the files exchanged, another payload, another scheme.

What is tried here uses the key, and is not paid for: it is a hint where to look, never evidence.
"""

from collections.abc import Iterator
from itertools import product

from jaxmark.alignment.attempts import align
from jaxmark.alignment.result import Align
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.imprint import restore
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.mark import Mark
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes.modulated import EigenScheme
from jaxmark.watermark.schemes.passband import candidates
from jaxmark.watermark.schemes.registry import SCHEMES

_PAYLOADS = (16, 32, 64, 128)  # sizes that people choose
_MAX_EIGEN_POINTS = 20_000  # more points have eigenpairs that take minutes


def is_original(suspect: Mesh, record: Record, key: bytes) -> bool:
    """Whether a suspect is the original that a record was made for, as some file has it."""
    try:
        record.check(record.content, key)
        return restore(suspect, record.open_imprint(key)).exact
    except JaxmarkError:
        return False


def diagnose(suspect: Mesh, mark: Mark, align: Align) -> tuple[str, ...]:
    """Say what a suspect looks like in which a mark, without a record, was not found.

    Args:
        suspect: the suspect's mesh.
        mark: the mark that was not found.
        align: how suspects are aligned.
    """
    schemes = [one for scheme in SCHEMES.values() for one in candidates(scheme())]
    try:
        exchanged = make_marker(suspect, mark.key, bits=mark.bits, scheme=mark.scheme)
        own = [one for one in schemes if one.name == mark.scheme.name] or [mark.scheme]
        if any(_readable(exchanged, mark.original.mesh, own, [mark.bits], align)):
            return ("The files look exchanged: a mark reads in the original, if the suspect is taken for it.",)
    except JaxmarkError:
        pass  # no mesh that can be marked
    if len(mark.original.positions) > _MAX_EIGEN_POINTS:
        schemes = [one for one in schemes if not isinstance(one, EigenScheme)]
    for scheme, bits in _readable(mark, suspect, schemes, sorted({*_PAYLOADS, mark.bits}), align):
        if (scheme.name, bits) != (mark.scheme.name, mark.bits):
            return (f"A message of {bits} bits reads with the scheme {scheme.name!r}: give these, or the record.",)
    return ("Without its record, a mark reads only with the original's numbers as they were marked, in their order.",)


def _readable(
    mark: Mark, suspect: Mesh, schemes: list[Scheme], payloads: list[int], how: Align
) -> Iterator[tuple[Scheme, int]]:
    """Schemes and payloads with which anything reads quickly; a suspect is aligned only once."""
    try:
        seen = mark.observe(align(mark.original, suspect, how))
    except JaxmarkError:
        return
    for scheme, bits in product(schemes, payloads):
        try:
            if mark.with_scheme(scheme, bits).read_quickly(seen) is not None:
                yield scheme, bits
        except JaxmarkError:
            continue  # this payload does not fit
