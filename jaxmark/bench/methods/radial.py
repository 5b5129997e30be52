"""Rolland-Nevière, Doërr, Alliez, "Triangle surface mesh watermarking based on a constrained optimization framework".

IEEE Transactions on Information Forensics and Security 9 (9), 1491-1501, 2014. The distances of a surface to its centre
are sorted into bins of equal width. The mean distance in a bin carries a bit: it is above or below the middle of the
bin, as in Cho et al. A quadratic programme finds the least radial displacements so that each bin has the desired mean,
no point leaves its bin, and the centre does not move. Centre, means and squares are integrals over the surface, in
which each point has a third of the area of its faces. Therefore they do not depend on the sampling density.

This implementation fills gaps of the publication as follows.

- The bins divide the distances between two quantiles, because noise changes quantiles less than the largest distance.
- Newton's method solves the dual of the programme exactly; the dual has a multiplier for each bin and three for the
  centre. The solution is repeated for the resulting surface, because areas change with the mark.
- A key permutes and flips the bits.
- There is no detector. The score is the margin that three bits in four exceed; it does not depend on the key.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import decode_margins, make_surface, per_point, scatter
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, face_areas

SOURCE = "Rolland-Nevière, Doërr, Alliez, IEEE Transactions on Information Forensics and Security 9 (9), 2014"
_RANGE = (0.01, 0.99)  # quantiles of the distance that limit the bins
_MAX_ROUNDS, _ROUND_TOLERANCE = 12, 1e-3  # rounds of the programme; error of a mean, as a fraction of the strength
_MAX_STEPS, _MAX_HALVINGS, _TOLERANCE = 60, 10, 1e-12  # steps and line searches of Newton's method; its residual
_MIN_WEIGHT = 1e-15  # least weight of a bin in the derivative, so that it can be inverted
_EDGE = 0.05  # least distance of points from the ends of their bin, over its width; the ends move with the areas

Values = Float64[np.ndarray, " points"]
PerBin = Float64[np.ndarray, " bits"]


class Radii(NamedTuple):
    """The distances of a surface's points to its centre, sorted into bins."""

    weight: Values  # area of each point, as a fraction of the surface
    ray: Float64[np.ndarray, "points 3"]  # unit vectors from the centre
    distance: Values
    width: float  # width of a bin
    place: Int64[np.ndarray, " points"]  # the bin of each point; the number of bins if it is in none
    inside: Values  # position of each point in its bin, from 0 to 1; 0 if it is in none

    def mean(self, bits: int) -> tuple[PerBin, PerBin]:
        """Compute the mean of each bin, from 0 to 1, and its weight; the mean of an empty bin is 1/2."""
        mass = np.bincount(self.place, self.weight, bits + 1)[:bits]
        total = np.bincount(self.place, self.weight * self.inside, bits + 1)[:bits]
        return np.divide(total, mass, out=np.full(bits, 0.5), where=mass > 0), mass


def radial(bits: int) -> Method:
    """Make the method; its strength is the shift of a bin's mean, as a fraction of the bin's width."""

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
            target = sign * np.maximum(short, 0) * mass * radii.width
            points = points + _least(radii, target, short > 0)[:, None] * radii.ray
        return surface.moved(points)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        return decode_margins(_radii(make_surface(suspect).mesh, bits).mean(bits)[0] - 0.5, key, "radial")

    return Method("radial", embed, read, True, bits, (1e-4, 0.3), SOURCE)


def _radii(mesh: Mesh, bits: int) -> Radii:
    """Sort the distances of points to the centre into bins; refuse a mesh without faces, and a sphere."""
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
        raise JaxmarkError(
            "All points of this surface have the same distance to its centre, so that the method cannot mark it."
        )
    scaled = (distance - low) / ((high - low) / bits)
    place = np.floor(scaled)
    place = np.where((place >= 0) & (place < bits), place, bits).astype(np.int64)
    return Radii(weight, ray, distance, float((high - low) / bits), place, np.where(place < bits, scaled - place, 0))


def _least(radii: Radii, target: PerBin, active: Bool[np.ndarray, " bits"]) -> Values:
    """Compute the least radial displacements that change the sums of bins as required, but not the centre.

    The displacements δ minimise Σ w δ² within their bounds, under the conditions that Σ w δ over each bin has its
    target, and that Σ w δ ray = 0. The solution is δ = clip(a + ray · m), with a number `a` for each bin and one vector
    `m`; these are the dual variables of the programme.
    """
    bits, weight, ray = len(target), radii.weight, radii.ray
    width = np.where(radii.place < bits, radii.width, 0)
    low = np.minimum(_EDGE - radii.inside, 0) * width
    high = np.maximum(1 - _EDGE - radii.inside, 0) * width

    def sums(values: Values) -> PerBin:
        return np.where(active, np.bincount(radii.place, values, bits + 1)[:bits], 0)

    def at(multipliers: Float64[np.ndarray, " multipliers"]) -> tuple[Values, Float64[np.ndarray, " multipliers"]]:
        shift = np.clip(np.append(multipliers[:bits], 0)[radii.place] + ray @ multipliers[bits:], low, high)
        return shift, np.append(sums(weight * shift) - target, (weight * shift) @ ray)

    now = np.zeros(bits + 3)
    shift, residual = at(now)
    tolerance = _TOLERANCE * np.linalg.norm(residual)
    for _ in range(_MAX_STEPS):
        # Points at a bound have no derivative. The matrix of derivatives is an arrowhead matrix: diagonal, except for
        # its last three rows and columns, so that the Schur complement of these solves it.
        free = weight * ((shift > low) & (shift < high))
        own = np.where(active, np.maximum(sums(free), _MIN_WEIGHT), 1)
        cross = np.stack([sums(free * part) for part in ray.T], axis=1)
        complement = (ray.T * free) @ ray - cross.T @ (cross / own[:, None]) + _MIN_WEIGHT * np.eye(3)
        turn = np.linalg.solve(complement, cross.T @ (residual[:bits] / own) - residual[bits:])
        step = np.append(-(residual[:bits] + cross @ turn) / own, turn)
        shift, trial = at(now + step)
        for _ in range(_MAX_HALVINGS):
            if np.linalg.norm(trial) < np.linalg.norm(residual):
                break
            step = step / 2
            shift, trial = at(now + step)
        now, residual = now + step, trial
        if np.linalg.norm(residual) <= tolerance:
            break
    return shift
