"""From a message to the code bits that are carried, and back; a keyed tag tells a decoded message from a guess.

The message and its tag are one polar codeword (`jaxmark.watermark.coding.polar`). The decoder lists its best
candidates; the tag, from a subkey of its own, tells which of them is the message, if any.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int8

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding import polar
from jaxmark.watermark.coding.keys import Choices

DEFAULT_BITS = 64  # size of the payload
TAG_BITS = 28
CANDIDATES = 64  # number of messages whose tags the decoder tries


def code_length(bits: int, places: int, spread: int) -> int:
    """Choose the number of code bits for a payload: the largest power of two that the carrier has room for and needs.

    Args:
        bits: size of the payload in bits, a multiple of 8; 0 for a mark that says nothing but that it is there.
        places: number of code bits that the carrier has room for.
        spread: number of code bits for each bit of message and tag, beyond which more are of no use.

    Raises:
        JaxmarkError: if the payload is no positive multiple of 8, or too large for the places.
    """
    if bits == 0:
        return 1
    if bits < 0 or bits % 8:
        raise JaxmarkError(f"The payload must be a multiple of 8 bits, got {bits}.")
    information = bits + TAG_BITS
    length = 1 << (max(1, min(places, spread * information)).bit_length() - 1)
    if information > length:
        most = max(0, length - TAG_BITS) // 8 * 8
        room = f"and the payload is at most {most} bits" if most else "too few for any message"
        raise JaxmarkError(
            f"{bits} bits and a tag of {TAG_BITS} do not fit: this mesh and scheme have {places} places, {room}."
        )
    return length


def check_size(message: bytes, bits: int) -> None:
    """Check that a message has exactly the payload's size.

    Raises:
        JaxmarkError: if it is not bytes, or of another size.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    if 8 * len(message) != bits:
        raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {bits} bits.")


def encode(message: bytes, choices: Choices, length: int, tag_bits: int = TAG_BITS) -> Float64[np.ndarray, " length"]:
    """Encode a message and its keyed tag as a codeword of signs: a code bit 0 is +1, a 1 is -1.

    Args:
        message: the payload.
        choices: the keyed choices of the mark.
        length: number of code bits, from `code_length`.
        tag_bits: size of the tag.
    """
    if not message:
        return np.ones(1)  # a tag tells messages apart, and here is none to tell
    payload = np.unpackbits(np.frombuffer(message, np.uint8))
    return 1.0 - 2.0 * polar.encode(np.concatenate([payload, _tag(message, choices, tag_bits)]), length)


class Decoded(NamedTuple):
    """A message whose keyed tag fits."""

    message: bytes
    rank: int  # how many messages were tried, this one included: chance fits its tag with rank · 2^-(size of tag)
    row: int = 0  # which of several readings it is from


def decode(
    scores: Float[np.ndarray, " length"], bits: int, choices: Choices, candidates: int = CANDIDATES
) -> Decoded | None:
    """Decode the most plausible message whose keyed tag fits; None if there is none among the first `candidates`.

    A mark without a payload has no message.

    A suspect that is independent of the key passes at a rank of at most r with probability at most r · 2^-TAG_BITS.

    Args:
        scores: soft values of the code bits, at any common scale; 0 where nothing is known.
        bits: size of the payload in bits.
        choices: the keyed choices of the mark.
        candidates: number of messages whose tags are tried.
    """
    return decode_any(scores[None], bits, choices, TAG_BITS, candidates)


def decode_any(
    scores: Float[np.ndarray, "rows length"],
    bits: int,
    choices: Choices,
    tag_bits: int,
    candidates: int,
) -> Decoded | None:
    """Decode the first message whose keyed tag fits, of several readings: their most plausible messages come first.

    Args:
        scores: soft values of the code bits in each reading, see `decode`.
        bits: size of the payload in bits.
        choices: the keyed choices of the mark.
        tag_bits: size of the tag.
        candidates: number of messages of each reading whose tags are tried.
    """
    rows = np.flatnonzero(np.any(scores, axis=1))
    if bits == 0 or not len(rows):
        return None
    words = _list_candidates(scores[rows], bits + tag_bits, candidates)
    words = np.swapaxes(words, 0, 1).reshape(-1, bits + tag_bits)
    messages, tags = np.packbits(words[:, :bits], axis=1), np.packbits(words[:, bits:], axis=1)
    for rank, (message, tag) in enumerate(zip(messages, tags, strict=True), 1):
        said = message.tobytes()
        if tag.tobytes() == np.packbits(_tag(said, choices, tag_bits)).tobytes():
            return Decoded(said, rank, int(rows[(rank - 1) % len(rows)]))
    return None


def guess(scores: Float[np.ndarray, " length"], bits: int, tag_bits: int = TAG_BITS) -> bytes | None:
    """Decode the most plausible message, whatever its tag, as a receiver without tags would.

    Args:
        scores: soft values, see `decode`.
        bits: size of the payload in bits.
        tag_bits: size of the tag.

    Returns:
        The message; None if all scores are 0.
    """
    if not np.any(scores):
        return None
    return np.packbits(_list_candidates(scores[None], bits + tag_bits, CANDIDATES)[0, 0, :bits]).tobytes()


def _list_candidates(
    scores: Float[np.ndarray, "rows length"], information: int, candidates: int
) -> Int8[np.ndarray, "rows candidates information"]:
    """List messages with their tags for each reading, the most plausible first."""
    size = np.abs(scores).max(axis=1, keepdims=True)
    return polar.decode(scores / np.where(size > 0, size, 1), information, candidates)


def _tag(message: bytes, choices: Choices, tag_bits: int) -> np.ndarray:
    """The keyed tag of a message, as bits 0 or 1."""
    digest = choices.derive("tag", -(-tag_bits // 8), message)
    return np.unpackbits(np.frombuffer(digest, np.uint8))[:tag_bits]
