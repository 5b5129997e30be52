"""Storage: what file formats lose of a mesh; host side."""

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.seeds import Randomness

_MAX_DIGITS = 17  # enough to tell any two float64 apart
_FLOAT_TYPES = {64: np.float64, 32: np.float32, 16: np.float16}  # by their bits
_MAX_ROUND_TRIPS = 10


@on_host
def digits(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Round coordinates to a number of significant decimal digits, as text files do.

    Args:
        mesh: any mesh, concrete.
        strength: number of digits, a whole number from 1 to 17; at 17 nothing changes.
        key: not used; attacks share one signature.

    Returns:
        The mesh with rounded coordinates.

    Raises:
        JaxmarkError: if the number of digits is not whole, or outside [1, 17].
    """
    if not 1 <= strength <= _MAX_DIGITS or strength != int(strength):
        raise JaxmarkError(f"A decimal has a whole number of 1 to {_MAX_DIGITS} significant digits, got {strength:g}.")
    vertices = np.asarray(mesh.vertices, np.float64)
    return _replace_used(mesh, np.char.mod(f"%.{int(strength) - 1}e", vertices).astype(np.float64))


@on_host
def float_bits(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Round coordinates to IEEE 754 binary floats of a number of bits.

    Args:
        mesh: any mesh, concrete.
        strength: bits per coordinate: 64, at which nothing changes, 32 or 16.
        key: not used; attacks share one signature.

    Returns:
        The mesh with rounded coordinates.

    Raises:
        JaxmarkError: if there is no float of that many bits, or a coordinate is too large for it.
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
def soup(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Write the mesh to a binary STL file and read it again: single precision, and no vertices shared by faces.

    Args:
        mesh: any mesh, concrete.
        strength: number of times, a whole number from 1 to 10; the first loses all that can be lost.
        key: not used; attacks share one signature.

    Returns:
        Three vertices for each face, in the order of the faces.

    Raises:
        JaxmarkError: if the number of times is not whole, or outside [1, 10], or single precision cannot hold the mesh
            (see `jaxmark.files.save_mesh`).
    """
    if not 1 <= strength <= _MAX_ROUND_TRIPS or strength != int(strength):
        raise JaxmarkError(
            f"A mesh is written and read a whole number of 1 to {_MAX_ROUND_TRIPS} times, got {strength:g}."
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "soup.stl"
        for _ in range(int(strength)):
            save_mesh(mesh, file)
            mesh = load_mesh(file)
    return mesh


def _replace_used(mesh: Mesh, rounded: Float64[np.ndarray, "vertices 3"]) -> Mesh:
    """Take the rounded coordinates of the vertices that faces use; keep the others."""
    return Mesh(np.where(used_vertices(mesh)[:, None], rounded, np.asarray(mesh.vertices)), mesh.faces)
