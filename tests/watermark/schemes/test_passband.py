"""Pass bands that suit a budget: what is predicted, what is chosen, and how readers without a record find it."""

import math
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment import attempts
from jaxmark.app import diagnosis
from jaxmark.evaluation.tuning import tune
from jaxmark.watermark.everyday import alternatives
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.perception.capacity import NOISE, Capacity
from jaxmark.watermark.schemes.keyed import PASS_BANDS, KeyedScheme
from jaxmark.watermark.schemes.passband import ADAPTIVE
from tests.samples import rough_sphere

FAINT = {"dame": 0.001}
SHAPE = rough_sphere(2000)


@cache
def marker_of(passband: str, key: bytes = bytes(32), bits: int = 16) -> NonBlindMarker:
    return jm.make_marker(SHAPE, jm.Key(key), bits=bits).with_scheme(KeyedScheme(passband=passband))


@cache
def faint(bits: int = 16) -> NonBlindMarker:
    return jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=bits).adapted(FAINT)


def evidence(passband: str, limits: dict[str, float]) -> tuple[float, float]:
    """Evidence for the true message in noise, measured; and predicted for marks as large as those."""
    ratios, predicted = [], []
    for number in range(4):
        marker = marker_of(passband, bytes([number] * 32))
        word = marker.codeword(b"ab")
        marked, info = marker.write(word, limits)
        for seed in range(3):
            suspect = jm.attack(marked, "noise", NOISE, seed=3 * number + seed)
            received = marker.receive(marker.register(suspect))
            score, norm = marker.reader.claim(received, jnp.asarray(word, marker.original.signal.dtype))
            ratios.append(float(score) / float(norm))
        predicted.append(marker.capacity.evidence(marker.bits, info.rms, NOISE))
    return float(np.mean(ratios)) ** 2 / 2, float(np.mean(predicted))


@pytest.mark.parametrize(
    "passband", ["low", *(pytest.param(one, marks=pytest.mark.long) for one in ADAPTIVE if one != "low")]
)
def test_evidence_is_what_is_predicted(passband):
    measured, predicted = evidence(passband, {"dame": 0.003})
    assert predicted == pytest.approx(measured, rel=0.2)


@pytest.mark.slow
def test_faint_marks_prove_more_in_the_band_that_is_chosen():
    assert faint().scheme == KeyedScheme(passband="low")
    assert evidence("low", FAINT)[0] > 1.2 * evidence("tapered", FAINT)[0]


def test_the_usual_band_stays_where_marks_are_strong():
    usual = jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=16)
    assert usual.adapted() is usual
    assert usual.adapted({"dame": 0.02}) is usual
    assert usual.adapted(1e-5) is usual  # all bands cost the same


@pytest.mark.parametrize("scheme", [KeyedScheme(hiding=False), KeyedScheme(profile=(1.0,) * 9), "host"])
def test_other_schemes_stay_as_they_are(scheme):
    marker = jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=16, scheme=scheme)
    assert marker.adapted(FAINT) is marker


def test_the_choice_does_not_depend_on_the_key():
    assert {
        jm.make_marker(SHAPE, jm.Key(bytes([number] * 32)), bits=16).adapted(FAINT).scheme for number in range(3)
    } == {faint().scheme}


def test_large_payloads_have_room_in_low_bands():
    """Six dimensions for each bit of message and tag, where there are so many."""
    for passband in ADAPTIVE[1:]:
        scheme, original = KeyedScheme(passband=passband), faint().original
        assert len(scheme.strengths(original, 0)) >= round(PASS_BANDS[passband].share * 64)
        assert scheme.dimensions(original, 256) >= 6 * (256 + 28)
        assert set(scheme.strengths(original, 256)) == {1.0}


def test_what_is_asked_to_be_survived_decides():
    """Without much noise, many dimensions are worth more than energy in each."""
    marker = jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=16)
    assert marker.adapted({"dame": 0.002}).scheme != KeyedScheme()
    assert marker.adapted(jm.Budget(limits={"dame": 0.002}, noise=1e-4)) is marker
    with pytest.raises(jm.JaxmarkError, match="at least 0"):
        marker.adapted(jm.Budget(limits=FAINT, noise=-1.0))


