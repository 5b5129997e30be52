"""Suspects of few vertices, read by these: without the key, paid for, and better than by closest points."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.heights import measure_heights
from jaxmark.alignment.result import Alignment
from jaxmark.geometry.mesh import Mesh, face_normals, simplify
from jaxmark.geometry.surfaces import Surface
from jaxmark.watermark.carriers.chips import KeyedCarrier
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.nonblind import read
from jaxmark.watermark.reading.coarse import orthonormal, receive_coarse
from jaxmark.watermark.reading.reception import Reception
from tests.samples import TWICE, bumpy_sphere

pytest.importorskip("igl")
pytest.importorskip("fast_simplification")

SHAPE, MESSAGE = bumpy_sphere(4), b"ab"


@cache
def marker_of(number: int) -> NonBlindMarker:
    return jm.make_marker(SHAPE, jm.Key(bytes([number] * 32)), bits=16)


@cache
def suspect() -> Mesh:
    marked = marker_of(3).embed(MESSAGE, jm.Budget(rms=1e-3, noise=0))[0]
    return jm.attack(marked, "simplification", 0.9, seed=0)


@cache
def aligned() -> Alignment:
    return align(marker_of(3).original, suspect())


@cache
def coarse(number: int) -> Reception:
    marker = marker_of(number)
    carrier, received, heights = marker.carrier, marker.receive(aligned()), aligned().heights
    assert isinstance(carrier, KeyedCarrier)
    assert isinstance(received, Reception)
    assert heights is not None
    found = receive_coarse(carrier, marker.original, heights, received)
    assert found is not None
    return found


def ratio(marker: NonBlindMarker, received: Reception) -> float:
    """S/‖a‖ of the claim."""
    score, norm = marker.reader.claim(received, jnp.asarray(marker.codeword(MESSAGE), received.residual.dtype))
    return float(score) / float(norm)


@pytest.mark.slow
def test_vertices_tell_what_closest_points_do_not():
    marker = marker_of(3)
    usual = marker.receive(aligned())
    assert isinstance(usual, Reception)
    assert ratio(marker, coarse(3)) > 1.4 * ratio(marker, usual)
    found = marker.detect(suspect())
    assert found.message == MESSAGE
    # With weights of one's own, which say nothing of vertices, only closest points are read.
    assert marker.read(aligned(), weights=np.ones(len(SHAPE.vertices))).message is None


@pytest.mark.slow
def test_no_key_takes_part():
    one, other = coarse(3).residual, coarse(5).residual
    np.testing.assert_allclose(other, one, rtol=0, atol=TWICE * np.abs(one).max())


@pytest.mark.long
def test_other_keys_prove_nothing():
    ratios = [ratio(marker_of(number), coarse(3)) for number in range(20, 60)]
    assert np.std(ratios) == pytest.approx(1, abs=0.35)
    assert abs(np.mean(ratios)) < 3 / np.sqrt(len(ratios))
    assert marker_of(20).detect(suspect(), MESSAGE).log10_p > -2


def test_the_price_is_paid():
    """What is read by vertices has a twentieth of the probability, and so much more has to be proven."""
    marker = marker_of(3)
    claimed = marker.read(aligned(), MESSAGE).log10_p
    alone = -(ratio(marker, coarse(3)) ** 2) / 2 / np.log(10)
    # One of twenty, two ways of weighing, which are the same here, and the shares of claim and alignment.
    price = np.log10(20 * 2 / 0.97**2)
    assert claimed == pytest.approx(alone + price, abs=0.02)


def test_what_was_chosen_before_is_charged():
    marker, half = marker_of(3), ledger.SCENE.charge("sum over meshes")
    charged = read(marker, aligned(), MESSAGE, charges=(half,)).evidence
    alone = marker.read(aligned(), MESSAGE).evidence
    assert charged.log10_p_unfloored == pytest.approx(alone.log10_p_unfloored + np.log10(2), abs=max(1e-6, TWICE))
    assert charged.charges == (half, *alone.charges)


def test_heights_are_those_of_a_plane():
    """Of points above one, its normals and barycentric coordinates are exact."""
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), indexing="ij"), -1).reshape(-1, 2) / 4
    corner = np.array([5 * i + j for i in range(4) for j in range(4)])
    faces = np.concatenate([corner[:, None] + [0, 5, 6], corner[:, None] + [0, 6, 1]])
    plane = Mesh(np.c_[grid, np.zeros(25)], faces)
    up = face_normals(plane)[0, 2]
    rng = np.random.default_rng(0)
    places = np.c_[rng.uniform(0, 1, (9, 2)), rng.uniform(-0.004, 0.004, 9)]
    found = measure_heights(Surface(plane), Mesh(places, np.arange(9).reshape(3, 3)))
    np.testing.assert_allclose(found.height, up * places[:, 2], atol=1e-12)
    np.testing.assert_allclose(found.share @ plane.vertices, places * [1, 1, 0], atol=1e-12)
    tilt = np.c_[np.zeros((25, 2)), plane.vertices @ [1.0, 2.0, 0.0]]
    np.testing.assert_allclose(found.along(tilt), up * (places @ [1.0, 2.0, 0.0]), atol=1e-12)
    heights, moved = rng.normal(size=9), rng.normal(size=(25, 3))
    assert np.vdot(found.adjoint(heights), moved) == pytest.approx(heights @ found.along(moved))


def test_far_vertices_and_too_few_are_left_out():
    marker = marker_of(3)
    original, received = marker.original, marker.receive(aligned())
    surface = Surface(Mesh(original.positions, original.points.faces))
    away = Mesh(1.1 * original.positions, original.points.faces)
    assert len(measure_heights(surface, away).height) == 0
    few = simplify(Mesh(original.positions, original.points.faces), 40)
    assert isinstance(marker.carrier, KeyedCarrier)
    assert isinstance(received, Reception)
    assert receive_coarse(marker.carrier, original, measure_heights(surface, few, 40), received) is None


def test_fine_suspects_have_no_heights():
    fine = jm.attack(SHAPE, "midpoint", 1, seed=0)
    noised = jm.attack(fine, "noise", 0.001, seed=0)
    assert align(marker_of(3).original, noised).heights is None
    assert align(marker_of(3).original, SHAPE).heights is None


def test_without_the_simplifier_suspects_are_read_by_closest_points(monkeypatch):
    monkeypatch.setattr("jaxmark.alignment.by_surface.available", lambda module: False)
    assert align(marker_of(3).original, suspect()).heights is None


def test_a_basis_of_dependent_columns():
    columns = np.random.default_rng(0).normal(size=(40, 3)) @ np.random.default_rng(1).normal(size=(3, 5))
    basis = orthonormal(columns)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(basis @ (basis.T @ columns), columns, atol=1e-12)
