"""Storage: rounding and loss of connectivity, as in file formats."""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.attacks.support import on_host, surface, whole_number
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.seeds import Randomness, Seed

_FLOAT_TYPES = {64: np.float64, 32: np.float32, 16: np.float16}  # by their bits


def quantisation(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Round coordinates to a uniform grid whose step along each axis is (max - min)/2^R.

    The strength is R, the bits per coordinate, a number in [1, 32]; static. Gradients pass straight through the
    rounding.
    """
    if not 1 <= strength <= 32:
        raise JaxmarkError(f"Quantisation takes 1 to 32 bits per coordinate, got {strength}.")
    vertices, points = jnp.asarray(mesh.vertices), surface(mesh)
    low = points.min(axis=0)
    step = (points.max(axis=0) - low) / float(2**strength)
    # Along an axis of zero extent there is nothing to round.
    rounds = used_vertices(mesh)[:, None] & (step > 0)
    rounded = jnp.where(rounds, low + step * jnp.round((vertices - low) / jnp.where(step > 0, step, 1)), vertices)
    return Mesh(vertices + jax.lax.stop_gradient(rounded - vertices), mesh.faces)


@on_host
def digits(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Round coordinates to a number of significant decimal digits, as text files do; on the host.

    The strength is the number of digits, a whole number from 1 to 17; at 17, which tells any two float64 apart, nothing
    changes.
    """
    count = whole_number(strength, 1, 17, "A decimal has a whole number of 1 to 17 significant digits")
    rounded = np.char.mod(f"%.{count - 1}e", np.asarray(mesh.vertices, np.float64)).astype(np.float64)
    return _replace_used(mesh, rounded)


@on_host
def float_bits(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Round coordinates to IEEE 754 binary floats of a number of bits; on the host.

    The strength is the number of bits per coordinate: 64, at which nothing changes, 32 or 16.

    Raises:
        JaxmarkError: if a coordinate is too large for such a float.
    """
    if strength not in _FLOAT_TYPES:
        raise JaxmarkError(f"A coordinate is stored as a float of 64, 32 or 16 bits, got {strength:g}.")
    kind = _FLOAT_TYPES[int(strength)]
    with np.errstate(over="ignore", under="ignore"):
        rounded = np.asarray(mesh.vertices).astype(kind).astype(np.float64)
    if not np.isfinite(rounded[used_vertices(mesh)]).all():
        most = float(np.finfo(kind).max)
        raise JaxmarkError(
            f"A coordinate exceeds {most:g}, the largest float of {strength:g} bits; scale the mesh down."
        )
    return _replace_used(mesh, rounded)


@on_host
def soup(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Write the mesh to a binary STL file and read it again: single precision, and no vertices shared by faces.

    The result has three vertices for each face, in the order of the faces. The strength is the number of times, a whole
    number from 1 to 10; the first loses all that can be lost. On the host.

    Raises:
        JaxmarkError: if single precision cannot hold the mesh (see `jaxmark.files.save_mesh`).
    """
    times = whole_number(strength, 1, 10, "A mesh is written and read a whole number of 1 to 10 times")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "soup.stl"
        for _ in range(times):
            save_mesh(mesh, file)
            mesh = load_mesh(file)
    return mesh


def _replace_used(mesh: Mesh, rounded: Float64[np.ndarray, "vertices 3"]) -> Mesh:
    """Take the rounded coordinates of the vertices that faces use; keep the others."""
    return Mesh(np.where(used_vertices(mesh)[:, None], rounded, np.asarray(mesh.vertices)), mesh.faces)
