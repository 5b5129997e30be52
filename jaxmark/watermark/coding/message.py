"""Encoding of messages as code bits, and decoding, with a keyed tag that verifies the decoded message.

The message and its tag are encoded together as one polar codeword (`jaxmark.watermark.coding.polar`). The decoder lists
the most plausible candidates. The tag, which uses a subkey of its own, decides which candidate is the message, if any.
"""

from numbers import Integral
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int8

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding import polar
from jaxmark.watermark.coding.keys import Choices

DEFAULT_BITS = 64  # size of the payload in bits
TAG_BITS = 28
CANDIDATES = 64  # number of candidate messages whose tags the decoder compares


def checked_payload(bits: int) -> int:
    """Check the size of a payload, and return it as a whole number of Python.

    Raises:
        JaxmarkError: if it is no whole number of bits, negative, or no multiple of 8.
    """
    if not isinstance(bits, Integral) or bits < 0 or bits % 8:
        raise JaxmarkError(f"The payload must be a multiple of 8 bits, got {bits!r}.")
    return int(bits)


def code_length(bits: int, places: int, spread: int) -> int:
    """Choose the number of code bits for a payload: the largest useful power of two that the carrier can hold.

    Args:
        bits: size of the payload in bits, a multiple of 8; 0 for a presence mark, which carries no message.
        places: largest number of code bits that the carrier can hold.
        spread: number of code bits per bit of message and tag beyond which further code bits are of no use.

    Raises:
        JaxmarkError: if the payload is negative or no multiple of 8, or too large for the carrier.
    """
    bits = checked_payload(bits)
    if bits == 0:
        return 1
    information = bits + TAG_BITS
    length = 1 << (max(1, min(places, spread * information)).bit_length() - 1)
    if information > length:
        most = max(0, length - TAG_BITS) // 8 * 8
        room = f"so the payload is at most {most} bits" if most else "too few for any message"
        raise JaxmarkError(
            f"A payload of {bits} bits and its tag of {TAG_BITS} bits do not fit: this mesh and scheme carry at most"
            f" {places} code bits, {room}."
        )
    return length


def check_size(message: bytes, bits: int) -> None:
    """Check that a message has exactly the payload's size.

    Raises:
        JaxmarkError: if the message is not bytes, or has another size.
    """
    if not isinstance(message, bytes):
        raise JaxmarkError(f"A message is bytes, got {type(message).__name__}.")
    if 8 * len(message) != bits:
        raise JaxmarkError(f"The message has {8 * len(message)} bits, but the payload is {bits} bits.")


def encode(message: bytes, choices: Choices, length: int, tag_bits: int = TAG_BITS) -> Float64[np.ndarray, " length"]:
    """Encode a message and its keyed tag as a codeword of signs: +1 for the code bit 0, -1 for the code bit 1.

    Args:
        message: the payload.
        choices: the keyed choices of the mark.
        length: number of code bits, from `code_length`.
        tag_bits: size of the tag.
    """
    if not message:
        return np.ones(1)  # a presence mark has no message, hence no tag
    payload = np.unpackbits(np.frombuffer(message, np.uint8))
    return 1.0 - 2.0 * polar.encode(np.concatenate([payload, _tag(message, choices, tag_bits)]), length)


class Decoded(NamedTuple):
    """A decoded message whose keyed tag matches."""

    message: bytes
    rank: int  # number of candidates tried, including this one: a chance match has probability ≤ rank · 2^-(tag bits)
    row: int = 0  # index of the reading that the message was decoded from


def decode(
    scores: Float[np.ndarray, " length"], bits: int, choices: Choices, candidates: int = CANDIDATES
) -> Decoded | None:
    """Decode the most plausible message whose keyed tag matches; None if no tag of the first `candidates` matches.

    A mark without a payload has no message.

    For a suspect that is independent of the key, the probability of a match at a rank of at most r is at most
    r · 2^-TAG_BITS.

    Args:
        scores: soft decisions of the code bits, at any common scale; 0 where nothing is known.
        bits: size of the payload in bits.
        choices: the keyed choices of the mark.
        candidates: number of candidate messages whose tags are compared.
    """
    return decode_any(scores[None], bits, choices, TAG_BITS, candidates)


def decode_any(
    scores: Float[np.ndarray, "rows length"],
    bits: int,
    choices: Choices,
    tag_bits: int,
    candidates: int,
) -> Decoded | None:
    """Decode the first message whose keyed tag matches, from several readings.

    The candidates are tried in the order of their plausibility: first the best one of each reading, then the second
    ones.

    Args:
        scores: soft decisions of the code bits in each reading, see `decode`.
        bits: size of the payload in bits.
        choices: the keyed choices of the mark.
        tag_bits: size of the tag.
        candidates: number of candidate messages of each reading whose tags are compared.
    """
    rows = np.flatnonzero(np.any(scores, axis=1))
    if bits == 0 or not len(rows):
        return None
    words = _list_candidates(scores[rows], bits + tag_bits, candidates)
    words = np.swapaxes(words, 0, 1).reshape(-1, bits + tag_bits)
    messages, tags = np.packbits(words[:, :bits], axis=1), np.packbits(words[:, bits:], axis=1)
    for rank, (message, tag) in enumerate(zip(messages, tags, strict=True), 1):
        candidate = message.tobytes()
        if tag.tobytes() == np.packbits(_tag(candidate, choices, tag_bits)).tobytes():
            return Decoded(candidate, rank, int(rows[(rank - 1) % len(rows)]))
    return None


def guess(scores: Float[np.ndarray, " length"], bits: int, tag_bits: int = TAG_BITS) -> bytes | None:
    """Decode the most plausible message without checking its tag, as a receiver without tags would.

    Args:
        scores: soft decisions, see `decode`.
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
    """List candidate messages with their tags for each reading, the most plausible ones first."""
    size = np.abs(scores).max(axis=1, keepdims=True)
    return polar.decode(scores / np.where(size > 0, size, 1), information, candidates)


def _tag(message: bytes, choices: Choices, tag_bits: int) -> np.ndarray:
    """Compute the keyed tag of a message, as bits 0 or 1."""
    digest = choices.derive("tag", -(-tag_bits // 8), message)
    return np.unpackbits(np.frombuffer(digest, np.uint8))[:tag_bits]
