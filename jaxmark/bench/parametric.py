"""Shapes by formula, such as parametric surfaces, each meshed with approximately a given number of points."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, Delaunay

from jaxmark.adversaries.by_name import attack
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, make_mesh, unit

Points = Float64[np.ndarray, "_ 3"]
Values = Float64[np.ndarray, " _"]
Indices = Int64[np.ndarray, " points"]
Faces = Int64[np.ndarray, "faces 3"]

_SIDES = np.array([0.5, 0.35, 0.2])  # half the sides of the boxes


def grid(rows: int, columns: int, closed: tuple[bool, bool] = (False, False)) -> tuple[Indices, Indices, Faces]:
    """Return the row and column of each point of a grid, and its triangles; each direction may be periodic."""
    i, j = np.divmod(np.arange(rows * columns), columns)
    inside = (closed[0] | (i < rows - 1)) & (closed[1] | (j < columns - 1))
    a, b = i[inside], j[inside]
    c, d = (a + 1) % rows, (b + 1) % columns
    corners = [row * columns + column for row, column in ((a, b), (c, b), (c, d), (a, d))]
    return i, j, np.concatenate([np.stack([corners[k] for k in face], axis=1) for face in ((0, 1, 2), (0, 2, 3))])


def cube(points: int) -> tuple[Points, Faces]:
    """Mesh the surface of the cube from -1 to 1, with equal grids on all sides."""
    side = round(np.sqrt(points / 6)) + 1
    i, j, faces = grid(side, side)
    far = np.full_like(i, side - 1)
    near = 0 * far
    sides = ((far, i, j), (near, j, i), (j, far, i), (i, near, j), (i, j, far), (j, i, near))
    lattice = np.concatenate([np.stack(one, axis=1) for one in sides])
    distinct, point = np.unique(lattice, axis=0, return_inverse=True)
    triangles = np.concatenate([faces + k * side**2 for k in range(6)])
    return 2 * distinct / (side - 1) - 1, point.reshape(-1)[triangles]


def cylindrical(radius: Values, angle: Values, height: Values) -> Points:
    """Convert cylindrical coordinates to points."""
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _patch(points: int) -> tuple[Values, Values, Faces]:
    """Return the coordinates of a square patch, from 0 to 1, and its triangles."""
    side = round(np.sqrt(points))
    i, j, faces = grid(side, side)
    return i / (side - 1), j / (side - 1), faces


def box(points: int) -> Mesh:
    """Make a box of sides 1, 0.7 and 0.4."""
    vertices, faces = cube(points)
    return make_mesh(vertices * _SIDES, faces)


def rounded_box(points: int) -> Mesh:
    """Make the box of `box`, with edges and corners rounded to a radius of 0.08."""
    vertices, faces = cube(points)
    inner = np.clip(vertices * _SIDES, 0.08 - _SIDES, _SIDES - 0.08)
    return make_mesh(inner + 0.08 * unit(vertices * _SIDES - inner), faces)


def cylinder(points: int) -> Mesh:
    """Make a closed cylinder of radius 0.4 and height 1; its caps are square grids that are mapped to discs."""
    vertices, faces = cube(points)
    x, y = vertices[:, 0], vertices[:, 1]
    wide = np.abs(x) >= np.abs(y)
    long, short = np.where(wide, x, y), np.where(wide, y, x)
    turn = np.pi / 4 * np.divide(short, long, out=np.zeros_like(x), where=long != 0)
    disc = cylindrical(long, turn, 0.5 * vertices[:, 2])
    disc[~wide, :2] = disc[~wide, 1::-1]
    return make_mesh(disc * [0.4, 0.4, 1], faces)


def star(points: int, radius: Callable[[Points], Values]) -> Mesh:
    """Make a star-shaped surface, whose radius is a function of the direction, on the grids of a cube's sides."""
    vertices, faces = cube(points)
    direction = unit(np.tan(np.pi / 4 * vertices))
    return make_mesh(radius(direction)[:, None] * direction, faces)


def sphere(points: int) -> Mesh:
    """Make a sphere of radius 0.5."""
    return star(points, lambda d: np.full(len(d), 0.5))


def superquadric(points: int, power: float) -> Mesh:
    """Make the surface |x|^p + |y|^p + |z|^p = 1: a pinched star for small p, a sphere for p = 2, a box for large p."""
    return star(points, lambda d: np.sum(np.abs(d) ** power, axis=1) ** (-1 / power))


