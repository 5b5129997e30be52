"""Shape descriptors for the retrieval of similar originals; on the host, without a key.

A descriptor describes the distribution of a surface about a centre. Points are spread over the surface, and expanded in
spherical harmonics on concentric shells. The descriptor consists of the energy of each degree, and of the products of
neighbouring shells (Kazhdan, Funkhouser, Rusinkiewicz, "Rotation invariant spherical harmonic representation of 3D
shape descriptors", SGP 2003). It does not change under rotations and reflections. Noise roughens a surface and
increases its area; therefore the weight of a point decreases with the number of points near it.

`whole` describes a shape about its centre of mass, in units of its size. `local` describes balls about points of the
shape, for suspects that are parts of an original.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import KDTree

from jaxmark.geometry.mesh import Mesh, boundary_vertices, cross_product, unit, used_vertices
from jaxmark.geometry.pose import Points

VERSION = 2  # version of all descriptors and landmarks; different versions cannot be compared
_SAMPLES = 8192
_DEGREES, _SHELLS, _APART = 12, 12, 2  # for whole shapes: largest degree, shells, largest distance of compared shells
_REACH = 2.2  # radius of the outermost shell, over the RMS distance to the centre
_THINNED = 0.08  # radius in which the points share their weight, over the RMS distance to the centre
_LOCAL_DEGREES, _LOCAL_SHELLS, _LOCAL_APART = 6, 6, 1  # the same for balls
_LOCAL_SAMPLES = 4096
LOCAL_RADIUS = 0.2  # radius of balls, over the square root of the surface's area
_LOCAL_THINNED = 0.03  # as _THINNED, over the square root of the area
CENTRES = 48  # number of balls of each original
POINTS = 1024  # number of points that are stored for each original


def _count(degrees: int, shells: int, apart: int) -> int:
    return (degrees + 1) * sum(shells - step for step in range(apart + 1))


WHOLE_SIZE = _count(_DEGREES, _SHELLS, _APART)
LOCAL_SIZE = _count(_LOCAL_DEGREES, _LOCAL_SHELLS, _LOCAL_APART)


@dataclass(frozen=True)
class Spread:
    """Points spread evenly over a shape."""

    points: Points
    normals: Points  # normals of the faces that they lie on; zeros for point clouds
    area: float  # area of the mesh; for a cloud, an estimate from its extent


def spread(mesh: Mesh, count: int = _SAMPLES) -> Spread | None:
    """Spread points evenly over the area of a surface, deterministically; returns None if its size or area is 0.

    Faces are visited along a space-filling curve, so that each region gets its share of the points, up to one point.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    used = vertices[used_vertices(mesh)]
    centre, size = np.median(used, axis=0), float(np.ptp(used, axis=0).max())
    if not 0 < size < math.inf:
        return None
    vertices = (vertices - centre) / size
    if not len(faces):
        some = np.linspace(0, len(vertices) - 1, min(count, len(vertices))).astype(np.int64)
        points = vertices[np.argsort(_along(vertices), kind="stable")[some]] * size + centre
        return Spread(points, np.zeros_like(points), size**2)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = cross_product(b - a, c - a)
    twice = np.sqrt(np.einsum("fc,fc->f", normals, normals))
    total = float(twice.sum())
    if not 0 < total < math.inf:
        return None
    order = np.argsort(_along((a + b + c) / 3), kind="stable")
    at = np.searchsorted(np.cumsum(twice[order]), (np.arange(count) + 0.5) / count * total)
    face = order[np.minimum(at, len(order) - 1)]
    # A low-discrepancy sequence in each face (Roberts 2018), which uses the plastic number instead of the golden ratio.
    plastic, number = 1.32471795724474602596, np.arange(1, count + 1)
    root, other = np.sqrt((0.5 + number / plastic) % 1), (0.5 + number / plastic**2) % 1
    shares = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    points = sum(shares[:, k, None] * corner[face] for k, corner in enumerate((a, b, c)))
    return Spread(np.asarray(points) * size + centre, unit(normals[face]), total / 2 * size**2)


def whole(shape: Spread) -> Float[np.ndarray, " numbers"]:
    """Describe a whole shape, in any pose and scale, `[WHOLE_SIZE]`.

    The distance of two shapes is the sum of the absolute differences of their descriptors.
    """
    points = shape.points
    centre, size = _centre(points, np.full(len(points), 1 / len(points)))
    weights = _weights(points, _THINNED * size)
    centre, size = _centre(points, weights)
    numbers = _describe((points - centre) / (_REACH * size), weights, _DEGREES, _SHELLS, _APART)
    return numbers.astype(np.float32)


def centred(mesh: Mesh) -> tuple[Points, Float64[np.ndarray, "3"], float]:
    """Spread points over a shape, and normalise their centre to 0, and their RMS distance to it to 1.

    The size and the area of the mesh must not be 0.

    Returns:
        The points `[POINTS, 3]`, and the centre and the RMS distance in the mesh's units.
    """
    shape = spread(mesh, POINTS)
    assert shape is not None
    points = shape.points[np.arange(POINTS) % len(shape.points)]  # a cloud may have fewer points
    centre, size = _centre(points, np.full(POINTS, 1 / POINTS))
    return (points - centre) / size, centre, size


