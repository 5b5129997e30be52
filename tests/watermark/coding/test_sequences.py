import numpy as np
import pytest

import jaxmark as jm
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.sequences import hadamard, orthogonal_sequences

pytestmark = pytest.mark.core


@pytest.mark.parametrize("order", [1, 2, 4, 8, 12, 16, 20, 24, 32, 40, 48, 64, 128, 192, 384])
def test_hadamard(order):
    matrix = hadamard(order).astype(int)
    assert set(np.unique(matrix)) <= {-1, 1}
    np.testing.assert_array_equal(matrix @ matrix.T, order * np.eye(order))


@pytest.mark.parametrize("order", [0, 3, 5, 6, 10, 63, 65])
def test_lengths_for_which_none_exist(order):
    """Erratum: the paper assumes orthogonal ±1 sequences of any length."""
    with pytest.raises(JaxmarkError, match="multiple of 4"):
        hadamard(order)


def test_no_three_signs_sequences_of_length_6_are_orthogonal():
    """The erratum itself, by trying all."""
    rows = 1 - 2 * np.array(np.unravel_index(np.arange(64), [2] * 6)).T
    orthogonal = rows @ rows.T == 0
    assert not any((orthogonal[i] & orthogonal[j] & orthogonal[i, j]).any() for i in range(64) for j in range(i))


def test_keyed_sequences_are_orthogonal_and_keyed(key: jm.Key):
    first = orthogonal_sequences(Choices(key, b"a" * 32), 10, 48).astype(int)
    np.testing.assert_array_equal(first @ first.T, 48 * np.eye(10))
    for other in (
        orthogonal_sequences(Choices(key, b"b" * 32), 10, 48),
        orthogonal_sequences(Choices(key, b"a" * 32), 10, 48, label="other"),
        orthogonal_sequences(Choices(key, b"a" * 32), 10, 96)[:, :48],
    ):
        assert np.abs(first @ other.T.astype(int)).max() < 48
    with pytest.raises(JaxmarkError, match="There are 4"):
        orthogonal_sequences(Choices(key, b""), 5, 4)
    with pytest.raises(JaxmarkError, match="56 mutually orthogonal sequences cannot be constructed"):
        hadamard(56)
