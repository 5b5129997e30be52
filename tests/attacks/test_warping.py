"""Maps of space and jamming against closed forms, NumPy's least squares, and dense algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxmark as jm
from jaxmark.adversaries.by_name import jamming
from jaxmark.attacks import bending, twisting, warp
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh
from jaxmark.spectral.graphs import from_mesh
from jaxmark.watermark.schemes.keyed import DERIVED
from tests.dense import laplacian_matrix
from tests.samples import exact_sheet, rough_sphere
from tests.test_precision import check_products

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def cap() -> Mesh:
    """A rough sphere with a hole, far from the origin, and an isolated vertex."""
    mesh = rough_sphere(300)
    return make_mesh(np.vstack([mesh.vertices, [[3.0, 3, 3]]]) + 5, mesh.faces[10:])


def shift_of(kind, mesh: Mesh, strength: float, dtype: str = "float64", seed: int = 0) -> np.ndarray:
    """Displacements of the vertices that faces use; the others have none."""
    vertices, used = jnp.asarray(mesh.vertices, dtype), np.unique(mesh.faces)
    moved = kind(Mesh(vertices, mesh.faces), strength, jax.random.key(seed)).vertices
    assert moved.dtype == dtype
    shift = np.asarray(moved, np.float64) - np.asarray(vertices, np.float64)
    np.testing.assert_array_equal(np.delete(shift, used, axis=0), 0)
    return shift[used]


def root_mean_square(shift: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))


@pytest.mark.parametrize("kind", [warp, jamming])
def test_the_root_mean_square_is_met(kind, cap: Mesh, dtype):
    for strength in (1e-3, 0.05):
        found = root_mean_square(shift_of(kind, cap, strength, dtype)) / diagonal(cap)
        # Positions of about 5 are rounded to their last digit.
        assert found == pytest.approx(strength, rel=1e-11 if dtype == "float64" else 1e-4)
    np.testing.assert_array_equal(shift_of(kind, cap, 0.0, dtype), 0)
    assert (shift_of(kind, cap, 0.1, dtype) != shift_of(kind, cap, 0.1, dtype, seed=1)).any()


def affine_part(points: np.ndarray, shift: np.ndarray) -> np.ndarray:
    maps = np.column_stack([np.ones(len(points)), points - points.mean(axis=0)])
    return maps @ np.linalg.lstsq(maps, shift, rcond=None)[0]


def test_warps_have_no_affine_part_and_are_smooth(cap: Mesh, dtype):
    points = cap.vertices[np.unique(cap.faces)]
    for seed in range(3):
        shift = shift_of(warp, cap, 0.05, dtype, seed)
        affine = affine_part(points, shift)
        assert root_mean_square(affine) < (1e-12 if dtype == "float64" else 1e-5) * root_mean_square(shift)
        # Two points near each other move alike: wavelengths are half a diagonal or more.
        near = np.linalg.norm(points[:, None] - points, axis=2) < 0.05 * diagonal(cap)
        apart = np.linalg.norm(shift[:, None] - shift, axis=2)
        assert apart[near].max() < 0.4 * apart.max()


def test_a_warp_is_a_sum_of_four_sinusoids(cap: Mesh, x64):
    """On a line of points: with the waves of the same draws, and the affine part fitted by NumPy."""
    key = jax.random.key(3)
    direct, length, turn, size = jax.random.split(key, 4)
    waves = np.array(jax.random.normal(direct, (4, 3)))
    waves *= (
        2
        * np.pi
        / (np.linalg.norm(waves, axis=1) * np.array(jax.random.uniform(length, (4,), minval=0.5, maxval=2)))[:, None]
    )
    phase, amplitude = jax.random.uniform(turn, (4,), maxval=2 * np.pi), np.asarray(jax.random.normal(size, (4, 3)))
    points = cap.vertices[np.unique(cap.faces)]
    x = (points - points.mean(axis=0)) / diagonal(cap)
    shift = sum(np.outer(np.sin(x @ w + float(p)), a) for w, p, a in zip(waves, phase, amplitude, strict=True))
    shift -= affine_part(points, shift)
    expected = 0.02 * diagonal(cap) * shift / root_mean_square(shift)
    np.testing.assert_allclose(shift_of(warp, cap, 0.02, seed=3), expected, atol=1e-12)


def test_flat_meshes_are_warped(x64):
    sheet = exact_sheet(8)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    flat = make_mesh(sheet.vertices * [1, 1, 0] @ turn, sheet.faces)
    shift = shift_of(warp, flat, 0.03)
    assert root_mean_square(shift) == pytest.approx(0.03 * diagonal(flat))
    np.testing.assert_allclose(affine_part(flat.vertices @ turn.T[:, :2], shift), 0, atol=1e-9)


def bar(axis: int) -> Mesh:
    """A box of 10, 3 and 1 with its length along an axis, its corners and a line through its centre, off the origin."""
    ends = np.stack(np.meshgrid([-5.0, 5], [-1.5, 1.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)
    line = np.stack([np.linspace(-5, 5, 101), np.zeros(101), np.zeros(101)], axis=1)
    points = np.vstack([ends, line])
    return make_mesh(
        np.vstack([np.roll(points, axis, axis=1), [[99.0, 0, 0]]]) + 7, np.arange(len(points) - 1)[:, None] + [0, 1, 0]
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("degrees", [0.0, 1e-5, 30.0, 360.0])
def test_the_axis_becomes_an_arc(axis, degrees, dtype):
    mesh, angle = bar(axis), np.radians(degrees)
    moved = np.roll(mesh.vertices[:-1] - 7 + shift_of(bending, mesh, degrees, dtype), -axis, axis=1)
    corners, line = moved[:8], moved[8:]
    close = {"atol": 1e-12 if dtype == "float64" else 1e-5}
    # Towards the shortest side only; and every chord is that of a circle of radius L/θ.
    np.testing.assert_allclose(line[:, 1], 0, **close)
    chord = 0.1 if degrees == 0 else 2 * 10 / angle * np.sin(angle / 100 / 2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(line, axis=0), axis=1), chord, **close)
    ends = np.array([line[1] - line[0], line[-1] - line[-2]])
    turned = np.arctan2(ends[:, 2], ends[:, 0])
    apart = (turned[1] - turned[0] - angle * 0.99 + np.pi) % (2 * np.pi) - np.pi
    assert apart == pytest.approx(0, abs=1e-10 if dtype == "float64" else 1e-3)
    np.testing.assert_allclose(line[50], 0, **close)
    # Corners keep their place in the plane across their end of the axis.
    for sign in (-1, 1):
        end = line[0 if sign < 0 else -1]
        normal = np.array([-np.sin(sign * angle / 2), 0, np.cos(angle / 2)])
        there = {
            tuple(np.round(end + y * np.array([0, 1, 0]) + z * normal, 4) + 0.0)
            for y in (-1.5, 1.5)
            for z in (-0.5, 0.5)
        }
        assert there <= {tuple(np.round(corner, 4) + 0.0) for corner in corners}


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_twists_turn_about_the_axis(axis, dtype):
    mesh, degrees = bar(axis), 90.0
    before = np.roll(mesh.vertices[:-1] - 7, -axis, axis=1)
    after = before + np.roll(shift_of(twisting, mesh, degrees, dtype), -axis, axis=1)
    close = {"atol": 1e-12 if dtype == "float64" else 1e-5}
    np.testing.assert_allclose(after[:, 0], before[:, 0], **close)
    np.testing.assert_allclose(after[8:], before[8:], **close)
    turned = (after[:8, 1] + 1j * after[:8, 2]) / (before[:8, 1] + 1j * before[:8, 2])
    np.testing.assert_allclose(turned, np.exp(1j * np.radians(degrees) * before[:8, 0] / 10), **close)


def test_jamming_is_shaped_like_a_mark(cap: Mesh, x64):
    """Against the same bands by a dense eigendecomposition; the scheme's own carrier shapes chips alike."""
    operator, used = from_mesh(cap), np.unique(cap.faces)
    values, vectors = np.linalg.eig(laplacian_matrix(operator)[np.ix_(used, used)])
    k, terms = np.arange(64), 64
    q = np.pi / (terms + 1)
    jackson = ((terms - k + 1) * np.cos(q * k) + np.sin(q * k) / np.tan(q)) / (terms + 1)
    response = np.zeros(len(values))
    for band, strength in enumerate(DERIVED):
        node = np.pi - (band + 0.5) * np.pi / 64
        c = 2 / 64 * np.cos(k * node) * jackson * np.where(k == 0, 0.5, 1)
        response += strength * np.cos(np.outer(np.arccos(np.clip(np.real(values) - 1, -1, 1)), k)) @ c
    noise = np.asarray(jax.random.normal(jax.random.key(0), cap.vertices.shape))[used]
    shaped = (vectors * response @ np.linalg.inv(vectors)).real @ noise
    expected = 1e-3 * diagonal(cap) * shaped / root_mean_square(shaped)
    np.testing.assert_allclose(shift_of(jamming, cap, 1e-3), expected, atol=1e-12)


