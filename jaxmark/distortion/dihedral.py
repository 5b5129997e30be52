"""Dihedral angles, and the metric DAME.

Reference: Váša, Rus, "Dihedral Angle Mesh Error: a fast perception correlated distortion measure for fixed connectivity
triangle meshes", Computer Graphics Forum 31(5), 2012.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmark.distortion.norms import Positions, Scalar, check_alike, lengths, ratio
from jaxmark.geometry.mesh import edges
from jaxmark.spectral.laplacian import take_rows

MIN_HEIGHT = 1e-5  # least height of a face over its longest side; flatter faces have no angles that could be seen
_FOLDED_WEIGHT = 0.01  # weight of an angle of π, where the surface is folded back onto itself; an angle of 0 has 1


class Hinges(NamedTuple):
    """Edges with the faces on their two sides; the angle is 0 at edges that do not have two faces."""

    edges: Int[Array | np.ndarray, "edges 2"]  # all edges, as `jaxmark.geometry.mesh.edges`
    left: Int[Array | np.ndarray, " edges"]  # third corner of the face that has the edge in this direction
    right: Int[Array | np.ndarray, " edges"]  # third corner of the other face
    inner: Float[Array | np.ndarray, " edges"]  # 1 if the edge has two faces, otherwise 0


class Angles(NamedTuple):
    """The dihedral angles of an original, as the metric DAME needs them; made by `weighted_angles`."""

    angles: Float[Array, " edges"]  # see `dihedral_angles`
    weights: Float[Array, " edges"]  # of the changes of these angles in the metric


def make_hinges(faces: Int[Array | np.ndarray, "faces 3"]) -> Hinges:
    """Find the faces on both sides of each edge, on the host. An edge of one face, or of three or more, is no hinge."""
    faces = np.asarray(faces)
    pairs, base = edges(faces), int(faces.max(initial=0)) + 1
    start, end, apex = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel(), np.roll(faces, -2, axis=1).T.ravel()
    # A face whose corners coincide has no sides, only an edge that it runs along twice.
    whole = (start != end) & (end != apex) & (apex != start)
    if not whole.all():
        start, end, apex = start[whole], end[whole], apex[whole]
    code = np.minimum(start, end) * base + np.maximum(start, end)
    order = np.argsort(2 * code + (start > end), kind="stable")  # first the face that has the edge in its own direction
    code, apex = code[order], apex[order]
    first = np.flatnonzero(np.diff(code, prepend=-1))
    first = first[np.diff(first, append=len(code)) == 2]
    place = np.searchsorted(pairs @ [base, 1], code[first])
    left, right, inner = pairs[:, 0].astype(np.int32), pairs[:, 0].astype(np.int32), np.zeros(len(pairs))
    left[place], right[place], inner[place] = apex[first], apex[first + 1], 1
    return Hinges(pairs.astype(np.int32), left, right, inner)


def dihedral_sine_cosine(x: Positions, hinges: Hinges) -> tuple[Float[Array, " edges"], Float[Array, " edges"]]:
    """Compute the sine and cosine, up to a common factor, of the angle by which the surface turns at each edge.

    The angle is positive where a surface whose faces run counterclockwise is convex, and 0 where it is not defined.
    """
    tail, head, left, right = _corners(x, hinges)
    along = head - tail
    length = lengths(along)
    first, second = jnp.cross(along, left - tail), jnp.cross(right - tail, along)
    size = lengths(first) * lengths(second) * length
    sine = ratio(jnp.sum(jnp.cross(first, second) * along, axis=1), size)
    cosine = ratio(jnp.sum(first * second, axis=1) * length, size)
    return sine, jnp.where(size > 0, cosine, 1)


@jax.jit
def dihedral_angles(x: Positions, hinges: Hinges) -> Float[Array, " edges"]:
    """Compute the angle by which the surface turns at each edge, in radians from -π to π; 0 without a hinge."""
    return jnp.arctan2(*dihedral_sine_cosine(x, hinges))


@jax.jit
def dame(original: Positions, distorted: Positions, hinges: Hinges) -> Scalar:
    """Compute the dihedral angle mesh error: the masked mean change of dihedral angles over inner edges.

    The error is in radians, and independent of scale. It is the paper's sum with masking m = exp((kα)²), k² =
    ln(0.01)/π², by the original's angle α. The paper's visibility weights, which need rendered images, are 1 here.
    Edges of faces that are flat in the original, which have no angle there, do not count.

    Raises:
        JaxmarkError: if the positions differ in shape.
    """
    check_alike("dame", original, distorted)
    return dame_from(weighted_angles(original, hinges), distorted, hinges)


@jax.jit
def weighted_angles(original: Positions, hinges: Hinges) -> Angles:
    """Compute what `dame_from` needs of an original, once for any number of distorted meshes."""
    angles = dihedral_angles(original, hinges)
    masking = jnp.exp(math.log(_FOLDED_WEIGHT) * (angles / np.pi) ** 2)
    inner = jnp.where(_is_flat(original, hinges), 0, jnp.asarray(hinges.inner).astype(angles.dtype))
    return Angles(angles, inner * masking / jnp.maximum(inner.sum(), 1))


@jax.jit
def dame_from(original: Angles, distorted: Positions, hinges: Hinges) -> Scalar:
    """Compute the dihedral angle mesh error from the angles of the original; see `dame`."""
    change = jnp.abs(dihedral_angles(distorted, hinges) - original.angles)
    change = jnp.minimum(change, 2 * np.pi - change)  # two sides of a sheet are folded by π and by -π alike
    return jnp.sum(original.weights * change)


def flat_faces(
    x: Float[Array | np.ndarray, "vertices 3"], faces: Int[Array | np.ndarray, "faces 3"]
) -> Bool[Array, " faces"]:
    """Find the faces that are flat, so that their angles mean nothing: lower than 1e-5 of their longest side."""
    return _are_flat(*(take_rows(x, jnp.asarray(faces)[:, corner]) for corner in range(3)))


def _are_flat(
    a: Float[Array, "faces 3"], b: Float[Array, "faces 3"], c: Float[Array, "faces 3"]
) -> Bool[Array, " faces"]:
    """Find the faces that are flat, as `flat_faces`, from the positions of their corners."""
    longest = jnp.max(jnp.stack([jnp.sum(side**2, axis=1) for side in (b - a, c - a, c - b)]), axis=0)
    return jnp.sum(jnp.cross(b - a, c - a) ** 2, axis=1) <= (MIN_HEIGHT * longest) ** 2


def _corners(x: Positions, hinges: Hinges) -> list[Float[Array, "edges 3"]]:
    """Return the positions of both ends of each edge, and of the third corners of the faces on its two sides."""
    return [take_rows(x, places) for places in (hinges.edges[:, 0], hinges.edges[:, 1], hinges.left, hinges.right)]


def _is_flat(x: Positions, hinges: Hinges) -> Bool[Array, " edges"]:
    """Find the edges that have a flat face on one of their sides."""
    tail, head, left, right = _corners(x, hinges)
    return _are_flat(tail, head, left) | _are_flat(tail, head, right)
