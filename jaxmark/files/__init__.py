"""Read and write mesh files (OBJ, PLY, OFF, STL, GLB, VRM, glTF, 3MF, USD) and point clouds (also XYZ, LAS, LAZ, SPZ).

A file is saved by patching the file that it was loaded from: all bytes except those of positions and normals stay.
"""

import os
import posixpath
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, obj, off, ply, point_cloud, splats, stl, threemf, usd
from jaxmark.files.atomic import holds, read_beside, read_file, write_atomically, write_together
from jaxmark.files.gltf import asset
from jaxmark.files.source import Indices, Source, Texture, concerning
from jaxmark.geometry.mesh import Mesh, host_mesh, make_mesh
from jaxmark.geometry.pose import Points
from jaxmark.geometry.skinning import Skinning

__all__ = [
    "SUFFIXES",
    "Scene",
    "load_mesh",
    "load_scene",
    "load_skin",
    "load_texture",
    "number_check",
    "save_mesh",
    "save_scene",
    "write_atomically",
]

_USD = (".usd", ".usda", ".usdc", ".usdz")
_FORMATS: dict[str, Callable[..., Source]] = {
    ".obj": obj.parse,
    ".ply": ply.parse,
    ".off": off.parse,
    ".stl": stl.parse,
    ".glb": asset.parse,
    ".gltf": asset.parse,
    ".vrm": asset.parse,
    ".3mf": threemf.parse,
    **dict.fromkeys(_USD, usd.parse),
    ".xyz": point_cloud.parse_xyz,
    ".las": point_cloud.parse_las,
    ".laz": point_cloud.parse_las,
    ".spz": splats.parse_spz,
}
SUFFIXES = tuple(_FORMATS)
_MOST_LOST = 0.9  # RMS of what rounding adds to a displacement, over the RMS of the displacement; readers decide below
_NOTED_LOSS = 0.05  # of the same, from which rounding is reported
_MIN_SPACINGS = 10  # numbers keep a displacement well if its RMS is this many times their spacing
_ONLY = "mesh"  # name of the mesh in a file that has just one
# Suffixes of the files that are copied along with a file that refers to them.
_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".avif", ".bmp", ".gif", ".svg", ".tga", ".tif", ".tiff", ".exr", ".hdr")
_TEXTURES = (".ktx", ".ktx2", ".basis", ".dds", ".tx")
_COMPANIONS = frozenset((*_IMAGES, *_TEXTURES, *_USD, ".bin", ".mtl", ".mtlx"))
_MOST_COMPANION, _MOST_COMPANIONS = 2**28, 2**30  # bytes of one of them, and of all together
_MOST_NOTED = 5
_MOST_MOVED = 0.05  # largest displacement, over the extent of a mesh, of a layer that was marked


