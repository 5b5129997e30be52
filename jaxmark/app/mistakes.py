"""Guess what went wrong where nothing was detected: the files exchanged, another payload, another scheme.

What is tried here uses the key, and is not paid for: it is a hint where to look, never evidence.
"""

from itertools import product

from jaxmark.alignment.alignment import Align, align
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.imprint import restore
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.marking import Marker, make_marker
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes import SCHEMES, EigenScheme

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
    original, mine = marker.original.mesh, (marker.scheme.name, marker.bits)
    if _reads(suspect, original, marker, *mine, how):
        return ("The files look exchanged: a mark reads in the original, if the suspect is taken for it.",)
    for scheme, bits in product(SCHEMES, sorted({*_PAYLOADS, marker.bits})):
        too_long = scheme == EigenScheme.name and len(original.vertices) > _MAX_EIGEN_POINTS
        if (scheme, bits) != mine and not too_long and _reads(original, suspect, marker, scheme, bits, how):
            return (f"A message of {bits} bits reads with the scheme {scheme!r}: give these, or the record.",)
    return ("Without its record, a mark reads only with the original's numbers as they were marked, in their order.",)


def _reads(original: Mesh, suspect: Mesh, marker: Marker, scheme: str, bits: int, how: Align) -> bool:
    """Whether anything reads at a glance with another original, scheme or payload."""
    try:
        other = make_marker(original, marker.key, bits=bits, scheme=scheme, version=marker.choices.version)
        return other.glance(other.observe(align(other.original, suspect, how))) is not None
    except JaxmarkError:
        return False
