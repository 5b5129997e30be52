"""Forms that need no file: knots, gears, creatures, rocks, terrain; meshes of about as many points as asked for."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, Delaunay

from jaxmark.adversaries.by_name import attack
from jaxmark.bench.shapes import cube, grid
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, make_mesh, unit

Points = Float64[np.ndarray, "_ 3"]
Angles = Float64[np.ndarray, " _"]


def tube(points: int, path: Callable[[Angles], Points], radius: float, *, ends: bool = False) -> Mesh:
    """A tube around a path of one parameter from 0 to 2π, closed or with two open ends.

    Args:
        points: about how many.
        path: the path.
        radius: of the tube.
        ends: whether the path ends elsewhere than it begins.
    """
    dense = path(np.linspace(0, 2 * np.pi, 4001))
    length = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    across = max(round(np.sqrt(points * 2 * np.pi * radius / length)), 6)
    along = round(points / across)
    i, j, faces = grid(along, across, closed=True)
    t = 2 * np.pi * np.arange(along) / (along - ends)
    centre, ahead = path(t), unit(path(t + 1e-4) - path(t - 1e-4))
    # Frames that turn as little as possible, and the turn that is left over spread over a closed path.
    normal = np.empty_like(centre)
    normal[0] = unit(np.cross(ahead[0], [0.3, 0.5, 0.8])[None])[0]
    for place in range(1, along):
        normal[place] = normal[place - 1] - (normal[place - 1] @ ahead[place]) * ahead[place]
        normal[place] /= np.linalg.norm(normal[place])
    last = normal[-1] - (normal[-1] @ ahead[0]) * ahead[0]
    left = 0.0 if ends else np.arctan2(np.cross(last, normal[0]) @ ahead[0], last @ normal[0])
    turn = 2 * np.pi * j / across + left * i / along
    ring = np.cos(turn)[:, None] * normal[i] + np.sin(turn)[:, None] * np.cross(ahead, normal)[i]
    if ends:  # the faces that would close it
        faces = faces[~((i[faces] == along - 1).any(axis=1) & (i[faces] == 0).any(axis=1))]
    return make_mesh(centre[i] + radius * ring, faces[:, ::-1])


def knot(points: int, turns: int, windings: int) -> Mesh:
    """A torus knot."""

    def path(t: Angles) -> Points:
        out = 1 + 0.4 * np.cos(windings * t)
        return np.stack([out * np.cos(turns * t), out * np.sin(turns * t), 0.4 * np.sin(windings * t)], axis=1)

    return tube(points, path, 0.11)


def spring(points: int) -> Mesh:
    """Six turns of wire, open at both ends."""
    return tube(points, lambda t: np.stack([np.cos(6 * t), np.sin(6 * t), 0.35 * t], axis=1), 0.09, ends=True)


def lathe(points: int, profile: Callable[[Angles], tuple[Angles, Angles]]) -> Mesh:
    """A surface of revolution, open at both ends of its profile: radius and height over a parameter from 0 to 1."""
    side = round(np.sqrt(points))
    i, j, faces = grid(side, side, closed=True)
    faces = faces[~((i[faces] == side - 1).any(axis=1) & (i[faces] == 0).any(axis=1))]
    radius, height = profile(i / (side - 1))
    turn = 2 * np.pi * j / side
    return make_mesh(np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1), faces[:, ::-1])


def vase(points: int) -> Mesh:
    """A vase."""
    return lathe(points, lambda s: (0.35 + 0.15 * np.sin(5 * s) + 0.08 * s**8, 1.4 * s))


def star(points: int, radius: Callable[[Points], Angles]) -> Mesh:
    """A closed form seen whole from its centre, its radius given by the direction; meshed as a cube's sides."""
    vertices, faces = cube(points)
    direction = unit(np.tan(np.pi / 4 * vertices))
    return make_mesh(radius(direction)[:, None] * direction, faces)


def supershape(points: int, fold: int, sharp: float) -> Mesh:
    """Gielis's superformula around both angles: symmetric, so many times around."""

    def formula(angle: Angles, times: int) -> Angles:
        half = times * angle / 4
        return (np.abs(np.cos(half)) ** sharp + np.abs(np.sin(half)) ** sharp) ** (-1 / (2 * sharp))

    def radius(d: Points) -> Angles:
        return formula(np.arctan2(d[:, 1], d[:, 0]), fold) * formula(np.arcsin(np.clip(d[:, 2], -1, 1)), 4)

    return star(points, radius)


def superquadric(points: int, power: float) -> Mesh:
    """Points with |x|^p + |y|^p + |z|^p = 1: from a pinched star over a ball to nearly a box."""
    return star(points, lambda d: np.sum(np.abs(d) ** power, axis=1) ** (-1 / power))


