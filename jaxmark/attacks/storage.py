"""What a file keeps of a mesh; on the host."""

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float64, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.mesh import Mesh, used_vertices

_DIGITS = 17  # that tell any two float64 apart
_FLOATS = {64: np.float64, 32: np.float32, 16: np.float16}
_TRIPS = 10


def digits(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Write coordinates as decimals of so many significant digits, as text files have them.

    Args:
        mesh: any mesh, concrete.
        strength: how many digits, a whole number from 1 to 17, at which nothing changes.
        key: not used; attacks share one signature.

    Returns:
        The mesh of the rounded coordinates.

    Raises:
        JaxmarkError: if the number of digits is not whole, or outside [1, 17].
    """
    if not 1 <= strength <= _DIGITS or strength != int(strength):
        raise JaxmarkError(f"A decimal has a whole number of 1 to {_DIGITS} significant digits, got {strength:g}.")
    vertices = np.asarray(mesh.vertices, np.float64)
    return _stored(mesh, np.char.mod(f"%.{int(strength) - 1}e", vertices).astype(np.float64))


def float_bits(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Store coordinates as IEEE 754 binary floats.

    Args:
        mesh: any mesh, concrete.
        strength: bits of each: 64, at which nothing changes, 32 or 16.
        key: not used; attacks share one signature.

    Returns:
        The mesh of the rounded coordinates.

    Raises:
        JaxmarkError: if there is no float of so many bits, or a coordinate is too large for it.
    """
    if strength not in _FLOATS:
        raise JaxmarkError(f"A coordinate is stored as a float of 64, 32 or 16 bits, got {strength:g}.")
    kind = _FLOATS[int(strength)]
    with np.errstate(over="ignore", under="ignore"):
        rounded = np.asarray(mesh.vertices).astype(kind).astype(np.float64)
    if not np.isfinite(rounded[used_vertices(mesh)]).all():
        most = float(np.finfo(kind).max)
        raise JaxmarkError(
            f"A coordinate exceeds {most:g}, the largest float of {strength:g} bits; scale the mesh down."
        )
    return _stored(mesh, rounded)


def soup(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Write the mesh to a binary STL file and read it again: single precision, and each face with vertices of its own.

    Args:
        mesh: any mesh, concrete.
        strength: how many times, a whole number from 1 to 10; the first loses all that can be lost.
        key: not used; attacks share one signature.

    Returns:
        Three vertices for each face, in the order of the faces.

    Raises:
        JaxmarkError: if the number of times is not whole, or outside [1, 10], or single precision cannot hold the mesh
            (see `jaxmark.files.save_mesh`).
    """
    if not 1 <= strength <= _TRIPS or strength != int(strength):
        raise JaxmarkError(f"A mesh is written and read a whole number of 1 to {_TRIPS} times, got {strength:g}.")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "soup.stl"
        for _ in range(int(strength)):
            save_mesh(mesh, file)
            mesh = load_mesh(file)
    return mesh


def _stored(mesh: Mesh, rounded: Float64[np.ndarray, "vertices 3"]) -> Mesh:
    return Mesh(np.where(used_vertices(mesh)[:, None], rounded, np.asarray(mesh.vertices)), mesh.faces)
