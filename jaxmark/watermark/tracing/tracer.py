"""Tracing of copies: the copy of each recipient carries a fingerprint, which identifies the copies in a suspect.

The carrier is the same as for messages, with keyed choices of its own. Its code bits are the slots of a
collusion-resistant code (`jaxmark.watermark.tracing.tardos`). The bounds on accusations use only the randomness of the
recipients' codewords, not that of the chips, because the copies of other recipients depend on the same chips.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral

from jaxmark.alignment import attempts
from jaxmark.alignment.result import Align, Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.files.typed import normalise, normalise_names
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.mark import EmbedInfo, Mark, bind_mark, recall
from jaxmark.watermark.perception.budget import BudgetLike
from jaxmark.watermark.record import Record, check_record
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.registry import get_nonblind, make_scheme
from jaxmark.watermark.tracing.tardos import Accusation, biases, codewords, rank

# Fingerprints use the pass band for a message of this size, which has 2,048 slots on a mesh of 10,000 vertices.
_PASSBAND_MESSAGE_BITS = 232
_MAX_SLOTS = 2048
_MIN_SLOTS = 8  # with fewer slots nothing can be proven
_MAX_LOG10_P = -6.0  # largest log10 p of an accusation


@dataclass(frozen=True, eq=False)
class Tracer:
    """A tracer, which makes copies of one original for recipients, and identifies recipients from suspects.

    Make one with `make_tracer`.
    """

    mark: Mark  # the mark that writes and reads fingerprints

    def fingerprint(self, recipient: str, budget: BudgetLike = None) -> tuple[Mesh, EmbedInfo]:
        """Make the copy for one recipient; see `fingerprint`."""
        choices, original, recipient = self.mark.choices, self.mark.original, normalise(recipient)
        if self.mark.code_bits >= _MIN_SLOTS:
            word = codewords([recipient], choices, biases(choices, self.mark.code_bits))[0]
            marked, info = self.mark.write(word.astype(float), budget, content=recipient.encode())
            if self.finds(marked, recipient):
                return marked, info
        raise JaxmarkError(
            f"This mesh ({int(original.used.sum())} points) cannot carry a fingerprint: its own recipient would not be"
            " identified, even unattacked. Use a finer or less regular mesh."
        )

    def finds(self, suspect: Mesh, recipient: str) -> bool:
        """Whether a suspect accuses a recipient with a probability of at most 1e-6, if no other recipient is tested."""
        return self.identify(suspect, [recipient])[0].log10_p <= _MAX_LOG10_P

    def register(self, suspect: Mesh, align: Align = "auto") -> Alignment:
        """Align a suspect with the original; see `jaxmark.alignment.attempts.align`."""
        return attempts.align(self.mark.original, suspect, align)

    def identify(
        self, suspect: Mesh, recipients: Iterable[str], top: int = 10, align: Align = "auto"
    ) -> list[Accusation]:
        """Rank recipients by their scores in a suspect; see `identify`."""
        names = _names(recipients, top)  # before the suspect is aligned, which takes long
        return self.rank(self.register(suspect, align), names, top)

    def read(self, aligned: Alignment, recipients: Iterable[str], top: int = 10) -> list[Accusation]:
        """Rank recipients by their scores in an aligned suspect; see `identify`."""
        return self.rank(aligned, _names(recipients, top), top)

    def rank(self, aligned: Alignment, recipients: Iterable[str], top: int = 10) -> list[Accusation]:
        """Rank recipients as `read` does, by identifiers that a catalogue holds and that are not normalised again."""
        soft = self.mark.soft_decisions(self.mark.receive(aligned))
        charges = *self.mark.order_charges, ledger.COPY_ALIGNMENT.charge(aligned.align)
        ranking = rank(soft, recipients, self.mark.choices, top=top)
        return [accusation.charged(*charges)._replace(caveats=self.mark.caveats) for accusation in ranking]


def make_tracer(original: Mesh, key: bytes, *, record: Record | None = None) -> Tracer:
    """Prepare an original for making copies, or for tracing suspects.

    Args:
        original: the unmarked mesh; see `make_marker`.
        key: 32 bytes, from `new_key`.
        record: the record of an earlier copy, which determines the scheme; original and key must be those that it was
            made with.

    Raises:
        JaxmarkError: if the mesh or key is unusable, or the record is not of a fingerprint, was edited, or is for
            another original or key.
    """
    key, scheme = Key(key), KeyedScheme()
    check_record(record)
    if record is not None:
        record.check("fingerprint", key)
        scheme = get_nonblind(make_scheme(record.scheme, record.parameters))
    ready, caveats = recall(original, key, record)
    dimensions = scheme.dimensions(ready, _PASSBAND_MESSAGE_BITS)
    if not dimensions:
        raise JaxmarkError(f"Fingerprints need the scheme 'keyed', not {scheme.name!r}.")
    # There are at most half as many slots as dimensions, so that slots can be distinguished.
    slots = min(_MAX_SLOTS, 1 << (max(2, dimensions) // 2).bit_length() - 1)
    choices = bind_mark(key, ready, scheme, slots, "fingerprint", record)
    carrier = scheme.carrier(ready, choices, _PASSBAND_MESSAGE_BITS, slots)
    mark = Mark(ready, choices, slots, scheme, carrier, slots, carrier.detector, "fingerprint", record, caveats)
    return Tracer(mark)


def fingerprint(mesh: Mesh, recipient: str, key: bytes, *, budget: BudgetLike = None) -> tuple[Mesh, EmbedInfo]:
    """Make the copy of a mesh for one recipient.

    Args:
        mesh: the original.
        recipient: any identifier that is not empty; the same identifier gives the same copy. Accents are composed
            (Unicode's form NFC), and white space at both ends and invisible characters are left out.
        key: 32 bytes, from `new_key`.
        budget: how strong the mark may be, see `embed`.

    Returns:
        The copy (float64 vertices, same faces), and the strength and the record of its mark.

    Raises:
        JaxmarkError: if the mesh, key, budget or identifier is unusable, or the mesh is too small.
    """
    return make_tracer(mesh, key).fingerprint(recipient, budget)


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
    """Identify the recipients whose copies a suspect was made of, with bounds on the probability of a false accusation.

    Args:
        suspect: any mesh.
        recipients: the identifiers of all recipients of a copy, a list that was fixed before the suspect existed;
            normalised as by `fingerprint`.
        original: the unmarked mesh.
        key: 32 bytes.
        record: the record of an earlier copy, see `make_tracer`.
        top: number of recipients to return.
        align: how the suspect is aligned, see `detect`.

    Returns:
        The recipients with the highest scores, the highest first. `log10_p` bounds the probability that any tested
        recipient who had no part in the suspect reaches this score, whatever the others did. The bound rests on the
        codewords alone (see `jaxmark.watermark.tracing.tardos`).

    Raises:
        JaxmarkError: see `make_tracer`; also if the suspect cannot be aligned, there is no recipient, an identifier is
            empty, or two identifiers differ only in what cannot be seen.
    """
    names = _names(recipients, top)  # before the original is prepared
    tracer = make_tracer(original, key, record=record)
    return tracer.rank(tracer.register(suspect, align), names, top)


def _names(recipients: Iterable[str], top: int) -> list[str]:
    """Normalise the identifiers of recipients; refused if there are none, or no recipient is asked for."""
    if not isinstance(top, Integral) or top < 1:
        raise JaxmarkError(f"top is a whole number of at least 1, got {top!r}.")
    names = normalise_names(recipients)
    if not names:
        raise JaxmarkError("No recipient is given; give the identifiers of all recipients of a copy.")
    return names
