"""Trials against marks that are made and read by themselves, and gradients against trials."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.evaluation import trials as module
from jaxmark.evaluation.trials import Trials
from jaxmark.evaluation.tuning import apply_attack, tune
from jaxmark.spectral.chebyshev import band_components
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import rough_sphere

ATTACKS = (("noise", 0.004), ("smoothing", 10))
RMS = 4e-4


@pytest.fixture(scope="module")
def mesh() -> jm.Mesh:
    return rough_sphere(1500)


@pytest.fixture(scope="module")
def trials(mesh) -> Trials:
    attacks = [partial(apply_attack, one) for one in ATTACKS]
    return Trials(make_original(mesh), 16, jm.Budget(rms=RMS).bounds(mesh), attacks, [7], "evidence")


@pytest.fixture(scope="module")
def trial(trials):
    return trials.run(KeyedScheme(profile=(1.0,) * 12))


@pytest.mark.slow
def test_what_is_tried_is_what_the_detector_has(mesh, trials, trial):
    """Keys of our own, a marker each: as much evidence, within what chance makes of so few marks."""
    for place, attack in enumerate(ATTACKS):
        ratios = []
        for number in range(6):
            marker = jm.make_marker(mesh, jm.Key(bytes([number + 1] * 32)), bits=16, scheme=trial.scheme)
            word = marker.codeword(b"ok")
            marked, _ = marker.write(word, RMS)
            received = marker.receive(marker.register(jm.attack(marked, *attack, seed=100 + number)))
            score, norm = marker.reader.claim(received, jnp.asarray(word, jnp.float32))
            ratios.append(float(score / norm))
        # Six marks of ours beside three that were tried; after smoothing they differ by more than the score's noise.
        spread = np.std(ratios, ddof=1) * np.sqrt(1 / 6 + 1 / 3)
        assert np.sqrt(2 * trial.worth[place]) == pytest.approx(np.mean(ratios), abs=4 * spread)
        assert spread < 0.3 * np.mean(ratios)
    assert trial.used == pytest.approx([1.0], rel=1e-3)
    assert trial.strengths == pytest.approx(np.mean(trial.scales) * np.ones(12))


@pytest.mark.slow
def test_strengths_are_fitted_chosen_and_checked_by_different_signs(trials, trial):
    fitted, checked = trials.run(trial.scheme, module.FITTED), trials.run(trial.scheme, module.CHECKED)
    signs = [np.asarray(one).tobytes() for tried in (trial, fitted, checked) for one in tried.signs]
    assert len(set(signs)) == len(signs) == 2 * (3 + 3 + 8)
    again = trials.run(trial.scheme)
    np.testing.assert_array_equal(again.worth, trial.worth)
    assert (fitted.worth != trial.worth).all()
    # The worth of each mark is that of all, but for how far they differ.
    np.testing.assert_allclose(np.sqrt(checked.by_signs).mean(axis=0), np.sqrt(checked.worth), rtol=1e-9)


def test_what_is_better_by_chance_does_not_surpass(trial):
    """Eight marks with gains that a t-test of SciPy's calls chance, or not."""
    random = np.random.default_rng(0)
    before = 10 + random.normal(size=(8, 2))
    other = trial._replace(by_signs=before, worth=before.mean(axis=0))
    for gain, spread, surpasses in ((3.0, 0.3, True), (3.0, 8.0, False), (0.5, 0.1, False), (-2.0, 0.3, False)):
        after = before + gain + spread * random.normal(size=(8, 1))
        found = trial._replace(by_signs=after, worth=np.full(2, 10 + gain))
        assert found.surpasses(other, 1.2) == surpasses
        if gain == 3.0:
            chance = stats.ttest_rel(after.min(axis=1), before.min(axis=1), alternative="greater").pvalue
            assert (chance < 0.01) == surpasses  # of three standard errors, with seven degrees of freedom
    nothing, hardly = (trial._replace(by_signs=np.full((8, 2), some), worth=np.full(2, some)) for some in (0.1, 0.5))
    assert not hardly.surpasses(nothing, 1.2)


@pytest.mark.long
def test_the_gradient_leads_to_more_evidence(trials, monkeypatch):
    """From strengths that fall too fast, judged by the very marks that better ones were fitted to."""
    poor = trials.run(KeyedScheme(profile=tuple(np.geomspace(1, 0.03, 24).tolist())))
    monkeypatch.setattr(module, "FITTED", module.CHOSEN)
    better = trials.run(trials._improved(poor, _rms_cost(trials)))
    assert better.worst > 1.15 * poor.worst
    change = np.log(better.strengths / poor.strengths)
    assert np.ptp(change) > 0.2
    # Neighbours change alike.
    assert np.abs(np.diff(change)).max() < 0.5 * np.ptp(change)


def _rms_cost(trials: Trials) -> np.ndarray:
    """Mean square displacement by unit strength in each band, which is a trace of the filter's square, by probes."""
    original, family = trials.original, KeyedScheme().family()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(original.signal), 3)).astype(np.float32)
    parts = band_components(original.operator, jnp.asarray(family, jnp.float32), jnp.asarray(signs))
    return np.mean(np.sum(np.asarray(parts, np.float64) ** 2, axis=2), axis=1)[None] / RMS**2


def test_limits_bind_as_metrics_do():
    """Two limits, of which the other one binds once strengths move to where it is used up."""
    limits = module._Limits(jnp.array([[1.0, 0.0], [0.0, 4.0]]), jnp.array([1.0, 0.5]))
    base = jnp.ones(2)
    assert limits.scale(base, base) == 1
    assert limits.scale(jnp.array([2.0, 1.0]), base) == pytest.approx(1 / 2)
    assert limits.scale(jnp.array([1.0, 4.0]), base) == pytest.approx(1 / 2)


@pytest.mark.long
def test_tuned_strengths_are_not_worse_than_those_given(mesh):
    poor = KeyedScheme(profile=(1.0,) * 8)
    found = tune(mesh, ATTACKS[:1], RMS, seed=jax.random.key(0), bits=16, scheme=poor)
    report = found.report
    assert not report.default_kept
    assert report.trials.min() >= max(1.1 * report.default_trials.min(), report.channel_trials.min())
    # Started from the best, nothing is much better, and so it is kept as it is.
    kept = tune(mesh, ATTACKS[:1], RMS, seed=jax.random.key(0), bits=16, scheme=found.scheme)
    assert kept.report.trials.min() >= report.trials.min()
    assert kept.report.default_kept == (kept.scheme == found.scheme)
