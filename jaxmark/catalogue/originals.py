"""Prepare originals for a catalogue: the hashes of a file and its meshes, their descriptors, and a picture."""

import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxmark.catalogue import descriptors
from jaxmark.catalogue.landmarks import KEPT, MOST, landmarks
from jaxmark.errors import JaxmarkError
from jaxmark.files import Scene, load_mesh, load_scene
from jaxmark.files.atomic import file_hash
from jaxmark.geometry.canonical import geometry_hash, grid_spacing, rounded
from jaxmark.geometry.mesh import Mesh, diagonal, unit, used_vertices
from jaxmark.geometry.pose import Points

WHOLE = ""  # name of the mesh of a file that has only one, or of all meshes of a file together
_MAX_COPY = 2**29  # bytes of a file that is kept in the catalogue
_PIXELS = 96  # on each side of the picture
_MARGIN = 4  # pixels
_CAMERA = unit(np.array([[0.87, 0.0, -0.5], [-0.17, 0.94, -0.3], [0.47, 0.34, 0.81]]))  # right, up, towards the eye
_LIGHT = unit(np.array([0.3, 0.5, 0.8]))  # in the camera's directions
_PAPER, _DARKEST = 255, 40


class Prepared(NamedTuple):
    """An original that is not in the catalogue yet."""

    file: dict[str, Any]  # its row in the table `originals`, but for the time
    shapes: list[dict[str, Any]]  # the rows of its meshes in the table `shapes`, but for its number
    skipped: Mapping[str, str]  # meshes that cannot be used, by name, and why


def meshes_of(path: str | os.PathLike[str]) -> Scene:
    """Read the meshes of a file; the mesh of a file that has only one is the whole file, and has no name.

    Raises:
        JaxmarkError: see `load_scene`.
    """
    scene = load_scene(path)
    if len(scene.meshes) + len(scene.skipped) > 1:
        return scene
    return Scene({WHOLE: load_mesh(path)}, {})


def prepare_file(path: str | os.PathLike[str], *, copy: bool = False) -> Prepared:
    """Read a file and describe its meshes.

    Raises:
        JaxmarkError: if it cannot be read, holds no mesh that has an extent, or is too large to keep a copy of it.
    """
    content = file_hash(path)
    size = Path(path).stat().st_size
    if copy and Path(path).suffix.lower() == ".gltf":
        raise JaxmarkError(
            f"{path} has its numbers in other files; save it as GLB to keep a copy, or leave out --copy."
        )
    if copy and size > _MAX_COPY:
        raise JaxmarkError(f"{path} has {size} bytes, too many to keep a copy in the catalogue; leave out --copy.")
    scene = meshes_of(path)
    shapes, skipped = [], dict(scene.skipped)
    for name, mesh in scene.meshes.items():
        if (shape := _describe(name, mesh)) is None:
            skipped[name] = "it has no extent"
        else:
            shapes.append(shape)
    if not shapes:
        raise JaxmarkError(f"{path} has no mesh with an extent; there is nothing to know it by.")
    shown = max(scene.meshes.values(), key=lambda mesh: len(mesh.vertices))
    seen = descriptors.spread(shown) or descriptors.spread(next(iter(scene.meshes.values())))
    assert seen is not None
    file = {
        "content": content,
        "path": os.path.realpath(path),
        "bytes": size,
        "copy": Path(path).read_bytes() if copy else None,
        "thumbnail": _thumbnail(seen.points, seen.normals),
    }
    return Prepared(file, shapes, skipped)


def _describe(name: str, mesh: Mesh) -> dict[str, Any] | None:
    """Describe a mesh, as a row of the table `shapes`; None if it has no extent."""
    seen, local = descriptors.spread(mesh), descriptors.local(mesh)
    if seen is None or local is None:
        return None
    parts = local.describe()
    points, centre, size = descriptors.centred(mesh)
    known = landmarks(mesh)[:MOST]
    known["place"] = (known["place"] - centre) / size
    return {
        "name": name,
        "geometry": rounded(mesh, grid_spacing(diagonal(mesh))).hash.hex(),
        "exact": geometry_hash(mesh).hex(),
        "vertices": int(used_vertices(mesh).sum()),
        "faces": len(mesh.faces),
        "described": descriptors.VERSION,
        "whole": descriptors.whole(seen).astype("<f2").tobytes(),
        # A cloud may have fewer points.
        "parts": parts[np.arange(descriptors.CENTRES) % len(parts)].astype("<f2").tobytes(),
        "points": points.astype("<f2").tobytes(),
        "landmarks": known.astype(KEPT).tobytes(),
    }


def _thumbnail(points: Points, normals: Points) -> bytes:
    """Draw a shape from the front, a little from above and the right, as PNG.

    It is given by some thousand points of its surface, and the unit normals there, or zeros.
    """
    seen, facing = points @ _CAMERA.T, normals @ _CAMERA.T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    size = max(float((high - low).max()), np.finfo(float).tiny)
    space = _PIXELS - 2 * _MARGIN - 1
    place = np.rint((seen[:, :2] - (low + high) / 2) / size * space + (_PIXELS - 1) / 2).astype(int)
    # Surfaces without an outside are lit from either side.
    light = np.abs(facing @ _LIGHT)
    shade = (_DARKEST + (225 - _DARKEST) * light).astype(np.uint8)
    picture = np.full((_PIXELS, _PIXELS), _PAPER, np.uint8)
    nearest_last = np.argsort(seen[:, 2])
    rows, columns = _PIXELS - 1 - place[nearest_last, 1], place[nearest_last, 0]
    for down, across in ((0, 1), (1, 0), (1, 1), (0, 0)):  # each point covers four pixels
        picture[np.minimum(rows + down, _PIXELS - 1), np.minimum(columns + across, _PIXELS - 1)] = shade[nearest_last]
    return _encode_png(picture)


def _encode_png(picture: UInt8[np.ndarray, "rows columns"]) -> bytes:
    """Encode a grey picture as PNG (ISO/IEC 15948)."""
    rows, columns = picture.shape
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), picture], axis=1).tobytes()  # 0: lines as they are
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0),
        b"IDAT": zlib.compress(lines),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )
