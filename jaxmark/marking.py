"""Marking meshes: messages and keys in, meshes and evidence out."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark import distortion
from jaxmark.carriers import Carrier
from jaxmark.detectors import Detector, decorrelate
from jaxmark.errors import JaxmarkError
from jaxmark.evidence import log10_p_claimed, log10_p_tag
from jaxmark.keys import Key, commitment
from jaxmark.laplacian import centre
from jaxmark.mesh import Mesh
from jaxmark.message import TAG_BITS, code_length, decode, encode
from jaxmark.original import Original, displaced, prepare, residual
from jaxmark.record import Record
from jaxmark.schemes import Scheme, get_scheme, parameters_of

DEFAULT_BITS = 64


class EmbedInfo(NamedTuple):
    """What was done to a mesh."""

    rms: float  # displacement of the welded vertices that faces use, unweighted, over the bounding-box diagonal
    max: float  # the largest such displacement
    beta: float  # strength: the factor on the carrier's unit displacement, in diagonals
    record: Record


class Detection(NamedTuple):
    """What was found in a suspect."""

    message: bytes | None  # the message read, None unless its keyed tag fits
    log10_p: float  # log10 of a bound on the false-positive probability, in [-77, 0]
    scores: Float64[np.ndarray, " bits"]  # soft values of the payload's bits, ±1 on average
    coverage: float  # share of the original's points that the suspect gave evidence for

    def detected(self, alpha: float = 1e-6) -> bool:
        """Whether the false-positive probability is at most `alpha`.

        Raises:
            JaxmarkError: if `alpha` is not in (0, 1).
        """
        if not 0 < alpha < 1:
            raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
        return self.log10_p <= math.log10(alpha)


@dataclass(frozen=True, eq=False)
class Marker:
    """Key, payload and scheme on one original: marks it, and reads any number of suspects, preparing only once.

    Make one with `make_marker`.
    """

    original: Original
    key: Key
    bits: int  # payload
    scheme: Scheme
    carrier: Carrier
    detector: Detector

    def embed(self, message: bytes, budget: float = 8e-4) -> tuple[Mesh, EmbedInfo]:
        """Hide a message of just the payload's size in the original; see `embed`."""
        if not 0 < budget < 1:
            raise JaxmarkError(f"The budget is relative to the bounding box's diagonal and in (0, 1), got {budget}.")
        self._check_size(message)
        original = self.original
        codeword = jnp.asarray(encode(message, self.key, original.geometry), original.signal.dtype)
        unit = np.asarray(self.carrier.displacement(codeword), np.float64)
        size = float(distortion.rms(unit[original.used]))
        if not (math.isfinite(size) and size > 0):
            raise JaxmarkError(
                f"The {len(unit)} points of this mesh leave the scheme {self.scheme.name!r} nothing to write in."
            )
        beta = float(budget) / size
        marked = displaced(original, beta * unit)
        written = residual(original, marked)[original.used]
        rms = float(distortion.rms(written))
        if abs(rms - budget) > 0.01 * budget:
            raise JaxmarkError(
                f"A budget of {budget:g} is lost in the rounding of this mesh's coordinates; use a larger one."
            )
        if self.detect(marked).message != message:
            raise JaxmarkError(
                f"This mesh ({len(unit)} points) cannot carry {self.bits} bits with the scheme {self.scheme.name!r}:"
                " they do not read back, even unattacked. Use a shorter message, or a finer or less regular mesh."
            )
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=beta,
            original=original.geometry.hex(),
            key=commitment(self.key),
            parameters=parameters_of(self.scheme),
        )
        return marked, EmbedInfo(rms, float(distortion.maximum(written)), beta, record)

    def detect(self, suspect: Mesh, message: bytes | None = None) -> Detection:
        """Read a suspect, with a claimed message or without; see `detect`."""
        original, dtype = self.original, self.original.signal.dtype
        if message is not None:
            self._check_size(message)
        # Scaled and centred in float64: nothing overflows in float32, and a suspect that was moved far away leaves no
        # rounding errors behind.
        moved = residual(original, suspect)
        moved /= np.abs(moved).max() or 1.0
        difference = jnp.asarray(centre(original.operator, moved), dtype)
        soft = np.asarray(self.detector(self.carrier, difference, 1.0), np.float64)
        read = decode(soft, self.key, original.geometry)
        if message is not None:
            claimed = jnp.asarray(encode(message, self.key, original.geometry), dtype)
            score, norm = self.carrier.claim(difference, claimed)
            # Another message that reads refutes the claim, however much the two have in common.
            log10_p = log10_p_claimed(score, norm) if read in (None, message) else 0.0
        else:
            log10_p = 0.0 if read is None else log10_p_tag(TAG_BITS)
        size = np.sqrt(np.mean(soft**2))
        return Detection(read, log10_p, soft[:-TAG_BITS] / (size or 1.0), 1.0)

    def _check_size(self, message: bytes) -> None:
        if not isinstance(message, bytes):
            raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
        if 8 * len(message) != self.bits:
            raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {self.bits} bits.")


