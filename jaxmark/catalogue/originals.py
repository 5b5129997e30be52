"""Preparation of originals for a catalogue: hashes, descriptors, landmarks and a thumbnail."""

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

WHOLE = ""  # name of the only mesh of a file
_MAX_COPY = 2**29  # largest size of a file that is copied into the catalogue, in bytes
_PIXELS = 96  # width and height of the thumbnail
_MARGIN = 4  # margin of the thumbnail, in pixels
_CAMERA = unit(np.array([[0.87, 0.0, -0.5], [-0.17, 0.94, -0.3], [0.47, 0.34, 0.81]]))  # right, up, towards the viewer
_LIGHT = unit(np.array([0.3, 0.5, 0.8]))  # direction of the light, in the camera's axes
_PAPER, _DARKEST = 255, 40  # grey values of the background and of the darkest surface


class Prepared(NamedTuple):
    """An original that is prepared for insertion into a catalogue."""

    file: dict[str, Any]  # the row in the table `originals`, except the time
    shapes: list[dict[str, Any]]  # the rows of the meshes in the table `shapes`, except the original's number
    skipped: Mapping[str, str]  # meshes that cannot be used, by name, and the reasons


def meshes_of(path: str | os.PathLike[str]) -> Scene:
    """Read the meshes of a file; the name of a file's only mesh is empty.

    Raises:
        JaxmarkError: see `load_scene`.
    """
    scene = load_scene(path)
    if len(scene.meshes) + len(scene.skipped) > 1:
        return scene
    return Scene({WHOLE: load_mesh(path)}, {})


def prepare_file(path: str | os.PathLike[str], *, copy: bool = False) -> Prepared:
    """Read a file, and compute the descriptors of its meshes.

    Raises:
        JaxmarkError: if the file cannot be read, if the size or area of all its meshes is 0, or if the file cannot be
            copied into the catalogue.
    """
    content = file_hash(path)
    size = Path(path).stat().st_size
    if copy and Path(path).suffix.lower() == ".gltf":
        raise JaxmarkError(
            f"{path} cannot be copied into the catalogue, because its data are in other files; save it as GLB, or leave"
            " out --copy."
        )
    if copy and size > _MAX_COPY:
        raise JaxmarkError(
            f"{path} cannot be copied into the catalogue, because it has {size} bytes, more than {_MAX_COPY}; leave out"
            " --copy."
        )
    scene = meshes_of(path)
    shapes, skipped = [], dict(scene.skipped)
    for name, mesh in scene.meshes.items():
        if (shape := _describe(name, mesh)) is None:
            skipped[name] = "its size or its area is 0"
        else:
            shapes.append(shape)
    if not shapes:
        raise JaxmarkError(f"{path} cannot be added: the size or the area of each of its meshes is 0.")
    largest = max(scene.meshes.values(), key=lambda mesh: len(mesh.vertices))
    spread = descriptors.spread(largest) or descriptors.spread(next(iter(scene.meshes.values())))
    assert spread is not None
    file = {
        "content": content,
        "path": os.path.realpath(path),
        "bytes": size,
        "copy": Path(path).read_bytes() if copy else None,
        "thumbnail": _thumbnail(spread.points, spread.normals),
    }
    return Prepared(file, shapes, skipped)


def _describe(name: str, mesh: Mesh) -> dict[str, Any] | None:
    """Describe a mesh as a row of the table `shapes`; returns None for a mesh of size or area 0."""
    spread, local = descriptors.spread(mesh), descriptors.local(mesh)
    if spread is None or local is None:
        return None
    parts = local.describe()
    points, centre, size = descriptors.centred(mesh)
    stored = landmarks(mesh)[:MOST]
    stored["place"] = (stored["place"] - centre) / size
    return {
        "name": name,
        "geometry": rounded(mesh, grid_spacing(diagonal(mesh))).hash.hex(),
        "exact": geometry_hash(mesh).hex(),
        "vertices": int(used_vertices(mesh).sum()),
        "faces": len(mesh.faces),
        "described": descriptors.VERSION,
        "whole": descriptors.whole(spread).astype("<f2").tobytes(),
        # A cloud may have fewer points than centres.
        "parts": parts[np.arange(descriptors.CENTRES) % len(parts)].astype("<f2").tobytes(),
        "points": points.astype("<f2").tobytes(),
        "landmarks": stored.astype(KEPT).tobytes(),
    }


def _thumbnail(points: Points, normals: Points) -> bytes:
    """Draw a shape from the front, slightly from above and from the right, as PNG.

    Args:
        points: some thousand points of the surface.
        normals: unit normals at the points, or zeros.
    """
    projected, facing = points @ _CAMERA.T, normals @ _CAMERA.T
    low, high = projected[:, :2].min(axis=0), projected[:, :2].max(axis=0)
    size = max(float((high - low).max()), np.finfo(float).tiny)
    space = _PIXELS - 2 * _MARGIN - 1
    place = np.rint((projected[:, :2] - (low + high) / 2) / size * space + (_PIXELS - 1) / 2).astype(int)
    # Both sides of the surface are lit, because some meshes have no consistent outside.
    light = np.abs(facing @ _LIGHT)
    shade = (_DARKEST + (225 - _DARKEST) * light).astype(np.uint8)
    picture = np.full((_PIXELS, _PIXELS), _PAPER, np.uint8)
    nearest_last = np.argsort(projected[:, 2])
    rows, columns = _PIXELS - 1 - place[nearest_last, 1], place[nearest_last, 0]
    for down, across in ((0, 1), (1, 0), (1, 1), (0, 0)):  # each point covers four pixels
        picture[np.minimum(rows + down, _PIXELS - 1), np.minimum(columns + across, _PIXELS - 1)] = shade[nearest_last]
    return _encode_png(picture)


def _encode_png(picture: UInt8[np.ndarray, "rows columns"]) -> bytes:
    """Encode a grey picture as PNG (ISO/IEC 15948)."""
    rows, columns = picture.shape
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), picture], axis=1).tobytes()  # 0: the lines have no filter
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0),
        b"IDAT": zlib.compress(lines),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )
