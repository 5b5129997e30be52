"""Keyed choices of a blind mark, by the lattice's indices; on the host.

An anchor's value is compared with a lattice of numbers that its dither shifts. The dither is δ + b/2, δ uniform on
[0, ½) and b a fair bit of another subkey: whatever is chosen by a suspect and by δ knows nothing of b, so that a
claimed score is a sum of independent signs (see `jaxmark.watermark.blind.reading`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.watermark.coding.keys import Choices


class Dither(NamedTuple):
    """What the key says of some cells of a lattice."""

    offset: Float64[np.ndarray, " cells"]  # δ, in steps, in [0, ½)
    sign: Float64[np.ndarray, " cells"]  # (-1)^b
    slot: Int64[np.ndarray, " cells"]  # number of the code bit that a cell carries


def make_dither(choices: Choices, cells: Int64[np.ndarray, "cells 3"], code_bits: int) -> Dither:
    """Derive the keyed choices of cells, each from its indices alone.

    Args:
        choices: the keyed choices of the mark.
        cells: indices in the lattice.
        code_bits: number of code bits.
    """

    def words(label: str) -> Int64[np.ndarray, " cells"]:
        """An integer of 62 bits for each cell."""
        found = (choices.derive(f"field/{label}", 8, cell.tobytes()) for cell in np.asarray(cells, "<i8"))
        return (np.frombuffer(b"".join(found), "<u8") >> np.uint64(2)).astype(np.int64)

    return Dither(words("dither") / 2.0**63, 1.0 - 2 * (words("sign") & 1), words("slot") % code_bits)
