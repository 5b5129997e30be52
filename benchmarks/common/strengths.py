"""The largest strength of an attack after which a message can still be read."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy import sparse
from scipy.spatial.transform import Rotation

from common.attacks import Own, attacked
from common.marks import Subject
from common.tables import Row
from jaxmark.geometry.mesh import Mesh, boundary_vertices, diagonal, edges, used_vertices, weld, weld_mesh


def smooth(points: Mesh, steps: float, rng: Generator) -> np.ndarray:
    """Half way to the mean of the neighbours, step by step; boundary vertices stay, as in `jaxmark.attacks`."""
    v, (i, j) = np.array(points.vertices), edges(points.faces).T
    graph = sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (len(v), len(v))).tocsr()
    degree = graph.sum(axis=1)[:, None]
    moving = degree > 0
    moving[boundary_vertices(points.faces)] = False
    for _ in range(int(steps)):
        v += 0.5 * moving * (graph @ v / np.maximum(degree, 1) - v)
    return v


def white(points: Mesh, rms: float, rng: Generator) -> Any:
    """White Gaussian noise; RMS length over the diagonal."""
    return points.vertices + diagonal(points) * rms / math.sqrt(3) * rng.normal(size=points.vertices.shape)


def affine(points: Mesh, most: float, rng: Generator) -> np.ndarray:
    """A random rotation and shift, shears up to 0.5, and scales from 1 / most to most."""
    rotation = Rotation.random(rng=rng).as_matrix()
    shear = np.eye(3) + np.triu(rng.uniform(-0.5, 0.5, (3, 3)), 1)
    scales = rng.permutation([1 / most, most ** rng.uniform(-1, 1), most])
    return points.vertices @ (rotation @ shear * scales).T + diagonal(points) * rng.normal(size=3)


def lost(points: Mesh, share: float, rng: Generator) -> np.ndarray:
    """So many of the vertices, on one side of a plane, moved by Gaussian noise of 2 % RMS of the diagonal."""
    side = points.vertices @ rng.normal(size=3)
    beyond = side > np.quantile(side[used_vertices(points)], 1 - share)
    return np.where(beyond[:, None], white(points, 0.02, rng), points.vertices)


def moved(of: Callable[[Mesh, float, Generator], np.ndarray], mesh: Mesh, strength: float, rng: Generator) -> Mesh:
    """A mesh whose points are moved, all copies of one together."""
    welded = weld(mesh.vertices)
    return Mesh(of(weld_mesh(mesh, welded), strength, rng)[welded.point], mesh.faces)


OWN: Own = {
    name: partial(moved, of) for name, of in {"laplace": smooth, "white": white, "affine": affine, "lost": lost}.items()
}
COUNTS = sorted({round(2 ** (step / 2)) for step in range(23)})
# Strengths from weak to strong, and their unit.
GRIDS: dict[str, tuple[list[float], str]] = {
    "noise": ([float(f"{x:.2g}") for x in np.geomspace(5e-4, 0.256, 28)], "half width / mean radius"),
    "laplace": ([*COUNTS], "steps of 0.5"),
    "taubin": ([*COUNTS], "pairs of steps 0.5, -0.53"),
    "quantisation": ([*range(16, 2, -1)], "bits per coordinate"),
    "warp": ([float(f"{x:.2g}") for x in np.geomspace(1e-3, 0.256, 25)], "RMS / diagonal"),
    "lost": ([percent / 100 for percent in range(5, 100, 5)], "share of the vertices"),
}


def largest(subjects: Sequence[Subject], kind: str) -> Row:
    """Place on the grid of the strongest attack that reads, the lower median over the subjects; -1 for none."""
    grid, found = GRIDS[kind][0], []
    for seed, (marker, marked, message, _) in enumerate(subjects):
        reads, fails = -1, len(grid)
        while fails - reads > 1:
            place = min(2 * reads + 3, fails - 1) if fails == len(grid) else (reads + fails) // 2
            good = marker.detect(attacked(marked, f"{kind} {grid[place]}", seed, OWN)).message == message
            reads, fails = (place, fails) if good else (reads, place)
        found.append(reads)
    place = sorted(found)[(len(found) - 1) // 2]
    cell = "none" if place < 0 else "≥ " * (place == len(grid) - 1) + f"{grid[place]:g}"
    return {"cell": cell, "place": place, "places": found}
