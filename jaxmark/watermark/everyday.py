"""Everyday use: embed a message, and detect it, whichever way its scheme is read.

Informed schemes are read beside the original (`jaxmark.watermark.marking`), blind ones without it
(`jaxmark.watermark.blind`).
"""

from collections.abc import Mapping
from typing import overload

from numpy.typing import ArrayLike

from jaxmark.alignment.alignment import Align
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind import reading
from jaxmark.watermark.blind.field import FieldMarker, FieldScheme, make_field_marker, parameters_in
from jaxmark.watermark.blind.reading import BlindDetection
from jaxmark.watermark.budget import Limits, Visibility
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.detectors import Detector
from jaxmark.watermark.marking import DEFAULT_BITS, Detection, EmbedInfo, Marker, detect_any, make_marker, make_markers
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes import DEFAULT_SCHEME, SCHEMES, Scheme

#: The schemes that are read without the original.
BLIND_SCHEMES: Mapping[str, type[FieldScheme]] = {FieldScheme.name: FieldScheme}
NAMES = (*SCHEMES, *BLIND_SCHEMES)  # of all schemes


def blind_scheme(scheme: str | Scheme | FieldScheme) -> FieldScheme | None:
    """The blind scheme of this name, or that it is; None if it is an informed one."""
    if isinstance(scheme, FieldScheme):
        return scheme
    return BLIND_SCHEMES[scheme]() if isinstance(scheme, str) and scheme in BLIND_SCHEMES else None


def prepare(mesh: Mesh, key: bytes, bits: int, scheme: str | Scheme | FieldScheme) -> Marker | FieldMarker:
    """Prepare an original for marking, with a scheme of either kind.

    Raises:
        JaxmarkError: see `make_marker`.
    """
    blind = blind_scheme(scheme)
    if blind is None:
        if isinstance(scheme, str) and scheme not in SCHEMES:
            raise JaxmarkError(f"There is no scheme {scheme!r}; there are {', '.join(NAMES)}.")
        assert not isinstance(scheme, FieldScheme)
        return make_marker(mesh, key, bits=bits, scheme=scheme)
    return make_field_marker(mesh, key, bits=bits, scheme=blind)


def embed(
    mesh: Mesh,
    message: bytes,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
    visibility: Visibility | None = None,
    noise: float | None = None,
    scheme: str | Scheme | FieldScheme = DEFAULT_SCHEME,
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
            `"careful look"`, seen beside the original; `"visible"`. See `jaxmark.watermark.budget.VISIBILITY`.
        noise: a demand: the noise that the message must survive when half of the vertices are lost, see `capacity`; 0
            requires only that there are enough dimensions. By default nothing is demanded but that the message reads.
            It has no effect for schemes whose readers have no model of noise, such as `host` and `eigen`.
        scheme: a name or a scheme, see `make_marker`; or `"field"`, whose marks are read without the original.

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
    return marker.embed(message, budget, limits=limits, visibility=visibility, noise=noise)


@overload
def detect(
    suspect: Mesh,
    *,
    original: Mesh,
    key: bytes,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
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
    scheme: str | Scheme | FieldScheme = FieldScheme.name,
) -> BlindDetection: ...


def detect(
    suspect: Mesh,
    *,
    key: bytes,
    original: Mesh | None = None,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme | FieldScheme | None = None,
    detector: Detector | None = None,
    weights: ArrayLike | None = None,
    align: Align = "auto",
) -> Detection | BlindDetection:
    """Read a mark from a suspect, and compute what the reading proves.

    Without `original`, marks of the scheme `field` are read, and a `BlindDetection` is returned. Its bound holds for
    any suspect independent of the key: see `jaxmark.watermark.blind.reading`. The rest is about reading beside it.

    The suspect is first aligned with the original (`jaxmark.alignment.alignment.align`); points that are far off are
    masked. Without `message`, the message that is read counts only if its keyed tag fits. Two kinds of proof are then
    tried, and each is paid for: the tag, and the union bound over all messages, or over the one that the record commits
    to. With `message`, log10_p is Hoeffding's bound for that message (see `evidence.log10_p_claimed`), which can prove
    a mark whose message can no longer be read. If another message is read, the claim is refuted, not the mark: log10_p
    is that of the message that was read, and a remark says so. The score is taken for each way of weighting the suspect
    (see `detectors.claims`), and each is paid for, too; so are ways of aligning other than `"auto"`, and, without a
    record, both versions of the keyed choices.

    All bounds hold for any suspect independent of the key, provided that key, original, message and record were fixed
    before the suspect existed (if nothing shows that, log10_p_undated counts); that weights depend on suspect and
    original only; and that the score is the plain correlation of the codeword: joint decoding may choose the codeword,
    but does not enter the score. A mesh marked under the same key is not independent of it: once its message can no
    longer be read, a claim of a message that has many bits in common with it may pass. Where the program cannot vouch
    for a condition, `doubts` says why, and the figures are estimates.

    Args:
        suspect: any mesh: moved, reordered, cropped, remeshed.
        key: 32 bytes.
        original: the unmarked mesh; None to read a blind mark.
        bits: size of the payload in bits, a multiple of 8; by default the record's, else the claimed message's, else
            64. With 0, presence is claimed.
        message: the message that is claimed to be in the suspect; None to read without a claim.
        record: the record of the mark, see `make_marker`.
        scheme: the scheme that the mark was embedded with, if there is no record; by default `"keyed"` beside an
            original, `"field"` without one.
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
    named = (
        record.scheme if record is not None else scheme or (FieldScheme.name if original is None else DEFAULT_SCHEME)
    )
    blind = blind_scheme(named)
    if blind is not None:
        if (detector, weights, align) != (None, None, "auto"):
            raise JaxmarkError("A blind mark is read without alignment, weights or a detector; leave them out.")
        return read_blind(suspect, key, bits=bits, message=message, record=record, scheme=blind)
    if original is None:
        raise JaxmarkError(f"The scheme {named!r} is read beside the original; give it, or mark with 'field'.")
    informed = DEFAULT_SCHEME if scheme is None or isinstance(scheme, FieldScheme) else scheme
    markers = make_markers(original, key, bits=bits, record=record, scheme=informed, detector=detector)
    return detect_any(markers, suspect, message, weights, align)


def read_blind(
    suspect: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: FieldScheme | None = None,
) -> BlindDetection:
    """Read a mark of the scheme `field` without the original; see `detect`.

    Raises:
        JaxmarkError: see `detect`.
    """
    tried = scheme or FieldScheme()
    if record is not None:
        record.check("message" if record.bits else "presence", key)
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        bits, tried = record.bits, parameters_in(record)
    payload = DEFAULT_BITS if bits is None else bits
    if message is not None:
        if not isinstance(message, bytes):
            raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
        if 8 * len(message) != payload:
            raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {payload} bits.")
        if record is not None and record.told and not record.commits_to(message, reading.context(Key(key), payload)):
            raise JaxmarkError("The record commits to another message than the one claimed; claim that, or none.")
    return reading.detect(suspect, Key(key), payload, message, record, tried.widths, tried.steps)
