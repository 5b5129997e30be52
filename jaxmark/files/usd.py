"""Parse USD: the meshes of one layer, or of all layers in a USDZ archive. Needs the extra `usd`."""

import io
import json
import posixpath
import struct
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.binary import BinaryNumbers
from jaxmark.files.limits import RunningCount
from jaxmark.files.source import (
    Faces,
    JoinedNumbers,
    Part,
    Patched,
    Source,
    Transported,
    fan,
    unique_names,
    unusable,
)
from jaxmark.files.unpacking import Unpacker
from jaxmark.files.zipped import Archive
from jaxmark.geometry.pose import Points

_LAYERS, _ZIP, _CRATE = (".usd", ".usda", ".usdc"), b"PK", b"PXR-USDC"
_ALIGNMENT = 64  # of the members of USDZ
_HEADER, _PADDING = 30, 0x1986  # bytes of a member's header, and the kind of the field in it that pads it
_REWRITTEN = "USD wrote the text of the layer in its own layout, without comments"


class _Mesh(NamedTuple):
    """One mesh of a layer, with the arrays that the layer has."""

    name: str  # unique in the file
    layer: int  # index of the layer
    stated: dict[str, Any]  # see `usd_program`
    arrays: dict[str, np.ndarray]

    @property
    def normals(self) -> np.ndarray | None:
        """The array of normals; None if there is none of triples."""
        found = self.arrays.get("normals")
        return found if found is not None and _has_rows(found, 3) else None

    @property
    def corners(self) -> Faces:
        """The corners of each triangle, as indices into those of the polygons."""
        return fan(self.arrays["faceVertexCounts"].astype(np.int64))

    @property
    def faces(self) -> Faces:
        """The triangles as indices into the points."""
        return self.arrays["faceVertexIndices"].astype(np.int64)[self.corners]

    def defect(self) -> str:
        """Return the reason why the mesh cannot be marked; empty if it can."""
        points, sizes, indices = (self.arrays.get(name) for name in ("points", "faceVertexCounts", "faceVertexIndices"))
        elsewhere = not self.stated["alone"]
        if "points" in self.stated["unread"] or (points is not None and points.size and not _has_rows(points, 3)):
            return "its points are no triples of floating-point numbers"
        if points is None or not points.size:
            return "its points are in another layer, which is left alone" if elsewhere else "it has no points"
        if {"faceVertexCounts", "faceVertexIndices"} & {*self.stated["unread"]}:
            return "its faces are no integers"
        if sizes is None or indices is None or not len(sizes):
            return "it has no faces" + ", or they are in another layer" * elsewhere
        if sizes.ndim != 1 or indices.ndim != 1 or not sizes.dtype == indices.dtype == np.int32:
            return "its faces are no integers of 32 bits, as USD has them"
        if sizes.min() < 3:
            return f"one of its faces has {sizes.min()} corners; it needs at least three"
        if (corners := int(sizes.sum(dtype=np.int64))) != len(indices):
            return f"its faces have {corners} corners, but there are {len(indices)} indices"
        if (outside := indices[(indices < 0) | (indices >= len(points))]).size:
            return f"a face refers to point {outside[0]}, but there are {len(points)}, numbered from 0"
        return ""

    def elements(self, name: str) -> Faces | None:
        """Return the element of `normals` or `texture` that each corner uses; None if that is not known."""
        stated, values, indices = self.stated[name], self.arrays[name], self.arrays.get(f"{name}.indices")
        plain = stated["attribute"] == "normals"  # the default of which differs from that of primvars
        match stated["interpolation"] or ("vertex" if plain else "constant"):
            case "vertex" | "varying":
                used = self.faces
            case "faceVarying":
                used = self.corners
            case "uniform":
                sizes = self.arrays["faceVertexCounts"].astype(np.int64)
                used = np.repeat(np.arange(len(sizes)), sizes - 2)[:, None].repeat(3, axis=1)
            case _:
                return None
        if indices is not None:
            if indices.ndim != 1 or used.max() >= len(indices):
                return None
            used = indices.astype(np.int64)[used]
        return used if used.min() >= 0 and used.max() < len(values) else None

    def texture(self) -> Float64[np.ndarray, "faces 3 2"]:
        """Read the texture coordinates of the corners; NaN unless they are pairs of numbers."""
        values = self.arrays.get("texture")
        used = self.elements("texture") if values is not None and _has_rows(values, 2) else None
        if values is None or used is None:
            return np.full((*self.faces.shape, 2), np.nan)
        return values[used].astype(np.float64)

    def notes(self) -> Iterator[str]:
        """Yield what a reader of the marked file should know of this mesh."""
        scheme = self.stated["subdivision"] or "catmullClark"  # USD's default
        if scheme != "none":
            yield f"{self.name}: programs that subdivide this mesh ({scheme}) show the mark smoothed"
        if self.stated["samples"]:
            yield f"{self.name}: its points are animated; {self.stated['samples']} later samples stay unmarked"


