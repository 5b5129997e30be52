"""Parse glTF 2.0 assets in both of their forms, GLB and JSON, with any number of meshes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.binary import BinaryNumbers, gather
from jaxmark.files.gltf import draco, meshopt
from jaxmark.files.gltf.document import FLOAT, Document, Elements, Read, attribute, objects, uses, whole
from jaxmark.files.limits import RunningCount
from jaxmark.files.source import (
    Faces,
    Indices,
    JoinedNumbers,
    Part,
    Patched,
    Source,
    Transported,
    linked,
    unique_names,
    unusable,
)
from jaxmark.geometry.pose import Points
from jaxmark.geometry.skinning import Skinning

_JOINTS = 2**16  # of a skin at most: their numbers have two bytes
_SETS = 4  # of joints that move a vertex, four in each
_MAX_WORK = 64  # largest work, in passes over the bytes of a file, of finding out what else reads them


def parse(data: bytes, read: Read) -> Source:
    """Read the meshes of a glTF file.

    Positions are local coordinates of each mesh: the transformations of nodes are not applied, so that all instances of
    a mesh change with it. Meshes that share positions are one. The points of several POSITION accessors follow
    each other in order of first use. Other files are read by `read`.

    Raises:
        JaxmarkError: if the document cannot be read, or no mesh of it can be marked.
    """
    document = Document(data, read)
    meshes = document.items("meshes")
    if not meshes:
        raise JaxmarkError("The file has no meshes.")
    limits.MESHES.check(len(meshes), len(data))
    names = unique_names(str(mesh.get("name") or f"mesh {index}") for index, mesh in enumerate(meshes))
    found: dict[str, list[_Primitive]] = {}
    left: dict[str, str] = {}
    for group in _groups(meshes):
        name = names[group[0]]
        try:
            found[name] = _primitives(document, [(index, meshes[index]) for index in group])
        except JaxmarkError as error:
            left[name] = str(error).rstrip(".")
    for name, reason in _shared_bytes(document, found).items():
        del found[name]
        left[name] = reason
    if not found:
        raise JaxmarkError(f"{next(iter(left.values()))}." if len(left) == 1 else unusable(left, len(meshes)))
    return _source(document, found, left)


def _groups(meshes: Sequence[dict[str, Any]]) -> list[list[int]]:
    """Group the meshes: those together that share an accessor of positions or normals."""
    nodes: dict[int, int] = {}  # of accessors, behind those of meshes
    links = [
        (index, len(meshes) + nodes.setdefault(accessor, len(nodes)))
        for index, mesh in enumerate(meshes)
        for role, accessor in uses(mesh)
        if role in ("POSITION", "NORMAL")
    ]
    one, other = np.array(links, np.int64).reshape(-1, 2).T
    group = linked(one, other, len(meshes) + len(nodes))
    members: dict[int, list[int]] = {}
    for index in range(len(meshes)):
        members.setdefault(int(group[index]), []).append(index)
    return list(members.values())


@dataclass
class _Primitive:
    """A primitive that can be marked."""

    data: dict[str, Any]
    place: tuple[int, int]  # of its mesh, and of it in the mesh
    position: int  # index of the accessor
    normal: int | None  # of the accessor; None if absent, or not of plain triples of floats, which are left alone
    faces: Faces  # indices of its own points
    compressed: draco.Compressed | None


def _primitives(document: Document, meshes: Sequence[tuple[int, dict[str, Any]]]) -> list[_Primitive]:
    """Read the triangles of meshes; refused if there are none, or if they cannot be marked."""
    found: list[_Primitive] = []
    for index, mesh in meshes:
        for number, primitive in enumerate(objects(mesh, "primitives", f"meshes[{index}]")):
            where = f"meshes[{index}].primitives[{number}]"
            if primitive.get("mode", 4) in (0, 1, 2, 3):  # points and lines
                continue
            if primitive.get("mode", 4) not in (4, 5, 6):
                raise JaxmarkError(f"{where} has the unknown mode {ascii(primitive['mode'])[:40]}.")
            found.append(_primitive(document, primitive, (index, number), where))
    if not found:
        raise JaxmarkError(f"meshes[{meshes[0][0]}] has no primitives that are triangles.")
    return found


def _primitive(document: Document, data: dict[str, Any], place: tuple[int, int], where: str) -> _Primitive:
    position = attribute(data, "POSITION")
    if position is None:
        raise JaxmarkError(f"{where} has no POSITION.")
    dtype, width, _, count = document.form(position)
    if width != 3 or dtype.itemsize > 4 or dtype == np.dtype("<u4"):
        raise JaxmarkError(f"accessors[{position}] holds no positions of three numbers.")
    normal = attribute(data, "NORMAL")
    compressed = draco.decompress(document, data, where)
    document.elements(position)  # refuses what does not lie in its buffer
    corners = _corners(document, data, count) if compressed is None else compressed.faces.ravel()
    if normal is not None and not (_is_plain(document, normal) and len(document.elements(normal).starts) == count):
        normal = None
    faces = _triangles(corners, data.get("mode", 4) if compressed is None else 4, document.accessed, where)
    return _Primitive(data, place, position, normal, faces, compressed)


def _is_plain(document: Document, index: int) -> bool:
    """Whether an accessor holds triples of floats and nothing else."""
    accessor = document.item("accessors", index)
    if index in document.decoded:
        return document.form(index)[:2] == (FLOAT, 3)
    plain = accessor.get("componentType") == 5126 and accessor.get("type") == "VEC3" and "bufferView" in accessor
    return plain and "sparse" not in accessor


def _corners(document: Document, primitive: dict[str, Any], count: int) -> Indices:
    """Read the corners of a primitive as indices into its own points."""
    if "indices" not in primitive:
        return np.arange(count)
    number = whole(primitive, "indices", "primitives")
    where = f"accessors[{number}]"
    starts, dtype, width, _ = document.elements(number)
    if width != 1 or dtype.kind != "u":
        raise JaxmarkError(f"{where} holds no plain unsigned integers, as indices must.")
    index = gather(document.data, starts, dtype).astype(np.int64)
    if (index >= count).any():
        raise JaxmarkError(f"{where} refers to vertex {index.max()}, but there are {count}, numbered from 0.")
    return index


def _triangles(corners: Indices, mode: int, accessed: RunningCount, where: str) -> Faces:
    """Split a list (mode 4), a strip (5) or a fan (6) into triangles; count the corners that the last two add."""
    if mode == 4:
        if len(corners) % 3:
            raise JaxmarkError(f"{where} has {len(corners)} corners, which is no multiple of three.")
        return corners.reshape(-1, 3)
    accessed.add(3 * max(len(corners) - 2, 0))
    first = np.arange(max(len(corners) - 2, 0))
    if mode == 6:
        return corners[np.stack([np.zeros_like(first), first + 1, first + 2], axis=1)]
    odd = first % 2
    faces = corners[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]  # strips turn by faces without area


def _shared_bytes(document: Document, found: dict[str, list[_Primitive]]) -> dict[str, str]:
    """Find the meshes whose positions or normals are also read by something else; returns names and reasons."""
    names = list(found)
    owner = np.zeros(len(document.data), np.int32)  # number of the mesh that a byte moves with, from 1
    refused: dict[str, str] = {}
    mine: dict[int, str] = {}  # meshes by the accessors that are patched

    def check(index: int, rows: Elements, own: int = 0) -> None:
        reason = f"accessors[{index}] shares bytes with positions or normals of another accessor"
        for byte in range(rows.size):
            place = rows.starts + byte
            if (others := owner[place]).any():
                numbers = [*np.unique(others[others > 0]), *([own] if own else [])]
                refused.update({names[number - 1]: reason for number in numbers})
            if own:
                owner[place] = own

    for number, (name, primitives) in enumerate(found.items(), 1):
        accessors = [one.position for one in primitives] + [one.normal for one in primitives]
        for index in dict.fromkeys(accessors):
            if index is not None and index not in mine:
                mine[index] = name
                check(index, document.located[index], number)
    elsewhere = {
        index for mesh in document.items("meshes") for role, index in uses(mesh) if role not in ("POSITION", "NORMAL")
    }
    for index in set(mine) & elsewhere:
        refused[mine[index]] = f"accessors[{index}] is used for something else, too"
    work, seen = 0, set()
    for index in range(len(document.items("accessors"))):
        accessor = document.item("accessors", index)
        form = tuple(str(accessor.get(key)) for key in ("bufferView", "byteOffset", "componentType", "type", "count"))
        if index in mine or "bufferView" not in accessor or form in seen:
            continue
        seen.add(form)
        try:
            if document.is_unread(whole(accessor, "bufferView", f"accessors[{index}]")):  # it shares nothing
                continue
            rows = document.elements(index)
        except JaxmarkError:  # an accessor that cannot be read shares nothing
            continue
        if not owner[rows.span].any():
            continue
        work += rows.size * len(rows.starts)
        if work > _MAX_WORK * len(owner) + 2**20:
            raise JaxmarkError("Too many accessors read the same bytes; save the file with other software.")
        check(index, rows)
    return refused


def _source(document: Document, found: dict[str, list[_Primitive]], left: dict[str, str]) -> Source:
    """Make the source of the meshes that were found."""
    data = document.data = bytes(document.data)
    primitives = [one for group in found.values() for one in group]
    points = {one.position: document.located[one.position] for one in primitives}
    normals = {one.normal: document.located[one.normal] for one in primitives if one.normal is not None}
    rows, normal_rows = _rows(points), _rows(normals)
    parts: list[Part] = []
    for name, group in found.items():
        begin, end = rows[group[0].position].start, max(rows[one.position].stop for one in group)
        faces = np.concatenate([one.faces + rows[one.position].start for one in group])
        parts.append(Part(name, np.arange(begin, end), faces - begin))
    turned = None
    if normals:
        offsets = np.concatenate([elements.offsets for elements in normals.values()])
        corners = [
            np.full_like(one.faces, -1) if one.normal is None else one.faces + normal_rows[one.normal].start
            for one in primitives
        ]
        turned = Transported(BinaryNumbers(data, offsets, (FLOAT,) * 3), np.concatenate(corners))
    return _GltfSource(
        data,
        JoinedNumbers([BinaryNumbers(data, one.offsets, (one.dtype,) * 3, one.unit) for one in points.values()]),
        np.concatenate([part.faces + part.places[0] for part in parts]),
        [] if turned is None else [turned],
        lambda: np.concatenate([_texture(document, one) for one in primitives]),
        partial(_skin, document, list({one.position: one for one in primitives}.values())),
        parts if len(parts) + len(left) > 1 else (),
        left,
        document=document,
        patched={**points, **normals},
        compressed=[one for one in primitives if one.compressed is not None],
    )


def _rows(accessors: dict[int, Elements]) -> dict[int, range]:
    """Assign each accessor the range of its elements among those of all, in order."""
    rows, size = {}, 0
    for index, elements in accessors.items():
        rows[index] = range(size, size + len(elements.starts))
        size = rows[index].stop
    return rows


def _texture(document: Document, primitive: _Primitive) -> Float64[np.ndarray, "faces 3 2"]:
    """Read the texture coordinates of the corners of a primitive's faces; NaN unless they are pairs of numbers."""
    nothing = np.full((*primitive.faces.shape, 2), np.nan)
    try:
        number = attribute(primitive.data, "TEXCOORD_0")
        pairs = None if number is None else document.numbers(number)
    except JaxmarkError:  # a wrong texture is no reason to refuse the file
        return nothing
    if pairs is None or pairs.shape[1] != 2 or primitive.faces.max(initial=-1) >= len(pairs):
        return nothing
    return pairs[primitive.faces]


