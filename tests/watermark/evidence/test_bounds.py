"""Probabilities that hold, and that are not empty."""

import math
import subprocess
import sys

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.watermark.evidence.bounds import (
    MIN_LOG10_P,
    UNFLOORED,
    any_of,
    log10_p_claimed,
    log10_p_fitted,
    log10_p_fitted_strengths,
    log10_p_read,
    log10_p_tag,
    share_of,
    undated,
)
from jaxmark.watermark.markers import make_marker
from tests import ROOT
from tests.samples import bumpy_sphere

SECURITY = ROOT / "benchmarks" / "security"


def test_hoeffding_by_hand():
    assert log10_p_claimed(3.0, 1.0) == pytest.approx(math.log10(math.exp(-4.5)))
    for score, norm in [(0, 0), (0, 1), (-5, 1), (math.nan, 1), (1, math.nan), (math.inf, 1), (1, 0)]:
        assert log10_p_claimed(score, norm) == 0.0
        assert log10_p_read(score, norm, 8) == 0.0
    assert log10_p_claimed(1e9, 1.0) == MIN_LOG10_P == -77.0


def test_hoeffding_bounds_the_exact_distribution():
    """All 2^14 sign patterns of unequal terms: the bound is above the exact tail at every score."""
    terms = np.random.default_rng(0).exponential(size=14)
    signs = 1 - 2 * ((np.arange(2**14)[:, None] >> np.arange(14)) & 1)
    scores = np.sort(signs @ terms)[::-1]
    tail = np.arange(1, len(scores) + 1) / len(scores)
    bound = np.array([10 ** log10_p_claimed(score, np.linalg.norm(terms)) for score in scores])
    assert (bound >= tail - 1e-12)[scores > 0].all()


def test_alternatives_are_paid_for():
    assert log10_p_tag(28, 32) == pytest.approx(math.log10(32 * 2.0**-28))
    assert log10_p_tag(1000, 1) == MIN_LOG10_P
    assert log10_p_tag(2, 32) == 0.0
    assert log10_p_read(8.0, 1.0, 16) == pytest.approx(math.log10(2**16 * math.exp(-32)))
    assert log10_p_read(2.0, 1.0, 16) == 0.0
    assert any_of(-7.0, -3.0) == pytest.approx(-7 + math.log10(2))
    assert any_of(-0.1, 0.0) == 0.0


def test_formulas_go_on_below_the_floor_where_that_is_asked_for():
    below = log10_p_read(40.0, 1.0, 64, UNFLOORED)
    assert below == pytest.approx(64 * math.log10(2) - 800 / math.log(10), rel=1e-3)
    assert any_of(below, -3.0, floor=UNFLOORED) == pytest.approx(below + math.log10(2))
    assert share_of(below, 0.5, UNFLOORED) == pytest.approx(below + math.log10(2))
    assert log10_p_read(0.0, 1.0, 0, UNFLOORED) == 0.0


def test_evidence_without_floor_orders_what_the_bound_does_not():
    """Where nothing has reached the floor both are one number; where the bound stands still, the other does not."""
    mesh, key = bumpy_sphere(4), jm.Key(bytes(32))
    marked, _ = jm.embed(mesh, b"original", key, budget=2e-3)
    marker = make_marker(mesh, key)
    found = [marker.detect(jm.attack(marked, "noise", size, seed=0)) for size in (0.0005, 0.001, 0.002, 0.02, 0.05)]
    bounds, further = ([getattr(one, name) for one in found] for name in ("log10_p", "log10_p_unfloored"))
    assert bounds[0] == bounds[1] == bounds[2] < MIN_LOG10_P + 1
    assert further == sorted(further)
    assert further[2] < MIN_LOG10_P - 10
    assert bounds[-1] == further[-1] > -70
    assert all(one <= bound for one, bound in zip(further, bounds, strict=True))
    assert marker.detect(mesh).log10_p_unfloored == 0.0


def test_the_fitted_value_is_the_gaussian_tail():
    assert log10_p_fitted(3.0, 1.0) == pytest.approx(math.log10(0.5 * math.erfc(3 / math.sqrt(2))))
    assert log10_p_fitted(6.0, 1.0, 8) == pytest.approx(math.log10(256 * 0.5 * math.erfc(6 / math.sqrt(2))))
    assert log10_p_fitted(0.0, 0.0) == 0.0
    assert -1000 < log10_p_fitted(60.0, 1.0) < -700  # far below the floor of a claim, and finite


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
    assert found.log10_p < log10_p_tag(28, 32)
    assert claimed.log10_p < found.log10_p
    assert claimed.evidence.log10_p_gaussian < claimed.log10_p
    assert found.detected(1e-20)


def test_fitted_strengths_are_paid_for():
    """Against the supremum itself, ‖P s‖ over random signs, and against figures that were computed by hand."""
    score = math.sqrt(2 * 21.5 * math.log(10))
    assert log10_p_fitted_strengths(score, 1.0, 64) == pytest.approx(-1.4, abs=0.05)
    assert log10_p_fitted_strengths(math.sqrt(2 * 76.9 * math.log(10)), 1.0, 64) == pytest.approx(-32.8, abs=0.1)
    assert log10_p_fitted_strengths(7.9, 1.0, 64) == 0.0
    random = np.random.default_rng(0)
    basis = np.linalg.qr(random.normal(size=(512, 16)))[0]
    suprema = np.linalg.norm(random.choice([-1.0, 1.0], (20_000, 512)) @ basis, axis=1)
    for level in (0.1, 0.01, 0.001):
        counted = np.mean([10 ** log10_p_fitted_strengths(s, 1.0, 16) <= level for s in suprema])
        assert counted <= level
    assert log10_p_fitted_strengths(suprema.max(), 1.0, 16) > log10_p_claimed(suprema.max(), 1.0)


def test_shares_and_tries():
    assert undated(-30.0) == pytest.approx(-30 + 64 * math.log10(2))
    assert undated(-3.0) == 0.0
    assert share_of(-3.0, 0.01) == pytest.approx(-1.0)
    assert share_of(-3.0, 1e-6) == 0.0
