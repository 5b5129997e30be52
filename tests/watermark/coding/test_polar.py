"""The code against its definition, exhaustive decoding, and counted errors in noise."""

import math
from functools import reduce

import numpy as np
import pytest
from scipy import optimize, stats

from jaxmark.watermark.coding import polar

pytestmark = pytest.mark.core

LENGTHS = [1 << m for m in range(11)]


def kronecker(length: int) -> np.ndarray:
    """F ⊗ F ⊗ … as a matrix; row vectors are multiplied from the left."""
    factors = [np.array([[1, 0], [1, 1]])] * (length.bit_length() - 1)
    return reduce(np.kron, factors, np.ones((1, 1), int))


def positions(length: int, information: int) -> list[int]:
    """Where the information goes, by weights summed over binary digits; no two are equal."""

    def weight(i: int) -> float:
        return math.fsum(2 ** (j / 4) for j, digit in enumerate(reversed(f"{i:b}")) if digit == "1")

    return sorted(sorted(range(length), key=weight)[length - information :])


def noisy(random: np.random.Generator, words: np.ndarray, length: int, sigma: float) -> np.ndarray:
    return 1.0 - 2.0 * polar.encode(words, length) + sigma * random.normal(size=(len(words), length))


def listed(soft: np.ndarray, words: np.ndarray, paths: int) -> np.ndarray:
    """Which words are among the candidates."""
    return (polar.decode(soft, words.shape[1], paths) == words[:, None]).all(axis=2).any(axis=1)


@pytest.mark.parametrize("length", LENGTHS)
def test_encode_is_the_kronecker_power_and_its_own_inverse(length: int):
    bits = np.random.default_rng(length).integers(0, 2, (5, length))
    code = polar.encode(bits, length)
    np.testing.assert_array_equal(code, bits @ kronecker(length) % 2)
    np.testing.assert_array_equal(polar.encode(code, length), bits)


def test_encode_puts_information_on_the_open_positions():
    bits = np.random.default_rng(0).integers(0, 2, (4, 21))
    open_rows = kronecker(64)[positions(64, 21)]
    np.testing.assert_array_equal(polar.encode(bits, 64), bits @ open_rows % 2)


@pytest.mark.parametrize("length", LENGTHS)
def test_frozen_positions(length: int):
    """Of the right number, nested, and those of least weight."""
    before = np.ones(length, bool)
    for information in range(length + 1) if length <= 128 else range(0, length + 1, 64):
        fixed = polar.frozen_inputs(length, information)
        assert fixed.sum() == length - information
        assert not (fixed & ~before).any()
        np.testing.assert_array_equal(np.flatnonzero(~fixed), positions(length, information))
        before = fixed


