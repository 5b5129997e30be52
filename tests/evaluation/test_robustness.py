"""Robustness curves against attacks and readings one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.attacks import Attack
from jaxmark.evaluation import minimum_distortion
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import decode, encode, guess
from tests.samples import bumpy_sphere

MESSAGE = b"ok"


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(3), key, bits=16)
    return marker, marker.embed(MESSAGE, jm.Budget(rms=2e-3, noise=0))[0]


def test_a_curve_is_what_attack_and_detect_say(marked):
    marker, mesh = marked
    found = jm.robustness(marker, mesh, MESSAGE, "noise", [0.002, 0.2], samples=2)
    np.testing.assert_array_equal(found.strengths, [0.002, 0.2])
    for place, strength in enumerate((0.002, 0.2)):
        for seed in range(2):
            one = marker.detect(jm.attack(mesh, "noise", strength, seed=seed))
            assert found.success[place, seed] == (one.message == MESSAGE)
            assert found.log10_p[place, seed] == one.log10_p
    assert found.success.tolist() == [[True, True], [False, False]]
    assert (found.bit_errors[0] == 0).all()
    assert (found.bit_errors[1] > 0).all()
    assert found.refusals == (("", ""), ("", ""))


@pytest.mark.slow
def test_an_attack_of_ones_own_and_a_refusal(marked):
    marker, mesh = marked

    def flatten(mesh: Mesh, strength: float, key: jax.Array) -> Mesh:
        return Mesh(jnp.asarray(mesh.vertices) * jnp.array([1, 1, 1 - strength]), mesh.faces)

    def replace(mesh: Mesh, strength: float, key: jax.Array) -> Mesh:
        square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
        return Mesh(square, np.array([[0, 1, 2], [1, 3, 2]]))

    squashed = jm.robustness(marker, mesh, MESSAGE, Attack(flatten, "share of the height", (0.4,)), samples=1)
    assert squashed.success.all()
    np.testing.assert_array_equal(squashed.strengths, [0.4])
    lost = jm.robustness(marker, mesh, MESSAGE, Attack(replace, "none", (1.0,), host=True), samples=1)
    assert (lost.success.item(), lost.bit_errors.item(), lost.log10_p.item()) == (False, 0.5, 0)
    assert "align" in lost.refusals[0][0]


def test_the_best_guess_is_the_message_without_its_tag(key: jm.Key):
    code = encode(b"guess me", Choices(key, b"geometry"), 256)
    assert guess(code + 0.3 * np.random.default_rng(0).normal(size=256), 64) == b"guess me"
    assert guess(np.zeros(256), 64) is None
    # Under another key the tag fits no more, and the guess is the same.
    assert decode(code, 64, Choices(jm.Key(bytes(32)), b"geometry")) is None
    wrong = guess(np.random.default_rng(1).normal(size=256), 64)
    assert wrong is not None
    assert wrong != b"guess me"


def test_refusals(marked):
    with pytest.raises(jm.JaxmarkError, match="a strength and a sample, got 0 and 5"):
        jm.robustness(*marked, MESSAGE, "noise", [])
    with pytest.raises(jm.JaxmarkError, match="no attack 'melting'"):
        jm.robustness(*marked, MESSAGE, "melting")


@pytest.mark.slow
def test_the_least_that_breaks_a_mark_lies_between_what_does_and_what_does_not(marked):
    marker, mesh = marked
    wide = jm.adversaries.ATTACKS["noise"]._replace(strengths=(0.001, 0.3))
    found = minimum_distortion(marker, mesh, MESSAGE, wide, metrics=["rms", "dame"])
    held = [one for one in found.curve if one.log10_p <= -6]
    assert found.weakest is not None
    assert found.weakest.strength == min(one.strength for one in found.curve if one.log10_p > -6)
    assert max(one.strength for one in held) < found.weakest.strength < 1.06 * max(one.strength for one in held)
    for one in found.curve:
        suspect = jm.attack(mesh, "noise", one.strength, seed=0)
        assert one.log10_p == marker.detect(suspect, MESSAGE).log10_p
        assert one.distortion.rms == jm.distortion.displacement_size(mesh, suspect).rms
    own = jm.distortion.displacement_size(marker.original.mesh, mesh).rms
    assert found.cost("rms") == pytest.approx(found.weakest.distortion.rms / own)
    assert np.isnan(found.cost("msdm2"))  # not asked for


@pytest.mark.slow
def test_whole_strengths_and_attacks_that_never_or_always_succeed(marked):
    marker, mesh = marked
    coarse = minimum_distortion(
        marker, mesh, MESSAGE, jm.adversaries.ATTACKS["quantisation"]._replace(strengths=(10, 2))
    )
    assert [one.strength for one in coarse.curve] == sorted((one.strength for one in coarse.curve), reverse=True)
    assert coarse.weakest is not None
    bits = int(coarse.weakest.strength)
    assert [one.strength for one in coarse.curve if one.log10_p <= -6][-1] == bits + 1
    noise = jm.adversaries.ATTACKS["noise"]
    mild = minimum_distortion(marker, mesh, MESSAGE, noise._replace(strengths=(1e-4, 2e-4)), metrics=["rms"])
    assert (mild.weakest, mild.cost("rms"), len(mild.curve)) == (None, np.inf, 1)
    harsh = minimum_distortion(marker, mesh, MESSAGE, noise._replace(strengths=(1, 2)), metrics=["rms"])
    assert harsh.weakest == harsh.curve[0]
    assert harsh.weakest.strength == 1
    with pytest.raises(jm.JaxmarkError, match="positive to be bisected"):
        minimum_distortion(marker, mesh, MESSAGE, noise._replace(strengths=(0, 2)))
