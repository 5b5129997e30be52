"""Diagnose a suspect without a detection: exchanged files, another payload or another scheme.

The readings that are made here use the key, and their number is not charged. Their results are hints, not evidence, and
a hint says what a reading that follows it must be charged.
"""

import math
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

_PAYLOADS = (16, 32, 64, 128)  # usual payloads in bits
_MAX_EIGEN_POINTS = 20_000  # with more points, computing eigenpairs takes minutes


def is_original(suspect: Mesh, record: Record, key: bytes) -> bool:
    """Whether a suspect is the original that a record was made for, possibly saved again."""
    try:
        record.check(record.content, key)
        return restore(suspect, record.open_imprint(key)).exact
    except JaxmarkError:
        return False


def diagnose(suspect: Mesh, mark: Mark, align: Align) -> tuple[str, ...]:
    """Return hints on why a mark, without its record, was not detected in a suspect.

    Args:
        suspect: the suspect's mesh.
        mark: the mark that was not detected.
        align: how suspects are aligned.
    """
    schemes = [candidate for scheme in SCHEMES.values() for candidate in candidates(scheme())]
    try:
        exchanged = make_marker(suspect, mark.key, bits=mark.bits, scheme=mark.scheme)
        own = [scheme for scheme in schemes if scheme.name == mark.scheme.name] or [mark.scheme]
        if any(_readable(exchanged, mark.original.mesh, own, [mark.bits], align)):
            return ("The files look exchanged: a mark is readable from the original, if the suspect is the original.",)
    except JaxmarkError:
        pass  # the suspect cannot be marked
    if len(mark.original.positions) > _MAX_EIGEN_POINTS:
        schemes = [scheme for scheme in schemes if not isinstance(scheme, EigenScheme)]
    payloads = sorted({*_PAYLOADS, mark.bits})
    tried = len(schemes) * len(payloads)
    for scheme, bits in _readable(mark, suspect, schemes, payloads, align):
        if (scheme.name, bits) != (mark.scheme.name, mark.bits):
            return (
                f"A message of {bits} bits is readable with the scheme {scheme.name!r}: give both, or give the record."
                f" {tried} readings led to this hint; if nothing else says so, add {math.log10(tried):.1f} to log10 p.",
            )
    looked_for = f"a message of {mark.bits} bits" if mark.bits else "a presence mark"
    return (
        f"Without the record, only {looked_for} of this key was looked for: if it has another size, give that by --bits"
        " (a text has 8 bits for each byte). The original must have exactly the coordinates, and the order, in which it"
        " was marked. Blind marks are read without --original, and copies for recipients by `jaxmark identify`.",
    )


def _readable(
    mark: Mark, suspect: Mesh, schemes: list[Scheme], payloads: list[int], how: Align
) -> Iterator[tuple[Scheme, int]]:
    """Yield the schemes and payloads with which a quick reading succeeds; the suspect is aligned only once."""
    try:
        observation = mark.observe(align(mark.original, suspect, how))
    except JaxmarkError:
        return
    for scheme, bits in product(schemes, payloads):
        try:
            if mark.with_scheme(scheme, bits).read_quickly(observation) is not None:
                yield scheme, bits
        except JaxmarkError:
            continue  # this payload does not fit