def _skin(document: Document, primitives: Sequence[_Primitive]) -> Skinning | None:
    """Read the skin of all points, those of one accessor of positions after the other; None unless all have one."""
    skins = {
        node["mesh"]: whole(node, "skin", "a node")
        for node in document.items("nodes")
        if isinstance(node.get("mesh"), int) and "skin" in node
    }
    found = [_part_of_skin(document, one, skins.get(one.place[0])) for one in primitives]
    parts = [part for part in found if part is not None]
    if not parts or len(parts) < len(found):
        return None
    slots = max(part.joints.shape[1] for part in parts)
    wide = [[np.pad(rows, ((0, 0), (0, slots - rows.shape[1]))) for rows in part] for part in parts]
    return Skinning(*(np.concatenate(column) for column in zip(*wide, strict=True)))


def _part_of_skin(document: Document, primitive: _Primitive, skin: int | None) -> Skinning | None:
    """Read the skin of a primitive's points; joints of another skin are other joints."""
    count, found = len(document.located[primitive.position].starts), []
    for number in range(_SETS + 1):
        indices = [attribute(primitive.data, f"{name}_{number}") for name in ("JOINTS", "WEIGHTS")]
        pair = [document.numbers(index) for index in indices if index is not None]
        if len(pair) < 2:
            break
        if number == _SETS:
            raise JaxmarkError(f"A skin has more than {_SETS} sets of joints and weights.")
        if pair[0].shape[1] != 4 or pair[1].shape[1] != 4:
            raise JaxmarkError("Joints and weights of a skin come in sets of four.")
        if not len(pair[0]) == len(pair[1]) == count:
            raise JaxmarkError("Joints and weights of a primitive are not as many as its positions.")
        found.append(pair)
    if not found or skin is None:
        return None
    joints, weights = (np.concatenate(column, axis=1) for column in zip(*found, strict=True))
    if not ((joints >= 0) & (joints < _JOINTS)).all() or skin >= _JOINTS:
        raise JaxmarkError("A skin refers to joints that no file can have.")
    total = weights.sum(axis=1, keepdims=True)
    if not (np.isfinite(weights) & (weights >= 0)).all() or not (total > 0).all():
        raise JaxmarkError("A vertex has weights of joints that are negative, or none.")
    return Skinning(skin * _JOINTS + joints.astype(np.int64), weights / total)