def _has_rows(array: np.ndarray, width: int) -> bool:
    """Whether an array has rows of this many floating-point numbers."""
    return array.ndim == 2 and array.shape[1] == width and array.dtype.kind == "f"


class _Layer(NamedTuple):
    member: str  # its name in the archive; empty if the file is the layer
    content: bytes


class _Stretch(NamedTuple):
    """An array of triples in the data of the source."""

    begin: int
    array: np.ndarray

    def numbers(self, data: bytes) -> BinaryNumbers:
        offsets = self.begin + self.array.itemsize * np.arange(self.array.size).reshape(-1, 3)
        return BinaryNumbers(data, offsets, (self.array.dtype,) * 3)

    def read(self, data: bytes) -> np.ndarray:
        """Return the array as it is in other data."""
        return np.frombuffer(data, self.array.dtype, self.array.size, self.begin).reshape(-1, 3)


def parse(data: bytes) -> "_UsdSource":
    """Read the meshes of a layer, in text or binary, or of all layers of a USDZ archive.

    Points are those that the layer itself states, local to the mesh: transformations are not applied, and instances
    change with their prototype. Layers in other files are neither read nor changed. Meshes of variants are meshes of
    their own. The first sample of animated points is read.

    Raises:
        JaxmarkError: if USD is missing or cannot read the file, or no mesh in it can be marked.
    """
    archive = Archive(data) if data.startswith(_ZIP) else None
    layers = [_Layer("", data)]
    if archive is not None:
        members = [member for member in archive.members if member.name.casefold().endswith(_LAYERS)]
        limits.LAYERS.check(len(members), len(data))
        layers = [_Layer(member.name, archive.read(member)) for member in members]
        if not layers:
            raise JaxmarkError("The archive has no layer (USD, USDA or USDC), so it is no whole USDZ file.")
    unpacker = Unpacker("usd", len(data))
    found: list[_Mesh] = []
    outside: dict[str, None] = {}
    assets: list[str] = []
    counted, unpacked = (RunningCount(limit, len(data)) for limit in (limits.MESHES, limits.UNPACKED))
    for number, layer in enumerate(layers):
        try:
            answer = unpacker(_request(layer.content, most=np.array(limits.UNPACKED.most(len(data)))))
        except JaxmarkError as error:
            where = ascii(layer.member)[:80] if layer.member else "the file"
            raise JaxmarkError(f"USD cannot read {where}: {error}.") from None
        unpacked.add(sum(array.nbytes for array in answer.values()))
        report = json.loads(answer.pop("report").tobytes())
        counted.add(len(report["meshes"]))
        arrays: list[dict[str, np.ndarray]] = [{} for _ in report["meshes"]]
        for name, array in answer.items():
            index, _, kind = name.partition(".")
            arrays[int(index)][kind] = array
        prefix = layer.member if number else ""
        found += [
            _Mesh(prefix + stated["path"], number, stated | {"alone": report["alone"]}, mine)
            for stated, mine in zip(report["meshes"], arrays, strict=True)
        ]
        outside |= dict.fromkeys(path for path in report["layers"] if not _is_member(archive, layer.member, path))
        assets += [*report["layers"], *report["assets"]]
    unique = unique_names(mesh.name for mesh in found)
    meshes = [mesh._replace(name=name) for mesh, name in zip(found, unique, strict=True)]
    return _source(data, archive, layers, meshes, [*outside], assets, unpacker)


