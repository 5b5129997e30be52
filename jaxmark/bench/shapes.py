"""Shapes as designers make them, meshed regularly, with about as many points as are asked for."""

from collections.abc import Callable, Mapping

import numpy as np

from jaxmark.geometry.mesh import Mesh, make_mesh, unit


def box(points: int) -> Mesh:
    """Of sides 1, 0.7 and 0.4."""
    vertices, faces = cube(points)
    return make_mesh(vertices * [0.5, 0.35, 0.2], faces)


def cylinder(points: int) -> Mesh:
    """Of radius 0.4 and height 1, closed; caps are meshed in squares that were bent to circles."""
    vertices, faces = cube(points)
    x, y = vertices[:, 0], vertices[:, 1]
    radius = np.maximum(np.abs(x), np.abs(y))
    wide = np.abs(x) >= np.abs(y)
    long, short = np.where(wide, x, y), np.where(wide, y, x)
    turn = np.pi / 4 * np.divide(short, long, out=np.zeros_like(x), where=long != 0)
    along, across = np.sign(long) * radius * np.cos(turn), np.sign(long) * radius * np.sin(turn)
    disc = np.stack([np.where(wide, along, across), np.where(wide, across, along)], axis=1)
    return make_mesh(np.column_stack([0.4 * disc, 0.5 * vertices[:, 2]]), faces)


def sphere(points: int) -> Mesh:
    """Of radius 0.5."""
    vertices, faces = cube(points)
    return make_mesh(0.5 * unit(np.tan(np.pi / 4 * vertices)), faces)


def rounded_box(points: int) -> Mesh:
    """The box, with edges and corners rounded to a radius of 0.08."""
    vertices, faces = cube(points)
    radius = 0.08
    outer = np.array([0.5, 0.35, 0.2])
    inner = np.clip(vertices * outer, radius - outer, outer - radius)
    return make_mesh(inner + radius * unit(vertices * outer - inner), faces)


def torus(points: int) -> Mesh:
    """Of radii 0.4 and 0.15."""
    around = round(np.sqrt(points * 0.4 / 0.15))
    across = round(points / around)
    i, j, faces = grid(around, across, closed=True)
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    ring = 0.4 + 0.15 * np.cos(v)
    return make_mesh(np.stack([ring * np.cos(u), ring * np.sin(u), 0.15 * np.sin(v)], axis=1), faces)


def corrugated(points: int) -> Mesh:
    """A sheet of side 1 with ten waves."""
    u, v, faces = _patch(points)
    return make_mesh(np.stack([u, v, 0.015 * np.sin(20 * np.pi * u)], axis=1), faces)


def body(points: int) -> Mesh:
    """A patch like a car's wing: curved slowly both ways, with one crease that fades out."""
    u, v, faces = _patch(points)
    crease = 0.04 * (1 - u) ** 2 * np.abs(v - 0.6 + 0.1 * u)
    return make_mesh(np.stack([1.6 * u, v, 0.25 * u * (1 - u) + 0.15 * v * (1 - v) - crease], axis=1), faces)


#: Ways to make a shape of about so many points, by name.
SHAPES: Mapping[str, Callable[[int], Mesh]] = {
    make.__name__: make for make in (box, cylinder, sphere, rounded_box, torus, corrugated, body)
}


def grid(rows: int, columns: int, *, closed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of each point, and triangles; closed, the last ones are followed by the first."""
    i, j = np.divmod(np.arange(rows * columns), columns)
    inside = np.full(len(i), True) if closed else (i < rows - 1) & (j < columns - 1)
    a, b = i[inside], j[inside]
    c, d = (a + 1) % rows, (b + 1) % columns
    corners = [row * columns + column for row, column in ((a, b), (c, b), (c, d), (a, d))]
    return i, j, np.concatenate([np.stack([corners[k] for k in face], axis=1) for face in ((0, 1, 2), (0, 2, 3))])


def _patch(points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates of a square patch, from 0 to 1, and triangles."""
    side = round(np.sqrt(points))
    i, j, faces = grid(side, side, closed=False)
    return i / (side - 1), j / (side - 1), faces


def cube(points: int) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a cube from -1 to 1, all sides meshed alike."""
    side = round(np.sqrt(points / 6)) + 1
    i, j, faces = grid(side, side, closed=False)
    far = np.full_like(i, side - 1)
    near = 0 * far
    sides = ((far, i, j), (near, j, i), (j, far, i), (i, near, j), (i, j, far), (j, i, near))
    lattice = np.concatenate([np.stack(one, axis=1) for one in sides])
    kept, point = np.unique(lattice, axis=0, return_inverse=True)
    triangles = np.concatenate([faces + k * side**2 for k in range(6)])
    return 2 * kept / (side - 1) - 1, point.reshape(-1)[triangles]
