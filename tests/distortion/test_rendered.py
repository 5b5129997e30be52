"""Pictures of meshes against closed forms and the metrics' own programs."""

import sys

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.distortion import RENDERED, Difference, flip, measure, ssim
from jaxmark.distortion.rendered import lambert
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.geometry.raster import SIDES, Frame, cast

pytestmark = pytest.mark.core

pytest.importorskip("igl")


@pytest.fixture(scope="module")
def ball() -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=4)
    return make_mesh(np.asarray(shape.vertices) + np.array([3.0, 1, 2]), shape.faces)


def test_a_ball_from_all_sides(ball: Mesh):
    frame = Frame.of(ball)
    for camera in SIDES.values():
        np.testing.assert_allclose(camera @ camera.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(camera) == pytest.approx(1)
        raster = cast(ball, camera, frame, 64)
        steps = ((np.arange(64) + 0.5) / 64 - 0.5) * frame.width
        up, right = np.meshgrid(-steps, steps, indexing="ij")
        inside = np.hypot(up, right) < 0.97
        assert (raster.shown >= inside).all()
        assert not raster.shown[np.hypot(up, right) > 1].any()
        normals = np.stack([right, up, np.sqrt(np.maximum(1 - right**2 - up**2, 0))], axis=2)
        np.testing.assert_allclose(raster.normals(smooth=True)[inside], normals[inside], atol=0.02)
        np.testing.assert_allclose(raster.normals(smooth=False)[inside], normals[inside], atol=0.25)
        np.testing.assert_array_equal(raster.normals(smooth=True)[~raster.shown], 0)


def test_lambert_s_law_as_a_screen_shows_it(ball: Mesh):
    light = np.array([0, np.sin(0.5), np.cos(0.5)])
    raster = cast(ball, SIDES["front"], Frame.of(ball), 32)
    linear = np.maximum(raster.normals(smooth=True) @ light, 0)
    shade = lambert(raster, light, smooth=True)
    assert shade.max() == pytest.approx(1, abs=0.02)
    dark = linear <= 0.0031308
    np.testing.assert_allclose(shade[~dark], 1.055 * linear[~dark] ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shade[dark], 12.92 * linear[dark])


@pytest.mark.parametrize("compared", [flip, ssim])
def test_pictures_differ_more_the_more_a_mesh_is_dented(compared, ball: Mesh):
    pytest.importorskip("flip_evaluator" if compared is flip else "skimage")
    inward = np.random.default_rng(0).random(len(ball.vertices))[:, None] * (np.asarray(ball.vertices) - [3, 1, 2])
    found = [compared(ball, ball._replace(vertices=ball.vertices - size * inward), 40) for size in (0, 1e-3, 1e-2)]
    assert found[0] == Difference(0, 0)
    assert 0 < found[1].mean < found[2].mean < found[2].high <= 1


def test_pictures_are_compared_only_where_asked_for(ball: Mesh, monkeypatch):
    pytest.importorskip("skimage")
    calls: list[str] = []
    for name in RENDERED:
        monkeypatch.setattr(
            f"jaxmark.distortion._compare.{name}", lambda *_, name=name: calls.append(name) or Difference(0.25, 0.5)
        )
    moved = ball._replace(vertices=ball.vertices + 1e-3)
    assert jm.compare(ball, moved, ["rms"]).flip is None
    assert not calls
    assert jm.compare(ball, moved, ["rms", "ssim"]).ssim == 0.5
    assert measure(ball, moved, ["flip"]) == {"flip": 0.5}
    assert calls == ["ssim", "flip"]


def test_what_is_missing_is_named(ball: Mesh, monkeypatch):
    for module, compared in (("flip_evaluator", flip), ("skimage.metrics", ssim)):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(jm.JaxmarkError, match=r"jaxmark\[render\]"):
            compared(ball, ball, 16)
