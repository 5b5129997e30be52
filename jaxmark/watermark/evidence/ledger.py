"""The ledger: every choice that a reading may make after it saw the suspect, and what each alternative costs.

A bound of `jaxmark.watermark.evidence.bounds` holds for one proof that was fixed before the suspect was seen. Whoever
reads may choose among several: how to align, which message, which of many originals. Each alternative has a share of
the significance budget. The shares of a choice add up to at most 1, so that the best of all alternatives, with its
probability divided by its share, is a bound again (the weighted Bonferroni correction). A share s costs -log10 s.

Choices are a tree: what remains to be chosen after an alternative is its `then`. A reading is charged along one path
from a root; a choice that was not open to it is left out, and costs nothing. Nothing else in the package spends a
share.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

MIN_LOG10_P = -77.0  # a 256-bit key supports no claim below 2^-256
UNFLOORED = -math.inf


class Charge(NamedTuple):
    """What one choice cost a reading."""

    choice: str  # the name of the choice
    taken: str  # the alternative that was taken
    log10: float  # what it adds to log10 p, at least 0
    in_bound: bool  # whether it is part of a union bound, so that the floor of the key holds after it


class Alternative(NamedTuple):
    """One alternative of a choice."""

    name: str
    share: float | None  # of the significance budget; None for an equal share of a number that the reading counts
    then: "Choice | None" = None  # what remains to be chosen


class Choice(NamedTuple):
    """A choice that is made after the suspect was seen."""

    name: str
    alternatives: tuple[Alternative, ...]
    counted: str = ""  # what is counted, if shares are equal
    in_bound: bool = False  # see `Charge`

    def charge(self, taken: str, count: float = 1.0, *, bits: float = 0.0) -> Charge:
        """Return what an alternative costs.

        Args:
            taken: name of the alternative.
            count: number of alternatives that share alike, if they are counted.
            bits: base-2 logarithm of a further factor of that number.
        """
        share = next(one.share for one in self.alternatives if one.name == taken)
        cost = math.log10(count) + bits * math.log10(2) if share is None else -math.log10(share)
        return Charge(self.name, taken, cost, self.in_bound)


def figure(log10_p: float, charges: Sequence[Charge], floor: float = MIN_LOG10_P) -> float:
    """Return log10 of the bound after all charges, at most 0.

    Args:
        log10_p: of one proof, without a floor.
        charges: of the reading that found it.
        floor: of the key, before charges that are no part of the bound. `UNFLOORED` goes on below it: such figures
            order attacks and schemes, but no claim rests on them.
    """
    inside = sum(charge.log10 for charge in charges if charge.in_bound)
    outside = sum(charge.log10 for charge in charges if not charge.in_bound)
    return min(0.0, max(floor, log10_p + inside) + outside)


def uncommitted(log10_p: float) -> float:
    """Return log10 of the bound if nothing was fixed beforehand, but all that was tried was charged."""
    return figure(log10_p, [FORGERIES], UNFLOORED)


def _each(name: str, counted: str, then: Choice | None = None, *, in_bound: bool = False) -> Choice:
    """A choice among alternatives that are counted, and share alike."""
    return Choice(name, (Alternative("each", None, then),), counted, in_bound)


def _alignment(then: Choice) -> Choice:
    return Choice(
        "alignment",
        (
            Alternative("auto", 0.97, then),
            Alternative("same", 0.01, then),
            Alternative("similarity", 0.01, then),
            Alternative("affine", 0.01, then),
        ),
    )


# From the leaves to the roots. The tag's rank is no Bonferroni correction: the r-th message to be tried is the first
# that fits with a probability of at most r times that of one.
RANK = _each("tag rank", "messages whose tags were tried, the one that fits included", in_bound=True)
DECODER = Choice(
    "decoder", (Alternative("correlations", 0.03, RANK), Alternative("joint decoding", 0.97, RANK)), in_bound=True
)
PAYLOAD = _each("payload", "messages that the payload can hold, if none was fixed beforehand", in_bound=True)
PROOF = Choice(
    "proof",
    (Alternative("score", None, PAYLOAD), Alternative("tag", None, DECODER)),
    "ways of weighting the suspect, and the tag of a message that was read",
)
MESSAGE = Choice("message", (Alternative("claimed or recorded", 0.97, PROOF), Alternative("another", 0.03, PROOF)))
READING = Choice(
    "reading", (Alternative("all points", 0.95, MESSAGE), Alternative("coarse or non-rigid", 0.05, MESSAGE))
)
ALIGNMENT = _alignment(READING)
REFLECTION = Choice(
    "reflection of a surface",
    (Alternative("the one that fits better", 0.97, ALIGNMENT), Alternative("the other", 0.03, ALIGNMENT)),
)
PASS_BAND = Choice(
    "pass band, without a record",
    (
        Alternative("tapered", 0.9, REFLECTION),
        Alternative("low", 0.05, REFLECTION),
        Alternative("lowest", 0.05, REFLECTION),
    ),
)

# Scenes: the sum over meshes, in the poses that the readings of single meshes chose, or one mesh.
SUM_ALIGNMENT = _alignment(MESSAGE)
MESHES = _each("mesh", "meshes of the original that were compared", REFLECTION)
SCENE = Choice("scene", (Alternative("sum over meshes", 0.5, SUM_ALIGNMENT), Alternative("one mesh", 0.5, MESHES)))

# Blind reading. Tags are tried reading by reading, so that their rank counts those of all readings.
LOOKS = _each("look", "widths, views, quantisation steps and poses of the suspect", PAYLOAD, in_bound=True)
BLIND_PROOF = Choice(
    "proof", (Alternative("score", None, LOOKS), Alternative("tag", None, RANK)), "the score, and the tag"
)
BLIND_MESSAGE = Choice(
    "message", (Alternative("claimed or recorded", 0.97, BLIND_PROOF), Alternative("another", 0.03, BLIND_PROOF))
)
BLIND_SCHEME = _each("scheme, without a record", "blind schemes", BLIND_MESSAGE)
PARTS = _each("part of a file", "meshes of the suspect times records", BLIND_SCHEME)

# Several marks in one mesh: their probabilities are independent, so that Fisher's product of them counts, which has a
# factor and no share; where nothing is committed, the least of them counts.
MARKS = Choice(
    "marks in one mesh",
    (Alternative("product", None), Alternative("one mark", None, REFLECTION)),
    "the factor of Fisher's product of independent probabilities; the marks, if one of them counts",
)

# Copies for recipients.
RECIPIENTS = _each("recipient", "recipients who were tried")
COPY_ALIGNMENT = _alignment(RECIPIENTS)

# Catalogues: all that could have been named in place of what is.
ORIGINALS = Choice(
    "catalogue",
    (Alternative("original", None, PASS_BAND), Alternative("copy", None, COPY_ALIGNMENT)),
    "pieces of the suspect times keys times originals without a record, records and lists of recipients",
)

# What was fixed beforehand, and by what.
COMMITMENT = _each("timestamped commitment", "records under it", PASS_BAND)
UNCOMMITTED = _each("forgery", "2^64 keys, originals and records, as many as can be paid for", PASS_BAND)

FORGERIES = UNCOMMITTED.charge("each", bits=64)

#: The paths of readings, by what is read.
ROOTS: dict[str, Choice] = {
    "One mesh, with the original": PASS_BAND,
    "A scene of several meshes": SCENE,
    "Blind, without the original": PARTS,
    "Several marks in one mesh": MARKS,
    "Copies for recipients": COPY_ALIGNMENT,
    "A catalogue of originals": ORIGINALS,
    "A record of a timestamped commitment": COMMITMENT,
    "Nothing committed": UNCOMMITTED,
}


def choices(root: Choice) -> Iterator[Choice]:
    """Iterate over a choice and all that may remain to be chosen after it, each once."""
    found: list[Choice] = [root]
    for choice in found:
        found += [one.then for one in choice.alternatives if one.then is not None and one.then not in found]
    return iter(found)


def is_charged_along_a_path(charges: Sequence[Charge]) -> bool:
    """Whether charges follow one path from a root, in this order, with choices left out that were not open."""

    def follows(choice: Choice | None, left: Sequence[Charge]) -> bool:
        if not left or choice is None:
            return not left
        head, *rest = left
        taken = [one for one in choice.alternatives if (choice.name, one.name) == (head.choice, head.taken)]
        return any(follows(one.then, rest) for one in taken) or any(
            follows(one.then, left) for one in choice.alternatives
        )

    return any(follows(root, list(charges)) for root in ROOTS.values())


def table() -> str:
    """Return the ledger as a Markdown table: for each path its choices and the shares of their alternatives."""
    lines = ["| path | choice | alternatives, and their shares |", "|---|---|---|"]
    known: list[Choice] = []
    for path, root in ROOTS.items():
        for choice in choices(root):
            if choice in known:
                continue
            known.append(choice)
            shares = "; ".join(
                one.name if one.share is None else f"{one.name} {100 * one.share:g} %" for one in choice.alternatives
            )
            if choice.counted:
                shares = f"{shares}: equal shares, counted: {choice.counted}".removeprefix("each: ")
            lines.append(f"| {path} | {choice.name} | {shares} |")
    return "\n".join(lines) + "\n"