def supershape(points: int, fold: int, sharp: float) -> Mesh:
    """Make a surface by Gielis's superformula in both angles, with `fold`-fold symmetry."""

    def formula(angle: Values, times: int) -> Values:
        half = times * angle / 4
        return (np.abs(np.cos(half)) ** sharp + np.abs(np.sin(half)) ** sharp) ** (-1 / (2 * sharp))

    def radius(d: Points) -> Values:
        return formula(np.arctan2(d[:, 1], d[:, 0]), fold) * formula(np.arcsin(np.clip(d[:, 2], -1, 1)), 4)

    return star(points, radius)


def torus(points: int) -> Mesh:
    """Make a torus of radii 0.4 and 0.15."""
    around = round(np.sqrt(points * 0.4 / 0.15))
    across = round(points / around)
    i, j, faces = grid(around, across, (True, True))
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    return make_mesh(cylindrical(0.4 + 0.15 * np.cos(v), u, 0.15 * np.sin(v)), faces)


def corrugated(points: int) -> Mesh:
    """Make a sheet of side 1 with ten waves."""
    u, v, faces = _patch(points)
    return make_mesh(np.stack([u, v, 0.015 * np.sin(20 * np.pi * u)], axis=1), faces)


def body(points: int) -> Mesh:
    """Make a patch like a car's wing: slightly curved in both directions, with a crease that fades out."""
    u, v, faces = _patch(points)
    crease = 0.04 * (1 - u) ** 2 * np.abs(v - 0.6 + 0.1 * u)
    return make_mesh(np.stack([1.6 * u, v, 0.25 * u * (1 - u) + 0.15 * v * (1 - v) - crease], axis=1), faces)


#: Shapes of computer-aided design by name: functions of the number of points.
SHAPES: Mapping[str, Callable[[int], Mesh]] = {
    make.__name__: make for make in (box, cylinder, sphere, rounded_box, torus, corrugated, body)
}


def tube(points: int, path: Callable[[Values], Points], radius: float, *, ends: bool = False) -> Mesh:
    """Make a tube around a path with a parameter from 0 to 2π; the path is closed, or the tube has two open ends."""
    dense = path(np.linspace(0, 2 * np.pi, 4001))
    length = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    across = max(round(np.sqrt(points * 2 * np.pi * radius / length)), 6)
    along = round(points / across)
    i, j, faces = grid(along, across, (not ends, True))
    t = 2 * np.pi * np.arange(along) / (along - ends)
    centre, tangent = path(t), unit(path(t + 1e-4) - path(t - 1e-4))
    # Rotation-minimising frames; on a closed path, the remaining angle is distributed along the path.
    normal = np.empty_like(centre)
    normal[0] = unit(np.cross(tangent[0], [0.3, 0.5, 0.8])[None])[0]
    for place in range(1, along):
        normal[place] = normal[place - 1] - (normal[place - 1] @ tangent[place]) * tangent[place]
        normal[place] /= np.linalg.norm(normal[place])
    last = normal[-1] - (normal[-1] @ tangent[0]) * tangent[0]
    remaining = 0.0 if ends else np.arctan2(np.cross(last, normal[0]) @ tangent[0], last @ normal[0])
    turn = 2 * np.pi * j / across + remaining * i / along
    ring = np.cos(turn)[:, None] * normal[i] + np.sin(turn)[:, None] * np.cross(tangent, normal)[i]
    return make_mesh(centre[i] + radius * ring, faces[:, ::-1])


def knot(points: int, turns: int, windings: int) -> Mesh:
    """Make a tube around a torus knot."""

    def path(t: Values) -> Points:
        return cylindrical(1 + 0.4 * np.cos(windings * t), turns * t, 0.4 * np.sin(windings * t))

    return tube(points, path, 0.11)


def spring(points: int) -> Mesh:
    """Make a spring of six turns of wire, with two open ends."""
    return tube(points, lambda t: cylindrical(np.ones_like(t), 6 * t, 0.35 * t), 0.09, ends=True)


def vase(points: int) -> Mesh:
    """Make a vase: a surface of revolution, open at both ends."""
    side = round(np.sqrt(points))
    i, j, faces = grid(side, side, (False, True))
    s = i / (side - 1)
    radius = 0.35 + 0.15 * np.sin(5 * s) + 0.08 * s**8
    return make_mesh(cylindrical(radius, 2 * np.pi * j / side, 1.4 * s), faces[:, ::-1])


