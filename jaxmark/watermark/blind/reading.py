"""Reading without the original, and what it proves.

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
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.blind.search import moved, search
from jaxmark.watermark.coding.keys import Choices, Key, bind
from jaxmark.watermark.coding.message import decode_any, encode
from jaxmark.watermark.evidence import bounds as evidence
from jaxmark.watermark.marking import CLAIM_SHARE
from jaxmark.watermark.record import Record

TAG_BITS = 40
_CODE_SPREAD = 4  # code bits for each bit of message and tag, at least: of few anchors, few share one then
_CHANGES = 2  # changes of pose that are read: none, and the best by the offsets
_CANDIDATES = 32  # messages of each reading whose tags are tried
# log10 of a probability from which on no other way of looking is tried, where a message reads and where none does.
_SURE, _SURE_UNREAD = -12.0, -40.0


class Reading(NamedTuple):
    """One way in which a suspect may be read: a view, a turn, a step and a change of pose."""

    view: Look
    turn: int
    step: float
    pilot: float  # how well the offsets fit, see `Found`
    soft: Float64[np.ndarray, " code"]  # soft values of the code bits
    square: float  # Σ c²
    anchors: int  # that count


class BlindDetection(NamedTuple):
    """The result of reading a suspect without the original.

    Attributes:
        scheme: name of the scheme that it was read with.
        message: the message that was read; None unless its keyed tag fits.
        log10_p: log10 of a bound on the false-positive probability, in [-77, 0], if all that is claimed is dated.
        log10_p_undated: the same if nothing is: for the best message of any of 2^64 keys.
        log10_p_fitted: log10 of that probability if the score were Gaussian: an estimate, which decides nothing.
        log10_p_unfloored: log10_p without the floor at -77: orders attacks and schemes, proves and decides nothing.
        scores: soft values of the code bits, scaled to root mean square 1.
        anchors: number of values that were read.
        agreement: mean cosine of their phases, 1 if all are exactly where the mark put them.
        width: of the averages, in the scheme's unit.
        step: of the lattice of values, in the scheme's unit.
        pose: from the suspect's file to where it was read.
        version: version of the keyed choices that were read with.
        doubts: why the probabilities are estimates, not proofs; empty if they are proofs.
        remarks: what else the suspect looks like.
    """

    scheme: str
    message: bytes | None
    log10_p: float
    log10_p_undated: float
    log10_p_fitted: float
    log10_p_unfloored: float
    scores: Float64[np.ndarray, " code"]
    anchors: int
    agreement: float
    width: float
    step: float
    pose: Pose
    version: int
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def premises(self) -> str:
        """What must have been fixed before the suspect existed; a mesh marked under the same key is no such suspect."""
        return "key, message and record"

    def detected(self, alpha: float = 1e-6) -> bool:
        """Whether the false-positive probability is at most `alpha`, if all that is claimed is dated.

        Raises:
            JaxmarkError: if `alpha` is not in (0, 1).
        """
        if not 0 < alpha < 1:
            raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
        return self.log10_p <= math.log10(alpha)


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


def detect(
    suspect: Mesh,
    key: bytes,
    bits: int,
    scheme: BlindScheme,
    message: bytes | None = None,
    record: Record | None = None,
) -> BlindDetection:
    """Read a suspect without its original.

    Args:
        suspect: any mesh.
        key: 32 bytes.
        bits: size of the payload in bits.
        scheme: the widths and steps to try.
        message: the message that is claimed to be in it; None to read without a claim.
        record: the record of the mark, which was checked; it fixes the message, if it commits to one.

    Raises:
        JaxmarkError: if the suspect is a point cloud, or has no extent.
    """
    choices, length = context(Key(key), bits, scheme.name), code_length(bits)
    claimed = b"" if message is None and not bits else message
    tries = len(scheme.widths) * scheme.looks * len(scheme.steps) * _CHANGES
    best = _nothing(scheme, choices, length)
    before = 0  # messages whose tags were tried already
    for _, group in groupby(scheme.views(suspect, choices), key=lambda view: view.undone):
        readings = [one for view in group for one in _readings(view, scheme, choices, length)]
        if not readings:
            continue
        found = _weigh(readings, scheme, choices, bits, claimed, record, tries, before)
        before += len(readings) * _CANDIDATES
        best = min(best, found, key=lambda one: (one.message is None, one.log10_p, -one.anchors))
        if is_sure(best):
            break
    return best


def try_each(reads: Iterable[Callable[[], BlindDetection]]) -> Iterator[BlindDetection]:
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


def best_of(found: Sequence[BlindDetection], tries: int) -> BlindDetection:
    """Of several detections, one whose message reads, and then the one that proves most; all tries are paid for."""
    best = min(found, key=lambda one: (one.message is None, one.log10_p))
    return best._replace(
        log10_p=evidence.share_of(best.log10_p, 1 / tries),
        log10_p_undated=evidence.share_of(best.log10_p_undated, 1 / tries),
        log10_p_unfloored=evidence.share_of(best.log10_p_unfloored, 1 / tries, evidence.UNFLOORED),
    )


def is_sure(found: BlindDetection) -> bool:
    """Whether so much is proven that nothing else needs to be tried."""
    return found.log10_p <= (_SURE if found.message is not None else _SURE_UNREAD)


def _readings(view: Look, scheme: BlindScheme, choices: Choices, length: int) -> list[Reading]:
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
                readings.append(Reading(view, turn, float(step), pilot, soft, float(cosine @ cosine), len(cosine)))
    return readings


def _weigh(
    readings: Sequence[Reading],
    scheme: BlindScheme,
    choices: Choices,
    bits: int,
    claimed: bytes | None,
    record: Record | None,
    tries: int,
    before: int,
) -> BlindDetection:
    """What readings prove, of so many that might have been tried, after the tags of so many messages were tried."""
    order = sorted(range(len(readings)), key=lambda place: -readings[place].pilot)
    readings = [readings[place] for place in order]
    soft = np.stack([one.soft for one in readings])
    decoded = None if claimed == b"" else decode_any(soft, bits, choices, TAG_BITS, _CANDIDATES)
    told = record is not None and bool(record.told)
    fixed, share = claimed, 1.0
    if decoded is not None and decoded.message != claimed:
        fixed = decoded.message if told and record and record.commits_to(decoded.message, choices) else None
    if claimed or told:  # what was fixed beforehand has nearly all of the probability, any other message the rest
        share = CLAIM_SHARE if fixed is not None else 1 - CLAIM_SHARE
    if decoded is None and fixed is None:
        return _nothing(scheme, choices, code_length(bits), readings[0])
    message = fixed if fixed is not None else decoded.message if decoded is not None else b""
    word = codeword(message, choices)
    # Readings are compared by what their scores prove.
    score, norm = soft @ word, np.sqrt([one.square for one in readings])
    chosen = int(np.argmax(np.maximum(score, 0) / np.maximum(norm, 1e-300)))
    paid = math.log2(tries)
    unknown = 0 if fixed is not None else bits
    tag = [evidence.log10_p_tag(TAG_BITS, before + decoded.rank)] if decoded is not None and claimed is None else []

    def proven(floor: float) -> float:
        proofs = [evidence.log10_p_read(score[chosen], norm[chosen], unknown + paid, floor), *tag]
        return evidence.share_of(evidence.any_of(*proofs, floor=floor), share, floor)

    late = evidence.log10_p_read(score[chosen], norm[chosen], bits + paid)
    reading = readings[chosen]
    remarks = []
    if fixed is None and (claimed or told):
        remarks.append(f"Another message of this key reads than the one {'claimed' if claimed else 'in the record'}.")
    if reading.view.undone:
        remarks.append(f"It was read after {reading.view.undone} steps of smoothing were undone.")
    if reading.view.mirrored[reading.turn]:
        remarks.append("It is the mirror image of what was marked.")
    return _nothing(scheme, choices, len(word), reading)._replace(
        message=None if decoded is None else decoded.message,
        log10_p=proven(evidence.MIN_LOG10_P),
        log10_p_undated=evidence.undated(evidence.share_of(late, share)),
        log10_p_fitted=evidence.log10_p_fitted(score[chosen], norm[chosen], unknown + paid),
        log10_p_unfloored=proven(evidence.UNFLOORED),
        agreement=float(score[chosen] / reading.anchors),
        remarks=tuple(remarks),
    )


def _nothing(scheme: BlindScheme, choices: Choices, length: int, reading: Reading | None = None) -> BlindDetection:
    """A detection that proves nothing, of a reading."""
    if reading is None:
        pose = Pose(np.eye(3), np.zeros(3))
        zeros = np.zeros(length)
        return BlindDetection(scheme.name, None, 0.0, 0.0, 0.0, 0.0, zeros, 0, 0.0, 0.0, 0.0, pose, choices.version)
    scores = reading.soft / (np.sqrt(np.mean(reading.soft**2)) or 1.0)
    return BlindDetection(
        scheme.name,
        None,
        *(0.0, 0.0, 0.0, 0.0),
        scores,
        reading.anchors,
        0.0,
        reading.view.width,
        reading.step,
        reading.view.pose,
        choices.version,
    )
