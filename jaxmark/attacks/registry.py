"""The list of attacks, and the host function that puts a mesh of a file through one of them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmark.attacks.affine import affine, similarity
from jaxmark.attacks.flips import edge_flips
from jaxmark.attacks.noise import diagonal_noise, uniform_noise
from jaxmark.attacks.quantisation import quantisation
from jaxmark.attacks.smoothing import laplacian_smoothing
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, diagonal, host_mesh, used_vertices, weld, welded_mesh


class Attack(NamedTuple):
    """An attack of the library."""

    # (mesh, strength, random key) → mesh: in JAX, or on the host if faces change, of which there are as many then
    apply: Callable[[Mesh, Any, Any], Mesh]
    unit: str  # of its strength


ATTACKS: Mapping[str, Attack] = {
    "noise": Attack(uniform_noise, "half width over the mean distance to the centre"),
    "diagonal-noise": Attack(diagonal_noise, "half width over the diagonal"),
    "smoothing": Attack(laplacian_smoothing, "steps of 0.1"),
    "quantisation": Attack(quantisation, "bits per coordinate"),
    "similarity": Attack(similarity, "shift over the diagonal, and scale up or down less 1; any rotation"),
    "affine": Attack(affine, "Frobenius norm of the map less the identity"),
    "edge-flips": Attack(edge_flips, "share of the edges"),
}


def attack(mesh: Mesh, kind: str, strength: float, *, seed: int) -> Mesh:
    """Put a mesh through an attack as a modelling tool would: on its welded points, copies moving together.

    A face that an attack changes refers to the first copy of each of its points: along a seam, where copies differ in
    what the file says of them, it takes that of the first.

    Args:
        mesh: any mesh.
        kind: a name in `ATTACKS`.
        strength: in the attack's unit.
        seed: of its randomness, where it has any.

    Returns:
        The attacked mesh, float64 vertices, as many as there were; other faces only from an attack that changes them.

    Raises:
        JaxmarkError: if there is no such attack, or its strength is out of range.
    """
    if kind not in ATTACKS:
        raise JaxmarkError(f"There is no attack {kind!r}; there are {', '.join(ATTACKS)}.")
    if not (np.isfinite(strength) and strength >= 0):
        raise JaxmarkError(f"The strength of an attack must be a number, not negative, got {strength}.")
    mesh = host_mesh(mesh)
    welded = weld(mesh.vertices)
    points = welded_mesh(mesh, welded)
    # Near the origin and at unit size, float32 keeps its digits.
    centre, length = points.vertices[used_vertices(points)].mean(axis=0), diagonal(mesh)
    start = (points.vertices - centre) / length
    attacked = ATTACKS[kind].apply(Mesh(start, points.faces), strength, jax.random.key(seed))
    # What the attack left alone stays exactly where it was.
    still = np.asarray(attacked.vertices) == start.astype(attacked.vertices.dtype)
    vertices = np.where(still, points.vertices, centre + length * np.asarray(attacked.vertices, np.float64))
    kept = (attacked.faces == points.faces).all(axis=1)
    faces = np.where(kept[:, None], mesh.faces, welded.first[attacked.faces])
    return Mesh(vertices[welded.point], faces)
