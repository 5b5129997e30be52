"""Reading of phases without the original, and the bound on the probability of a score.

**The bound.** The phase of an anchor is its value divided by the quantisation step, minus its offset δ; c is the cosine
of 2π times the phase, times the reliability of the value, which is less than 1 beside a border. With the key's sign
(-1)^b, from another subkey, and the code bit a of the anchor's slot, the score is S = Σ a (-1)^b c. Everything that
depends only on the suspect and the offsets is independent of the signs: the pose, the step, the choice of anchors, and
their reliability. Given these, S is a sum of independent signs times c, and
P(S ≥ t) ≤ exp(-t²/(2 Σ c²)) (Hoeffding 1963). The denominator is that of the chosen pose, so that a search which makes
all c² large also increases it. Each reading whose score is compared is charged, whether it was made or not.

The bound holds for any suspect that is independent of the key. A work that was marked under the same key is not
independent of it, because the keyed choices do not depend on the geometry: their reader has no original.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, compact, host_mesh, weld, weld_mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.scheme import LOOKS_AGAIN, BlindScheme, Look
from jaxmark.watermark.blind.search import moved, random_changes, reliability, search
from jaxmark.watermark.coding.keys import Choices, Key, bind
from jaxmark.watermark.coding.message import checked_payload, decode_any, encode
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence, Tag, weigh
from jaxmark.watermark.evidence.ledger import Choice
from jaxmark.watermark.record import Record, is_recorded
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, is_builtin

TAG_BITS = 40
_MOST_BITS = 2**15  # the largest payload
_CODE_SPREAD = 4  # least number of code bits per bit of message and tag: few anchors then share a code bit
_MOST_PER_ANCHOR = 32  # largest number of code bits per anchor; more are not read, whatever a record says
_CHANGES = 2  # changes of pose that are read: none, and the one that fits the offsets best
_CANDIDATES = 32  # number of candidate messages of each reading whose tags are compared
# log10 p from which on no other view is tried, with and without a decoded message.
_SURE, _SURE_UNREAD = -12.0, -40.0


class Phases(NamedTuple):
    """The phases of anchors in one reading: with a view, a turn, a quantisation step and a change of pose."""

    view: Look
    turn: int
    step: float
    change: Float64[np.ndarray, " changes"]
    pilot: float  # fit of the offsets, see `Found`
    soft: Float64[np.ndarray, " code"]  # soft decisions of the code bits, sums of ±c; the largest |c| is 1
    square: float  # Σ c²
    anchors: int  # number of anchors that count
    reliable: float  # sum of their reliabilities, in units of c

    @property
    def anchored(self) -> "Anchored":
        """The registration of this reading."""
        return Anchored(self.view.pose, self.view.width, self.step, self.anchors)


class Anchored(NamedTuple):
    """The registration of a blind reading, which is a `Registration`: its pose and anchors."""

    pose: Pose  # the map from the coordinates of the suspect's file to those in which it was read
    width: float = 0.0  # width of the averages, in the scheme's unit
    step: float = 0.0  # quantisation step of the values, in the scheme's unit
    anchors: int = 0  # number of values that were read
    agreement: float = 0.0  # mean cosine of their phases by reliability; 1 if all have exactly the values of the mark

    def facts(self) -> dict[str, Any]:
        """See `Registration`."""
        return self._asdict() | {"pose": self.pose.facts()}


def context(key: bytes, bits: int, scheme: str) -> Choices:
    """Derive the keyed choices of a mark, which are bound to no original, because the reader has none."""
    content = "message" if bits else "presence"
    return bind(key, b"", {"scheme": scheme, "content": content, "bits": bits})


def code_length(bits: int) -> int:
    """Compute the number of code bits for a payload: the least power of two of at least four times message and tag.

    Raises:
        JaxmarkError: if the payload is not a multiple of 8 bits, negative or too large.
    """
    bits = checked_payload(bits)
    if bits > _MOST_BITS:
        raise JaxmarkError(f"A mark that is read without the original has at most {_MOST_BITS} bits, got {bits}.")
    return 1 << math.ceil(math.log2(_CODE_SPREAD * (bits + TAG_BITS))) if bits else 1


def codeword(message: bytes, choices: Choices) -> Float64[np.ndarray, " code"]:
    """Encode a message and its keyed tag as code bits, each -1 or +1."""
    return encode(message, choices, code_length(8 * len(message)), TAG_BITS)


def register(suspect: Mesh) -> Mesh:
    """Weld a suspect and drop vertices that no face uses, as `read` expects it; independent of the key.

    Raises:
        JaxmarkError: if it is a point cloud, or no mesh, see `make_mesh`.
    """
    suspect = host_mesh(suspect)
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
        scheme: the scheme, with the widths and steps to try.
        message: the claimed message; None to read without a claim.
        record: the record of the mark, which was checked. If it commits to a message, this message is fixed.

    Raises:
        JaxmarkError: if the suspect has no extent.
    """
    choices, length = context(Key(key), bits, scheme.name), code_length(bits)
    claim = _Claim(choices, bits, b"" if message is None and not bits else message, record)
    # Without a record, widths and steps that were left out may have been left out after seeing the suspect.
    usual = scheme if record is not None else BLIND_SCHEMES.get(scheme.name, scheme)
    kinds = max(len(one.widths) * len(one.steps) for one in (scheme, usual))
    looks, omitted = kinds * scheme.looks * _CHANGES, kinds / (len(scheme.widths) * len(scheme.steps))
    best = _nothing(scheme, claim, np.zeros(length), Anchored(Pose(np.eye(3), np.zeros(3))))
    tags_compared = 0  # number of messages whose tags were already compared
    poses: set[bytes] = set()  # poses that the hint gave
    for group in scheme.views(suspect, choices):
        poses |= {view.pose.shift.tobytes() for view in group if view.by_hint}
        readings = [reading for view in group for reading in _readings(view, scheme, choices, length)]
        if not readings:
            continue
        readings += _readings_again(readings, scheme, choices, length)
        detection = _weigh(readings, scheme, claim, looks, tags_compared, omitted)
        tags_compared += len(readings) * _CANDIDATES
        best = min(
            best,
            detection,
            key=lambda found: (found.message is None, found.log10_p, -found.registration.anchors),
        )
        if is_sure(best):
            break
    if record is not None and record.parameters.get("hint") and not best.detected(allow_estimate=True):
        return best._replace(notes=(*best.notes, _note_on_poses(len(poses))))
    return best


