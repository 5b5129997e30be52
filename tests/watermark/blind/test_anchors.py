"""The cutting of faces into samples."""

import numpy as np
import trimesh

from jaxmark.geometry.mesh import make_mesh
from jaxmark.watermark.blind import anchors


def test_samples_of_faces_have_the_centres_and_areas_of_their_slices():
    """Against points on a fine grid, slice by slice of the main axis; one face has two equal sides."""
    corners = np.array([[[0, 0, 0], [9, 0, 1], [3, 1, 0]], [[0, 0.2, 0], [0, -0.2, 0], [5, 0, 0]]], np.float64)
    face, shares, part = anchors._samples(corners, np.array([1, 1]), np.array([7, 3]))
    grid, _ = anchors._centres(np.arange(400**2), np.full(400**2, 400))
    for one, (triangle, count) in enumerate(zip(corners, (7, 3), strict=True)):
        _, _, (axis, *_) = np.linalg.svd(triangle - triangle.mean(axis=0))
        along = triangle @ axis
        edges = np.linspace(along.min(), along.max(), count + 1)
        place = np.searchsorted(edges[1:-1], grid @ along)
        centres = np.stack([grid[place == index].mean(axis=0) for index in range(count)])
        found = shares[face == one]
        np.testing.assert_allclose(found[np.argsort(found @ along)], centres, atol=2e-3)
        np.testing.assert_allclose(np.sort(part[face == one]), np.sort(np.bincount(place) / 400**2), atol=3e-3)

    # Cut further, upside-down triangles have the slices of the others, turned.
    face, shares, part = anchors._samples(corners, np.array([3, 2]), np.array([2, 5]))
    np.testing.assert_allclose(np.bincount(face, part), 1)
    np.testing.assert_allclose(shares.sum(axis=1), 1)
    np.testing.assert_allclose(part @ shares, np.full(3, 2 / 3))
    assert shares.min() > 0


def test_many_needles_are_cut_less_often(monkeypatch):
    needles = trimesh.creation.cylinder(1, 9, sections=500)
    mesh = make_mesh(np.asarray(needles.vertices), np.asarray(needles.faces))
    assert len(anchors.cut(mesh, 0.5).part) > 20_000
    monkeypatch.setattr(anchors, "_MAX_SAMPLES", 5000)
    assert len(mesh.faces) < len(anchors.cut(mesh, 0.5).part) < 5000 + len(mesh.faces)
