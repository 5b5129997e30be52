"""Keyed choices of a blind mark, by the names of its anchors; on the host.

An anchor's value is compared with a lattice of numbers that its dither shifts. The dither is δ + b/2, δ uniform on
[0, ½) and b a fair bit of another subkey: whatever is chosen by a suspect and by δ knows nothing of b, so that a
claimed score is a sum of independent signs (see `jaxmark.watermark.blind.reading`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.watermark.coding.keys import Choices


class Dither(NamedTuple):
    """What the key says of some anchors."""

    offset: Float64[np.ndarray, " anchors"]  # δ, in steps, in [0, ½)
    sign: Float64[np.ndarray, " anchors"]  # (-1)^b
    slot: Int64[np.ndarray, " anchors"]  # number of the code bit that an anchor carries


def make_dither(choices: Choices, scheme: str, names: Int64[np.ndarray, "anchors parts"], code_bits: int) -> Dither:
    """Derive the keyed choices of anchors, each from its name alone.

    Args:
        choices: the keyed choices of the mark.
        scheme: name of the scheme.
        names: of the anchors, such as indices in a lattice.
        code_bits: number of code bits.
    """

    def words(label: str) -> Int64[np.ndarray, " anchors"]:
        return make_words(choices, f"{scheme}/{label}", names)

    return Dither(words("dither") / 2.0**63, 1.0 - 2 * (words("sign") & 1), words("slot") % code_bits)


def make_words(
    choices: Choices, label: str, names: Int64[np.ndarray, "anchors parts"]
) -> Int64[np.ndarray, " anchors"]:
    """Derive an integer of 62 bits for each anchor, from its name alone."""
    found = b"".join(choices.derive(label, 8, name.tobytes()) for name in np.asarray(names, "<i8"))
    return (np.frombuffer(found, "<u8") >> np.uint64(2)).astype(np.int64)
