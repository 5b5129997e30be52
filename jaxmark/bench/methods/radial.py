"""Rolland-Nevière, Doërr, Alliez, "Triangle surface mesh watermarking based on a constrained optimization framework".

IEEE Transactions on Information Forensics and Security 9 (9), 1491-1501, 2014. The distances of a surface to its centre
are sorted into bins of equal width, and a bit is the mean distance in one of them, above or below its middle, as in
Cho et al. Points move along their radii by the least squares of a quadratic programme: each bin has its mean, no point
leaves its bin, and the centre stays where it was. Centre, means and squares are integrals over the surface, where each
point stands for a third of the area of its faces, so that they do not depend on the density of sampling.

Chosen here, where the publication is silent or was not at hand. Bins divide the distances between two quantiles, which
noise changes less than the largest distance. The programme is solved exactly in its dual, which has a multiplier for
each bin and three for the centre, by Newton's method; and again for the surface that results, as areas change with the
mark. Bits are scattered by a key. There is no detector: the score is the margin that three bits in four exceed, which
does not depend on the key.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import decode_margins, make_surface, per_point, scatter
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, face_areas

SOURCE = "Rolland-Nevière, Doërr, Alliez, IEEE Transactions on Information Forensics and Security 9 (9), 2014"
_RANGE = (0.01, 0.99)  # quantiles of the distance between which bins lie
_MAX_ROUNDS, _ROUND_TOLERANCE = 12, 1e-3  # of the programme; the share of the strength by which a mean may miss
_MAX_STEPS, _MAX_HALVINGS, _TOLERANCE = 60, 10, 1e-12  # of Newton's method and its line search; of its residual
_MIN_WEIGHT = 1e-15  # below which nothing can be moved
_EDGE = 0.05  # of the width of a bin: the distance of points from its ends, which move with the areas

Values = Float64[np.ndarray, " points"]
PerBin = Float64[np.ndarray, " bits"]


class Radii(NamedTuple):
    """The distances of a surface's points to its centre, by bins."""

    weight: Values  # area that a point stands for, over the whole
    ray: Float64[np.ndarray, "points 3"]  # unit vectors from the centre
    distance: Values
    width: float  # of a bin
    place: Int64[np.ndarray, " points"]  # the bin of each point; the number of bins where it is in none
    inside: Values  # where in its bin, from 0 to 1; 0 where it is in none

    def mean(self, bits: int) -> tuple[PerBin, PerBin]:
        """The mean of each bin, from 0 to 1, and its weight; 1/2 in an empty one."""
        mass = np.bincount(self.place, self.weight, bits + 1)[:bits]
        total = np.bincount(self.place, self.weight * self.inside, bits + 1)[:bits]
        return np.divide(total, mass, out=np.full(bits, 0.5), where=mass > 0), mass


def radial(bits: int) -> Method:
    """Strengths are shifts of a bin's mean, over its width."""

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        surface = make_surface(mesh)
        points = np.asarray(surface.mesh.vertices)
        sign = np.where(scatter(message, key, "radial"), 1.0, -1.0)
        for _ in range(_MAX_ROUNDS):
            radii = _radii(surface.mesh._replace(vertices=points), bits)
            mean, mass = radii.mean(bits)
            short = np.where(mass > 0, strength - sign * (mean - 0.5), 0)
            if short.max() <= _ROUND_TOLERANCE * strength:
                break
            wanted = sign * np.maximum(short, 0) * mass * radii.width
            points = points + _least(radii, wanted, short > 0)[:, None] * radii.ray
        return surface.moved(points)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        return decode_margins(_radii(make_surface(suspect).mesh, bits).mean(bits)[0] - 0.5, key, "radial")

    return Method("radial", embed, read, True, bits, (1e-4, 0.3), SOURCE)


def _radii(mesh: Mesh, bits: int) -> Radii:
    """Sort the distances of points to the centre of area into bins; refuse a surface without faces, and a sphere."""
    check_faces("The method radial", mesh)
    points = np.asarray(mesh.vertices)
    weight = per_point(mesh, face_areas(mesh))
    weight /= weight.sum()
    centre = weight @ points
    distance = np.linalg.norm(points - centre, axis=1)
    ray = (points - centre) / np.where(distance > 0, distance, 1)[:, None]
    order = np.argsort(distance)
    below = np.cumsum(weight[order]) - weight[order] / 2
    low, high = np.interp(_RANGE, below, distance[order])
    if not high > low:
        raise JaxmarkError("All of this surface is equally far from its centre, so that nothing can be written there.")
    scaled = (distance - low) / ((high - low) / bits)
    place = np.floor(scaled)
    place = np.where((place >= 0) & (place < bits), place, bits).astype(np.int64)
    return Radii(weight, ray, distance, float((high - low) / bits), place, np.where(place < bits, scaled - place, 0))


def _least(radii: Radii, wanted: PerBin, active: Bool[np.ndarray, " bits"]) -> Values:
    """Compute the least radial displacements, by weighted squares, that shift bins' sums, and not the centre.

    Minimising Σ w δ² over displacements δ within their bounds, with Σ w δ over a bin as wanted and Σ w δ ray = 0,
    gives δ = clip(a + ray · m), with a number `a` for each bin and one vector `m` (the dual of the programme).
    """
    bits, weight, ray = len(wanted), radii.weight, radii.ray
    width = np.where(radii.place < bits, radii.width, 0)
    low = np.minimum(_EDGE - radii.inside, 0) * width
    high = np.maximum(1 - _EDGE - radii.inside, 0) * width

    def sums(values: Values) -> PerBin:
        return np.where(active, np.bincount(radii.place, values, bits + 1)[:bits], 0)

    def at(multipliers: Float64[np.ndarray, " multipliers"]) -> tuple[Values, Float64[np.ndarray, " multipliers"]]:
        shift = np.clip(np.append(multipliers[:bits], 0)[radii.place] + ray @ multipliers[bits:], low, high)
        return shift, np.append(sums(weight * shift) - wanted, (weight * shift) @ ray)

    now = np.zeros(bits + 3)
    shift, residual = at(now)
    tolerance = _TOLERANCE * np.linalg.norm(residual)
    for _ in range(_MAX_STEPS):
        # Points held at a bound do not count in the derivative. It is an arrow matrix, solved from its tip.
        loose = weight * ((shift > low) & (shift < high))
        own = np.where(active, np.maximum(sums(loose), _MIN_WEIGHT), 1)
        cross = np.stack([sums(loose * part) for part in ray.T], axis=1)
        tip = (ray.T * loose) @ ray - cross.T @ (cross / own[:, None]) + _MIN_WEIGHT * np.eye(3)
        turn = np.linalg.solve(tip, cross.T @ (residual[:bits] / own) - residual[bits:])
        step = np.append(-(residual[:bits] + cross @ turn) / own, turn)
        shift, found = at(now + step)
        for _ in range(_MAX_HALVINGS):
            if np.linalg.norm(found) < np.linalg.norm(residual):
                break
            step = step / 2
            shift, found = at(now + step)
        now, residual = now + step, found
        if np.linalg.norm(residual) <= tolerance:
            break
    return shift
