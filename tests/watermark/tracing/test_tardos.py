"""A fingerprint accuses colluders, and innocents no more often than it says."""

import hashlib
import itertools
import math

import numpy as np
import pytest
from scipy import special, stats

import jaxmark as jm
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.bounds import log10_p_fingerprint
from jaxmark.watermark.evidence.detection import accuse
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.tracing.tardos import (
    _THRESHOLDS,
    MIN_BIAS_LEVEL,
    Accusation,
    biases,
    codewords,
    rank,
    scores,
)

pytestmark = pytest.mark.core

GEOMETRY = b"g" * 32
NOISE = 0.3


def people(count: int) -> list[str]:
    return [f"recipient {i}" for i in range(count)]


def test_golden(key: jm.Key):
    """Held exactly, for ever: copies that were handed out must stay traceable."""
    p = biases(Choices(key, b""), 12)
    assert (256 * p).tolist() == [140, 196, 34, 102, 155, 243, 48, 16, 66, 202, 149, 150]
    words = codewords(["alice", "bob"], Choices(key, b""), p)
    rows = ["".join("+" if x > 0 else "-" for x in word) for word in words]
    assert rows == ["++--++---++-", "++---+-+++++"]
    levels = (256 * biases(Choices(key, GEOMETRY), 2048)).astype(np.uint8).tobytes()
    assert hashlib.sha256(levels).hexdigest() == "845fc45f43d200c136679e77f1dd039be627f2ee4d93c5b20f91cbd13a3917fd"


def test_biases_follow_the_arcsine_law(key: jm.Key):
    """Kolmogorov and Smirnov's distance at the edges between levels, where the quantised law is the exact one."""
    count = 2**18
    levels = 256 * biases(Choices(key, GEOMETRY), count)
    assert MIN_BIAS_LEVEL == levels.min() == 256 - levels.max()
    assert round(256 * special.roots_sh_legendre(5)[0].min()) == MIN_BIAS_LEVEL
    np.testing.assert_array_equal(levels, np.round(levels))
    law = stats.arcsine.cdf((np.arange(MIN_BIAS_LEVEL - 1, 257 - MIN_BIAS_LEVEL) + 0.5) / 256)
    law = (law - law[0]) / (law[-1] - law[0])
    found = np.cumsum(np.bincount(levels.astype(int), minlength=257))[MIN_BIAS_LEVEL - 1 : 257 - MIN_BIAS_LEVEL] / count
    assert np.abs(found - law).max() < 1.95 / math.sqrt(count)  # exceeded once in a thousand
    np.testing.assert_array_equal(_THRESHOLDS, np.round(2**32 * law[1:-1]))
    assert np.abs(2**32 * law[1:-1] % 1 - 0.5).min() > 1e-4


def test_codewords_by_definition(key: jm.Key):
    p = biases(Choices(key, GEOMETRY), 300)
    stream = hashlib.shake_256(key + GEOMETRY + b"jaxmark/2/fingerprint/300/codeword\0Zo\xc3\xab").digest(300)
    expected = [1 if byte < 256 * q else -1 for byte, q in zip(stream, p, strict=True)]
    np.testing.assert_array_equal(codewords(["Zoë"], Choices(key, GEOMETRY), p)[0], expected)


def test_codewords_have_their_biases_and_nothing_in_common(key: jm.Key):
    p = biases(Choices(key, GEOMETRY), 64)
    words = codewords(people(4000), Choices(key, GEOMETRY), p)
    z = ((words == 1).sum(0) - 4000 * p) / np.sqrt(4000 * p * (1 - p))
    assert 1e-3 < stats.chi2.sf(np.sum(z**2), 64) < 1 - 1e-3
    standard = (words - (2 * p - 1)) / np.sqrt(4 * p * (1 - p))
    assert np.abs(np.corrcoef(standard.T) - np.eye(64)).max() < 5 / math.sqrt(4000)
    other = codewords(people(4000), Choices(key, b"h" * 32), p)
    assert abs(np.mean(standard * (other - (2 * p - 1)) / np.sqrt(4 * p * (1 - p)))) < 5 / math.sqrt(64 * 4000)