@pytest.mark.parametrize("length", LENGTHS)
def test_round_trip_without_noise(length: int):
    random = np.random.default_rng(length)
    for information in sorted({1, max(1, length // 8), max(1, length // 2), max(1, length - 1), length}):
        words = random.integers(0, 2, (3, information))
        soft = 1.0 - 2.0 * polar.encode(words, length)
        for paths in (1, 8):
            np.testing.assert_array_equal(polar.decode(soft, information, paths)[:, 0], words)


@pytest.mark.parametrize(("length", "information"), [(2, 2), (8, 4), (16, 6), (32, 7)])
def test_all_paths_rank_all_words_by_their_cost(length: int, information: int):
    """With as many paths as words, the list is every word in the order of its correlation: maximum likelihood.

    A path pays |soft| where its code bit is against the sign: over a whole word, half of Σ|soft| - Σ soft · code.
    """
    words = (np.arange(2**information)[:, None] >> np.arange(information)) & 1
    codes = 1.0 - 2.0 * polar.encode(words, length)
    soft = np.random.default_rng(length).normal(size=(40, length))
    found = polar.decode(soft, information, 2**information)
    assert found.shape == (40, 2**information, information)
    best = np.argsort(-soft @ codes.T, axis=1)
    np.testing.assert_array_equal(found, words[best])


def test_paths_are_costed_by_the_least_that_the_open_bits_allow():
    """The check nodes' smaller magnitude is exact on one check: the frozen bit of (1, 1) costs the weaker value."""
    soft = np.array([[3.0, -1.0], [-3.0, 1.0], [-2.0, -5.0], [0.5, 4.0]])
    np.testing.assert_array_equal(polar.decode(soft, 1, 1)[:, 0, 0], [0, 1, 1, 0])


def test_scale_does_not_matter():
    soft = np.random.default_rng(1).normal(size=(10, 256))
    expected = polar.decode(soft, 60, 8)
    for factor in (2.0**-40, 0.25, 2.0**40):
        np.testing.assert_array_equal(polar.decode(factor * soft, 60, 8), expected)


def test_one_by_one_is_the_same_as_together():
    soft = np.random.default_rng(2).normal(size=(12, 256))
    together = polar.decode(soft, 60, 8)
    for one, expected in zip(soft, together, strict=True):
        np.testing.assert_array_equal(polar.decode(one[None], 60, 8)[0], expected)


def test_erasures():
    """A third of the code bits unknown, the others known: read for all words, and refuted by none of the candidates."""
    random = np.random.default_rng(3)
    words = random.integers(0, 2, (50, 80))
    soft = 1.0 - 2.0 * polar.encode(words, 512)
    soft[random.random(soft.shape) < 1 / 3] = 0
    np.testing.assert_array_equal(polar.decode(soft, 80, 32)[:, 0], words)


def test_nothing_known_leaves_every_word_possible():
    found = polar.decode(np.zeros((1, 8)), 3, 8)[0]
    assert len(np.unique(found, axis=0)) == 8


def test_candidates_are_distinct_and_in_order():
    soft = np.random.default_rng(4).normal(size=(20, 128))
    found = polar.decode(soft, 40, 16)
    for one, words in zip(soft, found, strict=True):
        assert len(np.unique(words, axis=0)) == 16
        score = (1.0 - 2.0 * polar.encode(words, 128)) @ one
        assert (np.diff(score) <= 1e-3).all()


def test_more_paths_read_more():
    random = np.random.default_rng(5)
    words = random.integers(0, 2, (400, 64))
    soft = noisy(random, words, 256, 1.35)
    hits = [listed(soft, words, paths).mean() for paths in (1, 2, 4, 8, 16, 32)]
    assert (np.diff(hits) > 0).all(), hits
    assert hits[0] < 0.9 < hits[-1]


def failures(decibel: float, trials: int) -> int:
    """64 bits and a tag of 28 in 1024 code bits, at an Eb/N0 in which the tag is not counted as payload."""
    random = np.random.default_rng(6)
    count = 0
    for start in range(0, trials, 250):
        words = random.integers(0, 2, (min(250, trials - start), 92))
        sigma = math.sqrt(1024 / (2 * 64 * 10 ** (decibel / 10)))
        count += int((~listed(noisy(random, words, 1024, sigma), words, 32)).sum())
    return count


@pytest.mark.slow
def test_five_decibel_better_than_uncoded():
    """Messages of 64 bits fail once in a thousand at 9.4 dB uncoded; coded, no more often at 4.4 dB.

    If the code failed once in a thousand, 3000 messages would do with no failure in 5 % of all cases. At 1 dB, where no
    code of 64 bits reads more than a few, as a control the same count must find many.
    """

    def uncoded(decibel: float) -> float:
        return -math.expm1(64 * stats.norm.logcdf(math.sqrt(2 * 10 ** (decibel / 10))))

    assert optimize.brentq(lambda x: uncoded(x) - 1e-3, 0, 20) == pytest.approx(9.4, abs=0.05)
    failed = failures(4.4, 3000)
    assert stats.beta.ppf(0.95, failed + 1, 3000 - failed) <= 1e-3
    assert failures(1.0, 250) > 25