def _is_member(archive: Archive | None, layer: str, path: str) -> bool:
    """Whether a layer that another one refers to is in the same archive."""
    place = posixpath.normpath(posixpath.join(posixpath.dirname(layer), path))
    return archive is not None and archive.find(place) is not None


def _request(layer: bytes, **arrays: np.ndarray) -> bytes:
    """Return the block that the program for unpacking takes, see `usd_program`."""
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, layer=np.frombuffer(layer, np.uint8), **arrays)
    return out.getvalue()


def _change(layer: bytes, changes: Mapping[str, np.ndarray], *, binary: bool) -> bytes:
    """Return the request to write a layer with other values of some attributes."""
    arrays = {str(index): array for index, array in enumerate(changes.values())}
    paths = np.frombuffer(json.dumps([*changes]).encode(), np.uint8)
    return _request(layer, paths=paths, binary=np.array(binary), **arrays)


def to_binary(layer: bytes) -> bytes:
    """Write a layer in USD's binary form.

    Raises:
        JaxmarkError: half a sentence, if USD is missing or cannot read the layer.
    """
    return Unpacker("usd", len(layer))(_change(layer, {}, binary=True))["layer"].tobytes()


def _source(
    data: bytes,
    archive: Archive | None,
    layers: Sequence[_Layer],
    found: Sequence[_Mesh],
    outside: Sequence[str],
    assets: Sequence[str],
    unpacker: Unpacker,
) -> "_UsdSource":
    """Make the source of the meshes that can be marked; refused if there are none."""
    skipped = {mesh.name: reason for mesh in found if (reason := mesh.defect())}
    meshes = [mesh for mesh in found if mesh.name not in skipped]
    if not meshes and outside:
        names = ", ".join(map(ascii, outside[:3]))
        raise JaxmarkError(f"The file has no mesh of its own that can be marked; mark the files it refers to: {names}.")
    if not meshes:
        raise JaxmarkError(unusable(skipped, len(skipped)) if skipped else "The file has no mesh.")
    skipped |= dict.fromkeys(outside, "it is another file; mark it on its own")
    size, stretches = 0, list[dict[str, _Stretch]]()
    for mesh in meshes:
        arrays = {"points": mesh.arrays["points"]} | ({} if mesh.normals is None else {"normals": mesh.normals})
        stretches.append({})
        for name, array in arrays.items():
            stretches[-1][name] = _Stretch(size, array)
            size += array.nbytes
    content = b"".join(one.array.tobytes() for stretch in stretches for one in stretch.values())
    parts, points, corners, normals, rows = list[Part](), 0, list[Faces](), list[BinaryNumbers](), 0
    for mesh, stretch in zip(meshes, stretches, strict=True):
        faces, used = mesh.faces, None if mesh.normals is None else mesh.elements("normals")
        parts.append(Part(mesh.name, points + np.arange(len(mesh.arrays["points"])), faces))
        points += len(mesh.arrays["points"])
        corners.append(np.full_like(faces, -1) if used is None else used + rows)
        if used is not None:
            normals.append(stretch["normals"].numbers(content))
            rows += len(normals[-1].values)
    return _UsdSource(
        content,
        JoinedNumbers([stretch["points"].numbers(content) for stretch in stretches]),
        np.concatenate([part.faces + part.places[0] for part in parts]),
        [Transported(JoinedNumbers(normals), np.concatenate(corners))] if normals else [],
        lambda: np.concatenate([mesh.texture() for mesh in meshes]),
        parts=parts if len(parts) + len(skipped) > 1 else (),
        skipped=skipped,
        file=data,
        archive=archive,
        layers=layers,
        meshes=meshes,
        stretches=stretches,
        companions=tuple(assets) if archive is None else (),
        unpacker=unpacker,
    )