def make_marker(
    original: Mesh,
    key: bytes,
    *,
    bits: int | None = None,
    record: Record | None = None,
    scheme: str | Scheme = "host",
    detector: Detector = decorrelate,
) -> Marker:
    """Prepare an original for marking, or for reading many suspects.

    Args:
        original: the unmarked mesh. Vertices at exactly the same position move together; a vertex that no face uses
            stays.
        key: 32 bytes, from `new_key`.
        bits: payload, a multiple of 8; by default the record's, else 64.
        record: of an earlier mark; fixes scheme and payload, and binds to original and key.
        scheme: a name (`"host"`, `"eigen"`), which a record overrides; or an object of `jaxmark.schemes`.
        detector: see `jaxmark.detectors`.

    Returns:
        The marker.

    Raises:
        JaxmarkError: if the mesh, key or payload is unusable, or the record is for another original, key or payload.
    """
    key = Key(key)
    ready = prepare(original)
    if record is not None:
        if record.original != ready.geometry.hex():
            raise JaxmarkError("The original is not the mesh that the record was made for (its geometry differs).")
        if record.key != commitment(key):
            raise JaxmarkError("The key is not the one that the record commits to.")
        if bits not in (None, record.bits):
            raise JaxmarkError(f"The payload is {record.bits} bits by the record, not {bits}.")
        bits = record.bits
        if isinstance(scheme, str):
            scheme = get_scheme(record.scheme, record.parameters)
        elif (scheme.name, parameters_of(scheme)) != (record.scheme, record.parameters):
            raise JaxmarkError(
                f"The record is of the scheme {record.scheme!r} with {dict(record.parameters)}, not {scheme}."
            )
    scheme = get_scheme(scheme)
    payload = DEFAULT_BITS if bits is None else bits
    carrier = scheme.carrier(ready, key, code_length(payload))
    return Marker(ready, key, payload, scheme, carrier, detector)


def embed(
    mesh: Mesh, message: bytes, key: bytes, *, budget: float = 8e-4, scheme: str | Scheme = "host"
) -> tuple[Mesh, EmbedInfo]:
    """Hide a message in the vertex positions of a mesh.

    The mark is read back before the mesh is returned: a mesh that does not carry it is refused, not marked in vain.

    Args:
        mesh: the original.
        message: any bytes, at least one.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement of the welded vertices that faces use, unweighted, relative to the diagonal of their
            axis-aligned bounding box: 0.0008 is 0.08 % of it. It is met exactly.
        scheme: see `make_marker`.

    Returns:
        The marked mesh (float64 vertices, same faces) and what was done to it.

    Raises:
        JaxmarkError: if the mesh, key, budget or payload is unusable, or the mesh cannot carry so many bits.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    return make_marker(mesh, key, bits=8 * len(message), scheme=scheme).embed(message, budget)


def detect(
    suspect: Mesh,
    *,
    original: Mesh,
    key: bytes,
    bits: int | None = None,
    message: bytes | None = None,
    record: Record | None = None,
    scheme: str | Scheme = "host",
    detector: Detector = decorrelate,
) -> Detection:
    """Read a mark from a suspect, and say what the reading proves.

    Without `message`, the message read counts only if its keyed 32-bit tag fits: log10_p is then log10 2⁻³² = -9.6,
    else 0. With `message`, log10_p is Hoeffding's bound for that message (see `evidence.log10_p_claimed`), which can
    prove a mark whose message no longer reads; a claim is refuted (0) where another message reads. Both hold for any
    suspect independent of the key, provided that key, original and claimed message were fixed before the suspect was
    seen. A mesh marked under the same key is not independent of it: once its message no longer reads, a claim that has
    many bits in common with it may pass.

    Args:
        suspect: a mesh with the original's connectivity.
        original: the unmarked mesh.
        key: 32 bytes.
        bits: payload, a multiple of 8; by default the record's, else the claimed message's, else 64.
        message: the message that is claimed to be there.
        record: see `make_marker`.
        scheme: as embedded, where there is no record.
        detector: see `jaxmark.detectors`.

    Returns:
        What was found; a suspect identical to the original gives log10_p = 0.

    Raises:
        JaxmarkError: as `make_marker`; also if the suspect has another connectivity, or the claimed message another
            size than the payload.
    """
    if bits is None and record is None and isinstance(message, bytes):
        bits = 8 * len(message)
    marker = make_marker(original, key, bits=bits, record=record, scheme=scheme, detector=detector)
    return marker.detect(suspect, message)