@pytest.mark.slow
def test_faint_marks_are_read_with_their_record_and_without():
    key = jm.Key(bytes(range(32)))
    marked, info = jm.embed(SHAPE, b"ab", key, budget=FAINT)
    assert info.record.parameters["passband"] == "low"
    with_record = jm.detect(marked, original=SHAPE, key=key, message=b"ab", record=info.record)
    without = jm.detect(marked, original=SHAPE, key=key, message=b"ab")
    assert with_record.message == without.message == b"ab"
    # One of two bands that share a tenth. With the record, there are charges for what a record leaves open: the order
    # of the original, blind marks beside, and the tag.
    price = without.evidence.log10_p_unfloored - with_record.evidence.log10_p_unfloored
    assert price == pytest.approx(math.log10(2 / 0.1) + math.log10(0.97**2 * 2 / 3), abs=0.01)
    assert jm.detect(marked, original=SHAPE, key=jm.new_key(), bits=16).log10_p > -6


def test_all_bands_are_tried_beside_one_alignment(monkeypatch):
    calls, align = [], attempts.align
    monkeypatch.setattr(attempts, "align", lambda *given, **options: (calls.append(1), align(*given, **options))[1])
    found, mark = alternatives(jm.make_marker(SHAPE, jm.new_key(), bits=16)).read(
        jm.attack(SHAPE, "noise", 0.001, seed=0)
    )
    assert len(calls) == 1
    assert not found.detected()
    assert isinstance(mark.scheme, KeyedScheme)
    assert mark.scheme.passband in ADAPTIVE


def test_a_scheme_given_as_an_object_keeps_its_band_and_is_read_with_it():
    key = jm.Key(bytes(range(32)))
    marked, info = jm.embed(SHAPE, b"ab", key, budget=FAINT, scheme=KeyedScheme())
    assert info.record.parameters["passband"] == "tapered"
    assert jm.detect(marked, original=SHAPE, key=key, bits=16, scheme=KeyedScheme()).message == b"ab"
    assert jm.detect(marked, original=SHAPE, key=key, bits=16).message == b"ab"


def test_a_forgotten_payload_size_is_told_whatever_the_band(monkeypatch):
    """And the suspect is aligned twice, however much is tried: as it is, and for the files exchanged."""
    calls = []
    align = diagnosis.align
    monkeypatch.setattr(diagnosis, "align", lambda *given: (calls.append(1), align(*given))[1])
    marked = faint().embed(b"ab", FAINT)[0]
    usual = jm.make_marker(SHAPE, jm.Key(bytes(32)))
    (hint,) = diagnosis.diagnose(marked, usual, "auto")
    assert hint.startswith("A message of 16 bits is readable with the scheme 'keyed'")
    exchanged = jm.make_marker(marked, jm.Key(bytes(32)), bits=16)
    (hint,) = diagnosis.diagnose(SHAPE, exchanged, "auto")
    assert hint.startswith("The files look exchanged")
    assert len(calls) == 3


@pytest.mark.long
def test_a_scheme_that_is_given_is_the_only_one_read():
    marked = marker_of("low").embed(b"ab", 4e-4)[0]
    assert jm.detect(marked, original=SHAPE, key=jm.Key(bytes(32)), bits=16).message == b"ab"
    low = replace(KeyedScheme(), passband="low")
    alone = alternatives(jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=16, scheme=low), low)
    assert alone.read(marked)[0].message == b"ab"
    other = alternatives(jm.make_marker(SHAPE, jm.Key(bytes(32)), bits=16, scheme=KeyedScheme()), KeyedScheme())
    assert other.read(marked)[0].message is None


def test_evidence_grows_with_the_mark_up_to_half_of_the_dimensions():
    capacity = Capacity(faint().original, KeyedScheme(passband="low"))
    sizes = [1e-5, 1e-4, 1e-3, 1.0]
    values = [capacity.evidence(16, size, NOISE) for size in sizes]
    assert values == sorted(values)
    assert values[-1] == pytest.approx(capacity._free_dimensions(16).dimensions.sum() / 2, rel=1e-3)
    assert capacity.needed(16, values[1], NOISE) == pytest.approx(sizes[1], rel=1e-6)
    assert capacity.needed(16, 2 * values[-1], NOISE) == math.inf


@pytest.mark.long
def test_tuning_begins_with_the_band_that_suits():
    tuned = tune(SHAPE, [("noise", 0.005)], FAINT, seed=jax.random.key(0), bits=16, margin="evidence")
    assert tuned.report.default_trials.min() > 1.1 * evidence("tapered", FAINT)[0]
    assert tuned.report.trials.min() >= tuned.report.default_trials.min()
