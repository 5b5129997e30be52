"""From a message to the code bits and back: what the tag binds, and how often chance passes it."""

import math

import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.watermark.coding import polar
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import CANDIDATES, TAG_BITS, code_length, decode, encode

pytestmark = pytest.mark.core

MESSAGE = bytes.fromhex("0123456789abcdef")


def read(scores, bits: int, choices: Choices, candidates: int = CANDIDATES) -> bytes | None:
    """The message, if its tag fits among so many candidates."""
    found = decode(scores, bits, choices)
    return None if found is None or found.rank > candidates else found.message


def test_codeword_is_the_message_and_its_tag(key: jm.Key):
    """The code bits undone by the transform: frozen zeros, the message's bits, the tag's bits."""
    code = encode(MESSAGE, Choices(key, b"mesh"), 1024)
    assert set(code) == {-1.0, 1.0}
    inputs = polar.encode((code < 0).astype(int), 1024)
    fixed = polar.frozen_inputs(1024, 64 + TAG_BITS)
    assert not inputs[fixed].any()
    said = "".join(map(str, inputs[~fixed]))
    assert int(said[:64], 2) == int.from_bytes(MESSAGE, "big")
    tag = int.from_bytes(Choices(key, b"mesh").derive("tag", 4, MESSAGE), "big") >> (32 - TAG_BITS)
    assert int(said[64:], 2) == tag


def test_the_codeword_never_changes(key: jm.Key):
    """If this fails, marks in the world no longer read."""
    code = encode(MESSAGE, Choices(key, b""), 128)
    assert np.packbits(code < 0).tobytes().hex() == "8a47d1849234e42542525d2aa5de9774"


@pytest.mark.parametrize(("size", "length"), [(1, 64), (8, 128), (8, 1024), (32, 2048), (128, 2048)])
def test_round_trip(key: jm.Key, size: int, length: int):
    """At any scale, and with some code bits wrong and some unknown where the code has room for it."""
    random = np.random.default_rng(size)
    message = random.bytes(size)
    code = encode(message, Choices(key, b"mesh"), length)
    for factor in (1e-30, 1.0, 1e30):
        assert read(factor * code, 8 * size, Choices(key, b"mesh")) == message
    if length > 4 * (8 * size + TAG_BITS):
        hurt = code.copy()
        hurt[random.random(length) < 0.1] *= -1
        hurt[random.random(length) < 0.2] = 0
        assert read(hurt, 8 * size, Choices(key, b"mesh")) == message


def test_the_tag_binds_key_and_geometry_and_message(key: jm.Key):
    code = encode(MESSAGE, Choices(key, b"mesh"), 512)
    assert read(code, 64, Choices(key, b"mesh")) == MESSAGE
    assert decode(code, 64, Choices(key, b"other mesh")) is None
    assert decode(code, 64, Choices(jm.Key(bytes(32)), b"mesh")) is None
    other = encode(MESSAGE[::-1], Choices(key, b"mesh"), 512)
    # The code is linear: the product of three codewords is the codeword of the sum, here message bits with wrong tags.
    zero = encode(bytes(8), Choices(key, b"mesh"), 512)
    assert decode(code * other * zero, 64, Choices(key, b"mesh")) is None


def test_a_wrong_tag_gives_nothing(key: jm.Key):
    """Each bit of the tag turned in turn: one candidate, and that is refused; with more, it is the only close one."""
    word = np.r_[np.unpackbits(np.frombuffer(MESSAGE, np.uint8)), np.zeros(TAG_BITS, np.uint8)]
    tag = np.unpackbits(np.frombuffer(Choices(key, b"").derive("tag", 4, MESSAGE), np.uint8))[:TAG_BITS]
    for turned in range(TAG_BITS):
        word[64:] = tag
        word[64 + turned] ^= 1
        assert read(1.0 - 2.0 * polar.encode(word, 1024), 64, Choices(key, b""), candidates=1) is None
    word[64:] = tag
    assert read(1.0 - 2.0 * polar.encode(word, 1024), 64, Choices(key, b""), candidates=1) == MESSAGE


def test_nothing_seen_gives_nothing(key: jm.Key):
    assert decode(np.zeros(1024), 64, Choices(key, b"")) is None


@pytest.mark.parametrize(("candidates", "trials"), [pytest.param(8, 1000, marks=pytest.mark.slow), (CANDIDATES, 500)])
def test_chance_passes_as_often_as_the_tag_says(
    key: jm.Key, monkeypatch: pytest.MonkeyPatch, candidates: int, trials: int
):
    """With a tag of 8 bits, random soft values pass with probability 1 - (1 - 2^-8)^candidates ≤ candidates · 2^-8.

    As a control, half or twice as many would be noticed.
    """
    monkeypatch.setattr("jaxmark.watermark.coding.message.TAG_BITS", 8)
    random = np.random.default_rng(7)
    passed = sum(read(random.normal(size=32), 8, Choices(key, b""), candidates) is not None for _ in range(trials))
    exact = 1 - (1 - 2**-8) ** candidates

    def plausible(count: int) -> bool:
        above = stats.binomtest(count, trials, candidates / 256, alternative="greater").pvalue
        below = stats.binomtest(count, trials, exact, alternative="less").pvalue
        return bool(min(above, below) > 2e-3)

    assert plausible(passed)
    assert not plausible(round(exact / 2 * trials))
    assert not plausible(round(2 * candidates / 256 * trials))


def test_chance_does_not_pass_the_whole_tag(key: jm.Key):
    random = np.random.default_rng(8)
    assert all(decode(random.normal(size=128), 64, Choices(key, b"")) is None for _ in range(30))


def test_code_length():
    """The largest power of two within the places and within `spread` for each bit of message and tag."""
    for bits in (8, 64, 256, 1024):
        for spread in (2, 12):
            for places in (2**11, 3000, 2**14):
                limit = min(places, spread * (bits + TAG_BITS))
                assert code_length(bits, places, spread) == 2 ** math.floor(math.log2(limit))
    assert code_length(64, 128, 12) == code_length(64, 255, 12) == 128


@pytest.mark.parametrize("bits", [-8, 12, 1])
def test_payloads_of_no_whole_bytes_are_refused(bits: int):
    with pytest.raises(jm.JaxmarkError, match="multiple of 8"):
        code_length(bits, 4096, 12)


@pytest.mark.parametrize("places", [0, 1, 20, 64, 127])
def test_payloads_that_do_not_fit_are_refused(places: int):
    """And the refusal names the largest that does, if there is one."""
    with pytest.raises(jm.JaxmarkError, match=r"at most 32 bits|too few for any message") as refusal:
        code_length(64, places, 12)
    most = 32 if "at most 32 bits" in str(refusal.value) else 0
    assert most == (32 if places >= 64 else 0)
    if most:
        code_length(most, places, 12)
    with pytest.raises(jm.JaxmarkError, match="do not fit"):
        code_length(most + 8, places, 12)
