"""The list of attacks, and the host function that puts a mesh of a file through one of them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmark.attacks.noise import uniform_noise
from jaxmark.attacks.quantisation import quantisation
from jaxmark.attacks.smoothing import laplacian_smoothing
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, diagonal, host_mesh, used_vertices, weld, welded_mesh


class Attack(NamedTuple):
    """An attack of the library."""

    apply: Callable[[Mesh, Any, Any], Mesh]  # (mesh, strength, random key) → mesh, in JAX
    unit: str  # of its strength


ATTACKS: Mapping[str, Attack] = {
    "noise": Attack(uniform_noise, "half width over the mean distance to the centre"),
    "smoothing": Attack(laplacian_smoothing, "steps of 0.1"),
    "quantisation": Attack(quantisation, "bits per coordinate"),
}


def attack(mesh: Mesh, kind: str, strength: float, *, seed: int) -> Mesh:
    """Put a mesh through an attack as a modelling tool would: on its welded points, copies moving together.

    Args:
        mesh: any mesh.
        kind: a name in `ATTACKS`.
        strength: in the attack's unit.
        seed: of its randomness, where it has any.

    Returns:
        The attacked mesh, float64 vertices.

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
    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    start = jnp.asarray((points.vertices - centre) / length, dtype)
    attacked = ATTACKS[kind].apply(Mesh(start, points.faces), strength, jax.random.key(seed))
    moved = np.asarray(attacked.vertices, np.float64)
    # What the attack left alone stays exactly where it was.
    still = moved == np.asarray(start, np.float64)
    vertices = np.where(still, points.vertices, centre + length * moved)
    return Mesh(vertices[welded.point], mesh.faces)
