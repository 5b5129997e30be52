"""Meshes made on the spot."""

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral.graphs import Weighting, from_mesh
from jaxmark.spectral.laplacian import Laplacian

#: By how much two runs of one computation may differ, relative: GPUs add in no fixed order.
TWICE = 0.0 if jax.default_backend() == "cpu" else 1e-4
FINE = 2.0**-44  # spacing of a grid for originals, so fine that rounding to it changes nothing that tests measure


def bumpy_sphere(level: int, seed: int = 0) -> Mesh:
    """A `rough_sphere` of 10 · 4^level + 2 vertices, as many as a subdivided icosahedron has."""
    return rough_sphere(10 * 4**level + 2, seed)


def rough_sphere(count: int, seed: int = 0) -> Mesh:
    """A closed surface of irregular triangles, with bumps, and a little roughness so that no band is empty.

    Random points on a sphere, joined by their convex hull: unlike a subdivided icosahedron, its graph has no symmetry,
    and so no repeated eigenvalues.
    """
    random = np.random.default_rng(seed)
    # A spiral spreads points evenly, a shake makes them irregular.
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    height = 1 - (2 * np.arange(count) + 1) / count
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    points += 0.5 / np.sqrt(count) * random.normal(size=points.shape)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    bumps = np.sin(points @ (2 * random.normal(size=(3, 6))) + random.uniform(0, 6, 6)).sum(axis=1)
    radius = 1 + 0.05 * bumps + 0.01 * random.normal(size=count)
    return make_mesh(points * radius[:, None] * [1.0, 0.8, 1.3], faces)


def exact_sheet(size: int) -> Mesh:
    """A rough sheet of size² vertices whose coordinates are the same to the last bit on every machine."""
    i, j = np.divmod(np.arange(size * size), size)
    z = (7919 * i * i + 104729 * j + 31 * i * j) % 97
    vertices = np.stack([i + (13 * j % 7) / 32, j + (11 * i % 5) / 32, z / 128], axis=1)
    corner = (i * size + j).reshape(size, size)[:-1, :-1].ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + size, corner + 1], 1),
            np.stack([corner + 1, corner + size, corner + size + 1], 1),
        ]
    )
    return make_mesh(vertices, faces)


def ordered_laplacian(mesh: Mesh, weights: Weighting = "valence", **options) -> Laplacian:
    """With rows in an order of its own, as large meshes have them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxmark.spectral.laplacian._MIN_ORDERED_VERTICES", 0)
        made = from_mesh(mesh, weights, **options)
    assert made.neighbours is not None
    assert not np.array_equal(made.neighbours.order, np.arange(len(made.degree)))
    return made


def with_thin_faces(mesh: Mesh) -> Mesh:
    """Split the first face at a point so near to its first corner that two faces are thin."""
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    a, b, c = faces[0]
    new, near = len(points), points[a] + 1e-3 * (points[b] + points[c] - 2 * points[a])
    return make_mesh(np.vstack([points, near]), np.vstack([[[a, b, new], [b, c, new], [c, a, new]], faces[1:]]))
