"""Read and write mesh files: OBJ, PLY, OFF, STL and GLB; and point clouds: XYZ, LAS and LAZ, too.

A mesh is saved by patching the file that it was loaded from: whatever is no position or normal stays byte for byte.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files import glb, las, obj, off, ply, stl, xyz
from jaxmark.files.atomic import write_atomically
from jaxmark.files.reading import read_file
from jaxmark.files.source import Source, Texture
from jaxmark.geometry.mesh import Mesh, host_mesh, make_mesh

__all__ = ["SUFFIXES", "load_mesh", "load_texture", "save_mesh", "write_atomically"]

_FORMATS: dict[str, Callable[[bytes], Source]] = {
    ".obj": obj.parse,
    ".ply": ply.parse,
    ".off": off.parse,
    ".stl": stl.parse,
    ".glb": glb.parse,
    ".xyz": xyz.parse,
    ".las": las.parse,
    ".laz": las.parse,
}
SUFFIXES = tuple(_FORMATS)
# A file's numbers keep a displacement well enough if its RMS is at least this many times their spacing.
_MIN_SPACINGS = 10


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh from a file, in the format that its suffix names.

    Vertices are the file's own, in its order: none are merged or dropped, and isolated ones are kept. An STL file has
    three vertices of its own for each facet. A GLB file gives the local coordinates of its one mesh; transformations of
    nodes are not applied. A file without faces is a point cloud, as XYZ, LAS and LAZ files are. Polygons are split into
    triangles (v0, v1, v2), (v0, v2, v3), …, for computing only.

    Args:
        path: an OBJ, PLY (text or binary), OFF (text), STL (text or binary), GLB, XYZ (text), LAS or LAZ file.

    Returns:
        NumPy arrays: float64 vertices in the file's units, int64 faces.

    Raises:
        JaxmarkError: if the file is missing, of another format, malformed, or holds no valid mesh (see `make_mesh`).
    """
    return _read(path)[1]


def load_texture(path: str | os.PathLike) -> Texture:
    """Read the texture coordinates of an OBJ or GLB file.

    Args:
        path: a mesh file, see `load_mesh`.

    Returns:
        One pair for each corner of the faces that `load_mesh` returns, NaN for those that have none; None if the file
        or its format has no texture coordinates, or none that can be read.

    Raises:
        JaxmarkError: see `load_mesh`.
    """
    found = _read(path)[0].texture()
    return None if found is None or not np.isfinite(found).any() else found


def save_mesh(mesh: Mesh, path: str | os.PathLike, *, like: str | os.PathLike | None = None) -> None:
    """Write a mesh to a file, which appears whole or not at all.

    Args:
        mesh: the mesh to write.
        path: the file to write, in the format that its suffix names. It may be the same file as `like`.
        like: the file that the mesh was loaded from. Only the numbers of vertices that moved change, their normals
            follow, and everything else stays byte for byte. Without it a new file is written: exact in OBJ and OFF,
            in single precision in PLY, STL and GLB; exact in XYZ, and none in LAS and LAZ.

    Raises:
        JaxmarkError: if `path` has another suffix than `like`, the mesh has other faces or another number of
            vertices, the file cannot be read or written, or its numbers are too coarse for what changed: their
            spacing exceeds a tenth of the root mean square displacement of the vertices.
    """
    mesh = host_mesh(mesh)
    parse = _parser(path)
    if like is None:
        from jaxmark.files.fresh import encode_new

        write_atomically(path, encode_new(mesh, Path(path).suffix.lower(), parse))
        return
    if Path(path).suffix.lower() != Path(like).suffix.lower():
        raise JaxmarkError(
            f"{os.fspath(path)} must have the same suffix as {os.fspath(like)}, whose bytes it takes over."
        )
    source, before = _read(like)
    if len(mesh.vertices) != len(before.vertices) or not np.array_equal(mesh.faces, before.faces):
        raise JaxmarkError(
            f"The mesh ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces) does not have the vertices and faces"
            f" of {os.fspath(like)} ({len(before.vertices)} vertices, {len(before.faces)} faces)."
        )
    write_atomically(path, _patched(source, np.asarray(mesh.vertices), os.fspath(like)))


def _parser(path: str | os.PathLike) -> Callable[[bytes], Source]:
    """The parser of the format that a path's suffix names."""
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        known = ", ".join(known[1:].upper() for known in _FORMATS)
        raise JaxmarkError(f"{os.fspath(path)}: '{suffix}' is no suffix of a known mesh format ({known}).")
    return _FORMATS[suffix]


def _read(path: str | os.PathLike) -> tuple[Source, Mesh]:
    """Read a file as its source and as a validated mesh."""
    parse = _parser(path)
    try:
        data = read_file(path)
    except (OSError, ValueError) as error:  # ValueError for a NUL in the name
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {getattr(error, 'strerror', None) or error}.") from error
    try:
        source = parse(data)
        return source, make_mesh(source.positions, source.faces)
    except JaxmarkError as error:
        raise JaxmarkError(f"{os.fspath(path)}: {error}") from error


def _patched(source: Source, positions: np.ndarray, name: str) -> bytes:
    """The source's bytes with new positions; refused if its numbers are too coarse for the displacement."""
    with np.errstate(all="ignore"):
        moved = np.abs(positions - source.positions)
        largest = moved.max()
        if largest == 0:
            return source.data
        rms = float(largest * np.sqrt(np.square(moved / largest).sum(axis=1).mean()))  # scaled: squares may overflow
    try:
        spacing = source.coordinates.spacing(positions)
        if not spacing <= rms / _MIN_SPACINGS:
            raise JaxmarkError(
                f"The mesh differs from the file by {rms:.3g} (root mean square over the vertices, in file units),"
                f" but the file's numbers are {spacing:.3g} apart, more than a tenth of that;"
                f" {source.coordinates.advice(rms / _MIN_SPACINGS)}."
            )
        return source.patch(positions)
    except JaxmarkError as error:
        raise JaxmarkError(f"{name}: {error}") from error