def creature(points: int, seed: int) -> Mesh:
    """A body with limbs, irregularly meshed: smooth bumps on a ball, mirrored in x."""
    random = np.random.default_rng(seed)
    limbs = unit(random.normal(size=(6, 3)))
    limbs = np.concatenate([limbs, limbs * [-1, 1, 1]])
    lengths, widths = np.tile(random.uniform(0.3, 1.2, 6), 2), np.tile(random.uniform(8, 40, 6), 2)
    base = asteroid(points, seed=seed)  # for its triangles and directions alone
    direction = unit(np.asarray(base.vertices) / [1.0, 0.72, 0.8])
    radius = 0.6 + np.sum(lengths * np.exp(widths * (direction @ limbs.T - 1)), axis=1)
    return make_mesh(radius[:, None] * direction, base.faces)


def gem(points: int, seed: int) -> Mesh:
    """Flat facets between 40 corners, each divided evenly."""
    corners = unit(np.random.default_rng(seed).normal(size=(40, 3))) * [1, 0.8, 0.6]
    faces = ConvexHull(corners).simplices.astype(np.int64)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    steps = max(round(np.log(points / 40) / np.log(4)), 1)
    return attack(make_mesh(corners, faces), "midpoint", steps, seed=0)


def gear(points: int, teeth: int) -> Mesh:
    """A wheel with teeth, a hole and flat sides: a ring's section carried around an outline."""
    across = 24
    along = round(points / across)
    i, j, faces = grid(along, across, closed=True)
    turn = 2 * np.pi * i / along
    outer = 1 + 0.09 * np.tanh(4 * np.sin(teeth * turn))
    place = 4 * j / across  # around a rectangle: inwards, down, outwards, up
    side, along_side = place.astype(int) % 4, place % 1
    radial = np.choose(side, [1 - along_side, 0 * along_side, along_side, 1 + 0 * along_side])
    height = np.choose(side, [1 + 0 * along_side, 1 - along_side, 0 * along_side, along_side])
    radius = 0.4 + radial * (outer - 0.4)
    return make_mesh(np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.3 * height], axis=1), faces)


def seashell(points: int) -> Mesh:
    """A spiral that grows: a tube of rising radius around a helix, open at its mouth."""
    side = round(np.sqrt(points / 4))
    i, j, faces = grid(4 * side, side, closed=True)
    faces = faces[~((i[faces] == 4 * side - 1).any(axis=1) & (i[faces] == 0).any(axis=1))]
    t, around = i / (4 * side - 1), 2 * np.pi * j / side
    size = np.exp(2.2 * (t - 1))
    out = size * (1 + 0.75 * np.cos(around))
    return make_mesh(
        np.stack(
            [out * np.cos(6 * np.pi * t), out * np.sin(6 * np.pi * t), size * (0.75 * np.sin(around) + 2.5) - 2.5],
            axis=1,
        ),
        faces,
    )


def terrain(points: int, seed: int) -> Mesh:
    """A square of land as a scanner from above sees it: irregular triangles, rough at all lengths."""
    random = np.random.default_rng(seed)
    flat = random.uniform(size=(points, 2))
    height = np.zeros(points)
    for octave in range(7):
        waves = 2.0**octave * 3 * random.normal(size=(2, 6))
        height += 0.06 * 0.5**octave * np.sin(flat @ waves + random.uniform(0, 2 * np.pi, 6)).sum(axis=1)
    return make_mesh(np.column_stack([flat, height]), np.asarray(Delaunay(flat).simplices, np.int64))


def noisy(mesh: Mesh, size: float, seed: int) -> Mesh:
    """A mesh as a bad scanner sees it."""
    return attack(mesh, "gaussian-noise", size, seed=seed)


def several(parts: list[Mesh], shifts: Points) -> Mesh:
    """Several parts beside each other, which share no vertex."""
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = [np.asarray(part.vertices) + shift for part, shift in zip(parts, shifts, strict=True)]
    faces = [np.asarray(part.faces) + first for part, first in zip(parts, counts, strict=False)]
    return make_mesh(np.concatenate(vertices), np.concatenate(faces))


def chain(points: int, links: int) -> Mesh:
    """Links of a chain, every other one turned by a quarter."""

    def link(turned: bool) -> Mesh:
        def path(t: Angles) -> Points:
            x, y = 0.9 * np.cos(t), 0.5 * np.sin(t)
            return np.stack([x, 0 * x, y] if turned else [x, y, 0 * x], axis=1)

        return tube(points // links, path, 0.13)

    return several([link(bool(k % 2)) for k in range(links)], np.arange(links)[:, None] * np.array([[1.35, 0, 0]]))


def rubble(points: int, rocks: int) -> Mesh:
    """Rocks beside each other."""
    places = np.stack(np.unravel_index(np.arange(rocks), (3, 3, -(-rocks // 9))), axis=1) * 2.6
    return several([asteroid(points // rocks, seed=seed) for seed in range(rocks)], places.astype(float))


def sorted_faces(mesh: Mesh) -> Int64[np.ndarray, "faces 3"]:
    """Faces in one order, whatever the order was that a library found them in; each begins with its least vertex."""
    faces = np.asarray(mesh.faces, np.int64)
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])]
