"""Many originals from a few: bent, twisted, stretched, with a joint turned, noisy, and as coarse as other models."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, compact, weld, weld_mesh
from jaxmark.geometry.pose import Points

LEAST_DEGREES, MOST_DEGREES = 5.0, 45.0
_MOST_STRETCH = 0.15  # logarithm of a factor along an axis
_MOST_NOISE = 0.002  # half width over the mean distance to the centre
_JOINT = 0.1  # of the shape's length is bent where a joint turns
MIN_VERTICES = 500


def load_models(paths: list[Path]) -> dict[str, Mesh]:
    """Meshes with so many vertices that they may carry a mark, by name; others are left out."""
    found = {}
    for path in paths:
        try:
            mesh = jm.load_mesh(path)
        except jm.JaxmarkError:
            continue
        mesh = compact(weld_mesh(mesh, weld(mesh.vertices)))
        if len(mesh.faces) and len(mesh.vertices) >= MIN_VERTICES:
            found[path.stem] = mesh
    return found


def variants(models: dict[str, Mesh], count: int, most: int, seed: int = 0) -> Iterator[tuple[str, Mesh]]:
    """Originals by name: each model in turn, at first as it is, at most so many vertices large."""
    random = np.random.default_rng(seed)
    sizes = sorted(min(len(mesh.vertices), most) for mesh in models.values())
    coarse: dict[tuple[str, int], Mesh] = {}
    for number in range(count):
        name = list(models)[number % len(models)]
        size = most if number < len(models) else int(random.choice(sizes))
        if (name, size) not in coarse:
            coarse[name, size] = simplified(models[name], size)
        mesh = coarse[name, size]
        if number >= len(models):
            mesh = deformed(mesh, random)
        yield f"{number:05d}-{name}", mesh


def simplified(mesh: Mesh, size: int) -> Mesh:
    """A mesh of about so many vertices, if it has more."""
    if len(mesh.vertices) <= size:
        return mesh
    simpler = jm.attack(mesh, "simplification", 1 - size / len(mesh.vertices), seed=0)
    return compact(Mesh(np.asarray(simpler.vertices), np.asarray(simpler.faces)))


def deformed(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """A mesh after one or two random deformations, and a little noise."""
    points = np.asarray(mesh.vertices, np.float64)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    points = (points - points.mean(axis=0)) / size
    for deform in random.choice(np.array([_bend, _twist, _turn_joint, _stretch]), random.integers(1, 3), replace=False):
        axes = rotation(random)
        points = points @ axes.T
        points = deform(points - points.mean(axis=0), random) @ axes
    radius = np.linalg.norm(points - points.mean(axis=0), axis=1).mean()
    points = points + radius * random.uniform(0, _MOST_NOISE) * random.uniform(-1, 1, points.shape)
    return jm.make_mesh(points * size, mesh.faces)


def rotation(random: np.random.Generator) -> Points:
    """A random rotation."""
    matrix, triangle = np.linalg.qr(random.normal(size=(3, 3)))
    matrix = matrix * np.sign(np.diag(triangle))
    return matrix * np.sign(np.linalg.det(matrix))


def _angle(random: np.random.Generator) -> float:
    return float(np.deg2rad(random.uniform(LEAST_DEGREES, MOST_DEGREES)) * random.choice([-1, 1]))


def _bend(points: Points, random: np.random.Generator) -> Points:
    radius = np.ptp(points[:, 0]) / _angle(random)
    turn, arm = points[:, 0] / radius, radius - points[:, 1]
    return np.stack([arm * np.sin(turn), radius - arm * np.cos(turn), points[:, 2]], axis=1)


def _twist(points: Points, random: np.random.Generator) -> Points:
    return _turned(points, _angle(random) * points[:, 0] / np.ptp(points[:, 0]), 1, 2)


def _turn_joint(points: Points, random: np.random.Generator) -> Points:
    at = random.uniform(-0.15, 0.15)
    share = np.clip((points[:, 0] - at) / (_JOINT * np.ptp(points[:, 0])), 0, 1)
    return _turned(points - [at, 0, 0], _angle(random) * share**2 * (3 - 2 * share), 0, 1)


def _stretch(points: Points, random: np.random.Generator) -> Points:
    return points * np.exp(random.uniform(-_MOST_STRETCH, _MOST_STRETCH, 3))


def _turned(points: Points, angle: np.ndarray, first: int, second: int) -> Points:
    """Points turned each by an angle of its own, in the plane of two axes."""
    found = points.copy()
    found[:, first] = np.cos(angle) * points[:, first] - np.sin(angle) * points[:, second]
    found[:, second] = np.sin(angle) * points[:, first] + np.cos(angle) * points[:, second]
    return found
