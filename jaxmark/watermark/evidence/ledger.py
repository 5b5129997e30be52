"""The ledger: all choices that a reader may make after seeing the suspect, and the share of each alternative.

A bound of `jaxmark.watermark.evidence.bounds` holds for a single test that was fixed before the suspect was seen. A
reader may choose among several tests: how to align the suspect, which message to test, which of many originals to read
with. The ledger gives each alternative a share of the significance budget, and the shares of a choice add up to at most
1. The smallest p-value of all alternatives, divided by the share of its alternative, is then a valid bound (weighted
Bonferroni correction). An alternative with the share s adds -log10 s to log10 p.

Choices form a tree: `Alternative.then` is the choice that follows an alternative. A reading is charged along one path
that starts at a root. A choice that a reading does not have, such as that of the pass band if a record names it, is
skipped and costs nothing. No other module of the package divides the significance budget.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

MIN_LOG10_P = -77.0  # a 256-bit key supports no claim below 2^-256
UNFLOORED = -math.inf


class Charge(NamedTuple):
    """The cost of one choice of a reading."""

    choice: str  # the name of the choice
    taken: str  # the name of the alternative that was taken
    log10: float  # the term that the choice adds to log10 p, at least 0
    in_bound: bool  # whether the term belongs to a union bound: the floor of the key is then applied after it


class Alternative(NamedTuple):
    """One alternative of a choice."""

    name: str
    share: float | None  # of the significance budget; None if alternatives are counted and have equal shares
    then: "Choice | None" = None  # the choice that follows


class Choice(NamedTuple):
    """A choice that the reader makes after seeing the suspect."""

    name: str
    alternatives: tuple[Alternative, ...]
    counted: str = ""  # the shares in words, if alternatives are counted
    in_bound: bool = False  # see `Charge`

    def charge(self, taken: str, count: float = 1.0, *, bits: float = 0.0) -> Charge:
        """Return the charge for an alternative.

        Args:
            taken: name of the alternative.
            count: number of alternatives with equal shares, if they are counted.
            bits: base-2 logarithm of a further factor of that number.
        """
        share = next(one.share for one in self.alternatives if one.name == taken)
        cost = math.log10(count) + bits * math.log10(2) if share is None else -math.log10(share)
        return Charge(self.name, taken, cost, self.in_bound)


def charges_as_json(charges: Iterable[Charge]) -> list[dict[str, Any]]:
    """Return charges as values for JSON."""
    return [charge._asdict() for charge in charges]


def figure(log10_p: float, charges: Sequence[Charge], floor: float = MIN_LOG10_P) -> float:
    """Return log10 of the bound after all charges, at most 0.

    Args:
        log10_p: log10 of the bound of a single test, without a floor.
        charges: the charges of the reading.
        floor: the floor of the key. It is applied before the charges that belong to no union bound. With `UNFLOORED`,
            figures below the floor are returned; they order attacks and schemes, but support no claim.
    """
    inside = sum(charge.log10 for charge in charges if charge.in_bound)
    outside = sum(charge.log10 for charge in charges if not charge.in_bound)
    return min(0.0, max(floor, log10_p + inside) + outside)


def rounded_up(log10_p: float) -> float:
    """Round a bound up to one digit behind the point, so that what is shown is a bound as well."""
    return math.ceil(10 * log10_p - 1e-9) / 10 + 0.0


def uncommitted(log10_p: float) -> float:
    """Return log10 of the bound if nothing was fixed beforehand; `log10_p` must include all other charges."""
    return figure(log10_p, [forgeries()], UNFLOORED)


def forgeries(meshes: int = 1) -> Charge:
    """Return the charge for the keys, originals and records that a forger can try.

    A forger tries originals for each mesh of a sum on its own, keeps those with a large score, and thereby also chooses
    how many meshes are united. If N can be tried for one mesh, then at most Nᵏ/k! sets of k meshes can be united. A
    share of N⁻ᵏ for each set of at least two spends Σ 1/k! = e - 2 < 1.

    Args:
        meshes: number of meshes whose scores were added.
    """
    return UNCOMMITTED.charge("each", bits=64 * meshes)


def selection(read: int, among: int) -> tuple[Charge, ...]:
    """Return the charges for reading all meshes of an original, or only some of them, which the reader picked.

    The share of a set of k of n meshes is 2⁻ᵏ divided by the number of such sets; the shares of all sets add up to less
    than 1.

    Args:
        read: number of meshes that are read.
        among: number of meshes that could be picked.
    """
    if among == 1:
        return ()
    if read == among:
        return (SELECTION.charge("all"),)
    return SELECTION.charge("picked"), PICKED.charge("each", math.comb(among, read), bits=read)


def in_all(charges: Sequence[Charge]) -> tuple[Charge, ...]:
    """Return the charge for a choice that was made for each of several meshes, if any: the product of all shares."""
    if not charges:
        return ()
    dearest = max(charges, key=lambda charge: charge.log10)
    return (dearest._replace(log10=math.fsum(charge.log10 for charge in charges)),)


def _each(name: str, counted: str, then: Choice | None = None, *, in_bound: bool = False) -> Choice:
    """Make a choice among alternatives that are counted and have equal shares."""
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


def _order(then: Choice) -> Choice:
    """Make the choice of the order in which an original with a record is presented."""
    return Choice(
        "order of the original (record)", (Alternative("marked", 0.97, then), Alternative("another", 0.03, then))
    )


# Choices are defined from the leaves to the roots. The charge for the rank of a tag is a union bound, not a Bonferroni
# correction: the probability that one of the first r candidates has the right tag is at most r times that of one.
RANK = _each("tag rank", "1/n if the tag of the n-th candidate message is the first that matches", in_bound=True)
DECODER = Choice(
    "decoder", (Alternative("correlations", 0.03, RANK), Alternative("joint decoding", 0.97, RANK)), in_bound=True
)
PAYLOAD = _each(
    "payload", "1/n for each of the n messages of this size; 1 if the message was fixed beforehand", in_bound=True
)
PROOF = Choice(
    "proof",
    (Alternative("score", None, PAYLOAD), Alternative("tag", None, DECODER)),
    "1/n for each of n tests: the scores and, if a message was decoded without being claimed, its tag",
)
MESSAGE = Choice("message", (Alternative("claimed or recorded", 0.97, PROOF), Alternative("another", 0.03, PROOF)))
READING = Choice(
    "reading method", (Alternative("standard", 0.95, MESSAGE), Alternative("coarse or non-rigid", 0.05, MESSAGE))
)
ALIGNMENT = _alignment(READING)
# With a record, an original may be presented in another order of vertices than the marked one, which alignment uses.
# Its points are sorted then, so all other orders are alike. Without a record, keyed choices are bound to the order.
ORDER = _order(ALIGNMENT)
REFLECTION = Choice("reflection", (Alternative("better fit", 0.97, ORDER), Alternative("worse fit", 0.03, ORDER)))
PASS_BAND = Choice(
    "pass band (no record)",
    (
        Alternative("tapered", 0.9, REFLECTION),
        Alternative("low", 0.05, REFLECTION),
        Alternative("lowest", 0.05, REFLECTION),
    ),
)

# Several marks in one mesh: their p-values are independent, so they are united by Fisher's product, which has a factor
# instead of a share. The uncommitted p-value is the smallest of the marks' own, charged for their number.
MARKS = Choice(
    "marks in one mesh",
    (Alternative("product", None), Alternative("one mark", None, REFLECTION)),
    "product: no share, but a factor by Fisher's method; one mark (uncommitted): 1/n for each of the n marks",
)

# The record of several marks in one mesh is that of the first, so that the reader names the others. One of these may be
# decoded where that of the record is not; its message is, or is not, the one that the record commits to.
MARKS_MESSAGE = Choice(
    "message", (Alternative("claimed or recorded", 0.97, MARKS), Alternative("another", 0.03, MARKS))
)
BESIDE = Choice(
    "marks beside the record's",
    (
        Alternative("none", 0.97, PASS_BAND),
        Alternative("field", 0.01, MARKS_MESSAGE),
        Alternative("local", 0.01, MARKS_MESSAGE),
        Alternative("rooted", 0.002, MARKS_MESSAGE),
        Alternative("field and local", 0.005, MARKS_MESSAGE),
        Alternative("field and rooted", 0.001, MARKS_MESSAGE),
        Alternative("local and rooted", 0.001, MARKS_MESSAGE),
        Alternative("field and local and rooted", 0.001, MARKS_MESSAGE),
    ),
)

# Scenes: either the sum of scores over meshes, in the poses that the readings of single meshes chose, or one mesh.
SUM_ALIGNMENT = _alignment(MESSAGE)
MESHES = _each("mesh", "1/n for each of the n meshes of the original scene that are read", BESIDE)
SCENE = Choice("scene", (Alternative("sum over meshes", 0.5, SUM_ALIGNMENT), Alternative("one mesh", 0.5, MESHES)))
# The order of each original is a choice, also if its mesh is not found in the suspect because of it.
SCENE_ORDER = _order(SCENE)
PICKED = _each("meshes picked", "2^-k/m for each of the m sets of k meshes that could be picked", SCENE_ORDER)
SELECTION = Choice("meshes read", (Alternative("all", 0.97, SCENE_ORDER), Alternative("picked", 0.03, PICKED)))

# Blind reading. The rank of a tag counts the candidates of all readings, because tags are compared reading by reading,
# and without a record also, in proportion, those of widths and steps that the reader left out.
LOOKS = _each(
    "view",
    "1/n for each of n combinations of width, quantisation step, undone smoothing or blur, half turn, reflection, unit"
    " with orientation of the faces, or pose that a hint gives, and change of pose",
    PAYLOAD,
    in_bound=True,
)
BLIND_PROOF = Choice(
    "proof",
    (Alternative("score", None, LOOKS), Alternative("tag", None, RANK)),
    "1/n for each of n tests: the score and, if a message was decoded without being claimed, its tag",
)
BLIND_MESSAGE = Choice(
    "message", (Alternative("claimed or recorded", 0.97, BLIND_PROOF), Alternative("another", 0.03, BLIND_PROOF))
)
BLIND_SCHEME = _each("scheme (no record)", "1/n for each of the n blind schemes", BLIND_MESSAGE)
PARTS = _each("part of a file", "1/n for each of n distinct pairs of a mesh of the suspect and a record", BLIND_SCHEME)

# Copies for recipients.
RECIPIENTS = _each("recipient", "1/n for each of the n recipients who were tested")
COPY_ALIGNMENT = _alignment(RECIPIENTS)
COPY_ORDER = _order(COPY_ALIGNMENT)

# Catalogues: everything that could have been identified instead.
ORIGINALS = Choice(
    "catalogue",
    (Alternative("original", None, BESIDE), Alternative("copy", None, COPY_ORDER)),
    "1/n for each of n readings: each piece of the suspect, under each key, with each original that has no record,"
    " each record and each recipient list",
)

# The commitment under which everything else was fixed beforehand, if any.
COMMITMENT = _each("timestamped commitment", "1/n for each of the n records in the commitment", BESIDE)
UNCOMMITTED = _each(
    "forgery",
    "2^-64 for each key, original and record that a forger can afford to try; 2^-64k for a sum over k meshes",
    BESIDE,
)

#: The roots of the tree, by the kind of reading.
ROOTS: dict[str, Choice] = {
    "One mesh, non-blind": PASS_BAND,
    "A scene of several meshes": SELECTION,
    "Blind": PARTS,
    "Several marks in one mesh": MARKS,
    "One mesh with a record": BESIDE,
    "Copies for recipients": COPY_ORDER,
    "A catalogue of originals": ORIGINALS,
    "A record with a timestamped commitment": COMMITMENT,
    "Without a commitment": UNCOMMITTED,
}


def choices(root: Choice) -> Iterator[Choice]:
    """Iterate over a choice and all choices that can follow it, each once."""
    reachable: list[Choice] = [root]
    for choice in reachable:
        reachable += [one.then for one in choice.alternatives if one.then is not None and one.then not in reachable]
    return iter(reachable)


def is_charged_along_a_path(charges: Sequence[Charge]) -> bool:
    """Whether charges follow one path from a root, in this order; choices that were not open may be missing."""

    def follows(choice: Choice | None, remaining: Sequence[Charge]) -> bool:
        if not remaining or choice is None:
            return not remaining
        head, *rest = remaining
        matching = [one for one in choice.alternatives if (choice.name, one.name) == (head.choice, head.taken)]
        return any(follows(one.then, rest) for one in matching) or any(
            follows(one.then, remaining) for one in choice.alternatives
        )

    return any(follows(root, list(charges)) for root in ROOTS.values())


def table() -> str:
    """Return the ledger as a Markdown table: for each kind of reading, its choices and the shares of alternatives."""
    lines = ["| path | choice | share of the significance budget for each alternative |", "|---|---|---|"]
    listed: list[Choice] = []
    for path, root in ROOTS.items():
        for choice in choices(root):
            if choice in listed:
                continue
            listed.append(choice)
            shares = [f"{one.name} {100 * one.share:g} %" for one in choice.alternatives if one.share is not None]
            lines.append(f"| {path} | {choice.name} | {choice.counted or '; '.join(shares)} |")
    return "\n".join(lines) + "\n"
