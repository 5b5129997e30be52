"""Common parts of the attacks: checks, lengths that strengths are relative to, and displacements of a given size."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmark.distortion.norms import rms
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, boundary_vertices, check_concrete, used_vertices

Strength = float | Float[Array, ""]
Positions = Float[Array, "vertices 3"]
Arguments = ParamSpec("Arguments")


def on_host(attack: Callable[Arguments, Mesh]) -> Callable[Arguments, Mesh]:
    """Make an attack that runs on the host, in NumPy or another program, refuse to be traced."""

    @wraps(attack)
    def checked(*arguments: Arguments.args, **options: Arguments.kwargs) -> Mesh:
        check_concrete(attack.__name__, *jax.tree.leaves((arguments, options)))
        return attack(*arguments, **options)

    return checked


def check_share(share: float, what: str, *, closed: bool = False) -> None:
    """Raise `JaxmarkError` if a share is outside [0, 1), or with `closed` outside [0, 1]."""
    allowed = "in [0, 1]" if closed else "at least 0 and below 1"
    if not (0 <= share < 1 or (closed and share == 1)):
        raise JaxmarkError(f"A share of {what} is {allowed}, got {share:g}.")


def whole_number(strength: float, least: int, most: int, rule: str) -> int:
    """Return a strength as an integer; raise `JaxmarkError` with the violated rule if it is not whole or in range."""
    if not least <= strength <= most or strength != int(strength):
        raise JaxmarkError(f"{rule}, got {strength:g}.")
    return int(strength)


def surface(mesh: Mesh) -> Float[Array, "used 3"]:
    """Return the positions of the vertices that faces use."""
    return jnp.asarray(mesh.vertices)[np.flatnonzero(used_vertices(mesh))]


def inner_vertices(mesh: Mesh) -> Bool[np.ndarray, "vertices 1"]:
    """Return a mask of the vertices that faces use and that lie on no boundary."""
    inner = used_vertices(mesh)[:, None]
    inner[boundary_vertices(np.asarray(mesh.faces))] = False
    return inner


def centred(mesh: Mesh) -> Positions:
    """Return positions relative to their mean, so that filters of a distant mesh lose no digits; unused ones are 0."""
    return jnp.where(used_vertices(mesh)[:, None], jnp.asarray(mesh.vertices) - surface(mesh).mean(axis=0), 0)


def diagonal(points: Float[Array, "points 3"]) -> Float[Array, ""]:
    """Return the length of the diagonal of the points' axis-aligned bounding box."""
    return jnp.linalg.norm(jnp.ptp(points, axis=0))


def displace(mesh: Mesh, shift: Positions) -> Mesh:
    """Move the vertices that faces use by a shift; leave the others alone."""
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(used_vertices(mesh)[:, None], shift, 0), mesh.faces)


def displace_by(mesh: Mesh, shift: Positions, size: Strength) -> Mesh:
    """Move as `displace` does, with the shift rescaled to an RMS of `size` diagonals; a shift of zero stays zero."""
    found = rms(shift[np.flatnonzero(used_vertices(mesh))])
    wanted = jnp.asarray(size).astype(shift.dtype) * diagonal(surface(mesh))
    return displace(mesh, wanted / jnp.where(found > 0, found, 1) * shift)
