"""Mutually orthogonal sequences of signs, which let several bits share the same bands (Sohn et al., section 2.2).

The paper asks for k orthogonal sequences of any length n. Two such sequences do not exist at an odd length above 1, and
three or more need a length that is a multiple of 4: they are rows of a Hadamard matrix.
"""

import numpy as np
from jaxtyping import Int8

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import Choices


def orthogonal_sequences(
    choices: Choices, count: int, length: int, *, label: str = "sequences"
) -> Int8[np.ndarray, "count length"]:
    """Derive mutually orthogonal ±1 sequences: rows of a Hadamard matrix, chosen, permuted and signed by the key.

    The signs of the columns are independent of the choice of rows and columns, so that a false-positive probability may
    rest on the signs alone. Sequences with different labels or lengths are independent.

    Args:
        choices: the keyed choices of the mark.
        count: number of sequences, at most `length`.
        length: 1, 2 or a multiple of 4 that `hadamard` can construct.
        label: purpose of the sequences; the keyed choices have the labels `label/length/rows`, `…/columns` and
            `…/signs`.

    Returns:
        `[count, length]` with values -1 and 1.

    Raises:
        JaxmarkError: if fewer sequences of that length exist, or `hadamard` cannot construct the length.
    """
    matrix = hadamard(length)
    if not 0 < count <= length:
        raise JaxmarkError(f"There are {length} mutually orthogonal sequences of length {length}, not {count}.")
    rows = choices.permutation(f"{label}/{length}/rows", length)[:count]
    columns = choices.permutation(f"{label}/{length}/columns", length)
    return matrix[rows][:, columns] * choices.signs(f"{label}/{length}/signs", length)


def hadamard(order: int) -> Int8[np.ndarray, "order order"]:
    """Construct a matrix of ±1 with orthogonal rows, by Sylvester's doubling and Paley's first construction.

    Raises:
        JaxmarkError: if no such matrix exists, because the order is above 2 and no multiple of 4, or if these
            constructions do not provide it.
    """
    if order < 1 or (order > 2 and order % 4):
        raise JaxmarkError(f"No {order} mutually orthogonal ±1 sequences of length {order} exist; use a multiple of 4.")
    matrix = _construct(order)
    if matrix is None:
        raise JaxmarkError(
            f"{order} mutually orthogonal sequences cannot be constructed here; use a power of two, or three times one."
        )
    return matrix


def _construct(order: int) -> Int8[np.ndarray, "order order"] | None:
    """Construct the matrix; None if these constructions do not provide it."""
    if order == 1:
        return np.ones((1, 1), np.int8)
    if order % 4 == 0 and _is_prime(order - 1):
        return _paley(order - 1)
    half = _construct(order // 2) if order % 2 == 0 else None
    return None if half is None else np.block([[half, half], [half, -half]]).astype(np.int8)


def _paley(q: int) -> Int8[np.ndarray, "order order"]:
    """Construct a Hadamard matrix of order q + 1 for a prime q ≡ 3 (mod 4), from the quadratic residues modulo q."""
    residue = np.full(q, -1, np.int8)
    residue[np.arange(1, q, dtype=np.int64) ** 2 % q] = 1
    residue[0] = 0
    skew = np.zeros((q + 1, q + 1), np.int8)
    skew[0, 1:] = 1
    skew[1:, 0] = -1
    skew[1:, 1:] = residue[np.subtract.outer(np.arange(q), np.arange(q)) % q]
    return skew + np.eye(q + 1, dtype=np.int8)


def _is_prime(n: int) -> bool:
    return n > 1 and all(n % d for d in range(2, int(n**0.5) + 1))