@pytest.mark.parametrize("kind", ["normal", "equal", "heavy"])
def test_scores_and_bound_against_all_codewords(key: jm.Key, kind: str):
    """All 2^12 codewords with their probabilities: moments, and the exact tail under the bound at every score."""
    random = np.random.default_rng(0)
    y = {"normal": random.normal(size=12), "equal": np.ones(12), "heavy": random.standard_cauchy(12)}[kind]
    p = biases(Choices(key, b""), 12)
    words = np.array(list(itertools.product([-1, 1], repeat=12)), np.int8)
    chances = np.where(words > 0, p, 1 - p).prod(1)
    found = scores(y, p, words)
    by_hand = np.where(words > 0, np.sqrt((1 - p) / p), -np.sqrt(p / (1 - p))) @ y
    np.testing.assert_allclose(found, by_hand, atol=1e-12)
    assert chances @ found == pytest.approx(0, abs=1e-12)
    assert chances @ found**2 == pytest.approx(y @ y)
    order = np.argsort(-found)
    tail = np.cumsum(chances[order])
    bound = 10 ** log10_p_fingerprint(found[order], y, p)
    tiny = 10 ** log10_p_fingerprint(1e-162 * found[order], 1e-162 * y, p)
    np.testing.assert_allclose(tiny, bound, rtol=1e-6)  # although squares underflow
    assert (bound >= tail * (1 - 1e-9)).all()
    assert bound[0] == pytest.approx(tail[0], rel=0.01)  # Chernoff's bound is exact at the highest score
    assert (bound < 30 * tail)[found[order] > 0].all()


def test_bound_is_finite_and_in_range(key: jm.Key):
    p = biases(Choices(key, b""), 12)
    found = accuse(np.array([-1e9, -1.0, 0.0, 1.0, 1e9]), np.ones(12), p, 1)
    np.testing.assert_array_equal(found[[0, 1, 2, 4]], [0, 0, 0, MIN_LOG10_P])
    assert -1 < found[3] <= 0
    np.testing.assert_array_equal(accuse(np.zeros(2), np.zeros(12), p, 1), [0, 0])


@pytest.mark.slow
def test_innocents_are_accused_as_seldom_as_said(key: jm.Key):
    """Nominal against counted over 100 000 innocents: never more often, and not thirty times more seldom."""
    random = np.random.default_rng(1)
    slots, innocents = 256, 100_000
    p = biases(Choices(key, GEOMETRY), slots)
    guilty = codewords(["x", "y", "z"], Choices(key, GEOMETRY), p)
    values = {
        "a colluders' copy": guilty.mean(0) + NOISE * random.normal(size=slots),
        "another key's copy": codewords(["x"], Choices(jm.Key(bytes(32)), GEOMETRY), p)[0].astype(float),
        "constant": np.ones(slots),
        "biases": 2 * p - 1,
        "sparse": np.where(np.arange(slots) % 8, 0.0, random.normal(size=slots)),
        "heavy tailed": random.standard_t(2, size=slots),
    }
    found: dict[str, list[np.ndarray]] = {name: [] for name in values}
    names = people(innocents)
    for start in range(0, innocents, 10_000):
        words = codewords(names[start : start + 10_000], Choices(key, GEOMETRY), p)
        for name, y in values.items():
            found[name].append(accuse(scores(y, p, words), y, p, 1))
    for name in values:
        claims = np.concatenate(found[name])
        for exponent in (-1, -2, -3, -4):
            hits, nominal = np.sum(claims <= exponent), 10.0**exponent * innocents
            assert hits <= nominal, name
            assert exponent == -4 or hits >= nominal / 30, name


def mixed(words: np.ndarray, how: str, random: np.random.Generator) -> np.ndarray:
    """What a coalition hands on: soft values of every slot, under noise."""
    slots = np.arange(words.shape[1])
    mixture = {
        "average": words.mean(0),
        "pieces": words[random.integers(0, len(words), len(slots)), slots],
        "median": np.median(words, axis=0),
    }[how]
    return mixture + NOISE * random.normal(size=len(slots))


