"""Attackers with several copies: by definition, by geometry, and against one copy alone."""

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries.collusion import Rule, collude, combine
from jaxmark.adversaries.oracle import score_oracle
from jaxmark.geometry.mesh import Mesh
from tests.samples import bumpy_sphere

RANDOM = np.random.default_rng(0)


@pytest.fixture(scope="module")
def marker(key: jm.Key) -> jm.watermark.NonBlindMarker:
    return jm.make_marker(bumpy_sphere(3), key, bits=16)


@pytest.fixture(scope="module")
def copies(marker: jm.watermark.NonBlindMarker) -> dict[bytes, Mesh]:
    messages = [b"ok", b"no", b"so", b"we", b"it", b"he"]
    return {one: marker.embed(one, jm.Budget(rms=8e-4, noise=0), read_back="never")[0] for one in messages}


@pytest.mark.parametrize(
    ("rule", "wanted"),
    [("mean", [1, 6, 3]), ("median", [1, 5, 3]), ("minimum", [0, 4, 3]), ("maximum", [2, 9, 3])],
)
def test_rules_by_definition(rule, wanted):
    values, way = np.array([[0, 1, 2], [4, 5, 9], [3, 3, 3]]), np.array([1.0, 0.0, -0.0])
    copies = [Mesh(np.outer(one, way), np.array([[0, 1, 2]])) for one in values.T]
    np.testing.assert_allclose(combine(copies, rule, RANDOM).vertices, np.outer(wanted, way))


def test_points_are_mixed_whole(copies):
    few = list(copies.values())[:3]
    soup = [Mesh(one.vertices[one.faces].reshape(-1, 3), np.arange(one.faces.size).reshape(-1, 3)) for one in few]
    mixed = combine(soup, "mixing", np.random.default_rng(0)).vertices
    from_which = np.array([(mixed == one.vertices).all(axis=1) for one in soup])
    assert (from_which.sum(axis=0) == 1).all()
    # All copies of a point are from one mesh, and each mesh gives about a third.
    which, point = from_which.argmax(axis=0), few[0].faces.ravel()
    assert all(len(set(which[point == one])) == 1 for one in range(len(few[0].vertices)))
    assert np.bincount(which) / len(which) == pytest.approx(1 / 3, abs=0.1)


def test_the_circumcentre_is_as_far_from_all_copies(copies, marker: jm.watermark.NonBlindMarker):
    every = list(copies.values())
    centre = combine(every, "circumcentre", RANDOM).vertices
    far = [np.linalg.norm(one.vertices - centre) for one in every]
    np.testing.assert_allclose(far, far[0], rtol=1e-6)
    # It is the original's projection on the hull: the rest of the way is normal to all sides.
    rest = marker.original.mesh.vertices - centre
    sides = np.array([np.sum(rest * (one.vertices - every[0].vertices)) for one in every[1:]])
    assert np.abs(sides).max() < 1e-4 * far[0] ** 2
    mean = combine(every, "mean", RANDOM).vertices
    assert np.linalg.norm(rest) <= np.linalg.norm(marker.original.mesh.vertices - mean)


@pytest.mark.slow
def test_enough_copies_give_the_original_back(key: jm.Key):
    """Marks of one key lie in a space of as many dimensions as the code has bits: more copies span it."""
    marker = jm.make_marker(bumpy_sphere(2), key, bits=16)
    messages = [bytes(one) for one in np.random.default_rng(0).integers(0, 256, (marker.code_bits + 20, 2), np.uint8)]
    copies = [marker.embed(one, jm.Budget(rms=8e-4, noise=0), read_back="never")[0] for one in messages]
    original = marker.original.mesh.vertices

    def left(rule: Rule, count: int) -> float:
        """Of the mark, over that of one copy."""
        found = combine(copies[:count], rule, RANDOM).vertices
        return float(np.linalg.norm(found - original) / np.linalg.norm(copies[0].vertices - original))

    assert left("circumcentre", len(copies)) < 1e-4
    assert left("circumcentre", 20) > 0.1
    assert left("mean", len(copies)) > 0.01


@pytest.mark.parametrize("rule", ["mean", "median", "minimum", "maximum", "mixing", "circumcentre"])
def test_several_copies_are_worth_more_than_one(marker, copies, rule):
    score = score_oracle(marker, b"ok")
    mesh, *others = copies.values()
    alone = jm.attack(mesh, "jamming", 2e-3, seed=0)
    together = jm.attack(mesh, collude(others, rule), 2e-3, seed=0)
    assert score(together) < score(alone) - 1


def test_strength_is_of_the_jamming(copies):
    mesh, *others = copies.values()
    attack = collude(others, "mean")
    bare, jammed = (jm.attack(mesh, attack, strength, seed=0) for strength in (0, 1e-3))
    np.testing.assert_allclose(bare.vertices, np.mean([one.vertices for one in copies.values()], axis=0), atol=1e-12)
    assert jm.distortion.displacement_size(bare, jammed).rms == pytest.approx(1e-3, rel=1e-3)


def test_refusals(copies, unchecked):
    _, *others = copies.values()
    with pytest.raises(jm.JaxmarkError, match="no rule 'mode'"):
        collude(others, "mode")  # pyright: ignore[reportArgumentType]
    with pytest.raises(jm.JaxmarkError, match="copies of one connectivity"):
        jm.attack(bumpy_sphere(2), collude(others, "mean"), 1e-3, seed=0)
    with pytest.raises(jm.JaxmarkError, match="these 0 copies"):
        combine([], "mean", RANDOM)
