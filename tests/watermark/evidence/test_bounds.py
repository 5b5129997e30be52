"""Probabilities that hold, and that are not empty."""

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.watermark.evidence.bounds import log10_p_gaussian, log10_p_product, log10_p_score, log10_p_tag
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.markers import make_marker
from tests import ROOT
from tests.samples import bumpy_sphere

SECURITY = ROOT / "benchmarks" / "security"


def test_hoeffding_by_hand():
    assert log10_p_score(3.0, 1.0) == pytest.approx(math.log10(math.exp(-4.5)))
    assert log10_p_score(1e3, 1.0) == pytest.approx(-5e5 / math.log(10))
    for score, norm in [(0, 0), (0, 1), (-5, 1), (math.nan, 1), (1, math.nan), (math.inf, 1), (1, 0)]:
        assert log10_p_score(score, norm) == 0.0


def test_hoeffding_bounds_the_exact_distribution():
    """All 2^14 sign patterns of unequal terms: the bound is above the exact tail at every score."""
    terms = np.random.default_rng(0).exponential(size=14)
    signs = 1 - 2 * ((np.arange(2**14)[:, None] >> np.arange(14)) & 1)
    scores = np.sort(signs @ terms)[::-1]
    tail = np.arange(1, len(scores) + 1) / len(scores)
    bound = np.array([10 ** log10_p_score(score, np.linalg.norm(terms)) for score in scores])
    assert (bound >= tail - 1e-12)[scores > 0].all()


def test_a_tag_fits_by_chance_as_often_as_its_bits_say():
    assert log10_p_tag(28) == pytest.approx(math.log10(2.0**-28))
    assert log10_p_tag(1000) == pytest.approx(-1000 * math.log10(2))


def test_fishers_product_is_that_of_chi_square():
    """-2 ln of a product of n independent p-values has chi-square's law with 2n degrees of freedom."""
    for values in ([-3.0], [-3.0, -1.0], [-20.0, -0.5, -7.0], [0.0, 0.0]):
        nats = -2 * math.log(10) * sum(values)
        expected = stats.chi2.logsf(nats, 2 * len(values)) / math.log(10)
        assert log10_p_product(values) == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_evidence_without_floor_orders_what_the_bound_does_not():
    """Where nothing has reached the floor both are one number; where the bound stands still, the other does not."""
    mesh, key = bumpy_sphere(4), jm.Key(bytes(32))
    marked, _ = jm.embed(mesh, b"original", key, budget=2e-3)
    marker = make_marker(mesh, key)
    found = [marker.detect(jm.attack(marked, "noise", size, seed=0)) for size in (0.0005, 0.001, 0.002, 0.02, 0.05)]
    bounds, further = ([getattr(one.evidence, name) for one in found] for name in ("log10_p", "log10_p_unfloored"))
    assert bounds[0] == bounds[1] == bounds[2] < MIN_LOG10_P + 1
    assert further == sorted(further)
    assert further[2] < MIN_LOG10_P - 10
    assert bounds[-1] == further[-1] > -70
    assert all(one <= bound for one, bound in zip(further, bounds, strict=True))
    assert marker.detect(mesh).evidence.log10_p_unfloored == 0.0


def test_the_gaussian_tail_by_hand():
    assert log10_p_gaussian(3.0, 1.0) == pytest.approx(math.log10(0.5 * math.erfc(3 / math.sqrt(2))))
    assert log10_p_gaussian(0.0, 0.0) == 0.0
    assert -1000 < log10_p_gaussian(60.0, 1.0) < -700  # far below the floor of a claim, and finite


@pytest.mark.long
def test_false_positive_rates_of_unmarked_suspects():
    """The benchmark in small: nominal against counted, with controls that must fail; it exits 1 if one does not."""
    # With fewer keys the control fails or not by chance.
    command = [sys.executable, SECURITY / "false_positives.py", "--keys", "8000"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.slow
def test_wrong_keys_and_other_suspects_read_nothing():
    mesh = bumpy_sphere(4)
    marked, _ = jm.embed(mesh, b"original", jm.new_key())
    for suspect in (marked, jm.attack(mesh, "noise", 0.003, seed=2), mesh):
        for seed in range(3):
            found = make_marker(mesh, jm.Key(bytes([seed] * 32))).detect(suspect)
            assert found.message is None
            assert found.log10_p == found.evidence.log10_p_gaussian == 0.0
            assert not found.detected()


def test_both_proofs_of_a_message_read():
    """Unattacked, the union bound is far stronger than the tag; what is given is the better, times two."""
    mesh, key = bumpy_sphere(4), jm.Key(bytes(32))
    marked, _ = jm.embed(mesh, b"original", key)
    marker = make_marker(mesh, key)
    found, claimed = marker.detect(marked), marker.detect(marked, b"original")
    assert found.log10_p < log10_p_tag(28)
    assert claimed.log10_p < found.log10_p
    assert claimed.evidence.log10_p_gaussian < claimed.log10_p
    assert found.detected(1e-20)
