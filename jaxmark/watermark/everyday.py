"""Everyday use: embed a message, and detect it, whichever way its scheme is read.

Informed schemes are read beside the original (`jaxmark.watermark.marking`), blind ones without it
(`jaxmark.watermark.blind`).
"""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import overload

from numpy.typing import ArrayLike

from jaxmark.alignment.alignment import Align
from jaxmark.alignment.original import make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_mesh
from jaxmark.watermark.blind import reading
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.local import LocalScheme
from jaxmark.watermark.blind.marker import BlindMarker, make_blind_marker, parameters_in
from jaxmark.watermark.blind.reading import BlindDetection
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import KEY_BYTES, Key
from jaxmark.watermark.combined import CombinedMarker, unite
from jaxmark.watermark.marking import (
    DEFAULT_BITS,
    Detection,
    EmbedInfo,
    Marker,
    make_marker,
    make_markers,
)
from jaxmark.watermark.perception.budget import Limits, Visibility, make_budget, visibility_of
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.reading.detectors import Detector
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes.scheme import DEFAULT_SCHEME, SCHEMES, Scheme, get_scheme

#: The schemes that are read without the original, the soonest read first.
BLIND_SCHEMES: Mapping[str, BlindScheme] = {LocalScheme.name: LocalScheme(), FieldScheme.name: FieldScheme()}
NAMES = (*SCHEMES, *BLIND_SCHEMES)  # of all schemes
#: A scheme of either kind, or the names of an informed one and blind ones, which mark one mesh together.
AnyScheme = str | Scheme | BlindScheme | tuple[str, ...]
AnyMarker = Marker | BlindMarker | CombinedMarker


def name_of(scheme: AnyScheme) -> str:
    """The name of a scheme, or of several with commas between."""
    if isinstance(scheme, tuple):
        return ",".join(scheme)
    return scheme if isinstance(scheme, str) else scheme.name


def blind_scheme(scheme: str | Scheme | BlindScheme) -> BlindScheme | None:
    """The blind scheme of this name, or that it is; None if it is an informed one."""
    if isinstance(scheme, BlindScheme):
        return scheme
    return BLIND_SCHEMES.get(scheme) if isinstance(scheme, str) else None


def informed_scheme(scheme: str | Scheme | BlindScheme) -> str | Scheme:
    """The scheme, which must be one that is read beside the original.

    Raises:
        JaxmarkError: if it is not.
    """
    if isinstance(scheme, BlindScheme) or (isinstance(scheme, str) and scheme not in SCHEMES):
        kind = "informed scheme" if scheme in NAMES else "scheme"
        raise JaxmarkError(f"There is no {kind} {scheme!r}; the schemes are {', '.join(NAMES)}.")
    return scheme


def split(schemes: tuple[str, ...]) -> tuple[str, tuple[BlindScheme, ...]]:
    """The informed scheme and the blind ones that mark one mesh together, by their names.

    Raises:
        JaxmarkError: unless the first is informed and the others are blind, each once.
    """
    if len(schemes) < 2 or schemes[0] not in SCHEMES or any(name not in BLIND_SCHEMES for name in schemes[1:]):
        raise JaxmarkError(
            f"Several marks in one mesh are an informed one ({', '.join(SCHEMES)}) and then blind ones"
            f" ({', '.join(BLIND_SCHEMES)}), not {', '.join(schemes)}."
        )
    if len(set(schemes)) < len(schemes):
        raise JaxmarkError(f"Each scheme marks a mesh once, but one is twice among {', '.join(schemes)}.")
    return schemes[0], tuple(BLIND_SCHEMES[name] for name in schemes[1:])


def scheme_named(scheme: str | Scheme | BlindScheme) -> Scheme | BlindScheme:
    """The scheme of this name, of either kind, or that it is.

    Raises:
        JaxmarkError: if there is none.
    """
    return blind_scheme(scheme) or get_scheme(informed_scheme(scheme))


def prepare_alone(mesh: Mesh, key: bytes, bits: int, scheme: str | Scheme | BlindScheme) -> Marker | BlindMarker:
    """Prepare an original for marking with one scheme of either kind.

    Raises:
        JaxmarkError: see `make_marker`.
    """
    blind = blind_scheme(scheme)
    if blind is None:
        return make_marker(mesh, key, bits=bits, scheme=informed_scheme(scheme))
    return make_blind_marker(mesh, key, bits=bits, scheme=blind)


def prepare(mesh: Mesh, key: bytes, bits: int, scheme: AnyScheme) -> AnyMarker:
    """Prepare an original for marking, with a scheme of either kind or several.

    Raises:
        JaxmarkError: see `make_marker` and `split`.
    """
    if isinstance(scheme, tuple):
        informed, blind = split(scheme)
        return CombinedMarker(make_marker(mesh, key, bits=bits, scheme=informed), blind)
    return prepare_alone(mesh, key, bits, scheme)


