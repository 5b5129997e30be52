"""Probabilities that hold, and that are not empty."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.carriers import ModulatedCarrier
from jaxmark.evidence import FLOOR, log10_p_claimed, log10_p_tag
from jaxmark.marking import make_marker
from jaxmark.message import TAG_BITS, code_length, decode, encode
from jaxmark.original import prepare, residual
from jaxmark.schemes import HostScheme
from jaxmark.sequences import orthogonal_sequences
from tests.samples import bumpy_sphere


def test_hoeffding_by_hand():
    assert log10_p_claimed(3.0, 1.0) == pytest.approx(math.log10(math.exp(-4.5)))
    for score, norm in [(0, 0), (0, 1), (-5, 1), (math.nan, 1), (1, math.nan), (math.inf, 1), (1, 0)]:
        assert log10_p_claimed(score, norm) == 0.0
    assert log10_p_claimed(1e9, 1.0) == FLOOR == -77.0


def test_hoeffding_bounds_the_exact_distribution():
    """All 2^14 sign patterns of unequal terms: the bound is above the exact tail at every score."""
    terms = np.random.default_rng(0).exponential(size=14)
    signs = 1 - 2 * ((np.arange(2**14)[:, None] >> np.arange(14)) & 1)
    scores = np.sort(signs @ terms)[::-1]
    tail = np.arange(1, len(scores) + 1) / len(scores)
    bound = np.array([10 ** log10_p_claimed(score, np.linalg.norm(terms)) for score in scores])
    assert (bound >= tail - 1e-12)[scores > 0].all()


def test_tag_probability():
    assert log10_p_tag(32) == pytest.approx(math.log10(2.0**-32))
    assert log10_p_tag(1000) == FLOOR


def test_false_positive_rates_of_unmarked_suspects():
    """Nominal against counted, over keys, through the functions that `detect` calls, on hard suspects.

    At each level the exact lower confidence limit (99.9 %) of the rate must not exceed the nominal one, and the rate
    must be at least a thirtieth of it: a bound that never fires proves nothing. With the keyed signs left out of the
    carrier, as a control, the same check must fail.
    """
    mesh = bumpy_sphere(2)
    original = prepare(mesh)
    scheme = HostScheme(bands=32)
    bits = 8
    first = scheme.carrier(original, jm.Key(bytes(32)), code_length(bits))
    assert isinstance(first, ModulatedCarrier)
    other, _ = jm.embed(mesh, b"x", jm.Key(bytes([9] * 32)), scheme=scheme)
    suspects = jnp.stack(
        [
            jnp.asarray(residual(original, suspect), jnp.float32)
            for suspect in (
                jm.attack(mesh, "noise", 0.005, seed=1),
                jm.attack(mesh, "smoothing", 5, seed=0),
                jm.attack(mesh, "quantisation", 6, seed=0),
                other,
                mesh._replace(vertices=1.05 * mesh.vertices),
            )
        ]
    )

    @jax.jit
    def claims(sequences, codeword):
        carrier = first._replace(sequences=sequences)
        return jax.vmap(lambda r: carrier.claim(r, codeword))(suspects)

    counts = {}
    trials = 3000
    for signed in (True, False):
        found = []
        for seed in range(trials if signed else 200):
            key = jm.Key(seed.to_bytes(32, "little"))
            sequences = orthogonal_sequences(key, original.geometry, code_length(bits), 96)
            if not signed:
                sequences = np.abs(sequences)
            codeword = jnp.asarray(encode(b"m", key, original.geometry), jnp.float32)
            score, norm = claims(sequences.reshape(-1, 32, 3), codeword if signed else jnp.abs(codeword))
            found += [log10_p_claimed(s, n) for s, n in zip(np.asarray(score), np.asarray(norm), strict=True)]
        counts[signed] = np.array(found)

    def holds(values: np.ndarray) -> bool:
        levels = (1e-1, 1e-2, 1e-3)  # the last is too rare here to ask that it fires
        hits = [int(np.sum(values <= np.log10(level))) for level in levels]
        lower = [stats.beta.ppf(1e-3, hit, len(values) - hit + 1) if hit else 0.0 for hit in hits]
        fires = all(hit >= level * len(values) / 30 for hit, level in zip(hits[:2], levels[:2], strict=True))
        return fires and all(low <= level for low, level in zip(lower, levels, strict=True))

    assert holds(counts[True])
    assert not holds(counts[False])


def test_wrong_keys_and_other_suspects_read_nothing(sphere):
    marked, _ = jm.embed(sphere, b"original", jm.new_key())
    for suspect in (marked, jm.attack(sphere, "noise", 0.003, seed=2), sphere):
        for seed in range(5):
            found = make_marker(sphere, jm.Key(bytes([seed] * 32))).detect(suspect)
            assert found.message is None
            assert found.log10_p == 0.0
            assert not found.detected()


def test_a_guessed_codeword_passes_a_tag_as_often_as_its_length_says(key: jm.Key, monkeypatch):
    """With the tag cut to 8 bits, 1 in 256 random readings passes."""
    monkeypatch.setattr("jaxmark.message.TAG_BITS", 8)
    random = np.random.default_rng(3)
    passed = sum(decode(random.normal(size=24), key, b"") is not None for _ in range(20000))
    assert stats.binomtest(passed, 20000, 1 / 256).pvalue > 1e-6


def test_codewords(key: jm.Key, unchecked):
    code = encode(b"\x80\x01", key, b"")
    assert len(code) == 16 + TAG_BITS == code_length(16)
    np.testing.assert_array_equal(code[:16], [1, *[-1] * 14, 1])
    assert decode(0.3 * code, key, b"") == b"\x80\x01"
    assert decode(code, key, b"other mesh") is None
    assert decode(0 * code, key, b"") is None
    turned = code.copy()
    turned[3] *= -1
    assert decode(turned, key, b"") is None
    for bits in (0, -8, 12):
        with pytest.raises(jm.JaxmarkError, match="multiple of 8"):
            code_length(bits)
