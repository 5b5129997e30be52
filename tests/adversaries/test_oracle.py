"""Attackers who ask a detector: against what chance does with as much, and by the letter of what they are allowed."""

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries.oracle import (
    Counted,
    boundary,
    decide_by_score,
    decision_oracle,
    estimated_gradient,
    quantise_scores,
    random_search,
    randomise_scores,
    score_oracle,
)
from jaxmark.geometry.mesh import Mesh
from tests.samples import bumpy_sphere

MESSAGE = b"ok"
SCORED = [estimated_gradient, random_search]


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(3), key, bits=16)
    return marker, marker.embed(MESSAGE, jm.Budget(rms=8e-4, noise=0))[0]


def along(mesh: Mesh, way: np.ndarray) -> Counted:
    """A score that falls evenly along one displacement."""
    return Counted(lambda suspect: -float(np.sum((suspect.vertices - mesh.vertices) * way)))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "strength"), [("jamming", 0.0047), ("noise", 0.017)])
def test_oracles_say_what_the_detector_says(marked, kind, strength):
    marker, mesh = marked
    suspect = jm.attack(mesh, kind, strength, seed=0)
    found, score = marker.detect(suspect, MESSAGE), score_oracle(marker, MESSAGE)(suspect)
    # Hoeffding's bound is the score's square, over 2 ln 10; rounding is taken off it, and what else might have been
    # read or aligned is paid for.
    assert -77 < found.log10_p < 0
    assert found.log10_p == pytest.approx(-(score**2) / 2 / np.log(10) - 2 * np.log10(0.97), rel=1e-4)
    for alpha in (1e-6, 10 ** (found.log10_p + 0.1), 10 ** (found.log10_p - 0.1)):
        wanted = found.detected(alpha)
        assert decision_oracle(marker, MESSAGE, alpha)(suspect) == wanted
        assert decide_by_score(score_oracle(marker, MESSAGE), alpha)(suspect) == wanted


@pytest.mark.slow
def test_what_is_refused_is_not_detected(marked):
    marker, _ = marked
    other = jm.make_mesh(np.eye(3), np.array([[0, 1, 2]]))
    assert score_oracle(marker, MESSAGE)(other) == 0
    assert not decision_oracle(marker, MESSAGE)(other)


def test_copies_of_points_are_attacked_together(marked):
    marker, mesh = marked
    # A file without shared vertices: each face has three of its own.
    soup = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))
    attack = estimated_gradient(score_oracle(marker, MESSAGE), queries=8)
    moved = jm.attack(soup, attack, 1e-3, seed=0)
    assert jm.distortion.displacement_size(soup, moved).rms == pytest.approx(1e-3, rel=0.5)
    joined = moved.vertices[np.unique(mesh.faces, return_index=True)[1]]
    np.testing.assert_array_equal(moved.vertices, joined[mesh.faces].reshape(-1, 3))


@pytest.mark.parametrize("make", SCORED)
def test_queries_and_size_are_met(marked, make):
    _, mesh = marked
    way = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    for queries in (2, 3, 9, 41):
        oracle = along(mesh, way)
        moved = jm.attack(mesh, make(oracle, queries=queries), 1e-3, seed=0)
        assert queries - 8 < oracle.queries <= queries
        assert jm.distortion.displacement_size(mesh, moved).rms == pytest.approx(1e-3, rel=1e-6)


@pytest.mark.parametrize("queries", [0, 1, 5, 17, 60])
def test_queries_of_decisions_are_met(marked, queries):
    _, mesh = marked
    # A ball of displacements is detected, wherever it is left.
    oracle = Counted(lambda suspect: bool(np.linalg.norm(suspect.vertices - mesh.vertices) < 0.3))
    moved = jm.attack(mesh, boundary(oracle), queries, seed=0)
    assert oracle.queries == queries
    assert queries < 12 or not oracle(moved)


