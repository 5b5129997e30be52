"""The bound of blind readings: it holds for suspects of any phases, and a denominator free of the pose would not."""

import math
from functools import cache

import numpy as np
import pytest
from jaxtyping import Float64

from jaxmark.confidence import clopper_pearson
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.reading import context
from jaxmark.watermark.evidence.bounds import log10_p_score

PAIRS, ANCHORS = 30_000, 80
LEVELS = (1e-1, 1e-2, 1e-3, 1e-4)


@cache
def simulate(*, climbed: bool) -> tuple[Float64[np.ndarray, " pairs"], Float64[np.ndarray, " pairs"]]:
    """Score and Σ c² of pairs of suspect and key; climbed, all phases are at the offset or half a step beside it."""
    rng = np.random.default_rng(0)
    offset, sign = rng.random((PAIRS, ANCHORS)) / 2, rng.choice([-1.0, 1.0], (PAIRS, ANCHORS))
    phase = offset + rng.integers(0, 2, offset.shape) / 2 if climbed else rng.random(offset.shape)
    cosine = np.cos(2 * np.pi * (phase - offset))
    return np.sum(sign * cosine, axis=1), np.sum(cosine**2, axis=1)


def hits(score: Float64[np.ndarray, " pairs"], square: Float64[np.ndarray, " pairs"]) -> dict[float, int]:
    """How many pairs state a probability at most as small as each level."""
    norm = np.sqrt(square)
    near = score > 2 * norm  # no other states a tenth
    stated = np.array([log10_p_score(*pair) for pair in zip(score[near], norm[near], strict=True)])
    return {level: int(np.sum(stated <= math.log10(level))) for level in LEVELS}


def broken(found: dict[float, int]) -> list[float]:
    """The levels that are exceeded by more than chance explains, at 99.9 %."""
    return [level for level, count in found.items() if clopper_pearson(count, PAIRS, 0.998).low > level]


@pytest.mark.parametrize("climbed", [False, True], ids=["any pose", "climbed"])
def test_no_level_is_exceeded_and_the_bound_is_not_empty(climbed: bool):
    found = hits(*simulate(climbed=climbed))
    assert broken(found) == []
    for level in (1e-1, 1e-2):
        assert found[level] >= level * PAIRS / 30


def test_the_number_of_anchors_as_denominator_breaks_where_a_search_climbed():
    """exp(-t²/n) holds where phases are uniform, which a search for the offsets makes them not be."""
    half = np.full(PAIRS, ANCHORS / 2)
    assert broken(hits(simulate(climbed=False)[0], half)) == []
    assert {1e-2, 1e-3, 1e-4} <= set(broken(hits(simulate(climbed=True)[0], half)))


def test_offsets_are_uniform_and_signs_fair_and_independent_of_them():
    cells = np.stack(np.meshgrid(*[np.arange(-7, 7)] * 3), axis=-1).reshape(-1, 3)
    dither = make_dither(context(bytes(32), 64, "field"), "field", cells, 256)
    count = len(cells)
    assert 0 <= dither.offset.min() < 0.005
    assert 0.495 < dither.offset.max() < 0.5
    assert abs(np.exp(4j * np.pi * dither.offset).sum()) < 3 * math.sqrt(count)
    for turns in (0, 4, 8):
        moment = np.sum(dither.sign * np.exp(1j * np.pi * turns * dither.offset))
        assert abs(moment) < 4 * math.sqrt(count), turns
    slots = np.bincount(dither.slot, minlength=256)
    assert np.sum((slots - count / 256) ** 2) / (count / 256) == pytest.approx(255, abs=6 * math.sqrt(510))
