"""Denoising: what shrinks, what stays, and that places which look alike help each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.adversaries.by_name import low_pass
from jaxmark.attacks.denoising import shrinkage
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral import band_components, bands, from_mesh
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

KINDS = [("shrinkage", 0.002), ("non-local-means", 5)]


@pytest.fixture(scope="module")
def rough() -> tuple[Mesh, Mesh]:
    """A smooth surface of waves that repeat, and the same with noise along its normals."""
    side = np.linspace(0, 1, 50)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    z = 0.03 * np.sin(4 * np.pi * x) * np.sin(4 * np.pi * y)
    corner = (np.arange(49)[:, None] * 50 + np.arange(49)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 50, 1], corner[:, None] + [1, 50, 51]])
    noise = 0.002 * np.random.default_rng(0).normal(size=len(x))
    return make_mesh(np.c_[x, y, z], faces), make_mesh(np.c_[x, y, z + noise], faces)


def deviation(mesh: Mesh, other: Mesh) -> float:
    return float(np.sqrt(np.mean(np.sum((np.asarray(mesh.vertices) - other.vertices) ** 2, axis=1))))


def test_averages_over_places_alike_remove_noise_and_keep_waves_that_repeat(rough):
    """As much smoothing at each place by itself takes the waves away."""
    clean, noisy = rough
    found, apart = (
        deviation(jm.attack(noisy, *way, seed=0), clean) for way in (("non-local-means", 5), ("smoothing", 50))
    )
    assert found < 0.5 * deviation(noisy, clean)
    assert found < 0.5 * apart


def test_shrinking_removes_noise_and_leaves_large_detail(rough):
    clean, noisy = rough
    left, quiet = (jm.attack(mesh, "shrinkage", 0.001, seed=0) for mesh in (noisy, clean))
    assert deviation(left, quiet) < 0.5 * deviation(noisy, clean)
    assert np.std(quiet.vertices[:, 2]) > 0.9 * np.std(clean.vertices[:, 2])


@pytest.mark.parametrize(("kind", "strength"), KINDS)
def test_pose_and_scale_do_not_matter(kind, strength, rough, x64):
    _, noisy = rough
    turn = Rotation.random(rng=np.random.default_rng(1))
    moved = Mesh(3 * turn.apply(noisy.vertices) + 7, noisy.faces)
    found, expected = (jm.attack(mesh, kind, strength, seed=0) for mesh in (moved, noisy))
    if kind == "shrinkage":  # whose strength is relative to a box that turns with the axes
        boxes = (np.linalg.norm(np.ptp(points, axis=0)) for points in (noisy.vertices, turn.apply(noisy.vertices)))
        found = jm.attack(moved, kind, strength * next(boxes) / next(boxes), seed=0)
    np.testing.assert_allclose(found.vertices, 3 * turn.apply(expected.vertices) + 7, atol=1e-9)


def test_shrinking_by_nothing_changes_nothing_and_by_much_leaves_the_lowest_band(sphere: Mesh, x64):
    still = shrinkage(sphere, 0.0)
    np.testing.assert_array_equal(still.vertices, sphere.vertices)
    # Where all is removed, what is left is the low-pass applied twice, as the frame is tight.
    frame, centre = bands.meyer(8), np.asarray(sphere.vertices).mean(axis=0)
    operator = from_mesh(sphere)
    low = band_components(operator, frame[:1], band_components(operator, frame[:1], sphere.vertices - centre)[0])[0]
    np.testing.assert_allclose(shrinkage(sphere, 10.0).vertices, low + centre, atol=4e-3)
    assert not np.allclose(low_pass(sphere, 0.9).vertices, sphere.vertices, atol=4e-3)


def test_vectors_keep_their_directions_and_lose_one_length(sphere: Mesh, x64):
    """Of the largest coefficients, by an analysis of one octave at a time."""
    frame, operator, length = bands.meyer(8), from_mesh(sphere), 1e-3
    moved = np.asarray(shrinkage(sphere, length).vertices) - sphere.vertices
    diagonal = np.linalg.norm(np.ptp(sphere.vertices, axis=0))
    parts = np.asarray(band_components(operator, frame, sphere.vertices - sphere.vertices.mean(axis=0)))
    size = np.linalg.norm(parts, axis=-1, keepdims=True)
    removed = parts * np.minimum(1, length * diagonal / np.maximum(size, 1e-300))
    expected = -sum(
        np.asarray(band_components(operator, frame[band][None], removed[band])[0]) for band in range(1, len(frame))
    )
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_non_local_means_end_somewhere(sphere: Mesh):
    with pytest.raises(jm.JaxmarkError, match=r"1,000 at most, got 1001"):
        jm.attack(sphere, "non-local-means", 1001, seed=0)
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]]), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(jm.attack(flat, "non-local-means", 3, seed=0).vertices, flat.vertices, atol=1e-6)
    two = [bumpy_sphere(2)] * 2
    first, second = (jm.attack(mesh, "non-local-means", 3, seed=seed) for seed, mesh in enumerate(two))
    np.testing.assert_array_equal(first.vertices, second.vertices)