def _note_on_poses(count: int) -> str:
    """Say in how many poses of a suspect, in which nothing was detected, landmarks of a record's hint fit."""
    if count == 0:
        return "The record's hint gives no pose of this suspect: too few landmarks of the original are found on it."
    tried = "one pose" if count == 1 else f"{count} poses"
    return (
        f"Landmarks of the record's hint fit the suspect in {tried}, as some do on any mesh, but what is read there"
        " does not prove the mark."
    )


def try_each(reads: Iterable[Callable[[], Detection]]) -> Iterator[Detection]:
    """Read in several ways, and skip those that raise an error.

    An error is no evidence: otherwise an adversary could hide a mark by adding a part that cannot be read.

    Raises:
        JaxmarkError: if all readings raise it.
    """
    refusals, is_refused = [], True
    for attempt in reads:
        try:
            detection = attempt()
        except JaxmarkError as refusal:
            refusals.append(refusal)
            continue
        is_refused = False
        yield detection
    if is_refused and refusals:
        raise refusals[0]


def best_of(found: Sequence[Detection], choice: Choice, tries: int) -> Detection:
    """Return the best detection, those with a message first, after a charge for the choice among `tries`."""
    best = min(found, key=lambda detection: (detection.message is None, detection.log10_p))
    return best._replace(evidence=best.evidence.charged(choice.charge("each", tries)))


