"""A sample mesh without a file: irregular triangles, with large forms and fine detail, as in scans."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull

from jaxmark.geometry.mesh import Mesh, make_mesh

_AXES = (1.0, 0.72, 0.8)
_CRATERS = 60
_ROUGHNESS = 0.002  # relative to the radius
_SHAKE = 0.3  # standard deviation of random shifts, over the distance of neighbours


def asteroid(vertices: int = 10_000, seed: int = 2) -> Mesh:
    """Make the surface of an imaginary asteroid: closed, with craters and a rough ground, about 2 long.

    Args:
        vertices: number of vertices, at least 100.
        seed: seed of the shape.
    """
    random = np.random.default_rng(seed)
    # A spiral spreads points evenly, and random shifts make their triangles irregular.
    turn = np.arange(vertices) * np.pi * (3 - np.sqrt(5))
    height = 1 - (2 * np.arange(vertices) + 1) / vertices
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], axis=1)
    points += _SHAKE * np.sqrt(4 * np.pi / vertices) * random.normal(size=points.shape)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return make_mesh(_radius(points, random)[:, None] * points * _AXES, faces)


def _radius(points: Float64[np.ndarray, "points 3"], random: np.random.Generator) -> Float64[np.ndarray, " points"]:
    """Compute the distance from the centre in each direction: waves, craters with rims, and roughness."""
    radius = np.ones(len(points))
    for octave in range(4):
        waves = np.sin(2.0**octave * points @ (1.6 * random.normal(size=(3, 8))) + random.uniform(0, 2 * np.pi, 8))
        radius += 0.08 * 0.45**octave * waves.sum(axis=1) / np.sqrt(8)
    centres = random.normal(size=(_CRATERS, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    sizes = np.minimum(0.07 / random.uniform(0.12, 1, _CRATERS), 0.45)  # many small ones, few large
    for centre, size in zip(centres, sizes, strict=True):
        away = np.linalg.norm(points - centre, axis=1) / size
        radius += 0.3 * size * (0.4 * np.exp(-(((away - 1) / 0.3) ** 2)) - np.maximum(1 - away**2, 0))
    return radius + _ROUGHNESS * random.normal(size=len(points))
