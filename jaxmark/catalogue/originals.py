"""What a catalogue holds of an original: what identifies its file and meshes, and what they look like."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxmark.catalogue import descriptors
from jaxmark.catalogue.landmarks import KEPT, MOST, landmarks
from jaxmark.catalogue.thumbnails import thumbnail
from jaxmark.errors import JaxmarkError
from jaxmark.files import Scene, load_mesh, load_scene
from jaxmark.geometry.canonical import geometry_hash, grid_spacing, rounded
from jaxmark.geometry.mesh import Mesh, used_vertices

WHOLE = ""  # name of the mesh of a file that has only one, or of all meshes of a file together
_MAX_COPY = 2**29  # bytes of a file that is kept in the catalogue


@dataclass(frozen=True)
class Shape:
    """What is kept of a mesh."""

    name: str  # in its file; empty if it is the only one
    geometry: str  # hash of its canonical geometry, hexadecimal, which records of version 2 have
    exact: str  # the same of version 1
    vertices: int
    faces: int
    whole: bytes  # descriptor of the whole shape
    parts: bytes  # descriptors of balls about points of it
    points: bytes  # points spread over it
    landmarks: bytes  # vertices that are known by their surroundings


@dataclass(frozen=True)
class Prepared:
    """What is kept of a file."""

    path: str  # absolute
    content: str  # SHA-256 of its bytes, hexadecimal
    size: int  # in bytes
    shapes: tuple[Shape, ...]
    left: Mapping[str, str]  # meshes that cannot be used, by name, and why
    thumbnail: bytes
    copy: bytes | None


def file_hash(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, hexadecimal.

    Raises:
        JaxmarkError: if it cannot be read.
    """
    if Path(path).exists() and not Path(path).is_file():  # a pipe may never end
        raise JaxmarkError(f"Cannot read {path}: it is no ordinary file.")
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise JaxmarkError(f"Cannot read {path}: {error.strerror or error}.") from None


def meshes_of(path: str | os.PathLike[str]) -> Scene:
    """The meshes of a file; that of a file of one mesh is the whole file, and has no name.

    Raises:
        JaxmarkError: see `load_scene`.
    """
    scene = load_scene(path)
    if len(scene.meshes) + len(scene.left) > 1:
        return scene
    return Scene({WHOLE: load_mesh(path)}, {})


def prepare_file(path: str | os.PathLike[str], *, copy: bool = False) -> Prepared:
    """Read a file and describe its meshes.

    Args:
        path: a mesh file.
        copy: whether to keep the file itself.

    Raises:
        JaxmarkError: if it cannot be read, holds no mesh that has an extent, or is too large to be kept.
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
    shapes, left = [], dict(scene.left)
    for name, mesh in scene.meshes.items():
        if (shape := describe(name, mesh)) is None:
            left[name] = "it has no extent"
        else:
            shapes.append(shape)
    if not shapes:
        raise JaxmarkError(f"{path} has no mesh with an extent; there is nothing to know it by.")
    shown = max(scene.meshes.values(), key=lambda mesh: len(mesh.vertices))
    seen = descriptors.spread(shown) or descriptors.spread(next(iter(scene.meshes.values())))
    assert seen is not None
    return Prepared(
        os.path.realpath(path),
        content,
        size,
        tuple(shapes),
        left,
        thumbnail(seen.points, seen.normals),
        Path(path).read_bytes() if copy else None,
    )


def describe(name: str, mesh: Mesh) -> Shape | None:
    """What is kept of a mesh; None if it has no extent."""
    seen, local = descriptors.spread(mesh), descriptors.local(mesh)
    if seen is None or local is None:
        return None
    geometry, exact = geometries(mesh)
    whole, parts = descriptors.whole(seen), local.describe()
    parts = parts[np.arange(descriptors.CENTRES) % len(parts)]  # a cloud may have fewer points
    points, centre, size = descriptors.centred(mesh)
    known = landmarks(mesh)[:MOST]
    known["place"] = (known["place"] - centre) / size
    return Shape(
        name,
        geometry,
        exact,
        int(used_vertices(mesh).sum()),
        len(mesh.faces),
        whole.astype("<f2").tobytes(),
        parts.astype("<f2").tobytes(),
        points.astype("<f2").tobytes(),
        known.astype(KEPT).tobytes(),
    )


def geometries(mesh: Mesh) -> tuple[str, str]:
    """The hashes by which records of version 2 and of version 1 name an original, hexadecimal.

    Raises:
        JaxmarkError: if the mesh has no extent.
    """
    return rounded(mesh, grid_spacing(mesh)).hash.hex(), geometry_hash(mesh).hex()