def is_sure(found: Detection) -> bool:
    """Whether the evidence is so strong that nothing else needs to be tried."""
    return found.log10_p <= (_SURE if found.message is not None else _SURE_UNREAD)


def _readings(view: Look, scheme: BlindScheme, choices: Choices, length: int) -> list[Phases]:
    """Read a view in all ways; in none if its anchors are far too few for the payload.

    Anchors of one name have one sign, so that the mean of their cosines is one term of the score.
    """
    counted = np.flatnonzero(view.good)
    if length > _MOST_PER_ANCHOR * len(counted):
        return []
    dtype, steps = view.values.dtype, np.asarray(view.steps or scheme.steps)
    errors = np.broadcast_to(view.error, view.good.shape)
    offsets, choices_per_turn = np.zeros(view.names.shape[:2]), []
    for turn, names in enumerate(view.names):
        names, group = np.unique(names[counted], axis=0, return_inverse=True)
        dither = make_dither(choices, scheme.name, names, length)
        offsets[turn, counted] = dither.offset[group.ravel()]
        choices_per_turn.append((dither, group.ravel()))
    fit = search(
        view.values,
        view.changes,
        jnp.asarray(view.good * reliability(errors, steps[:, None] / 2), dtype),
        jnp.asarray(offsets, dtype),
        jnp.asarray(steps, dtype),
        jnp.asarray(view.spread, dtype),
        jnp.asarray(random_changes(view.starts, len(view.spread)), dtype),
    )
    changes, pilots = np.asarray(fit.change, np.float64), np.asarray(fit.pilot, np.float64)
    readings = []
    for turn, (dither, group) in enumerate(choices_per_turn):
        alike = np.bincount(group)  # number of anchors of each name
        for rung, step in enumerate(steps):
            reliable = reliability(errors[counted], step)
            total = float(np.sum(np.bincount(group, reliable) / alike))
            for change, pilot in ((np.zeros(len(view.spread)), 0.0), (changes[turn, rung], float(pilots[turn, rung]))):
                cosines = np.cos(2 * np.pi * (moved(view, change)[counted] / step - offsets[turn, counted]))
                cosine = np.bincount(group, reliable * cosines) / alike
                # Relative to the largest, no square underflows that counts: the norm would be too small for the sum.
                peak = float(np.abs(cosine).max(initial=0)) or 1.0
                cosine /= peak
                soft, square = np.bincount(dither.slot, dither.sign * cosine, length), float(cosine @ cosine)
                found = Phases(view, turn, float(step), change, pilot, soft, square, len(cosine), total / peak)
                readings.append(found)
    return readings


def _readings_again(readings: list[Phases], scheme: BlindScheme, choices: Choices, length: int) -> list[Phases]:
    """See the suspect again after the change of pose that fits the offsets best, and read it, several times.

    Values are not quite linear in the change, so that a view from nearer the right pose shows more.
    """
    found: list[Phases] = []
    for _ in range(LOOKS_AGAIN):
        best = max(readings, key=lambda one: one.pilot)
        view = best.view.again(best.change)
        readings = [] if view is None else _readings(view, scheme, choices, length)
        if not readings:
            break
        found += readings
    return found


class _Claim(NamedTuple):
    """The mark that is looked for, and the claim."""

    choices: Choices
    bits: int  # size of the payload
    message: bytes | None  # the claimed message
    record: Record | None


