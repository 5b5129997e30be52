"""Tracing copies: each recipient's copy carries a fingerprint, which tells whose copies a suspect was made of.

The carrier is the same as for messages, with keyed choices of its own; its code bits are the slots of a code that
resists collusion (`jaxmark.watermark.tracing.tardos`). Accusations rest on the randomness of the recipients' codewords,
never on that of the chips: another recipient's copy under the same key is not independent of the chips.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from jaxmark.alignment import alignment
from jaxmark.alignment.alignment import Align, Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import KEY_BYTES, SCHEME_VERSION, Key
from jaxmark.watermark.evidence import bounds as evidence
from jaxmark.watermark.marking import ALIGN_SHARES, EmbedInfo, Marker, bind_mark, recall, versions_of
from jaxmark.watermark.perception.budget import Limits, Visibility, make_budget, visibility_of
from jaxmark.watermark.record import Record
from jaxmark.watermark.schemes.scheme import DEFAULT_SCHEME, get_scheme
from jaxmark.watermark.tracing.tardos import Accusation, biases, codewords, rank

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

    marker: Marker  # writes and reads fingerprints

    def fingerprint(
        self,
        recipient: str,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
    ) -> tuple[Mesh, EmbedInfo]:
        """Make the copy for one recipient; see `fingerprint`."""
        choices = self.marker.choices
        if self.marker.code_bits >= _MIN_SLOTS:
            word = codewords([recipient], choices, biases(choices, self.marker.code_bits))[0]
            bounds = make_budget(budget, limits, visibility, named=visibility_of(self.marker.original.mesh))
            marked, info = self.marker.write(word.astype(float), bounds, told=recipient.encode())
            if self.finds(marked, recipient):
                return marked, info
        raise JaxmarkError(
            f"This mesh ({int(self.marker.original.used.sum())} points) cannot carry a fingerprint: its own"
            " recipient would not be found, even unattacked. Use a finer or less regular mesh."
        )

    def finds(self, suspect: Mesh, recipient: str) -> bool:
        """Whether a suspect would accuse a recipient who is the only one tried, at a probability of 1e-6."""
        return self.identify(suspect, [recipient])[0].log10_p <= _MAX_LOG10_P

    def identify(
        self, suspect: Mesh | Alignment, recipients: Iterable[str], top: int = 10, align: Align = "auto"
    ) -> list[Accusation]:
        """Rank recipients by their scores in a suspect, or in its alignment; see `identify`."""
        aligned = suspect
        if not isinstance(aligned, Alignment):
            aligned = alignment.align(self.marker.original, aligned, align)
        soft = self.marker.soft_values(self.marker.receive(aligned))
        ranked = rank(soft, recipients, self.marker.choices, top=top)
        return [one._replace(doubts=self.marker.doubts) for one in pay(ranked, ALIGN_SHARES[aligned.how])]


def pay(ranking: Iterable[Accusation], share: float) -> list[Accusation]:
    """Accusations that have only a share of the probability, see `evidence.share_of`."""
    return [one._replace(log10_p=evidence.share_of(one.log10_p, share)) for one in ranking]


def make_tracer(original: Mesh, key: bytes, *, record: Record | None = None, version: int | None = None) -> Tracer:
    """Prepare an original for making copies, or for tracing suspects.

    Args:
        original: the unmarked mesh; see `make_marker`.
        key: 32 bytes, from `new_key`.
        record: the record of an earlier copy, which fixes the scheme; original and key must be those that it was made
            with.
        version: version of the keyed choices: the record's, else 2.

    Raises:
        JaxmarkError: if the mesh or key is unusable, or the record is not of a fingerprint, was edited, or is for
            another original or key.
    """
    key, scheme = Key(key), get_scheme(DEFAULT_SCHEME)
    if record is not None:
        record.check("fingerprint", key)
        scheme = get_scheme(record.scheme, record.parameters)
    used = record.version if record is not None else SCHEME_VERSION if version is None else version
    ready, doubts = recall(original, key, record, used)
    dimensions = scheme.dimensions(ready, _PASSBAND_MESSAGE_BITS)
    if not dimensions:
        raise JaxmarkError(f"Fingerprints are carried by the scheme 'keyed', not {scheme.name!r}.")
    # There are at most half as many slots as dimensions, so that slots can be told apart.
    slots = min(_MAX_SLOTS, 1 << (max(2, dimensions) // 2).bit_length() - 1)
    choices = bind_mark(key, ready, scheme, slots, "fingerprint", used, record=record)
    if used == 1:  # fingerprints had a key of their own, which is all that told them from messages
        choices = replace(choices, key=Key(choices.derive("fingerprint", KEY_BYTES)))
    carrier = scheme.carrier(ready, choices, _PASSBAND_MESSAGE_BITS, slots)
    return Tracer(Marker(ready, choices, slots, scheme, carrier, slots, scheme.detector, "fingerprint", record, doubts))


def fingerprint(
    mesh: Mesh,
    recipient: str,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
    visibility: Visibility | None = None,
) -> tuple[Mesh, EmbedInfo]:
    """Make the copy of a mesh for one recipient.

    Args:
        mesh: the original.
        recipient: any identifier that is not empty; the same identifier gives the same copy.
        key: 32 bytes, from `new_key`.
        budget: RMS displacement, see `embed`.
        limits: limits on metrics of distortion, see `embed`.
        visibility: how well people may see the mark, see `embed`.

    Returns:
        The copy (float64 vertices, same faces) and what was done to it.

    Raises:
        JaxmarkError: if the mesh, key, budget or identifier is unusable, or the mesh is too small.
    """
    return make_tracer(mesh, key).fingerprint(recipient, budget, limits=limits, visibility=visibility)


def identify(
    suspect: Mesh,
    recipients: Iterable[str],
    *,
    original: Mesh,
    key: bytes,
    record: Record | None = None,
    top: int = 10,
    align: Align = "auto",
) -> list[Accusation]:
    """Find whose copies a suspect was made of, and how surely.

    Args:
        suspect: any mesh.
        recipients: the identifiers of all who were given a copy.
        original: the unmarked mesh.
        key: 32 bytes.
        record: the record of an earlier copy, see `make_tracer`.
        top: number of recipients to return.
        align: how the suspect is aligned, see `detect`.

    Returns:
        The recipients with the highest scores, the highest first. log10_p bounds the probability that any of the
        recipients tried who had no part in the suspect scores so high, whatever the others did; it rests on the
        codewords alone (see `jaxmark.watermark.tracing.tardos`).

    Raises:
        JaxmarkError: see `make_tracer`; also if the suspect cannot be aligned, or an identifier is empty.
    """
    versions, tried = versions_of(record), list(recipients)
    rankings = []
    for version in versions:
        tracer = make_tracer(original, key, record=record, version=version)
        rankings.append(pay(tracer.identify(suspect, tried, top, align), 1 / len(versions)))
        if rankings[-1] and rankings[-1][0].log10_p <= _MAX_LOG10_P:
            break
    return min(rankings, key=lambda ranking: ranking[0].log10_p if ranking else 0.0)