@dataclass(kw_only=True)
class _UsdSource(Source):
    """A source whose data are the points and normals of all meshes; USD writes them into their layers."""

    file: bytes
    archive: Archive | None
    layers: Sequence[_Layer]
    meshes: Sequence[_Mesh]
    stretches: Sequence[Mapping[str, _Stretch]]  # of the points and normals of each mesh
    companions: tuple[str, ...]
    unpacker: Unpacker

    def patch(self, positions: Points, name: str) -> Patched:
        """Write these positions, normals and extents into the layers that state them; other opinions stay."""
        data = self.spliced(positions)
        edits: dict[int, dict[str, np.ndarray]] = {}
        notes: list[str] = []
        for mesh, stretch in zip(self.meshes, self.stretches, strict=True):
            changes = dict(_changes(mesh, stretch, data))
            if changes:
                edits.setdefault(mesh.layer, {}).update(changes)
                notes += mesh.notes()
        contents: dict[str, bytes] = {}
        for number, changes in edits.items():
            layer = self.layers[number]
            answer = self.unpacker(_change(layer.content, changes, binary=layer.content.startswith(_CRATE)))
            contents[layer.member] = answer["layer"].tobytes()
            if not answer["same_text"]:
                notes.append(f"{layer.member}: {_REWRITTEN}" if layer.member else _REWRITTEN)
        if not contents:
            return Patched(self.file, companions=self.companions)
        if self.archive is None:
            return Patched(contents[""], notes=tuple(notes), companions=self.companions)
        kept = {member.name: self.archive.read(member) for member in self.archive.members}
        return Patched(pack(self.file, kept | contents), notes=tuple(notes))


def _changes(mesh: _Mesh, stretch: Mapping[str, _Stretch], data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the attributes that change, by their paths, and their new values."""
    path = mesh.stated["path"]
    attributes = {"points": "points", "normals": mesh.stated["normals"]["attribute"]}
    for name, place in stretch.items():
        after = place.read(data)
        if after.tobytes() == place.array.tobytes():
            continue
        yield f"{path}.{attributes[name]}", after
        extent = mesh.arrays.get("extent")
        if name == "points" and extent is not None and extent.shape == (2, 3):
            yield f"{path}.extent", _extent(extent, place.array, after)


def _extent(extent: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the box of the new points; a box that was not that of the old points is only enlarged."""
    old, new = (np.stack([points.min(axis=0), points.max(axis=0)]).astype(extent.dtype) for points in (before, after))
    if np.allclose(extent, old, atol=1e-5 * float(np.abs(old).max())):
        return new
    return np.stack([np.fmin(extent[0], new[0]), np.fmax(extent[1], new[1])])


def pack(archive: bytes | None, contents: Mapping[str, bytes]) -> bytes:
    """Write a USDZ archive, whose members are not compressed and begin at multiples of 64 bytes.

    Dates are those of the members of another archive, if there is one.
    """
    dates: dict[str, tuple[int, int, int, int, int, int]] = {}
    if archive is not None:
        with zipfile.ZipFile(io.BytesIO(archive)) as old:
            dates = {info.filename: info.date_time for info in old.infolist()}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        for name, content in contents.items():
            info = zipfile.ZipInfo(name, dates.get(name, (1980, 1, 1, 0, 0, 0)))
            header = _HEADER + len(name.encode()) + 4
            padding = -(out.tell() + header) % _ALIGNMENT
            info.extra = struct.pack("<2H", _PADDING, padding) + bytes(padding)
            packed.writestr(info, content)
    return out.getvalue()