def _weigh(
    readings: Sequence[Phases], scheme: BlindScheme, claim: _Claim, looks: int, before: int, omitted: float
) -> Detection:
    """Compute the evidence of readings, among `looks` possible ones, after `before` tags were compared.

    Tags are charged `omitted` times, as if those of omitted widths and steps had been compared before.
    """
    readings = sorted(readings, key=lambda reading: -reading.pilot)
    soft = np.stack([reading.soft for reading in readings])
    choices, bits, claimed, record = claim
    decoded = None
    if claimed != b"":
        # An anchor carries at most one bit of information.
        is_enough = np.array([[reading.anchors >= bits + TAG_BITS] for reading in readings])
        decoded = decode_any(soft * is_enough, bits, choices, TAG_BITS, _CANDIDATES)
    recorded = record is not None and bool(record.message_commitment)
    message = claimed
    if decoded is not None and decoded.message != claimed:
        message = decoded.message if is_recorded(record, decoded.message, choices) else None
    fixed = message is not None
    if decoded is None and not fixed:
        return _nothing(scheme, claim, readings[0].soft, readings[0].anchored)
    if message is None:
        message = decoded.message if decoded is not None else b""
    word = codeword(message, choices)
    # Readings are compared by the evidence of their scores.
    score, norm = soft @ word, np.sqrt([reading.square for reading in readings])
    chosen = int(np.argmax(np.maximum(score, 0) / np.maximum(norm, 1e-300)))
    charges = ()
    if claimed or recorded:
        charges = (ledger.BLIND_MESSAGE.charge("claimed or recorded" if fixed else "another"),)
    tag = None
    if decoded is not None and claimed is None:
        tag = Tag(TAG_BITS, (ledger.RANK.charge("each", math.ceil(omitted * (before + decoded.rank))),))
    ways = [(score[chosen], norm[chosen])]
    reading = readings[chosen]
    notes = []
    if not fixed and (claimed or recorded):
        notes.append(
            f"Another message of this key was decoded than the one {'claimed' if claimed else 'in the record'}."
        )
    agreement = float(score[chosen] / max(reading.reliable, 1e-300))
    found = _nothing(scheme, claim, reading.soft, reading.anchored._replace(agreement=agreement))._replace(
        message=None if decoded is None else decoded.message,
        recorded=None if decoded is None else is_recorded(record, decoded.message, choices),
        evidence=weigh(
            ways,
            bits=bits,
            fixed=fixed,
            tag=tag,
            charges=charges,
            looks=looks,
            tag_was_open=bool(bits) and record is not None,
            caveats=_caveats(scheme, record),
        ),
    )
    if found.detected(allow_estimate=True):  # else the best view of the suspect is the best of chance
        notes += _observations(reading)
    return found._replace(notes=tuple(notes))


def _observations(reading: Phases) -> list[str]:
    """Return what was undone to the suspect, or found out about its pose."""
    notes = []
    if reading.view.undone:
        notes.append(f"The suspect was read after undoing {reading.view.undone} steps of smoothing.")
    if reading.view.by_hint:
        notes.append("The suspect was read in a pose that was found by the record's hint, as parts are.")
    if reading.view.mirrored[reading.turn]:
        notes.append("The suspect is the mirror image of the marked mesh.")
    return notes


def _caveats(scheme: BlindScheme, record: Record | None) -> tuple[str, ...]:
    """Return why readings with a scheme prove nothing, if so."""
    if not is_builtin(scheme):
        return (f"the scheme {scheme.name!r} is not one of this library",)
    usual = BLIND_SCHEMES[scheme.name]
    if record is None and not (set(scheme.widths) <= set(usual.widths) and set(scheme.steps) <= set(usual.steps)):
        return (f"the widths or steps of the scheme {scheme.name!r} were chosen by the reader",)
    chosen = [name for name in scheme.remembered if getattr(scheme, name) != getattr(usual, name)]
    if record is None and chosen:
        return (f"the {' and the '.join(chosen)} was chosen by the reader; give the record",)
    return ()


def _nothing(scheme: BlindScheme, claim: _Claim, soft: Float64[np.ndarray, " code"], anchored: Anchored) -> Detection:
    """Make a detection without evidence."""
    scores = soft / (np.sqrt(np.mean(soft**2)) or 1.0)
    premises = f"key, message and {'options' if claim.record is None else 'record'}"
    return Detection(None, Evidence(), anchored, scores, None, scheme.name, premises, claimed=claim.message)
