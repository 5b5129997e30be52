"""Claims by somebody who did not mark: each attack works where what it meets is taken away, and fails as things are."""

import math
from dataclasses import replace

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries.ambiguity import forge_original, search_key, transplant
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.mark import bind_mark
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import bumpy_sphere

MESSAGE, FORGED = b"ok", b"my"
FORGER = jm.Key(bytes(range(32, 64)))


@pytest.fixture(scope="module")
def original() -> Mesh:
    return bumpy_sphere(3)


@pytest.fixture(scope="module")
def published(original: Mesh, key: jm.Key) -> tuple[Mesh, jm.Record]:
    marked, info = jm.make_marker(original, key, bits=16).embed(MESSAGE, jm.Budget(rms=8e-4, noise=0))
    return marked, info.record


@pytest.fixture(scope="module")
def forged(published: tuple[Mesh, jm.Record]) -> Mesh:
    return forge_original(published[0], FORGER, FORGED, budget=8e-4)


def unbound(original: Mesh, other: Mesh, key: bytes) -> NonBlindMarker:
    """A marker whose choices hang on another mesh's hash: what they would be if they did not depend on the original."""
    bound, scheme = make_original(other), KeyedScheme()
    ready = replace(make_original(original), geometry=bound.geometry, order=bound.order)
    code = scheme.code_length(ready, 16)
    choices = bind_mark(key, ready, scheme, 16, "message")
    carrier = scheme.carrier(ready, choices, 16, code)
    return NonBlindMarker(ready, choices, 16, scheme, carrier, code, carrier.detector)


@pytest.mark.slow
def test_inversion_fails_only_by_the_hash(published, forged):
    mesh, _ = published
    assert jm.distortion.displacement_size(forged, mesh).rms == pytest.approx(8e-4, rel=1e-2)
    # Did the choices not depend on the original, the forger would have his claim ...
    without = unbound(forged, mesh, FORGER)
    assert without.detect(mesh, FORGED).log10_p < -20
    assert without.detect(mesh).message == FORGED
    # ... and with any luck in the world he does not: 1e-6 is one in a million keys.
    as_it_is = jm.detect(mesh, original=forged, key=FORGER, message=FORGED)
    assert as_it_is.log10_p > -6
    assert jm.detect(mesh, original=forged, key=FORGER, bits=16).message is None


@pytest.mark.slow
def test_going_round_does_not_help(published):
    """The forged original is made anew for the hash of the last one: it never settles."""
    mesh, _ = published
    last, found = mesh, []
    for _ in range(4):
        mark = (
            jm.make_marker(last, FORGER, bits=16)
            .embed(FORGED, jm.Budget(rms=8e-4, noise=0), read_back="never")[0]
            .vertices
        )
        last = Mesh(mesh.vertices - (mark - last.vertices), mesh.faces)
        found.append(jm.detect(mesh, original=last, key=FORGER, message=FORGED).log10_p)
    assert min(found) > -6


@pytest.mark.slow
def test_the_owner_has_the_forgers_original_too(original, published, forged, key: jm.Key):
    """Whose original holds the other's mark says who was first: the owner's does not hold the forger's."""
    owner = jm.make_marker(original, key, bits=16)
    assert owner.detect(forged, MESSAGE).log10_p < -20
    forger = unbound(forged, published[0], FORGER)
    assert forger.detect(original, FORGED).log10_p < -12, "so it does without the hash: the deadlock of the inversion"
    assert jm.detect(original, original=forged, key=FORGER, message=FORGED).log10_p > -6


def test_records_refuse_by_name(original, published, forged, key: jm.Key):
    mesh, record = published
    moved = np.asarray(original.vertices) + 1e-3 * np.random.default_rng(0).normal(size=original.vertices.shape)
    for other in (forged, Mesh(moved, original.faces)):
        with pytest.raises(jm.JaxmarkError, match="not the mesh that the record was made for"):
            jm.make_marker(other, key, record=record)
        with pytest.raises(jm.JaxmarkError, match="not the mesh that the record was made for"):
            jm.detect(mesh, original=other, key=key, message=MESSAGE, record=record)
    for ask in (
        lambda: jm.make_marker(original, FORGER, record=record),
        lambda: jm.detect(mesh, original=original, key=FORGER, message=MESSAGE, record=record),
    ):
        with pytest.raises(jm.JaxmarkError, match="not the one that the record commits to"):
            ask()
    assert jm.detect(mesh, original=original, key=key, message=MESSAGE, record=record).detected()
    # Without the record, an original that differs has other chips, and shows nothing.
    assert jm.detect(mesh, original=Mesh(moved, original.faces), key=key, message=MESSAGE).log10_p > -6


@pytest.mark.slow
def test_searching_keys_pays_as_chance_does(original, published):
    """The number of keys with log10 p ≤ -x is at most binomial of probability 10^-x, and as a normal score has it."""
    keys = 300
    found = search_key(published[0], original, FORGED, keys, seed=1).log10_p
    for x in (0.5, 1.0, 1.5, 2.0):
        bound = keys * 10**-x
        assert np.sum(found <= -x) <= bound + 3 * np.sqrt(bound)
    # S/‖a‖ > 1.2816 has probability 0.1 if S is normal, which Hoeffding's bound does not reach: the bound is not idle.
    likely = np.sum(found <= -(1.2816**2) / 2 / np.log(10))
    assert abs(likely - keys / 10) < 4 * np.sqrt(keys * 0.09)


def test_searching_agrees_with_detection(original, published, key: jm.Key):
    search = search_key(published[0], original, FORGED, 60, seed=2)
    again = jm.make_marker(original, search.key, bits=16).detect(published[0], FORGED)
    # A detection pays for how it aligns, and for what else may read.
    paid = -math.log10(0.97**2)
    assert search.log10_p.min() + paid == pytest.approx(again.log10_p, rel=1e-4)
    assert len(set(search.log10_p)) > 3  # most prove nothing once both ways of weighing are paid for
    assert isinstance(search.key, jm.Key)


def test_a_mark_moved_elsewhere(original, published, key: jm.Key):
    """The copy attack: evidence on what is compared with the same original, none under another's."""
    mesh, _ = published
    owner = jm.make_marker(original, key, bits=16)
    clean = jm.attack(original, "noise", 2e-4, seed=0)
    assert owner.detect(clean, MESSAGE).log10_p > -6
    # Onto the unmarked original, rough as it came from elsewhere: with the whole mark, the claim goes along.
    assert owner.detect(transplant(mesh, original, clean), MESSAGE).log10_p < -20
    # Under the same key, on another's mesh of the same connectivity, read with that one's original: nothing.
    target = Mesh(original.vertices * [1.1, 0.9, 1.0] + 0.02 * np.sin(3 * original.vertices), original.faces)
    moved = transplant(mesh, original, target)
    assert jm.detect(moved, original=target, key=key, message=MESSAGE).log10_p > -6
    # The control: with choices that do not hang on the original, it would be there.
    assert unbound(target, original, key).detect(moved, MESSAGE).log10_p < -20
    np.testing.assert_allclose(moved.vertices - target.vertices, mesh.vertices - original.vertices, atol=1e-12)


def test_refusals(original, published):
    with pytest.raises(jm.JaxmarkError, match="at least 1 key"):
        search_key(published[0], original, FORGED, 0)
    with pytest.raises(jm.JaxmarkError, match="one connectivity"):
        transplant(published[0], original, bumpy_sphere(2))