@dataclass(frozen=True)
class Locals:
    """The neighbourhoods of some points of a shape."""

    points: Points
    weights: Float64[np.ndarray, " points"]
    centres: Int64[np.ndarray, " centres"]  # indices of the points that are described
    area: float  # area of the surface, without the increase by noise

    def describe(self, share: float = 1.0) -> Float[np.ndarray, "centres numbers"]:
        """Describe the balls about the centres, `[centres, LOCAL_SIZE]`.

        Args:
            share: assumed ratio of this shape's area to that of its original, which determines the radius of the balls.
        """
        radius, tree = LOCAL_RADIUS * math.sqrt(self.area / share), KDTree(self.points)
        numbers = np.zeros((len(self.centres), LOCAL_SIZE), np.float32)
        for row, near in enumerate(tree.query_ball_point(self.points[self.centres], radius)):
            offsets = (self.points[near] - self.points[self.centres[row]]) / radius
            weights = self.weights[near] / self.weights[near].sum()
            numbers[row] = _describe(offsets, weights, _LOCAL_DEGREES, _LOCAL_SHELLS, _LOCAL_APART)
        return numbers


def local(mesh: Mesh, count: int = CENTRES) -> Locals | None:
    """Choose points of a shape that are far from each other and from its boundary; None if its size or area is 0."""
    shape = spread(mesh, _LOCAL_SAMPLES)
    if shape is None:
        return None
    points, area, weights = shape.points, shape.area, np.ones(len(shape.points))
    for _ in range(2):  # estimate the area by the number of discs that cover the points
        radius = _LOCAL_THINNED * math.sqrt(area)
        weights = 1 / np.asarray(KDTree(points).query_ball_point(points, radius, return_length=True))
        area = float(weights.sum()) * math.pi * radius**2
    far = np.full(len(points), np.inf)
    rim = boundary_vertices(mesh.faces)
    if len(rim):
        far = np.asarray(KDTree(np.asarray(mesh.vertices)[rim]).query(points)[0])
    return Locals(points, weights, _scattered(points, far, min(count, len(points))), area)


def _scattered(points: Points, far: Float64[np.ndarray, " points"], count: int) -> Int64[np.ndarray, " chosen"]:
    """Choose points, each as far as possible from the points before it; `far` are distances from the boundary."""
    first = far if np.isfinite(far).all() else np.linalg.norm(points - points.mean(axis=0), axis=1)
    chosen = [int(np.argmax(first))]
    distance = far
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def _centre(points: Points, weights: Float64[np.ndarray, " points"]) -> tuple[Float64[np.ndarray, "3"], float]:
    """Compute the centre of points, and their root mean square distance to it."""
    centre = weights @ points
    return centre, max(math.sqrt(weights @ ((points - centre) ** 2).sum(axis=1)), np.finfo(float).tiny)


def _weights(points: Points, radius: float) -> Float64[np.ndarray, " points"]:
    """Weight points so that the weight of a region is its area, independent of the number of points; the sum is 1."""
    neighbours = np.asarray(KDTree(points).query_ball_point(points, radius, return_length=True), np.float64)
    return (1 / neighbours) / (1 / neighbours).sum()


def _describe(
    offsets: Points, weights: Float64[np.ndarray, " points"], degrees: int, shells: int, apart: int
) -> Float64[np.ndarray, " numbers"]:
    """Compute energies of harmonics on shells of the unit ball, and products of shells that differ by up to `apart`."""
    radius = np.sqrt(np.einsum("pc,pc->p", offsets, offsets))
    harmonics = real_harmonics(offsets / np.maximum(radius, np.finfo(float).tiny)[:, None], degrees)
    place = np.minimum(radius, 1.0) * (shells - 1)
    on = np.maximum(1 - np.abs(place[:, None] - np.arange(shells)), 0)
    parts = (on * weights[:, None]).T @ harmonics
    starts = np.arange(degrees + 1) ** 2
    numbers = []
    for step in range(apart + 1):
        product = np.add.reduceat(parts[: shells - step] * parts[step:], starts, axis=1)
        numbers.append((np.sign(product) * np.sqrt(np.abs(product))).ravel())
    return np.concatenate(numbers)


def real_harmonics(directions: Points, degrees: int) -> Float64[np.ndarray, "points harmonics"]:
    """Evaluate orthonormal real spherical harmonics up to a degree L at unit vectors, by their recurrences.

    Returns:
        `[points, (L + 1)²]`; within a degree, order 0 is followed by the cosine and the sine of each higher order.
    """
    x, y, z = directions.T
    cosines, sines = [np.ones(len(z))], [np.zeros(len(z))]
    for _ in range(degrees):
        cosine, sine = cosines[-1], sines[-1]
        cosines.append(x * cosine - y * sine)
        sines.append(x * sine + y * cosine)
    rows: list[list[np.ndarray]] = [[] for _ in range(degrees + 1)]
    first = np.full(len(z), math.sqrt(1 / (4 * math.pi)))  # the normalised Legendre function without its power of sin
    for order in range(degrees + 1):
        if order:
            first = first * math.sqrt((2 * order + 1) / (2 * order))
        before, now = np.zeros(len(z)), first
        for degree in range(order, degrees + 1):
            if order:
                rows[degree] += [math.sqrt(2) * now * cosines[order], math.sqrt(2) * now * sines[order]]
            else:
                rows[degree].append(now)
            up = math.sqrt((4 * (degree + 1) ** 2 - 1) / ((degree + 1) ** 2 - order**2))
            back = math.sqrt(max(degree**2 - order**2, 0) / (4 * degree**2 - 1)) if degree else 0.0
            before, now = now, up * (z * now - back * before)
    return np.stack([column for row in rows for column in row], axis=1)


def _along(points: Points) -> Int64[np.ndarray, " points"]:
    """Compute the positions of points, of extent 1, along a space-filling curve (Morton 1966)."""
    low = points.min(axis=0)
    cells = np.clip((points - low) / max(float(np.ptp(points, axis=0).max()), 1e-300) * 1023, 0, 1023).astype(np.int64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << shift)) & mask
    return cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2)
