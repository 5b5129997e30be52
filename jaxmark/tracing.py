"""Tracing copies: each recipient's copy carries a fingerprint, and a suspect names those whose copies went into it.

The carrier is that of messages under a subkey of its own; its code bits are the slots of a collusion-resistant code
(`jaxmark.tardos`). What accuses is the randomness of the recipients' codewords, never the chips': another recipient's
copy under the same key is no stranger to the chips.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from jaxmark.budget import Limits, make_budget
from jaxmark.errors import JaxmarkError
from jaxmark.keys import KEY_BYTES, Key, commitment, derive
from jaxmark.marking import EmbedInfo, Marker
from jaxmark.mesh import Mesh
from jaxmark.original import prepare
from jaxmark.record import Record
from jaxmark.schemes import KeyedScheme, get_scheme
from jaxmark.tardos import Accusation, biases, codewords, rank

# The pass band is that of a message of so many bits: wide enough for 2,048 slots on a mesh of 10,000 vertices.
_BITS = 232
_MOST_SLOTS = 2048
_LEAST_SLOTS = 8  # fewer prove nothing
_ALPHA = -6.0


@dataclass(frozen=True, eq=False)
class Tracer:
    """Hands out copies of one original, and accuses. Make one with `make_tracer`."""

    marker: Marker  # with the subkey
    commitment: str  # to the owner's key

    def fingerprint(
        self, recipient: str, budget: float | None = None, *, limits: Limits | None = None
    ) -> tuple[Mesh, EmbedInfo]:
        """The copy of one recipient; see `fingerprint`."""
        key, geometry = self.marker.key, self.marker.original.geometry
        if self.marker.code >= _LEAST_SLOTS:
            word = codewords([recipient], key, geometry, biases(key, geometry, self.marker.code))[0]
            marked, info = self.marker.write(word.astype(float), make_budget(budget, limits))
            if self.finds(marked, recipient):
                record = replace(info.record, content="fingerprint", key=self.commitment)
                return marked, info._replace(record=record)
        raise JaxmarkError(
            f"This mesh ({int(self.marker.original.used.sum())} points) cannot carry a fingerprint: its own"
            " recipient would not be found, even unattacked. Use a finer or less regular mesh."
        )

    def finds(self, suspect: Mesh, recipient: str) -> bool:
        """Whether one recipient alone would be accused by a suspect, at 1e-6."""
        return self.identify(suspect, [recipient])[0].log10_p <= _ALPHA

    def identify(self, suspect: Mesh, recipients: Iterable[str], top: int = 10) -> list[Accusation]:
        """Rank recipients by a suspect; see `identify`."""
        soft = self.marker.soft_values(self.marker.observe(suspect))
        return rank(soft, recipients, self.marker.key, self.marker.original.geometry, top=top)


def make_tracer(original: Mesh, key: bytes, *, record: Record | None = None) -> Tracer:
    """Prepare an original for handing out copies, or for tracing suspects.

    Args:
        original: the unmarked mesh.
        key: 32 bytes, from `new_key`.
        record: of an earlier copy; binds to original and key.

    Raises:
        JaxmarkError: if the mesh or key is unusable, or the record is no fingerprint's, or for another original or key.
    """
    key, ready = Key(key), prepare(original)
    scheme = KeyedScheme()
    if record is not None:
        record.check("fingerprint", ready.geometry, key)
        scheme = get_scheme(record.scheme, record.parameters)
    if not isinstance(scheme, KeyedScheme):
        raise JaxmarkError(f"Fingerprints are carried by the scheme 'keyed', not {scheme.name!r}.")
    # Half of the dimensions, so that slots are told apart.
    slots = min(_MOST_SLOTS, 1 << (max(2, scheme.dimensions(ready, _BITS)) // 2).bit_length() - 1)
    own = Key(derive(key, ready.geometry, "fingerprint", KEY_BYTES))
    carrier = scheme.carrier(ready, own, _BITS, slots)
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
        recipient: any identifier, not empty; the same one gives the same copy.
        key: 32 bytes, from `new_key`.
        budget: see `embed`.
        limits: see `embed`.

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
    """Say whose copies a suspect was made of, and how surely.

    Args:
        suspect: any mesh.
        recipients: all who were given a copy.
        original: the unmarked mesh.
        key: 32 bytes.
        record: see `make_tracer`.
        top: how many to return.

    Returns:
        The highest scores first. log10_p bounds the probability that any recipient tried who had no part in the
        suspect scores so high, whatever the others did; it rests on the codewords alone (see `jaxmark.tardos`).

    Raises:
        JaxmarkError: as `make_tracer`; also if the suspect cannot be aligned, or an identifier is empty.
    """
    return make_tracer(original, key, record=record).identify(suspect, recipients, top)
