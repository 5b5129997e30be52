"""Keyed choices of a blind mark, derived from the names of its anchors; computed on the host.

The value of an anchor is compared with a lattice of numbers, which is shifted by the anchor's dither δ + b/2. Here δ is
uniform on [0, ½), and b is a fair bit from another subkey. Anything that depends on the suspect and on δ is independent
of b, so that the score of a claim is a sum of independent signs (see `jaxmark.watermark.blind.reading`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.watermark.coding.keys import Choices


class Dither(NamedTuple):
    """The keyed choices of some anchors."""

    offset: Float64[np.ndarray, " anchors"]  # δ, in steps, in [0, ½)
    sign: Float64[np.ndarray, " anchors"]  # (-1)^b
    slot: Int64[np.ndarray, " anchors"]  # index of the code bit that an anchor carries


def make_dither(choices: Choices, scheme: str, names: Int64[np.ndarray, "anchors parts"], code_bits: int) -> Dither:
    """Derive the keyed choices of anchors, each from its name alone.

    Args:
        choices: the keyed choices of the mark.
        scheme: name of the scheme.
        names: names of the anchors, such as indices in a lattice.
        code_bits: number of code bits.
    """

    def words(label: str) -> Int64[np.ndarray, " anchors"]:
        return make_words(choices, f"{scheme}/{label}", names)

    return Dither(words("dither") / 2.0**63, 1.0 - 2 * (words("sign") & 1), words("slot") % code_bits)


def make_words(
    choices: Choices, label: str, names: Int64[np.ndarray, "anchors parts"]
) -> Int64[np.ndarray, " anchors"]:
    """Derive an integer of 62 bits for each anchor, from its name alone."""
    stream = b"".join(choices.derive(label, 8, name.tobytes()) for name in np.asarray(names, "<i8"))
    return (np.frombuffer(stream, "<u8") >> np.uint64(2)).astype(np.int64)