def test_products_are_exact(cap: Mesh):
    vertices = jnp.asarray(cap.vertices, "float32")
    assert check_products(lambda v: warp(Mesh(v, cap.faces), 0.1, jax.random.key(0)).vertices, vertices) > 5


@pytest.mark.slow
def test_warping_is_differentiable(cap: Mesh, x64):
    v, key = jnp.asarray(cap.vertices), jax.random.key(1)
    for kind, strength, modes in [
        (warp, 0.1, ["rev", "fwd"]),
        (bending, 40.0, ["rev", "fwd"]),
        (bending, 0.0, ["rev", "fwd"]),
        (twisting, 40.0, ["rev", "fwd"]),
        (jamming, 0.1, ["rev"]),
    ]:

        def total(v, strength, kind=kind):
            return jnp.sum(jnp.sin(kind(Mesh(v, cap.faces), strength, key).vertices))

        check_grads(jax.jit(total), (v, strength), 1, modes)


@pytest.mark.usefixtures("unchecked")
def test_refusals(cap: Mesh):
    for kind, strength, sentence in [
        ("bending", 361, "0 to 360"),
        ("warp", -0.1, "from 0 to"),
        ("jamming", float("inf"), "must be a number"),
        ("twisting", float("nan"), "must be a number"),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(cap, kind, strength, seed=0)
