"""Rolland-Nevière, Doërr, Alliez, "Triangle surface mesh watermarking based on a constrained optimization framework".

IEEE Transactions on Information Forensics and Security 9 (9), 1491-1501, 2014. The distances of a surface to its centre
are sorted into bins of equal width, and a bit is the mean distance in one of them, above or below its middle, as in
Cho et al. But the points move along their radii as little as a quadratic programme allows: least squares, so that each
bin has its mean, no point leaves its bin, and the centre stays where it was. Centre, means and squares are integrals
over the surface, each point standing for a third of the area of its faces, so that they do not depend on how densely
it was sampled.

Chosen here, where the publication is silent or was not at hand. Bins divide the distances between two quantiles, of
which noise knows less than of the largest distance. The programme is solved exactly in its dual, which has a multiplier
for each bin and three for the centre, by Newton's method; and again, about what the reader would find in the result, as
areas change with the mark. Bits are scattered by a key. There is no detector: the score is the margin that three bits
in four exceed, which does not depend on the key.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.draws import gather, scatter
from jaxmark.bench.methods.surface import per_point, skin
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, face_areas

SOURCE = "Rolland-Nevière, Doërr, Alliez, IEEE Transactions on Information Forensics and Security 9 (9), 2014"
_RANGE = (0.01, 0.99)  # quantiles of the distance between which bins lie
_ROUNDS = 12  # of the programme
_NEAR = 1e-3  # share of the strength by which a mean may miss its target
_STEPS, _SHORTER, _SOLVED = 60, 10, 1e-12  # of Newton's method; its line search; the share of the error that ends it
_TINY = 1e-15  # weight below which nothing can be moved
_EDGE = 0.05  # of the width of a bin: what points keep from its ends, which move with the areas
_SURE = 0.25  # quantile of the margins

Values = Float64[np.ndarray, " points"]


class Radii(NamedTuple):
    """A surface as the reader sees it."""

    weight: Values  # area that a point stands for, over the whole
    centre: Float64[np.ndarray, " 3"]
    ray: Float64[np.ndarray, "points 3"]  # unit vectors from the centre
    distance: Values
    low: float  # where the first bin begins
    width: float  # of a bin
    place: Int64[np.ndarray, " points"]  # the bin of each point; as many as there are bins where it is in none

    def mean(self, bits: int) -> tuple[Float64[np.ndarray, " bits"], Float64[np.ndarray, " bits"]]:
        """The mean of each bin, from 0 to 1, and its weight; 1/2 in an empty one."""
        mass = np.bincount(self.place, self.weight, bits + 1)[:bits]
        inside = (self.distance - self.low) / self.width - self.place
        total = np.bincount(self.place, self.weight * inside, bits + 1)[:bits]
        return np.divide(total, mass, out=np.full(bits, 0.5), where=mass > 0), mass


def radial(bits: int) -> Method:
    """Strengths are shifts of a bin's mean, over its width."""

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        body = skin(mesh)
        points = np.asarray(body.mesh.vertices)
        sign = np.where(scatter(np.asarray(message, bool), key, "radial"), 1.0, -1.0)
        for _ in range(_ROUNDS):
            seen = _seen(body.mesh._replace(vertices=points), bits)
            mean, mass = seen.mean(bits)
            short = np.where(mass > 0, strength - sign * (mean - 0.5), 0)
            if short.max() <= _NEAR * strength:
                break
            wanted = sign * np.maximum(short, 0) * mass * seen.width
            points = points + _least(seen, wanted, short > 0)[:, None] * seen.ray
        return body.moved(points)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        margin = _seen(skin(suspect).mesh, bits).mean(bits)[0] - 0.5
        return Reading(gather(margin > 0, key, "radial"), float(np.quantile(np.abs(margin), _SURE)))

    return Method("radial", embed, read, True, bits, (1e-4, 0.3), SOURCE)


def _seen(mesh: Mesh, bits: int) -> Radii:
    """Centre, distances and bins of a surface.

    Raises:
        JaxmarkError: if it has no faces, or is a sphere.
    """
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
    width = (high - low) / bits
    place = np.floor((distance - low) / width)
    place = np.where((place >= 0) & (place < bits), place, bits).astype(np.int64)
    return Radii(weight, centre, ray, distance, float(low), float(width), place)


def _least(seen: Radii, wanted: Float64[np.ndarray, " bits"], active: Bool[np.ndarray, " bits"]) -> Values:
    """The least radial displacements, by weighted squares, that shift some bins' sums, and the centre by nothing.

    Of all displacements δ within their bounds, with Σ w δ over a bin as wanted and Σ w δ ray = 0, the one of least
    Σ w δ² is δ = clip(a + ray · m), with a number `a` for each bin and one vector `m` (the dual of the programme).
    """
    bits, weight, ray = len(wanted), seen.weight, seen.ray
    inside = np.where(seen.place < bits, (seen.distance - seen.low) / seen.width - seen.place, 0)
    low = np.where(seen.place < bits, np.minimum(_EDGE - inside, 0), 0) * seen.width
    high = np.where(seen.place < bits, np.maximum(1 - _EDGE - inside, 0), 0) * seen.width

    def sums(values: Values) -> Float64[np.ndarray, " bits"]:
        return np.where(active, np.bincount(seen.place, values, bits + 1)[:bits], 0)

    def at(multipliers: Float64[np.ndarray, " multipliers"]) -> tuple[Values, Float64[np.ndarray, " multipliers"]]:
        shift = np.clip(np.append(multipliers[:bits], 0)[seen.place] + ray @ multipliers[bits:], low, high)
        return shift, np.append(sums(weight * shift) - wanted, (weight * shift) @ ray)

    now = np.zeros(bits + 3)
    shift, off = at(now)
    enough = _SOLVED * np.linalg.norm(off)
    for _ in range(_STEPS):
        # Points held at a bound do not count in the derivative. It is an arrow matrix, solved from its tip.
        loose = weight * ((shift > low) & (shift < high))
        own = np.where(active, np.maximum(sums(loose), _TINY), 1)
        cross = np.stack([sums(loose * part) for part in ray.T], axis=1)
        tip = (ray.T * loose) @ ray - cross.T @ (cross / own[:, None]) + _TINY * np.eye(3)
        turn = np.linalg.solve(tip, cross.T @ (off[:bits] / own) - off[bits:])
        step = np.append(-(off[:bits] + cross @ turn) / own, turn)
        shift, found = at(now + step)
        for _ in range(_SHORTER):
            if np.linalg.norm(found) < np.linalg.norm(off):
                break
            step = step / 2
            shift, found = at(now + step)
        now, off = now + step, found
        if np.linalg.norm(off) <= enough:
            break
    return shift
