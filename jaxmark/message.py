"""From a message to the bits that are carried, and back: a keyed tag tells "decoded" from "guessed"."""

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.keys import derive

TAG_BITS = 32


def encode(message: bytes, key: bytes, geometry: bytes) -> Float64[np.ndarray, " code"]:
    """The codeword: the message's bits, most significant first, then its keyed tag; a set bit is +1, a clear one -1."""
    tag = derive(key, geometry, "tag", TAG_BITS // 8, message)
    return 2.0 * np.unpackbits(np.frombuffer(message + tag, np.uint8)) - 1.0


def decode(scores: Float[np.ndarray, " code"], key: bytes, geometry: bytes) -> bytes | None:
    """The message whose codeword has the signs of the scores, or None if its tag does not fit.

    A suspect that is independent of the key passes with probability 2⁻³².
    """
    if not np.any(scores):
        return None
    read = np.packbits(scores > 0).tobytes()
    message, tag = read[: -TAG_BITS // 8], read[-TAG_BITS // 8 :]
    return message if tag == derive(key, geometry, "tag", TAG_BITS // 8, message) else None


def code_length(bits: int) -> int:
    """How many bits are carried for a payload of so many.

    Raises:
        JaxmarkError: if the payload is not a positive multiple of 8.
    """
    if bits <= 0 or bits % 8:
        raise JaxmarkError(f"The payload must be a positive multiple of 8 bits, got {bits}.")
    return bits + TAG_BITS
