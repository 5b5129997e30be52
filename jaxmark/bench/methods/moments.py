"""Wang, Lavoué, Denis, Baskurt, "Robust and blind mesh watermarking based on volume moments", 2011.

Computers & Graphics 35 (1), 1-19. The volume moments of a closed surface determine a pose, in which the surface is cut
into patches by a cylindrical grid about its longest axis. Each of the largest patches carries a bit: the volume between
patch and axis (the moment of order zero) is quantised by a keyed scalar Costa scheme. A smooth deformation of the patch
changes the volume, but not the pose. All moments are integrals over triangles, which are cut at the borders of patches.
Therefore they do not depend on how the surface is meshed.

This implementation fills gaps of the publication as follows.

- The quantised value is the logarithm of the volume, relative to the volume of the whole surface.
- The grid divides the axis into equal parts between the ends of the surface, and the circle about it into equal angles.
- The two axes of largest skewness point to positive skewness; the third completes a right-handed frame.
- Points move along their normals. The displacement is a sum of three modes per patch: a mask that falls to zero at the
  rim of the patch, and two odd modes that compensate the change of pose. Among all deformations with the desired
  moments, it is the one of least squares over the surface. Newton's method finds it for the resulting surface.
- Patches that are nearly large enough to carry a bit are kept smaller than those that carry bits.
- The strength is the quantisation step. As in the publication, the reader may know it; otherwise the reader tries all
  steps that the writer may choose.
- The score is the agreement of the moments with the cells of the quantiser, whose positions the key draws at random. It
  is measured in standard deviations over other keys.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import ive

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import gather, make_surface, per_point, scatter, uniform
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, cross_product, face_areas, vertex_normals
from jaxmark.geometry.pose import Points
from jaxmark.geometry.surfaces import volume_moments

ANCHOR = (
    "bit error rates of SMI 2010 at its perceptual limits, within 0.1 in the mean, where the reader knows the step; not"
    " at its geometric ones (benchmarks/robustness/anchors.py)"
)
SOURCE = "Wang, Lavoué, Denis, Baskurt, Computers & Graphics 35 (1), 2011"
STEPS = tuple(0.128 * 2 ** (-place / 4) for place in range(25))  # quantisation steps, in logarithms of volume
_SECTORS = 8  # number of sectors around the axis; even, so that planes through the axis are their borders
_PATCHES_PER_BIT = 1.4
_MIN_GAP = 0.01  # least difference of the logarithms of volumes that carry bits and of those that do not
_NEARLY_LARGE = 0.8  # fraction of the smallest volume with a bit, above which volumes without a bit are controlled, too
_COSTA = 0.8  # fraction of the distance to the quantised value by which a value is moved (Costa's α)
_RIM = 0.35  # fraction of a patch's width, on either side, in which the mask rises
_AXIS = 0.1  # distance from the axis, in units of the volume's cube root, at which the mask is a half
_MAX_ROUNDS, _TOLERANCE = 15, 1e-3  # rounds of Newton's method; error of a moment, as a fraction of the step

Cells = Float64[np.ndarray, " cells"]
Values = Float64[np.ndarray, " points"]


class Posed(NamedTuple):
    """A closed surface in the pose, and with the size, that its volume moments determine."""

    mesh: Mesh  # the surface with outward normals and volume 1, whose axis is the first coordinate
    size: float  # the length of one unit, in the original units
    frame: Float64[np.ndarray, "3 3"]  # the axes of the pose in original coordinates, as columns
    ends: tuple[float, float]  # extent of the surface along the axis
    slabs: int  # number of slabs along the axis

    def cells(self, points: Points) -> tuple[Int64[np.ndarray, " points"], Values, Values]:
        """Return the patch of each point, and its position in the patch, along and around the axis, from 0 to 1."""
        along = (points[:, 0] - self.ends[0]) * self.slabs / (self.ends[1] - self.ends[0])
        around = (np.arctan2(points[:, 2], points[:, 1]) / (2 * np.pi) + 0.5) * _SECTORS
        slab = np.clip(np.floor(along), 0, self.slabs - 1).astype(np.int64)
        sector = np.minimum(around.astype(np.int64), _SECTORS - 1)
        return slab * _SECTORS + sector, along - np.floor(along), around - np.floor(around)


def moments(bits: int, steps: Sequence[float] = STEPS) -> Method:
    """Make the method; its strength is the quantisation step, rounded down to one of `steps`.

    Args:
        bits: payload in bits.
        steps: the steps that the writer may choose and the reader tries, descending; a single one if both agree on it.
    """
    slabs, candidates = math.ceil(_PATCHES_PER_BIT * bits / _SECTORS), np.asarray(steps, float)

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        surface = make_surface(mesh)
        points = np.asarray(surface.mesh.vertices)
        step = float(np.append(candidates[candidates <= strength * (1 + 1e-9)], candidates[-1])[0])
        target: Cells | None = None
        for _ in range(_MAX_ROUNDS):
            posed = _posed(surface.mesh._replace(vertices=points), slabs)
            volumes = _volumes(posed)
            if target is None:
                target = _target(volumes, scatter(message, key, "moments"), key, step)
            with np.errstate(divide="ignore", invalid="ignore"):
                error = np.where(np.isnan(target), 0, np.log(np.maximum(volumes, 0)) - target)
            if np.abs(error).max() <= _TOLERANCE * step:
                break
            height = _deformation(posed, volumes, -error, ~np.isnan(target))
            points = points + posed.size * height[:, None] * vertex_normals(posed.mesh) @ posed.frame.T
        return surface.moved(points)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        volumes = _volumes(_posed(make_surface(suspect).mesh, slabs))
        chosen = _largest(volumes, bits)
        positive = volumes[chosen] > 0
        value = np.log(np.where(positive, volumes[chosen], 1))
        dither = uniform(key, "moments", "dither", len(volumes))[chosen]
        phase = 2 * np.pi * (value / candidates[:, None] - dither)
        agreement = (np.cos(2 * phase) * positive).sum(axis=1)
        best = int(np.argmax(agreement))
        bound = _log10_tail(float(agreement[best]), int(positive.sum())) + math.log10(len(candidates))
        score = float(agreement[best] / math.sqrt(max(positive.sum(), 1) / 2))
        return Reading(gather(np.cos(phase[best]) < 0, key, "moments"), score, min(bound, 0.0))

    strengths = float(candidates[-1]), float(candidates[0])
    return Method("moments", embed, read, True, bits, strengths, SOURCE, ANCHOR)


def _posed(mesh: Mesh, slabs: int) -> Posed:
    """Transform a surface into the pose of its volume moments; refuse a mesh without faces, or without a volume."""
    check_faces("The method moments", mesh)
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    length = float(np.ptp(points, axis=0).max())
    points = (points - points.mean(axis=0)) / length
    whole = volume_moments(points[faces])
    if not abs(whole.mass) > 1e-9 or not np.linalg.eigvalsh(whole.covariance).min() > 0:
        raise JaxmarkError("This surface encloses no volume, but the method marks volumes; give a closed surface.")
    variance, axes = np.linalg.eigh(whole.covariance)
    points, axes = points - whole.centre, axes[:, ::-1]
    # The third moment of a tetrahedron at the origin is its volume over 20, times h3 of its corners.
    corners = (points @ axes)[faces]
    volume = (corners[:, 0] * cross_product(corners[:, 1], corners[:, 2])).sum(axis=1) / 6
    one, two, three = (np.sum(corners**power, axis=1) for power in (1, 2, 3))
    skewness = volume @ ((one**3 + 3 * one * two + 2 * three) / 120) / whole.mass / variance[::-1] ** 1.5
    sign = np.where(skewness < 0, -1.0, 1.0)
    sign[np.argmin(np.abs(skewness))] *= np.sign(np.linalg.det(axes * sign))
    size, frame = abs(whole.mass) ** (1 / 3), axes * sign
    turned = points @ frame / size
    ends = float(turned[:, 0].min()), float(turned[:, 0].max())
    return Posed(Mesh(turned, faces if whole.mass > 0 else faces[:, ::-1]), size * length, frame, ends, slabs)


def _volumes(posed: Posed) -> Cells:
    """Compute the volume between each patch and the axis.

    It is the flux of (0, y, z)/2 through the patch, because the planes between patches have no flux of this field.
    """
    triangles = np.asarray(posed.mesh.vertices)[np.asarray(posed.mesh.faces)]
    for turn in np.pi * 2 * np.arange(_SECTORS // 2) / _SECTORS:
        triangles = _cut(triangles, np.array([0, -np.sin(turn), np.cos(turn)]), 0.0)
    for height in np.linspace(*posed.ends, posed.slabs + 1)[1:-1]:
        triangles = _cut(triangles, np.array([1.0, 0, 0]), height)
    a, b, c = triangles.swapaxes(0, 1)
    middle = (a + b + c) / 3
    flux = (cross_product(b - a, c - a)[:, 1:] * middle[:, 1:]).sum(axis=1) / 4
    return np.bincount(posed.cells(middle)[0], flux, posed.slabs * _SECTORS)


def _cut(
    triangles: Float64[np.ndarray, "faces 3 3"], normal: Float64[np.ndarray, " 3"], height: float
) -> Float64[np.ndarray, "more 3 3"]:
    """Cut each triangle that a plane crosses into three triangles, so that all triangles are on one side."""
    side = triangles @ normal - height
    crossed = (side > 0).any(axis=1) & (side < 0).any(axis=1)
    part, side = triangles[crossed], side[crossed]
    positive = side > 0
    alone = np.argmax(positive ^ (positive.sum(axis=1) == 2)[:, None], axis=1)  # the corner alone on its side
    order = (alone[:, None] + np.arange(3)) % 3
    part, side = np.take_along_axis(part, order[:, :, None], axis=1), np.take_along_axis(side, order, axis=1)
    share = side[:, :1] / (side[:, :1] - side[:, 1:])
    a, b, c = part.swapaxes(0, 1)
    on_b, on_c = a + share[:, :1] * (b - a), a + share[:, 1:] * (c - a)
    parts = [np.stack(corners, axis=1) for corners in ((a, on_b, on_c), (on_b, b, c), (on_b, c, on_c))]
    return np.concatenate([triangles[~crossed], *parts])


def _largest(volumes: Cells, bits: int) -> Int64[np.ndarray, " bits"]:
    """Return the indices of the patches that carry bits, in ascending order."""
    return np.sort(np.argsort(-volumes, kind="stable")[:bits])


def _target(volumes: Cells, written: Bits, key: bytes, step: float) -> Cells:
    """Compute target logarithms of volumes, NaN for arbitrary volumes; refuse a surface with too few patches."""
    chosen = _largest(volumes, len(written))
    if not volumes[chosen].min() > 0:
        raise JaxmarkError(
            f"This surface has {(volumes > 0).sum()} patches about its longest axis, fewer than the"
            f" {len(written)} bits of the message; write fewer."
        )
    value, target = np.log(volumes[chosen]), np.full(len(volumes), np.nan)
    offset = uniform(key, "moments", "dither", len(volumes))[chosen] + written / 2
    nearest = step * (np.round(value / step - offset) + offset)
    target[chosen] = value + _COSTA * (nearest - value)
    # Patches without a bit stay smaller than those with bits, so that the reader chooses the same patches. Much smaller
    # patches need no target.
    most = target[chosen].min() - max(step / 2, _MIN_GAP)
    rest = np.isnan(target) & (volumes > _NEARLY_LARGE * math.exp(most))
    target[rest] = np.minimum(np.log(volumes[rest]), most)
    return target


def _deformation(posed: Posed, volumes: Cells, change: Cells, fixed: np.ndarray) -> Values:
    """Compute the least displacement along normals that changes logarithms of volumes, but not the pose."""
    points, area = np.asarray(posed.mesh.vertices), per_point(posed.mesh, face_areas(posed.mesh))
    cell, along, around = posed.cells(points)
    radius = np.hypot(points[:, 1], points[:, 2]) ** 2
    mask = _rise(along) * _rise(around) * radius / (radius + _AXIS**2)
    modes = mask[:, None] * np.stack([np.ones(len(mask)), np.sin(2 * np.pi * along), np.sin(2 * np.pi * around)], 1)
    x, y, z = points.T
    pose = np.stack([x, y, z, x * y, y * z, z * x])

    def sums(weight: np.ndarray) -> Float64[np.ndarray, "3 cells"]:
        return np.stack([np.bincount(cell, area * weight * mode, len(volumes)) for mode in modes.T])

    whole = sums(np.ones(len(x)))
    own = np.concatenate([np.diag(part) for part in whole], axis=1)[fixed]
    relative = own / np.maximum(volumes[fixed], 1e-9)[:, None] - whole.ravel()  # to the whole, which is 1
    rows = np.concatenate([relative, [sums(row).ravel() for row in pose]])
    cost = np.concatenate([np.bincount(cell, area * mode**2, len(volumes)) for mode in modes.T])
    inverse = np.where(cost > 0, 1 / np.maximum(cost, 1e-300), 0)
    target = np.append(change[fixed], np.zeros(len(pose)))
    amplitude = inverse * (rows.T @ np.linalg.lstsq((rows * inverse) @ rows.T, target, rcond=1e-12)[0])
    return (modes * amplitude.reshape(3, -1).T[cell]).sum(axis=1)


def _rise(place: Values) -> Values:
    """Compute the mask across a patch: it rises smoothly from 0 at the rims to 1."""
    return (1 - np.cos(np.pi * np.minimum(np.minimum(place, 1 - place) / _RIM, 1))) / 2


def _log10_tail(agreement: float, count: int) -> float:
    """Bound the probability that the sum of cosines of random angles reaches a value (Chernoff; E exp(λ cos) = I₀)."""
    rate = np.append(0.0, np.geomspace(1e-3, 1e4, 200))
    return float(np.min(count * (np.log(ive(0, rate)) + rate) - rate * agreement)) / math.log(10)
