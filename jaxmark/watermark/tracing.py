"""Tracing copies: each recipient's copy carries a fingerprint, which tells whose copies a suspect was made of.

The carrier is the same as for messages, under a subkey of its own; its code bits are the slots of a collusion-resistant
code (`jaxmark.watermark.tardos`). Accusations rest on the randomness of the recipients' codewords, never on that of the
chips: another recipient's copy under the same key is not independent of the chips.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from jaxmark.alignment.original import make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.budget import Limits, make_budget
from jaxmark.watermark.coding.keys import KEY_BYTES, Key, commitment, derive
from jaxmark.watermark.marking import EmbedInfo, Marker
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes import DEFAULT_SCHEME, get_scheme
from jaxmark.watermark.tardos import Accusation, biases, codewords, rank

# Fingerprints use the pass band for a message of this size: wide enough for 2,048 slots on a mesh of 10,000 vertices.
_PASSBAND_MESSAGE_BITS = 232
_MAX_SLOTS = 2048
_MIN_SLOTS = 8  # fewer prove nothing
_MAX_LOG10_P = -6.0  # of an accusation


@dataclass(frozen=True, eq=False)
class Tracer:
    """Makes copies of one original for recipients, and accuses recipients by a suspect.

    Make one with `make_tracer`.
    """

    marker: Marker  # writes and reads fingerprints, with the subkey
    commitment: str  # commitment to the owner's key, hexadecimal

    def fingerprint(
        self, recipient: str, budget: float | None = None, *, limits: Limits | None = None
    ) -> tuple[Mesh, EmbedInfo]:
        """Make the copy for one recipient; see `fingerprint`."""
        key, geometry = self.marker.key, self.marker.original.geometry
        if self.marker.code_bits >= _MIN_SLOTS:
            word = codewords([recipient], key, geometry, biases(key, geometry, self.marker.code_bits))[0]
            marked, info = self.marker.write(word.astype(float), make_budget(budget, limits))
            if self.finds(marked, recipient):
                record = replace(info.record, content="fingerprint", key=self.commitment)
                return marked, info._replace(record=record)
        raise JaxmarkError(
            f"This mesh ({int(self.marker.original.used.sum())} points) cannot carry a fingerprint: its own"
            " recipient would not be found, even unattacked. Use a finer or less regular mesh."
        )

    def finds(self, suspect: Mesh, recipient: str) -> bool:
        """Whether a suspect would accuse a recipient who is the only one tried, at a probability of 1e-6."""
        return self.identify(suspect, [recipient])[0].log10_p <= _MAX_LOG10_P

    def identify(self, suspect: Mesh, recipients: Iterable[str], top: int = 10) -> list[Accusation]:
        """Rank recipients by their scores in a suspect; see `identify`."""
        soft = self.marker.soft_values(self.marker.receive(suspect))
        return rank(soft, recipients, self.marker.key, self.marker.original.geometry, top=top)


def make_tracer(original: Mesh, key: bytes, *, record: Record | None = None) -> Tracer:
    """Prepare an original for making copies, or for tracing suspects.

    Args:
        original: the unmarked mesh.
        key: 32 bytes, from `new_key`.
        record: the record of an earlier copy, which fixes the scheme; original and key must be those that it was made
            with.

    Raises:
        JaxmarkError: if the mesh or key is unusable, or the record is not of a fingerprint or for another original or
            key.
    """
    key, ready = Key(key), make_original(original)
    scheme = get_scheme(DEFAULT_SCHEME)
    if record is not None:
        record.check("fingerprint", ready.geometry, key)
        scheme = get_scheme(record.scheme, record.parameters)
    dimensions = scheme.dimensions(ready, _PASSBAND_MESSAGE_BITS)
    if not dimensions:
        raise JaxmarkError(f"Fingerprints are carried by the scheme 'keyed', not {scheme.name!r}.")
    # There are at most half as many slots as dimensions, so that slots can be told apart.
    slots = min(_MAX_SLOTS, 1 << (max(2, dimensions) // 2).bit_length() - 1)
    own = Key(derive(key, ready.geometry, "fingerprint", KEY_BYTES))
    carrier = scheme.carrier(ready, own, _PASSBAND_MESSAGE_BITS, slots)
    return Tracer(Marker(ready, own, slots, scheme, carrier, slots, scheme.detector), commitment(key))


def fingerprint(
    mesh: Mesh,
    recipient: str,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
) -> tuple[Mesh, EmbedInfo]:
    """Make the copy of a mesh for one recipient.

    Args:
        mesh: the original.
        recipient: any identifier that is not empty; the same identifier gives the same copy.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement, see `embed`.
        limits: limits on metrics of distortion, see `embed`.

    Returns:
        The copy (float64 vertices, same faces) and what was done to it.

    Raises:
        JaxmarkError: if the mesh, key, budget or identifier is unusable, or the mesh is too small.
    """
    return make_tracer(mesh, key).fingerprint(recipient, budget, limits=limits)


def identify(
    suspect: Mesh,
    recipients: Iterable[str],
    *,
    original: Mesh,
    key: bytes,
    record: Record | None = None,
    top: int = 10,
) -> list[Accusation]:
    """Find whose copies a suspect was made of, and how surely.

    Args:
        suspect: any mesh.
        recipients: the identifiers of all who were given a copy.
        original: the unmarked mesh.
        key: 32 bytes.
        record: the record of an earlier copy, see `make_tracer`.
        top: number of recipients to return.

    Returns:
        The recipients with the highest scores, the highest first. log10_p bounds the probability that any of the
        recipients tried who had no part in the suspect scores so high, whatever the others did; it rests on the
        codewords alone (see `jaxmark.watermark.tardos`).

    Raises:
        JaxmarkError: see `make_tracer`; also if the suspect cannot be aligned, or an identifier is empty.
    """
    return make_tracer(original, key, record=record).identify(suspect, recipients, top)
