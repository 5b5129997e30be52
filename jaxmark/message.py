"""From a message to the code bits that are carried, and back: a keyed tag tells "decoded" from "guessed".

The message and its tag are one polar codeword (`jaxmark.polar`). The decoder lists its best candidates; the tag, from a
subkey of its own, says which of them is the message, if any.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Float64

from jaxmark import polar
from jaxmark.errors import JaxmarkError
from jaxmark.keys import derive

TAG_BITS = 28
CANDIDATES = 64


def code_length(bits: int, places: int, spread: int) -> int:
    """How many code bits carry a payload of so many bits: the largest power of two that fits and is of use.

    Args:
        bits: payload, a positive multiple of 8.
        places: how many code bits the carrier has places for.
        spread: how many code bits for each bit of message and tag are of use.

    Raises:
        JaxmarkError: if the payload is no positive multiple of 8, or too large for the places.
    """
    if bits <= 0 or bits % 8:
        raise JaxmarkError(f"The payload must be a positive multiple of 8 bits, got {bits}.")
    information = bits + TAG_BITS
    length = 1 << (max(1, min(places, spread * information)).bit_length() - 1)
    if information > length:
        raise JaxmarkError(
            f"{bits} bits and a tag of {TAG_BITS} do not fit: this mesh and scheme have {places} places, and the"
            f" payload is at most {max(0, length - TAG_BITS) // 8 * 8} bits."
        )
    return length


def encode(message: bytes, key: bytes, geometry: bytes, length: int) -> Float64[np.ndarray, " length"]:
    """The codeword of a message and its keyed tag: a code bit 0 is +1, a 1 is -1."""
    payload = np.unpackbits(np.frombuffer(message, np.uint8))
    return 1.0 - 2.0 * polar.encode(np.concatenate([payload, _tag(message, key, geometry)]), length)


def decode(
    scores: Float[np.ndarray, " length"], bits: int, key: bytes, geometry: bytes, candidates: int = CANDIDATES
) -> bytes | None:
    """The most plausible message whose keyed tag fits, or None.

    A suspect that is independent of the key passes with probability at most candidates · 2^-TAG_BITS.

    Args:
        scores: soft values of the code bits, at any common scale; 0 where nothing is known.
        bits: payload.
        key: 32 bytes.
        geometry: `geometry_hash` of the original.
        candidates: how many messages may be tried.
    """
    for word in _plausible(scores, bits, candidates):
        message = np.packbits(word[:bits]).tobytes()
        if np.array_equal(word[bits:], _tag(message, key, geometry)):
            return message
    return None


def guess(scores: Float[np.ndarray, " length"], bits: int) -> bytes | None:
    """The most plausible message, whatever its tag: what a receiver without one would say. None where nothing is known.

    Args:
        scores: see `decode`.
        bits: payload.
    """
    word = next(iter(_plausible(scores, bits, CANDIDATES)), None)
    return None if word is None else np.packbits(word[:bits]).tobytes()


def _plausible(scores: Float[np.ndarray, " length"], bits: int, candidates: int) -> Iterable[np.ndarray]:
    """Messages with their tags, the most plausible first; none where nothing is known."""
    if not np.any(scores):
        return ()
    return polar.decode(scores[None] / np.abs(scores).max(), bits + TAG_BITS, candidates)[0]


def _tag(message: bytes, key: bytes, geometry: bytes) -> np.ndarray:
    digest = derive(key, geometry, "tag", -(-TAG_BITS // 8), message)
    return np.unpackbits(np.frombuffer(digest, np.uint8))[:TAG_BITS]