def embed(
    mesh: Mesh,
    message: bytes,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
    visibility: Visibility | None = None,
    noise: float | None = None,
    scheme: AnyScheme = DEFAULT_SCHEME,
) -> tuple[Mesh, EmbedInfo]:
    """Embed a message in the vertex positions of a mesh.

    The mark is as strong as budget and limits allow; by default it is so weak that people do not notice it. The message
    is read back before the mesh is returned, and a mesh that cannot carry it is refused. What noise it survives
    (`EmbedInfo.survives`) depends on the mesh: much on scans, little on models of some hundred points.

    Args:
        mesh: the original.
        message: any bytes; none for a presence mark, which says nothing but that it is there, and fits where messages
            do not.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement of the welded vertices that faces use, unweighted, relative to the diagonal of their
            axis-aligned bounding box: 0.0008 is 0.08 % of it. It is met exactly, unless a limit is reached first.
        limits: the largest values that metrics of `distortion.METRICS` may reach, by name, in the units of
            `distortion.Comparison`; or that metrics of your own may, by function (see `distortion.measure`).
        visibility: how well people may see the mark: `"hidden"`, the default if budget and limits are not given;
            `"careful look"`, seen beside the original; `"visible"`. See
            `jaxmark.watermark.perception.budget.VISIBILITY`.
        noise: a demand: the noise that the message must survive when half of the vertices are lost, see `capacity`; 0
            requires only that there are enough dimensions. By default nothing is demanded but that the message reads.
            It has no effect for schemes whose readers have no model of noise, such as `host` and `eigen`.
        scheme: a name or a scheme, see `make_marker`; the default, by its name, takes the pass band that suits what
            may be seen (see `Marker.suited`), a scheme the one it has. Or `"field"` or `"local"`, whose marks are read
            without the original, after any remeshing or from any part; or several names, as `("keyed", "field")`, for
            marks within one set of bounds, of which the first is informed and has the record.

    Returns:
        The marked mesh (float64 vertices, same faces) and how it was marked.

    Raises:
        JaxmarkError: if the mesh, key, budget or payload is unusable, or the message does not read back; or if what
            `noise` demands cannot be met: the error then states the largest payload, and the least budget if there is
            one.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    marker = prepare(mesh, key, 8 * len(message), scheme)
    if isinstance(scheme, str | tuple):  # names stand for any pass band, objects for the one they have
        marker = marker.suited(budget, limits=limits, visibility=visibility, noise=noise)
    return marker.embed(message, budget, limits=limits, visibility=visibility, noise=noise)


def capacity(
    mesh: Mesh,
    budget: float | None = None,
    *,
    limits: Limits | None = None,
    visibility: Visibility | None = None,
    noise: float = NOISE,
    coverage: float = COVERAGE,
    scheme: str | Scheme | BlindScheme = DEFAULT_SCHEME,
) -> int:
    """Compute how many bits a mesh can carry, by the energy and the dimensions of a mark that projection leaves.

    For schemes whose readers have no model of noise, such as `host` and `eigen`, only the number of code bits counts.
    Marks of `field` do not survive the loss of parts, so that coverage has no meaning for them.

    Args:
        mesh: the original.
        budget: RMS displacement, see `embed`.
        limits: limits on metrics, see `embed`; how much displacement they allow is tried for each payload size.
        visibility: see `embed`.
        noise: half width of uniform noise on each coordinate, relative to the mean distance of the vertices to their
            centre; by default the strongest of the SMI 2010 protocol (Wang et al.), 0.5 %.
        coverage: share of the vertices that may be left.
        scheme: a name or a scheme, see `make_marker`.

    Returns:
        The largest payload in bits, a multiple of 8; 0 if not even 8.

    Raises:
        JaxmarkError: if the mesh is unusable or a number is out of range.
    """
    if not (0 <= noise < math.inf and 0 < coverage <= 1):
        raise JaxmarkError(
            f"capacity needs a noise of at least 0 and a coverage in (0, 1], got {noise:g} and {coverage:g}."
        )
    if (blind := blind_scheme(scheme)) is not None:
        field = make_blind_marker(mesh, bytes(KEY_BYTES), scheme=blind)
        return field.writer.capacity(make_budget(budget, limits, visibility, named=visibility_of(mesh)), noise)
    original = make_original(mesh)
    bounds = make_budget(budget, limits, visibility, named=visibility_of(original.mesh))
    conditions = Conditions(bounds, noise, coverage)
    return Capacity(original, get_scheme(informed_scheme(scheme))).bits(conditions)


@overload
def detect(
    suspect: Mesh,
    *,
    original: Mesh,
    key: bytes,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme | tuple[str, ...] = DEFAULT_SCHEME,
    detector: Detector | None = None,
    weights: ArrayLike | None = None,
    align: Align = "auto",
) -> Detection: ...


@overload
def detect(
    suspect: Mesh,
    *,
    key: bytes,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme | BlindScheme | None = None,
) -> BlindDetection: ...


def detect(
    suspect: Mesh,
    *,
    key: bytes,
    original: Mesh | None = None,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: AnyScheme | None = None,
    detector: Detector | None = None,
    weights: ArrayLike | None = None,
    align: Align = "auto",
) -> Detection | BlindDetection:
    """Read a mark from a suspect, and compute what the reading proves.

    Without `original`, marks of the blind schemes are read; see `jaxmark.watermark.blind.reading`. Beside it, the
    suspect is first aligned with it (`jaxmark.alignment.alignment.align`). Without `message`, what is read counts only
    if its keyed tag fits. With it, a mark is proven whose message can no longer be read; if another message is read,
    the claim is refuted, not the mark: log10_p is that of the message that was read, and a remark says so. All that was
    tried, or left to choose, is paid for (`Marker.detect`).

    **The bounds hold for any suspect independent of the key**, provided that key, original, message and record were
    fixed before it existed; if nothing shows that, log10_p_undated counts. A mesh marked under the same key is not
    independent of it: once its message can no longer be read, a claim of one that has many bits in common with it may
    pass. Where the program cannot vouch for a condition, `doubts` says why, and the figures are estimates.

    Args:
        suspect: any mesh: moved, reordered, cropped, remeshed.
        key: 32 bytes.
        original: the unmarked mesh; None to read a blind mark.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else the claimed message's, else
            64. With 0, presence is claimed.
        message: the message that is claimed to be in the suspect; None to read without a claim.
        record: the record of the mark, see `make_marker`.
        scheme: the scheme that the mark was embedded with, if there is no record; by default `"keyed"` beside an
            original, any blind one without it. Several names for marks that were embedded together: what they prove is
            united.
        detector: a detector, see `make_marker`.
        weights: one number for each vertex of the original, not negative: how far to trust what the suspect shows of
            it, 0 for not at all; **must not depend on the key**.
        align: how the suspect is aligned: `"auto"`, `"same"`, `"similarity"` or `"affine"`.

    Returns:
        The result of the reading; a suspect identical to the original gives log10_p = 0.

    Raises:
        JaxmarkError: see `make_marker`; also if the suspect cannot be aligned, or the claimed message has another size
            than the payload, or is not the one that the record commits to.
    """
    if bits is None and record is None and isinstance(message, bytes):
        bits = 8 * len(message)
    others: tuple[BlindScheme, ...] = ()
    if isinstance(scheme, tuple):
        scheme, others = split(scheme)
    named = scheme if record is None else record.scheme
    blind = None if named is None else blind_scheme(named)
    if blind is not None or (named is None and original is None):
        if (detector, weights, align) != (None, None, "auto"):
            raise JaxmarkError("A blind mark is read without alignment, weights or a detector; leave them out.")
        return read_blind(suspect, key, bits=bits, message=message, record=record, scheme=blind)
    if original is None:
        raise JaxmarkError(f"The scheme {named!r} is read beside the original; give it, or mark with 'field'.")
    informed = informed_scheme(scheme or DEFAULT_SCHEME)
    markers = make_markers(original, key, bits=bits, record=record, scheme=informed, detector=detector)
    found, marker = markers.detect(suspect, message, weights, align)
    return also(found, others, suspect, key, marker.bits, message) if others else found


def also(
    found: Detection, schemes: Sequence[BlindScheme], suspect: Mesh, key: bytes, bits: int, message: bytes | None
) -> Detection:
    """Read blind marks of the same message, too, and unite what all of them prove.

    Raises:
        JaxmarkError: see `detect`.
    """
    return unite(found, [read_blind(suspect, key, bits=bits, message=message, scheme=scheme) for scheme in schemes])


def read_blind(
    suspect: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: BlindScheme | None = None,
) -> BlindDetection:
    """Read a mark without the original, of a scheme or else of any of `BLIND_SCHEMES`, all paid for; see `detect`.

    Raises:
        JaxmarkError: see `detect`.
    """
    check_mesh(suspect)
    tried = [scheme] if scheme is not None else list(BLIND_SCHEMES.values())
    if record is not None:
        record.check("message" if record.bits else "presence", key)
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        blind = blind_scheme(record.scheme)
        if blind is None:
            raise JaxmarkError(
                f"The record says that the scheme is {record.scheme!r}, which is read beside the original."
            )
        bits, tried = record.bits, [parameters_in(record, blind)]
    payload = DEFAULT_BITS if bits is None else bits
    if message is not None:
        if not isinstance(message, bytes):
            raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
        if 8 * len(message) != payload:
            raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {payload} bits.")
    if record is not None and record.told and message is not None:
        choices = reading.context(Key(key), payload, record.scheme)
        if not record.commits_to(message, choices):
            raise JaxmarkError("The record commits to another message than the one claimed; claim that, or none.")
    found: list[BlindDetection] = []
    secret = Key(key)
    reads = (partial(reading.detect, suspect, secret, payload, one, message, record) for one in tried)
    for one in reading.try_each(reads):
        found.append(one)
        if reading.is_sure(one):
            break
    return reading.best_of(found, len(tried))