class Scene(NamedTuple):
    """The meshes of a file."""

    meshes: Mapping[str, Mesh]  # by name, in the file's order, each in its own coordinates
    skipped: Mapping[str, str]  # meshes that cannot be used, by name, and the reasons


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh from a file, in the format that its suffix names.

    Vertices are the file's own, in its order: none are merged or dropped, and isolated ones are kept. An STL file has
    three vertices of its own for each facet. A GLB, glTF, USD or 3MF file gives local coordinates; transformations of
    nodes, components and built items are not applied. Several meshes in a file follow each other as one; `load_scene`
    separates them. A file without faces is a point cloud, as XYZ, LAS, LAZ and SPZ files are. Polygons are split into
    triangles (v0, v1, v2), (v0, v2, v3), …, for computing only.

    Args:
        path: an OBJ, PLY (text or binary), OFF (text), STL (text or binary), GLB, VRM (a GLB), glTF, 3MF, USD (also
            USDA, USDC and USDZ), XYZ (text), LAS, LAZ or SPZ file.

    Returns:
        NumPy arrays: float64 vertices in the file's units, int64 faces.

    Raises:
        JaxmarkError: if the file is missing, of another format, malformed, or holds no valid mesh (see `make_mesh`).
    """
    return _whole(_read(path), path)


def load_scene(path: str | os.PathLike) -> Scene:
    """Read the meshes of a file: those of a GLB, glTF or USD file, or the objects of an OBJ or 3MF file.

    Objects of OBJ that share vertices are one mesh, and so are meshes that share positions. Instances and other nodes
    that show the same mesh are not distinguished. Files of other formats have one mesh.

    Raises:
        JaxmarkError: see `load_mesh`; but of several meshes, some may be invalid.
    """
    source = _read(path)
    if not source.parts:
        return Scene({_ONLY: _whole(source, path)}, {})
    meshes: dict[str, Mesh] = {}
    skipped = dict(source.skipped)
    for part in source.parts:
        try:
            meshes[part.name] = make_mesh(source.positions[part.places], part.faces)
        except JaxmarkError as error:
            skipped[part.name] = str(error).rstrip(".")
    if not meshes:
        raise JaxmarkError(f"{os.fspath(path)}: " + "; ".join(f"{name}: {reason}" for name, reason in skipped.items()))
    return Scene(meshes, skipped)


def load_texture(path: str | os.PathLike) -> Texture:
    """Read the texture coordinates of an OBJ, GLB, glTF or USD file.

    Returns:
        One pair for each corner of the faces that `load_mesh` returns, NaN for those that have none; None if the file
        or its format has no texture coordinates, or none that can be read.

    Raises:
        JaxmarkError: see `load_mesh`.
    """
    texture = _read(path).texture()
    return None if texture is None or not np.isfinite(texture).any() else texture


def load_skin(path: str | os.PathLike) -> Skinning:
    """Read the skin of a GLB or glTF file: the joints that move each vertex, and their weights.

    Returns:
        One row for each vertex that `load_mesh` returns. The weights of a vertex sum to 1; joints of several skins
        in one file have different numbers.

    Raises:
        JaxmarkError: see `load_mesh`; or if not all meshes of the file have a skin.
    """
    skin = _read(path).skin()
    if skin is None:
        raise JaxmarkError(
            f"{os.fspath(path)}: the file, or one of its meshes, has no skin; only GLB and glTF have one."
        )
    return skin


def save_mesh(mesh: Mesh, path: str | os.PathLike, *, like: str | os.PathLike | None = None) -> tuple[str, ...]:
    """Write a mesh to a file, atomically.

    Args:
        mesh: the mesh to write.
        path: the file to write, in the format that its suffix names. It may be the same file as `like`.
        like: the file that the mesh was loaded from. Only the numbers of vertices that moved change, their normals
            follow, and everything else stays byte for byte; in USD, all other opinions stay. Without it a new file is
            written: exact in OBJ, OFF, XYZ and 3MF, in single precision in PLY, STL, GLB, glTF and USD; none in LAS,
            LAZ and SPZ. Files that a glTF or USD file refers to come along: a buffer that changes is named after the
            new file, the others are copied where they are not there already.

    Returns:
        Sentences about content that could not stay as it was; usually none.

    Raises:
        JaxmarkError: if `path` has another suffix than `like`, the mesh has other faces or another number of
            vertices, the file cannot be read or written, or its numbers are too coarse for what changed: rounding
            takes more than 90 % of the root mean square displacement of the vertices.
    """
    mesh = host_mesh(mesh)
    if like is None:
        from jaxmark.files.export import encode_new

        write_atomically(path, encode_new(mesh, _suffix(path), partial(_parse, path)))
        return ()
    return _save_whole(mesh, _source_of(path, like), path, like)


def _save_whole(mesh: Mesh, source: Source, path: str | os.PathLike, like: str | os.PathLike) -> tuple[str, ...]:
    """Write all meshes of a file as one."""
    before = _whole(source, like)
    if len(mesh.vertices) != len(before.vertices) or not np.array_equal(mesh.faces, before.faces):
        raise JaxmarkError(
            f"The mesh ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces) does not have the vertices and faces"
            f" of {os.fspath(like)} ({len(before.vertices)} vertices, {len(before.faces)} faces)."
        )
    return _save(source, np.asarray(mesh.vertices), path, like)


def save_scene(meshes: Mapping[str, Mesh], path: str | os.PathLike, *, like: str | os.PathLike) -> tuple[str, ...]:
    """Write a file of several meshes, with changed vertices of some meshes.

    Args:
        meshes: meshes by their names in `load_scene`; those that are not given stay as they are.
        path: see `save_mesh`.
        like: the file that they were loaded from.

    Returns:
        Sentences about content that could not stay as it was; usually none.

    Raises:
        JaxmarkError: see `save_mesh`; also if there is no mesh of such a name.
    """
    source = _source_of(path, like)
    if not source.parts:
        if [*meshes] != [_ONLY]:
            raise JaxmarkError(f"{os.fspath(like)} has one mesh, {_ONLY!r}, not {', '.join(map(repr, meshes))}.")
        return _save_whole(host_mesh(meshes[_ONLY]), source, path, like)
    positions = source.positions.copy()
    parts = {part.name: part for part in source.parts}
    for name, mesh in meshes.items():
        part, mesh = parts.get(name), host_mesh(mesh)
        if part is None or len(part.places) != len(mesh.vertices) or not np.array_equal(part.faces, mesh.faces):
            raise JaxmarkError(f"{os.fspath(like)} has no mesh {name!r} with these vertices and faces.")
        positions[part.places] = mesh.vertices
    return _save(source, positions, path, like)


def number_check(like: str | os.PathLike) -> Callable[[str, Mesh], None]:
    """Make a function (name, mesh) that checks whether a file's numbers are precise enough for changed vertices.

    The function raises a `JaxmarkError` if they are not, see `save_mesh`.

    Raises:
        JaxmarkError: if the file cannot be read, or cannot be written with other positions.
    """
    source = _read(like)
    if source.fixed:
        raise JaxmarkError(f"{os.fspath(like)}: {source.fixed}")
    places = _places(source)

    def check(name: str, mesh: Mesh) -> None:
        positions = source.positions.copy()
        positions[places[name]] = mesh.vertices
        _check_rounding(source, positions, places[name])

    return check


def _places(source: Source) -> dict[str, Indices]:
    """Return the rows of the positions that each mesh has, by name."""
    return {part.name: part.places for part in source.parts} or {_ONLY: np.arange(len(source.positions))}


def _suffix(path: str | os.PathLike) -> str:
    """Return the suffix of a path, which names a known format."""
    if not isinstance(path, str | os.PathLike):
        raise JaxmarkError(f"A path is needed, got {type(path).__name__}.")
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        known = ", ".join(known[1:].upper() for known in _FORMATS)
        raise JaxmarkError(f"{os.fspath(path)}: '{suffix}' is no suffix of a known mesh format ({known}).")
    return suffix


def _parse(path: str | os.PathLike, data: bytes) -> Source:
    """Parse the bytes of a file; files of some formats refer to other files in the same folder."""
    suffix = _suffix(path)
    if _FORMATS[suffix] is not asset.parse:
        return _FORMATS[suffix](data)
    return asset.parse(data, read_beside(Path(path).parent, limits.BUFFERS.least, limits.BUFFERS.least))


def _read(path: str | os.PathLike) -> Source:
    """Read a file."""
    _suffix(path)
    try:
        data = read_file(path)
    except (OSError, ValueError) as error:  # ValueError for a NUL in the name
        raise JaxmarkError(f"Cannot read {os.fspath(path)}: {getattr(error, 'strerror', None) or error}.") from error
    with concerning(os.fspath(path)):
        return _parse(path, data)


def _whole(source: Source, path: str | os.PathLike) -> Mesh:
    """Join all meshes of a file."""
    with concerning(os.fspath(path)):
        return make_mesh(source.positions, source.faces)


def _source_of(path: str | os.PathLike, like: str | os.PathLike) -> Source:
    """Read the file that a new file is patched from."""
    if _suffix(path) != Path(like).suffix.lower():
        raise JaxmarkError(
            f"{os.fspath(path)} must have the same suffix as {os.fspath(like)}, whose bytes it takes over."
        )
    return _read(like)


def _save(source: Source, positions: np.ndarray, path: str | os.PathLike, like: str | os.PathLike) -> tuple[str, ...]:
    """Write a source with other positions, and the files beside it; refused if its numbers are too coarse."""
    with concerning(os.fspath(like)):
        lost = [_check_rounding(source, positions, places) for places in _places(source).values()]
        moved = any(loss is not None for loss in lost)
        if moved and source.fixed:
            raise JaxmarkError(source.fixed)
        patched = source.patch(positions if moved else source.positions, Path(path).stem)
    beside = dict(patched.beside)
    here, there = Path(like).parent, Path(path).parent
    left: tuple[str, ...] = ()
    if os.path.realpath(here) != os.path.realpath(there):
        read = read_beside(here, _MOST_COMPANION, _MOST_COMPANIONS)
        names = {posixpath.normpath(companion) for companion in patched.companions}
        for name in sorted(names):
            if not _may_come_along(name, Path(like)):
                left += (f"the file {ascii(name)[:80]} that it refers to is not copied",)
                continue
            try:
                beside[name] = read(name, None)
            except JaxmarkError as error:  # a file that is missing already does not come along
                left += (f"{error}, and is not copied",) if (here / name).exists() else ()
    write_together(path, patched.file, beside, may_stay)
    most = max((loss or 0.0 for loss in lost), default=0.0)
    noted = (f"rounding to the numbers of the file changes the displacement by {100 * most:.0f} %",)
    return patched.notes + left[:_MOST_NOTED] + noted * (most > _NOTED_LOSS)


def _may_come_along(name: str, like: Path) -> bool:
    """Whether a file that another one refers to may be copied: an image, a buffer or a layer in or below its folder.

    The name comes from the file, which could name a key or the original.
    """
    suffix, target = Path(name).suffix.lower(), like.parent / name
    inside = not posixpath.isabs(name) and "\\" not in name and not name.startswith("..")
    return inside and suffix in _COMPANIONS and os.path.realpath(target) != os.path.realpath(like)


def may_stay(target: Path, content: bytes) -> bool:
    """Whether an existing file may stay where a companion with the given bytes would come.

    It may if it has these bytes, or if it is the same USD layer with points that moved a little: most likely this layer
    was marked before the file that refers to it.
    """
    if holds(target, content):
        return True
    if not target.is_file() or target.suffix.lower() not in _USD:
        return False
    try:
        there, new = usd.parse(read_file(target, _MOST_COMPANION)), usd.parse(content)
    except (OSError, JaxmarkError):
        return False
    if [mesh.name for mesh in there.meshes] != [mesh.name for mesh in new.meshes]:
        return False
    if len(there.positions) != len(new.positions) or not np.array_equal(there.faces, new.faces):
        return False
    sizes = [np.ptp(new.positions[places], axis=0).max() for places in _places(new).values()]
    moved = [np.abs(there.positions[places] - new.positions[places]).max() for places in _places(new).values()]
    return all(shift <= _MOST_MOVED * size for shift, size in zip(moved, sizes, strict=True))


def _check_rounding(source: Source, positions: Points, places: Indices) -> float | None:
    """Refuse numbers that are too coarse for the displacement of a mesh.

    Returns the RMS of what rounding adds to the displacement, over the RMS of the displacement; None if nothing moves.
    """
    wanted = positions[places]
    with np.errstate(all="ignore"):
        moved = wanted - source.positions[places]
        largest = np.abs(moved).max(initial=0.0)
        if largest == 0:
            return None
        added = source.coordinates.rounded(positions, places) - wanted
        # Scaled, because squares may overflow.
        rms, lost = (float(np.sqrt(np.square(one / largest).sum(axis=1).mean())) for one in (moved, added))
    if not lost <= _MOST_LOST * rms:
        spacing = source.coordinates.spacing(positions, places)
        step = largest * rms / _MIN_SPACINGS
        raise JaxmarkError(
            f"The mesh differs from the file by {largest * rms:.3g} (root mean square over the vertices, in file"
            f" units), but the file's numbers are {spacing:.3g} apart, so that rounding takes"
            f" {100 * lost / rms:.0f} % of that; {source.coordinates.advice(step)}, or change it more."
        )
    return lost / rms
