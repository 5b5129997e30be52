"""Polar codes: encoding of information bits, and list decoding of soft decisions.

The code is that of Arıkan, "Channel Polarization", IEEE Trans. Inf. Theory 55 (2009). It is decoded by successive
cancellation with lists (Tal and Vardy, "List Decoding of Polar Codes", ibid. 61, 2015). Information bits are assigned
to the positions of largest polarization weight with β = 2^¼ (He et al., "β-expansion: A Theoretical Framework for Fast
and Recursive Construction of Polar Codes", GLOBECOM 2017). These positions are the same for every channel, and nested.
Everything runs on the host, in NumPy.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int8, Integer


@lru_cache(maxsize=16)
def frozen_inputs(length: int, information: int) -> Bool[np.ndarray, " length"]:
    """Select the inputs of the transform that are fixed to 0; the others take the information bits in order.

    Args:
        length: length of the code, a power of two.
        information: number of information bits, at most `length`.

    Returns:
        True for each input that is fixed, `[length]`; the array is read-only.
    """
    position = np.arange(length)
    weight = sum(((position >> j) & 1) * 2 ** (j / 4) for j in range(length.bit_length() - 1)) + np.zeros(length)
    fixed = np.ones(length, bool)
    fixed[np.argsort(weight)[length - information :]] = False
    fixed.flags.writeable = False  # the cached array is shared by all callers
    return fixed


def encode(bits: Integer[np.ndarray, "*batch information"], length: int) -> Int8[np.ndarray, "*batch length"]:
    """Encode information bits (0 or 1) as `length` code bits (0 or 1)."""
    inputs = np.zeros((*bits.shape[:-1], length), np.int8)
    inputs[..., ~frozen_inputs(length, bits.shape[-1])] = bits
    return _transform(inputs)


def decode(
    soft: Float[np.ndarray, "batch length"], information: int, paths: int
) -> Int8[np.ndarray, "batch paths information"]:
    """Decode soft decisions of code bits into the most plausible information words, the best one first.

    Check nodes take the smaller magnitude (min-sum decoding). The cost of a path grows by |soft| for every bit that
    contradicts the sign of its soft decision. A common factor of the soft decisions therefore changes nothing, and the
    noise level need not be known.

    Args:
        soft: positive where a code bit is likely 0, negative where it is likely 1, 0 where nothing is known.
        information: number of information bits that the code carries.
        paths: largest number of candidates; fewer are returned if there are fewer words.

    Returns:
        Information bits, 0 or 1.
    """
    fixed = frozen_inputs(soft.shape[1], information)
    start = soft[:, None].astype(np.float32)
    code, cost, _ = _decode(start, np.zeros(start.shape[:2], np.float32), fixed, paths)
    order = np.argsort(cost, axis=1, kind="stable")
    return _transform(_select(code, order))[..., ~fixed]


def _transform(bits: Int8[np.ndarray, "*batch length"]) -> Int8[np.ndarray, "*batch length"]:
    """Apply Arıkan's transform, x = u F^⊗m over GF(2), which is its own inverse."""
    code = bits.copy()
    half = 1
    while half < code.shape[-1]:
        pairs = code.reshape(*code.shape[:-1], -1, 2, half)
        pairs[..., 0, :] ^= pairs[..., 1, :]
        half *= 2
    return code


_Survivors = tuple[
    Int8[np.ndarray, "batch survivors length"],
    Float32[np.ndarray, "batch survivors"],
    Int[np.ndarray, "batch survivors"],
]


def _decode(
    soft: Float32[np.ndarray, "batch paths length"],
    cost: Float32[np.ndarray, "batch paths"],
    fixed: Bool[np.ndarray, " length"],
    paths: int,
) -> _Survivors:
    """Decode one subtree; return code bits and costs of the surviving paths, and the index of each path's parent."""
    count = soft.shape[1]
    if fixed.all():
        origin = np.broadcast_to(np.arange(count), cost.shape)
        return np.zeros(soft.shape, np.int8), cost + np.maximum(-soft, 0).sum(axis=-1), origin
    if len(fixed) == 1:
        value = soft[..., 0]
        forks = np.concatenate([cost + np.maximum(-value, 0), cost + np.maximum(value, 0)], axis=1)
        keep = min(paths, 2 * count)
        best = np.argpartition(forks, keep - 1, axis=1)[:, :keep]
        return (best >= count).astype(np.int8)[..., None], np.take_along_axis(forks, best, 1), best % count
    half = len(fixed) // 2
    first, second = soft[..., :half], soft[..., half:]
    check = np.sign(first) * np.sign(second) * np.minimum(np.abs(first), np.abs(second))
    upper, cost, origin = _decode(check, cost, fixed[:half], paths)
    first, second = _select(first, origin), _select(second, origin)
    lower, cost, parent = _decode(second + (1 - 2 * upper) * first, cost, fixed[half:], paths)
    upper = _select(upper, parent)
    return np.concatenate([upper ^ lower, lower], axis=-1), cost, np.take_along_axis(origin, parent, 1)


def _select(values: np.ndarray, path: Int[np.ndarray, "batch survivors"]) -> np.ndarray:
    """Take the rows of the given path indices."""
    return np.take_along_axis(values, path[..., None], 1)