def test_what_cannot_be_hidden_is_left_alone(marked):
    _, mesh = marked
    oracle = Counted(lambda _: True)
    moved = jm.attack(mesh, boundary(oracle), 100, seed=0)
    np.testing.assert_array_equal(moved.vertices, mesh.vertices)
    assert oracle.queries < 100


@pytest.mark.parametrize("make", SCORED)
def test_an_even_slope_is_found(marked, make):
    _, mesh = marked
    # Of a slope that looks like a mark, chance finds 1/√dimensions, and this much more.
    way = jm.attack(mesh, "jamming", 1e-3, seed=5).vertices - mesh.vertices
    moved = jm.attack(mesh, make(along(mesh, way), queries=400), 1e-3, seed=0).vertices - mesh.vertices
    assert np.sum(moved * way) / np.linalg.norm(moved) / np.linalg.norm(way) > 0.5


def test_the_nearest_of_two_planes_is_neared(marked):
    _, mesh = marked
    way = jm.attack(mesh, "jamming", 1e-3, seed=5).vertices - mesh.vertices

    def before(suspect: Mesh) -> bool:
        return bool(abs(np.sum((suspect.vertices - mesh.vertices) * way)) < np.sum(way**2))

    sizes = [
        jm.distortion.displacement_size(mesh, jm.attack(mesh, boundary(before), queries, seed=0)).rms
        for queries in (40, 160, 480)
    ]
    # The least is the way itself; a random start is farther by about √dimensions.
    assert 1e-3 < sizes[2] < sizes[1] < sizes[0]
    assert sizes[2] < 2e-3


def test_defences(marked, key: jm.Key):
    _, mesh = marked
    other = mesh._replace(vertices=mesh.vertices + 1e-9)
    assert [quantise_scores(lambda _, value=v: value, 0.5)(mesh) for v in (1.2, 1.3, -0.3)] == [1.0, 1.5, -0.5]
    noisy = randomise_scores(lambda _: 3.0, 0.1, key)
    assert noisy(mesh) == noisy(mesh) != noisy(other)
    shifted = [mesh._replace(vertices=mesh.vertices + k) for k in range(300)]
    noise = np.array([noisy(one) - 3 for one in shifted]) / 0.1
    assert abs(noise.mean()) < 4 / np.sqrt(300)
    assert noise.std() == pytest.approx(1, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("make", [estimated_gradient, random_search])
def test_answers_beat_chance(marked, make):
    marker, mesh = marked
    score = score_oracle(marker, MESSAGE)
    attack = make(score, queries=40)
    chance = min(score(jm.attack(mesh, "jamming", 2e-3, seed=seed)) for seed in range(5))
    assert score(jm.attack(mesh, attack, 2e-3, seed=0)) < chance - 0.5


@pytest.mark.long
def test_decisions_beat_chance(marked):
    marker, mesh = marked
    oracle = Counted(decide_by_score(score_oracle(marker, MESSAGE)))
    moved = jm.attack(mesh, boundary(oracle), 100, seed=0)
    assert oracle.queries == 100
    assert not marker.detect(moved, MESSAGE).detected()
    wide = jm.adversaries.ATTACKS["jamming"]._replace(strengths=(1e-3, 0.1))
    jammed = jm.evaluation.minimum_distortion(marker, mesh, MESSAGE, wide, metrics=("rms",)).weakest
    assert jammed is not None
    assert jm.distortion.displacement_size(mesh, moved).rms < jammed.strength


def test_refusals(marked):
    marker, _ = marked
    with pytest.raises(jm.JaxmarkError, match="24 bits, but the payload is 16"):
        score_oracle(marker, b"too")
    with pytest.raises(jm.JaxmarkError, match="must be in"):
        decision_oracle(marker, MESSAGE, 2.0)
    with pytest.raises(jm.JaxmarkError, match="at least 2 queries"):
        estimated_gradient(len, queries=1)
    with pytest.raises(jm.JaxmarkError, match="at least 1 query"):
        random_search(len, queries=0)
    with pytest.raises(jm.JaxmarkError, match="must be positive"):
        quantise_scores(len, 0.0)
