"""What methods draw from a key: where each bit of a message is written, whether it is turned round, and noise.

Published methods mostly take a key for granted, or have none. Here every one of them scatters and flips the bits of its
message by a key, so that a wrong key reads a message that knows nothing of the right one.
"""

import numpy as np
from jaxtyping import Float64
from scipy.special import ndtri

from jaxmark.bench.method import Bits
from jaxmark.watermark.coding.keys import Choices, Key

_WORD = 64  # bits of the hash for each number


def choices(key: bytes, method: str) -> Choices:
    """The keyed choices of one method."""
    return Choices(Key(key), f"bench/{method}".encode())


def scatter(message: Bits, key: bytes, method: str) -> Bits:
    """The bits in the order that a key writes them, some of them flipped by it."""
    drawn = choices(key, method)
    return message[drawn.permutation("places", len(message))] ^ (drawn.signs("flips", len(message)) < 0)


def gather(written: Bits, key: bytes, method: str) -> Bits:
    """The message that `scatter` made these bits of."""
    drawn, message = choices(key, method), np.empty_like(written)
    message[drawn.permutation("places", len(written))] = written ^ (drawn.signs("flips", len(written)) < 0)
    return message


def uniform(key: bytes, method: str, label: str, count: int) -> Float64[np.ndarray, " count"]:
    """Independent numbers, uniform between 0 and 1, both excluded."""
    words = np.frombuffer(choices(key, method).derive(label, count * _WORD // 8), "<u8")
    return ((words >> np.uint64(11)) + 0.5) / 2.0**53


def normal(key: bytes, method: str, label: str, count: int) -> Float64[np.ndarray, " count"]:
    """Independent standard normal numbers."""
    return ndtri(uniform(key, method, label, count))