def gear(points: int, teeth: int) -> Mesh:
    """Make a wheel with teeth, a hole and flat sides: a rectangle carried around an outline."""
    across = 24
    along = round(points / across)
    i, j, faces = grid(along, across, (True, True))
    turn = 2 * np.pi * i / along
    outer = 1 + 0.09 * np.tanh(4 * np.sin(teeth * turn))
    corners, place = np.arange(5), 4 * j / across  # around the rectangle: inwards, down, outwards, up
    radius = 0.4 + np.interp(place, corners, [1, 0, 0, 1, 1]) * (outer - 0.4)
    return make_mesh(cylindrical(radius, turn, 0.3 * np.interp(place, corners, [1, 1, 0, 0, 1])), faces)


def seashell(points: int) -> Mesh:
    """Make a seashell: a tube of increasing radius around a helix, open at its mouth."""
    side = round(np.sqrt(points / 4))
    i, j, faces = grid(4 * side, side, (False, True))
    t, around = i / (4 * side - 1), 2 * np.pi * j / side
    size = np.exp(2.2 * (t - 1))
    height = size * (0.75 * np.sin(around) + 2.5) - 2.5
    return make_mesh(cylindrical(size * (1 + 0.75 * np.cos(around)), 6 * np.pi * t, height), faces)


def creature(points: int, seed: int) -> Mesh:
    """Make a body with limbs on an irregular mesh: a ball with smooth bumps, symmetric in x."""
    random = np.random.default_rng(seed)
    limbs = unit(random.normal(size=(6, 3)))
    limbs = np.concatenate([limbs, limbs * [-1, 1, 1]])
    lengths, widths = np.tile(random.uniform(0.3, 1.2, 6), 2), np.tile(random.uniform(8, 40, 6), 2)
    base = asteroid(points, seed=seed)  # only its triangles and directions are used
    direction = unit(np.asarray(base.vertices) / [1.0, 0.72, 0.8])
    radius = 0.6 + np.sum(lengths * np.exp(widths * (direction @ limbs.T - 1)), axis=1)
    return make_mesh(radius[:, None] * direction, base.faces)


def gem(points: int, seed: int) -> Mesh:
    """Make the convex hull of 40 corners, with evenly subdivided facets."""
    corners = unit(np.random.default_rng(seed).normal(size=(40, 3))) * [1, 0.8, 0.6]
    faces = ConvexHull(corners).simplices.astype(np.int64)
    a, b, c = corners[faces].swapaxes(0, 1)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    steps = max(round(np.log(points / 40) / np.log(4)), 1)
    return attack(make_mesh(corners, faces), "midpoint", steps, seed=0)


def terrain(points: int, seed: int) -> Mesh:
    """Make a square of terrain, as an airborne scanner samples it: irregular triangles, rough at all scales."""
    random = np.random.default_rng(seed)
    flat = random.uniform(size=(points, 2))
    height = np.zeros(points)
    for octave in range(7):
        waves = 2.0**octave * 3 * random.normal(size=(2, 6))
        height += 0.06 * 0.5**octave * np.sin(flat @ waves + random.uniform(0, 2 * np.pi, 6)).sum(axis=1)
    return make_mesh(np.column_stack([flat, height]), np.asarray(Delaunay(flat).simplices, np.int64))


def several(parts: Sequence[Mesh], shifts: Points) -> Mesh:
    """Combine several parts, each shifted, into one mesh; the parts share no vertex."""
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = [np.asarray(part.vertices) + shift for part, shift in zip(parts, shifts, strict=True)]
    faces = [np.asarray(part.faces) + first for part, first in zip(parts, counts, strict=False)]
    return make_mesh(np.concatenate(vertices), np.concatenate(faces))


def chain(points: int, links: int) -> Mesh:
    """Make the links of a chain; every other link is rotated by 90 degrees."""

    def path(t: Values) -> Points:
        return np.stack([0.9 * np.cos(t), 0.5 * np.sin(t), 0 * t], axis=1)

    parts = [tube(points // links, path, 0.13), tube(points // links, lambda t: path(t)[:, [0, 2, 1]], 0.13)]
    return several([parts[k % 2] for k in range(links)], np.arange(links)[:, None] * np.array([[1.35, 0, 0]]))


def rubble(points: int, rocks: int) -> Mesh:
    """Make rows of rocks, which share no vertex."""
    places = np.stack(np.unravel_index(np.arange(rocks), (3, 3, -(-rocks // 9))), axis=1) * 2.6
    return several([asteroid(points // rocks, seed=seed) for seed in range(rocks)], places.astype(float))
