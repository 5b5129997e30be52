"""Moments of shapes: how much of them lies where. They do not depend on how a shape is cut into triangles.

The functions take the corners of faces, as NumPy or traced arrays, and need them near the origin to keep their digits.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

Corners = Float[Array | np.ndarray, "faces 3 3"]  # of each face, in order


class Moments(NamedTuple):
    """Mass, centre and covariance of a shape of density 1."""

    mass: Any  # area, or signed volume: positive where normals point outwards
    centre: Any  # `[3]`
    covariance: Any  # `[3, 3]`, about the centre, per mass


def surface_moments(corners: Corners) -> Moments:
    """Moments of a surface."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (_cross(b - a, c - a) ** 2).sum(axis=1) ** 0.5 / 2
    return _moments(area, area.sum(), (a, b, c), (3, 12))


def volume_moments(corners: Corners) -> Moments:
    """Moments of what a closed surface encloses: sums over the tetrahedra that its faces and the origin span.

    The mass is not positive if normals point inwards; centre and covariance do not depend on that.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    volume = (a * _cross(b, c)).sum(axis=1) / 6
    return _moments(volume, volume.sum(), (a, b, c), (4, 20))


def _moments(weight: Any, mass: Any, corners: tuple[Any, Any, Any], over: tuple[int, int]) -> Moments:
    """Moments of simplices: with the sum s of n corners p, they are s/n and (ssᵀ + Σ ppᵀ)/(n(n + 1))."""
    total = corners[0] + corners[1] + corners[2]
    centre = weight @ total / over[0] / mass
    square = sum((part.T * weight) @ part for part in (total, *corners)) / over[1] / mass
    return Moments(mass, centre, square - centre[:, None] * centre)


def _cross(x: Any, y: Any) -> Any:
    """The cross products of rows, of NumPy or traced arrays."""
    return x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - x[:, [2, 0, 1]] * y[:, [1, 2, 0]]