@dataclass(kw_only=True)
class _GltfSource(Source):
    """A source that also updates the `min` and `max` of the accessors that it changes."""

    document: Document
    patched: dict[int, Elements]  # the accessors of positions and normals
    compressed: Sequence[_Primitive]

    def patch(self, positions: Points, name: str) -> Patched:
        """Write these positions into the file; a primitive that cannot be compressed as it was is written without."""
        data = self.spliced(positions)
        contents: list[bytes | None] = [
            None if isinstance(buffer, str) else data[buffer.place.start : buffer.place.stop]
            for buffer in self.document.buffers
        ]
        document = self.document.copy_content()
        for index, rows in self.patched.items():
            before, after = (gather(one, rows.offsets, rows.dtype) for one in (self.data, data))
            if before.tobytes() != after.tobytes():
                _bound(document["accessors"][index], after)
        for view, place in self.document.packed.items():
            part = data[place.start : place.stop]
            if part != self.data[place.start : place.stop]:
                meshopt.write(document, contents, view, part)
        plain = []
        for one in self.compressed:
            assert one.compressed is not None
            if any(data[rows.span] != self.data[rows.span] for rows in one.compressed.attributes.values()):
                mesh, number = one.place
                primitive = document["meshes"][mesh]["primitives"][number]
                if not draco.write(document, contents, primitive, one.compressed, data):
                    plain.append(f"meshes[{mesh}].primitives[{number}]")
        if plain:
            draco.forget_unused(document)
        why = "written without Draco compression, because its encoder does not know all types of numbers in it"
        notes = (f"{', '.join(plain)}: {why}",) if plain else ()
        return self.document.encode(document, contents, name)._replace(notes=notes)


def _bound(accessor: dict[str, Any], stored: Shaped[np.ndarray, "rows 3"]) -> None:
    """Bring the bounds of an accessor up to date; they are stored numbers, without their unit."""
    for key, bound in (("min", np.fmin.reduce(stored)), ("max", np.fmax.reduce(stored))):
        if key in accessor and np.isfinite(bound).all() and not _states(accessor[key], bound):
            accessor[key] = bound.tolist()


def _states(written: Any, bound: np.ndarray) -> bool:
    """Whether the JSON already states this bound."""
    if not isinstance(written, list) or len(written) != 3:
        return False
    numbers = [item for item in written if isinstance(item, int | float) and abs(item) < 3.4e38]
    return len(numbers) == 3 and bool((np.array(numbers, np.float64).astype(bound.dtype) == bound).all())
