"""Intervals of confidence against SciPy's own, and against what they promise."""

import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.confidence import clopper_pearson

pytestmark = pytest.mark.core


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_as_the_binomial_test_has_it(confidence: float):
    places = [(0, 1), (1, 1), (0, 30), (30, 30), (3, 7), (12, 1000), (1, 10**6)]
    found = clopper_pearson([hits for hits, _ in places], [trials for _, trials in places], confidence)
    for (hits, trials), low, high in zip(places, *found, strict=True):
        expected = stats.binomtest(hits, trials).proportion_ci(confidence, method="exact")
        np.testing.assert_allclose((low, high), expected, rtol=1e-9, atol=4e-12)  # what SciPy's root finder leaves


def test_as_the_beta_distributions_quantiles():
    hits = np.arange(1, 20)
    low, high = clopper_pearson(hits, 20)
    np.testing.assert_allclose(low, stats.beta.ppf(0.025, hits, 21 - hits), rtol=1e-9)
    np.testing.assert_allclose(high, stats.beta.ppf(0.975, hits + 1, 20 - hits), rtol=1e-9)


@pytest.mark.parametrize("truth", [0.01, 0.3, 0.97])
def test_it_covers_the_truth_as_often_as_it_says(truth: float):
    counts = np.arange(26)
    low, high = clopper_pearson(counts, 25, 0.9)
    covered = (low <= truth) & (truth <= high)
    assert stats.binom.pmf(counts, 25, truth)[covered].sum() >= 0.9


def test_a_single_count_has_no_dimension_and_shapes_are_broadcast():
    low, high = clopper_pearson(5, 5)
    assert (low.shape, high.shape) == ((), ())
    assert low == pytest.approx(0.025 ** (1 / 5))  # all of n: the n-th root
    assert high == 1
    assert clopper_pearson([[0], [1]], [2, 3, 4]).low.shape == (2, 3)


@pytest.mark.parametrize(("hits", "trials"), [(-1, 3), (4, 3), (0.5, 3), (0, 0), (np.nan, 3)])
def test_counts_that_are_none(hits: float, trials: float):
    with pytest.raises(jm.JaxmarkError, match="An interval needs"):
        clopper_pearson(hits, trials)


@pytest.mark.parametrize("confidence", [0, 1, np.nan])
def test_confidences_that_are_none(confidence: float):
    with pytest.raises(jm.JaxmarkError, match="confidence in"):
        clopper_pearson(1, 2, confidence)
