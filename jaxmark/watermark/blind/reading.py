"""Phases without the original, and what it proves.

**The bound.** An anchor's phase is its value over the step, less its offset δ; c is the cosine of a whole turn of it.
With the key's sign (-1)^b, of another subkey, and the code bit a of the anchor's slot, the score is S = Σ a (-1)^b c.
Whatever is chosen by the suspect and the offsets (the pose, the step, which anchors count) knows nothing of the signs:
given all of it, S is a sum of independent signs times c, and P(S ≥ t) ≤ exp(-t²/(2 Σ c²)) (Hoeffding 1963). The
denominator is that of the pose at hand: a search that makes all c² large pays for it there. Readings whose scores are
compared are paid for one by one, whether they were looked at or not.

That holds for any suspect independent of the key. Every work that was marked under the key is not: there is no hash of
a geometry in the key's choices, as their reader has no original.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, compact, weld, weld_mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.blind.search import moved, search
from jaxmark.watermark.coding.keys import Choices, Key, bind
from jaxmark.watermark.coding.message import decode_any, encode
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence, Tag, weigh
from jaxmark.watermark.evidence.ledger import Choice
from jaxmark.watermark.record import Record, is_recorded

TAG_BITS = 40
_CODE_SPREAD = 4  # code bits for each bit of message and tag, at least: of few anchors, few share one then
_CHANGES = 2  # changes of pose that are read: none, and the best by the offsets
_CANDIDATES = 32  # messages of each reading whose tags are tried
# log10 of a probability from which on no other way of looking is tried, where a message reads and where none does.
_SURE, _SURE_UNREAD = -12.0, -40.0


class Phases(NamedTuple):
    """The phases of anchors in one way of reading a suspect: a view, a turn, a step and a change of pose."""

    view: Look
    turn: int
    step: float
    pilot: float  # how well the offsets fit, see `Found`
    soft: Float64[np.ndarray, " code"]  # soft values of the code bits
    square: float  # Σ c²
    anchors: int  # that count

    @property
    def anchored(self) -> "Anchored":
        """Where it is read."""
        return Anchored(self.view.pose, self.view.width, self.step, self.anchors)


class Anchored(NamedTuple):
    """Where a blind reading found its anchors: the `Registration` of a blind detection."""

    pose: Pose  # from the suspect's file to where it was read
    width: float = 0.0  # of the averages, in the scheme's unit
    step: float = 0.0  # quantisation step of the values, in the scheme's unit
    anchors: int = 0  # number of values that were read
    agreement: float = 0.0  # mean cosine of their phases, 1 if all are exactly where the mark put them

    def facts(self) -> dict[str, Any]:
        """See `Registration`."""
        return self._asdict() | {"pose": self.pose.facts()}


def context(key: bytes, bits: int, scheme: str) -> Choices:
    """The keyed choices of a mark: they are bound to no original, as its reader has none."""
    content = "message" if bits else "presence"
    return bind(key, b"", {"scheme": scheme, "content": content, "bits": bits})


def code_length(bits: int) -> int:
    """Number of code bits for a payload: the least power of two that is four times as long as message and tag.

    Raises:
        JaxmarkError: if the payload is not a multiple of 8 bits, or negative.
    """
    if bits < 0 or bits % 8:
        raise JaxmarkError(f"The payload must be a multiple of 8 bits, got {bits}.")
    return 1 << math.ceil(math.log2(_CODE_SPREAD * (bits + TAG_BITS))) if bits else 1


def codeword(message: bytes, choices: Choices) -> Float64[np.ndarray, " code"]:
    """The code bits of a message and its keyed tag, each -1 or +1."""
    return encode(message, choices, code_length(8 * len(message)), TAG_BITS)


def register(suspect: Mesh) -> Mesh:
    """Weld a suspect and drop what no face uses, as `read` expects it; independent of the key.

    Raises:
        JaxmarkError: if it is a point cloud.
    """
    check_faces("A mark without an original", suspect)
    return compact(weld_mesh(suspect, weld(suspect.vertices)))


def read(
    suspect: Mesh,
    key: bytes,
    bits: int,
    scheme: BlindScheme,
    message: bytes | None = None,
    record: Record | None = None,
) -> Detection:
    """Read a suspect without its original.

    Args:
        suspect: from `register`.
        key: 32 bytes.
        bits: size of the payload in bits.
        scheme: the widths and steps to try.
        message: the message that is claimed to be in it; None to read without a claim.
        record: the record of the mark, which was checked; it fixes the message, if it commits to one.

    Raises:
        JaxmarkError: if the suspect has no extent.
    """
    choices, length = context(Key(key), bits, scheme.name), code_length(bits)
    claim = _Claim(choices, bits, b"" if message is None and not bits else message, record)
    looks = len(scheme.widths) * scheme.looks * len(scheme.steps) * _CHANGES
    best = _nothing(scheme, np.zeros(length), Anchored(Pose(np.eye(3), np.zeros(3))))
    before = 0  # messages whose tags were tried already
    for _, group in groupby(scheme.views(suspect, choices), key=lambda view: view.undone):
        readings = [one for view in group for one in _readings(view, scheme, choices, length)]
        if not readings:
            continue
        found = _weigh(readings, scheme, claim, looks, before)
        before += len(readings) * _CANDIDATES
        best = min(best, found, key=lambda one: (one.message is None, one.log10_p, -one.registration.anchors))
        if is_sure(best):
            break
    return best


def try_each(reads: Iterable[Callable[[], Detection]]) -> Iterator[Detection]:
    """Read in several ways. One that refuses proves nothing: else who adds a part that is refused would hide a mark.

    Raises:
        JaxmarkError: if all refuse.
    """
    refusals, refused = [], True
    for read in reads:
        try:
            found = read()
        except JaxmarkError as refusal:
            refusals.append(refusal)
            continue
        refused = False
        yield found
    if refused and refusals:
        raise refusals[0]


def best_of(found: Sequence[Detection], choice: Choice, tries: int) -> Detection:
    """Return the detection whose message reads, and then the one that proves most, after a choice among `tries`."""
    best = min(found, key=lambda one: (one.message is None, one.log10_p))
    return best._replace(evidence=best.evidence.charged(choice.charge("each", tries)))


def is_sure(found: Detection) -> bool:
    """Whether so much is proven that nothing else needs to be tried."""
    return found.log10_p <= (_SURE if found.message is not None else _SURE_UNREAD)


def _readings(view: Look, scheme: BlindScheme, choices: Choices, length: int) -> list[Phases]:
    """All ways of reading a view.

    Anchors of one name have one sign: the mean of their cosines is one term of the score.
    """
    good = np.flatnonzero(view.good)
    if not len(good):
        return []
    dtype, steps = view.values.dtype, np.asarray(scheme.steps)
    offsets, lists = np.zeros(view.names.shape[:2]), []
    for turn, names in enumerate(view.names):
        names, place = np.unique(names[good], axis=0, return_inverse=True)
        dither = make_dither(choices, scheme.name, names, length)
        offsets[turn, good] = dither.offset[place.ravel()]
        lists.append((dither, place.ravel()))
    found = search(
        view.values,
        view.changes,
        jnp.asarray(view.good, dtype),
        jnp.asarray(offsets, dtype),
        jnp.asarray(steps, dtype),
        jnp.asarray(view.spread, dtype),
    )
    changes, pilots = np.asarray(found.change, np.float64), np.asarray(found.pilot, np.float64)
    readings = []
    for turn, (dither, place) in enumerate(lists):
        for rung, step in enumerate(steps):
            for change, pilot in ((np.zeros(len(view.spread)), 0.0), (changes[turn, rung], float(pilots[turn, rung]))):
                cosines = np.cos(2 * np.pi * (moved(view, change)[good] / step - offsets[turn, good]))
                cosine = np.bincount(place, cosines) / np.bincount(place)
                soft = np.bincount(dither.slot, dither.sign * cosine, length)
                readings.append(Phases(view, turn, float(step), pilot, soft, float(cosine @ cosine), len(cosine)))
    return readings


class _Claim(NamedTuple):
    """What is looked for."""

    choices: Choices
    bits: int  # size of the payload
    message: bytes | None  # that is claimed
    record: Record | None


def _weigh(readings: Sequence[Phases], scheme: BlindScheme, claim: _Claim, looks: int, before: int) -> Detection:
    """Weigh readings, of so many that might have been tried, after the tags of so many messages were tried."""
    readings = sorted(readings, key=lambda one: -one.pilot)
    soft = np.stack([one.soft for one in readings])
    choices, bits, claimed, record = claim
    decoded = None if claimed == b"" else decode_any(soft, bits, choices, TAG_BITS, _CANDIDATES)
    recorded = record is not None and bool(record.message_commitment)
    message = claimed
    if decoded is not None and decoded.message != claimed:
        message = decoded.message if is_recorded(record, decoded.message, choices) else None
    fixed = message is not None
    if decoded is None and not fixed:
        return _nothing(scheme, readings[0].soft, readings[0].anchored)
    if message is None:
        message = decoded.message if decoded is not None else b""
    word = codeword(message, choices)
    # Readings are compared by what their scores prove.
    score, norm = soft @ word, np.sqrt([one.square for one in readings])
    chosen = int(np.argmax(np.maximum(score, 0) / np.maximum(norm, 1e-300)))
    charges = ()
    if claimed or recorded:
        charges = (ledger.BLIND_MESSAGE.charge("claimed or recorded" if fixed else "another"),)
    tag = None
    if decoded is not None and claimed is None:
        tag = Tag(TAG_BITS, (ledger.RANK.charge("each", before + decoded.rank),))
    ways = [(score[chosen], norm[chosen])]
    reading = readings[chosen]
    notes = []
    if not fixed and (claimed or recorded):
        notes.append(f"Another message of this key reads than the one {'claimed' if claimed else 'in the record'}.")
    if reading.view.undone:
        notes.append(f"It was read after {reading.view.undone} steps of smoothing were undone.")
    if reading.view.mirrored[reading.turn]:
        notes.append("It is the mirror image of what was marked.")
    agreement = float(score[chosen] / reading.anchors)
    return _nothing(scheme, reading.soft, reading.anchored._replace(agreement=agreement))._replace(
        message=None if decoded is None else decoded.message,
        evidence=weigh(ways, bits=bits, fixed=fixed, tag=tag, charges=charges, looks=looks),
        notes=tuple(notes),
    )


def _nothing(scheme: BlindScheme, soft: Float64[np.ndarray, " code"], anchored: Anchored) -> Detection:
    """Make a detection that proves nothing."""
    scores = soft / (np.sqrt(np.mean(soft**2)) or 1.0)
    return Detection(None, Evidence(), anchored, scores, None, scheme.name, premises="key, message and record")