@pytest.mark.parametrize("how", ["average", "pieces", "median"])
@pytest.mark.parametrize("size", range(2, 9))
def test_a_coalition_is_found(key: jm.Key, size: int, how: str):
    """Among 500 recipients, by 64 c² slots against c colluders; an innocent is not accused."""
    slots = 64 * size**2
    random = np.random.default_rng(size)
    names = people(500)
    guilty = [names[i] for i in random.choice(500, size, replace=False)]
    words = codewords(guilty, Choices(key, GEOMETRY), biases(Choices(key, GEOMETRY), slots))
    found = rank(mixed(words, how, random), names, Choices(key, GEOMETRY))
    assert found[0].recipient in guilty
    assert found[0].log10_p < -6
    assert all(entry.log10_p > -2 for entry in found if entry.recipient not in guilty)


def test_what_biases_explain_is_left_out(key: jm.Key):
    random = np.random.default_rng(0)
    p = biases(Choices(key, GEOMETRY), 4096)
    words = codewords(people(8), Choices(key, GEOMETRY), p)
    y = mixed(words, "average", random)
    plain = scores(y, p, words) / np.linalg.norm(y)
    best = rank(y, people(8), Choices(key, GEOMETRY))
    assert np.mean([entry.score for entry in best]) > 1.5 * plain.mean()
    assert [entry.score for entry in rank(p**3 - 2 * p + 1, people(3), Choices(key, GEOMETRY))] == [0, 0, 0]


def test_another_key_or_mesh_accuses_nobody(key: jm.Key):
    names = people(2000)
    random = np.random.default_rng(0)
    for other in (Choices(jm.Key(bytes(32)), GEOMETRY), Choices(key, b"h" * 32)):
        words = codewords(names[:3], other, biases(other, 1024))
        assert rank(mixed(words, "average", random), names, other)[0].log10_p < -6
        assert rank(mixed(words, "average", random), names, Choices(key, GEOMETRY))[0].log10_p > -2


def test_rank_by_hand(key: jm.Key):
    """More recipients than are in memory at a time, some of them twice, at any scale of the values."""
    y = np.random.default_rng(5).normal(size=40)
    names = people(3000)
    p = biases(Choices(key, GEOMETRY), 40)
    powers = np.stack([p**k for k in range(4)], 1)
    rest = y - powers @ np.linalg.solve(powers.T @ powers, powers.T @ y)
    rest /= np.linalg.norm(rest)
    expected = scores(rest, p, codewords(names, Choices(key, GEOMETRY), p))
    found = rank(y, (name for name in names + names[::-1]), Choices(key, GEOMETRY), top=5)
    order = np.argsort(-expected)[:5]
    assert [entry.recipient for entry in found] == [names[i] for i in order]
    np.testing.assert_allclose([entry.score for entry in found], expected[order])
    joint = np.minimum(0, log10_p_fingerprint(expected[order], rest, p) + math.log10(3000))
    np.testing.assert_allclose([entry.log10_p for entry in found], joint, atol=1e-9)
    for scale in (1e-250, 1e250):
        again = rank(scale * y, names, Choices(key, GEOMETRY), top=5)
        assert [entry.recipient for entry in again] == [entry.recipient for entry in found]
    assert rank(y.astype(np.float32), names, Choices(key, GEOMETRY))[0].recipient == found[0].recipient


def test_nothing_to_go_by(key: jm.Key):
    charges = (ledger.RECIPIENTS.charge("each", 2),)
    nobody = [Accusation(name, 0.0, 0.0, charges=charges) for name in ("a", "b")]
    for y in (np.zeros(30), np.ones(30), np.arange(3.0)):
        assert rank(y, ["a", "b"], Choices(key, GEOMETRY)) == nobody
    assert rank(np.arange(30.0), [], Choices(key, GEOMETRY)) == []


def test_refusals(key: jm.Key):
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(jm.JaxmarkError, match="not finite"):
            rank(np.array([1.0, bad]), ["a"], Choices(key, GEOMETRY))
    with pytest.raises(jm.JaxmarkError, match="at least one slot"):
        rank(np.zeros(0), ["a"], Choices(key, GEOMETRY))
    with pytest.raises(jm.JaxmarkError, match="identifier is empty"):
        rank(np.ones(8), ["a", ""], Choices(key, GEOMETRY))
