"""Parse glTF 2.0 in both of its forms, GLB and JSON, with any number of meshes."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import BinaryNumbers, JoinedNumbers, encode, gather
from jaxmark.files.gltf import draco
from jaxmark.files.gltf.container import Container, Read, changed_range, open_container
from jaxmark.files.gltf.document import FLOAT, Document, Elements, attribute, objects, whole
from jaxmark.files.normals import Transported
from jaxmark.files.source import Part, Patched, Source, splice, unique_names
from jaxmark.geometry.skinning import Skinning

_JOINTS = 2**16  # of a skin at most: their numbers have two bytes
_SETS = 4  # of joints that move a vertex, four in each
_MAX_WORK = 64  # how often the bytes of a file are looked at to see who else reads them


def parse(data: bytes, read: Read) -> Source:
    """Read the meshes of a glTF file.

    Positions are local coordinates of each mesh: the transformations of nodes are not applied, so that all instances of
    a mesh change with it. Meshes that share positions are one. Where several primitives have several POSITION
    accessors, their points follow each other in order of first use.

    Args:
        data: the bytes of a GLB or glTF file.
        read: reads the files that it refers to.

    Raises:
        JaxmarkError: if the document cannot be read, or no mesh of it can be marked.
    """
    document = Document(open_container(data, read))
    meshes = document.items("meshes")
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
        raise JaxmarkError(_nothing(meshes, left))
    return _source(document, found, left)


def _nothing(meshes: Sequence[dict[str, Any]], left: dict[str, str]) -> str:
    if not meshes:
        return "The file has no meshes."
    if len(left) == 1:
        return f"{next(iter(left.values()))}."
    told = "; ".join(f"{name!r}: {reason}" for name, reason in list(left.items())[:3])
    return f"None of its {len(meshes)} meshes can be marked: {told}{'; …' if len(left) > 3 else ''}."


def _groups(meshes: Sequence[dict[str, Any]]) -> list[list[int]]:
    """The meshes, those together that share an accessor of positions or normals."""
    leader: dict[int, int] = {}  # the first mesh that uses an accessor
    group = list(range(len(meshes)))

    def root(index: int) -> int:
        while group[index] != index:
            group[index] = index = group[group[index]]
        return index

    for index, mesh in enumerate(meshes):
        primitives = mesh.get("primitives")
        for primitive in primitives if isinstance(primitives, list) else []:
            attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
            for name in ("POSITION", "NORMAL"):
                accessor = attributes.get(name) if isinstance(attributes, dict) else None
                if isinstance(accessor, int):
                    one, other = sorted((root(leader.setdefault(accessor, index)), root(index)))
                    group[other] = one
    members: dict[int, list[int]] = {}
    for index in range(len(meshes)):
        members.setdefault(root(index), []).append(index)
    return list(members.values())


@dataclass
class _Primitive:
    """A primitive that can be marked."""

    data: dict[str, Any]
    place: tuple[int, int]  # of its mesh, and of it in the mesh
    position: int  # index of the accessor
    points: Elements
    faces: Int64[np.ndarray, "faces 3"]  # indices of its own points
    normal: int | None = (
        None  # likewise; None if absent, or not of plain triples of floats: such normals are left alone
    )
    normals: Elements | None = None
    compressed: draco.Compressed | None = None
    begins: dict[str, int] = field(default_factory=dict)  # of what was compressed, in `Container.data`


def _primitives(document: Document, meshes: Sequence[tuple[int, dict[str, Any]]]) -> list[_Primitive]:
    """The triangles of meshes; refused if there are none, or if they cannot be marked."""
    found: list[_Primitive] = []
    for index, mesh in meshes:
        primitives = objects(mesh, "primitives", f"meshes[{index}]")
        for number, primitive in enumerate(primitives):
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
    if compressed is None:
        points, begins = document.elements(position), {}
        corners = _corners(document, data, count)
        normals = document.elements(normal) if normal is not None and _is_plain(document, normal) else None
    else:
        begins = {name: document.container.add(rows.tobytes()) for name, rows in compressed.attributes.items()}
        points = _elements(document, position, begins["POSITION"])
        corners = compressed.faces.ravel()
        plain = normal is not None and "NORMAL" in begins and document.form(normal)[:2] == (FLOAT, 3)
        normals = _elements(document, normal, begins["NORMAL"]) if plain and normal is not None else None
    faces = _triangles(corners, data.get("mode", 4) if compressed is None else 4, where)
    if normals is not None and len(normals.starts) != count:
        normals = None
    return _Primitive(
        data, place, position, points, faces, normal if normals is not None else None, normals, compressed, begins
    )


def _elements(document: Document, index: int, begin: int) -> Elements:
    """The elements of an accessor that was compressed."""
    dtype, width, unit, count = document.form(index)
    return Elements(begin + dtype.itemsize * width * np.arange(count), dtype, width, unit)


def _is_plain(document: Document, index: int) -> bool:
    """Whether an accessor holds triples of floats and nothing else."""
    accessor = document.item("accessors", index)
    plain = accessor.get("componentType") == 5126 and accessor.get("type") == "VEC3" and "bufferView" in accessor
    return plain and "sparse" not in accessor


def _corners(document: Document, primitive: dict[str, Any], count: int) -> Int64[np.ndarray, " corners"]:
    """The corners of a primitive as indices into its own points."""
    if "indices" not in primitive:
        return np.arange(count)
    number = whole(primitive, "indices", "primitives")
    where = f"accessors[{number}]"
    starts, dtype, width, _ = document.elements(number)
    if width != 1 or dtype.kind != "u":
        raise JaxmarkError(f"{where} holds no plain unsigned integers, as indices must.")
    index = gather(document.container.data, starts, dtype).astype(np.int64)
    if (index >= count).any():
        raise JaxmarkError(f"{where} refers to vertex {index.max()}, but there are {count}, numbered from 0.")
    return index


def _triangles(corners: Int64[np.ndarray, " corners"], mode: int, where: str) -> Int64[np.ndarray, "faces 3"]:
    """The triangles of a list (mode 4), a strip (5) or a fan (6)."""
    if mode == 4:
        if len(corners) % 3:
            raise JaxmarkError(f"{where} has {len(corners)} corners, which is no multiple of three.")
        return corners.reshape(-1, 3)
    first = np.arange(max(len(corners) - 2, 0))
    if mode == 6:
        return corners[np.stack([np.zeros_like(first), first + 1, first + 2], axis=1)]
    odd = first % 2
    faces = corners[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]  # strips turn by faces without area


def _shared_bytes(document: Document, found: dict[str, list[_Primitive]]) -> dict[str, str]:
    """The meshes whose positions or normals something else reads, too, and what that is."""
    names = list(found)
    owner = np.zeros(len(document.container.data), np.int32)
    refused: dict[str, str] = {}
    patched: set[int] = set()
    for number, primitives in enumerate(found.values(), 1):
        elements = {one.position: one.points for one in primitives}
        elements |= {
            one.normal: one.normals for one in primitives if one.normal is not None and one.normals is not None
        }
        for index, rows in elements.items():
            if index in patched:
                continue
            patched.add(index)
            for byte in range(rows.size):
                place = rows.starts + byte
                if (others := owner[place]).any():
                    reason = f"accessors[{index}] shares bytes with positions or normals of another accessor"
                    refused |= {names[other - 1]: reason for other in np.unique(others[others > 0])}
                    refused[names[number - 1]] = reason
                owner[place] = number
    elsewhere = _used_elsewhere(document)
    mine = {index: name for name, group in found.items() for one in group for index in (one.position, one.normal)}
    for index in patched & elsewhere:
        refused[mine[index]] = f"accessors[{index}] is used for something else, too"
    work, seen = 0, set()
    for index in range(len(document.items("accessors"))):
        accessor = document.item("accessors", index)
        form = tuple(str(accessor.get(key)) for key in ("bufferView", "byteOffset", "componentType", "type", "count"))
        if index in patched or "bufferView" not in accessor or form in seen:
            continue
        seen.add(form)
        try:
            rows = document.elements(index)
        except JaxmarkError:  # what cannot be read is read by nobody
            continue
        if not owner[rows.starts[0] : rows.starts[-1] + rows.size].any():
            continue
        work += rows.size * len(rows.starts)
        if work > _MAX_WORK * len(owner) + 2**20:
            raise JaxmarkError("Too many accessors read the same bytes; save the file with other software.")
        for byte in range(rows.size):
            others = owner[rows.starts + byte]
            reason = f"accessors[{index}] shares bytes with positions or normals of another accessor"
            refused |= {names[other - 1]: reason for other in np.unique(others[others > 0])}
    return refused


def _used_elsewhere(document: Document) -> set[int]:
    """The accessors that are used for something else than positions and normals of primitives."""
    used: set[int] = set()
    for mesh in document.items("meshes"):
        primitives = mesh.get("primitives")
        for primitive in primitives if isinstance(primitives, list) else []:
            if not isinstance(primitive, dict):
                continue
            targets = primitive.get("targets")
            for role in targets if isinstance(targets, list) else []:
                used.update(value for value in role.values() if isinstance(value, int))
            attributes = primitive.get("attributes")
            for name, value in attributes.items() if isinstance(attributes, dict) else ():
                if name not in ("POSITION", "NORMAL") and isinstance(value, int):
                    used.add(value)
            if isinstance(primitive.get("indices"), int):
                used.add(primitive["indices"])
    return used


class _Moved(NamedTuple):
    """Rows of the file's positions that are one accessor."""

    accessor: int
    rows: range
    elements: Elements


def _source(document: Document, found: dict[str, list[_Primitive]], left: dict[str, str]) -> Source:
    """The source of the meshes that were found."""
    data = document.container.data
    moved: list[_Moved] = []
    coordinates: list[BinaryNumbers] = []
    parts: list[Part] = []
    faces, corners, normals, textures = [], [], [], []
    first_row: dict[int, int] = {}
    first_normal: dict[int, int] = {}
    size = normal_rows = 0
    for name, primitives in found.items():
        begin, own = size, []
        for one in primitives:
            if one.position not in first_row:
                first_row[one.position] = size
                count = len(one.points.starts)
                moved.append(_Moved(one.position, range(size, size + count), one.points))
                coordinates.append(_numbers(data, one.points))
                size += count
            own.append(one.faces + first_row[one.position])
            textures.append(partial(_texture, document, one))
            if one.normal is None or one.normals is None:
                corners.append(np.full_like(one.faces, -1))
                continue
            if one.normal not in first_normal:
                first_normal[one.normal] = normal_rows
                normals.append(one.normals.starts)
                normal_rows += len(one.normals.starts)
            corners.append(one.faces + first_normal[one.normal])
        faces += own
        parts.append(Part(name, np.arange(begin, size), np.concatenate(own) - begin))
    turned = None
    if normals:
        offsets = np.concatenate(normals)[:, None] + np.arange(0, 12, 4)
        turned = Transported(BinaryNumbers(data, offsets, (FLOAT,) * 3), np.concatenate(corners))
    return _GltfSource(
        data,
        JoinedNumbers(coordinates),
        np.concatenate(faces),
        turned,
        lambda: np.concatenate([read() for read in textures]),
        partial(_skin, document, list({one.position: one for group in found.values() for one in group}.values())),
        parts if len(parts) + len(left) > 1 else (),
        left,
        container=document.container,
        moved=moved,
        compressed=[one for group in found.values() for one in group if one.compressed is not None],
    )


def _numbers(data: bytes, rows: Elements) -> BinaryNumbers:
    offsets = rows.starts[:, None] + rows.dtype.itemsize * np.arange(rows.width)
    return BinaryNumbers(data, offsets, (rows.dtype,) * rows.width, rows.unit)


def _texture(document: Document, primitive: _Primitive) -> Float64[np.ndarray, "faces 3 2"]:
    """Texture coordinates of the corners of a primitive's faces; NaN unless they are pairs of numbers."""
    nothing = np.full((*primitive.faces.shape, 2), np.nan)
    try:
        if primitive.compressed is not None:
            pairs = primitive.compressed.attributes.get("TEXCOORD_0")
            pairs = None if pairs is None else pairs.astype(np.float64)
        else:
            number = attribute(primitive.data, "TEXCOORD_0")
            pairs = None if number is None else document.numbers(number)
    except JaxmarkError:  # a wrong texture is no reason to refuse the file
        return nothing
    if pairs is None or pairs.shape[1] != 2 or primitive.faces.max(initial=-1) >= len(pairs):
        return nothing
    return pairs[primitive.faces]


def _skin(document: Document, primitives: Sequence[_Primitive]) -> Skinning | None:
    """The skin of all points, those of one accessor of positions after the other; None unless all have one."""
    skins = {
        node["mesh"]: whole(node, "skin", "a node")
        for node in document.items("nodes")
        if isinstance(node.get("mesh"), int) and "skin" in node
    }
    parts = [_part_of_skin(document, one, skins.get(one.place[0])) for one in primitives]
    if not parts or any(part is None for part in parts):
        return None
    slots = max(part.joints.shape[1] for part in parts if part is not None)
    wide = [[np.pad(rows, ((0, 0), (0, slots - rows.shape[1]))) for rows in part] for part in parts if part is not None]
    joints, weights = (np.concatenate(column) for column in zip(*wide, strict=True))
    return Skinning(joints, weights)


def _part_of_skin(document: Document, primitive: _Primitive, skin: int | None) -> Skinning | None:
    """The skin of a primitive's points; joints of another skin are other joints."""
    count, joints, weights = len(primitive.points.starts), [], []
    for number in range(_SETS + 1):
        found = [_rows(document, primitive, f"{name}_{number}") for name in ("JOINTS", "WEIGHTS")]
        if found[0] is None or found[1] is None:
            break
        if number == _SETS:
            raise JaxmarkError(f"A skin has more than {_SETS} sets of joints and weights.")
        if found[0].shape[1] != 4 or found[1].shape[1] != 4:
            raise JaxmarkError("Joints and weights of a skin come in sets of four.")
        if not len(found[0]) == len(found[1]) == count:
            raise JaxmarkError("Joints and weights of a primitive are not as many as its positions.")
        joints.append(found[0])
        weights.append(found[1])
    if not joints or skin is None:
        return None
    numbers, share = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)
    if not ((numbers >= 0) & (numbers < _JOINTS)).all() or skin >= _JOINTS:
        raise JaxmarkError("A skin refers to joints that no file can have.")
    total = share.sum(axis=1, keepdims=True)
    if not (np.isfinite(share) & (share >= 0)).all() or not (total > 0).all():
        raise JaxmarkError("A vertex has weights of joints that are negative, or none.")
    return Skinning(skin * _JOINTS + numbers.astype(np.int64), share / total)


def _rows(document: Document, primitive: _Primitive, name: str) -> np.ndarray | None:
    """The numbers of an attribute, one row a point; None if the primitive has none."""
    number = attribute(primitive.data, name)
    if number is None or primitive.compressed is None:
        return None if number is None else document.numbers(number)
    found = primitive.compressed.attributes.get(name)
    return None if found is None else found.astype(np.float64) * document.form(number)[2]


@dataclass(kw_only=True)
class _GltfSource(Source):
    """A source that also keeps the `min` and `max` of its position accessors true, as glTF demands."""

    container: Container
    moved: Sequence[_Moved]
    compressed: Sequence[_Primitive]

    def patch(self, positions: Float64[np.ndarray, "points 3"], name: str) -> Patched:
        """See `Source`; a primitive that cannot be compressed as it was is written without."""
        container = self.container
        data = splice(self.data, self.edits(positions))
        contents: list[bytes | None] = [
            None if isinstance(buffer, str) else data[buffer.place.start : buffer.place.stop]
            for buffer in container.buffers
        ]
        document = copy.deepcopy(container.document)
        for accessor, rows, elements in self.moved:
            self._bound(document["accessors"][accessor], positions[rows.start : rows.stop], elements)
        plain = []
        for one in self.compressed:
            if one.compressed is None or not any(
                changed_range(self.data, data, range(begin, begin + one.compressed.attributes[key].nbytes))
                for key, begin in one.begins.items()
            ):
                continue
            attributes = {
                key: np.frombuffer(data, old.dtype, old.size, one.begins[key]).reshape(old.shape)
                for key, old in one.compressed.attributes.items()
            }
            mesh, number = one.place
            primitive = document["meshes"][mesh]["primitives"][number]
            if not draco.write(document, contents, primitive, one.compressed, attributes):
                plain.append(f"meshes[{mesh}].primitives[{number}]")
        if plain:
            draco.forget_unused(document)
        encoded = container.encode(document, contents, name)
        remarks = (
            (f"{', '.join(plain)}: written without Draco, whose encoder does not know all types",) if plain else ()
        )
        return Patched(encoded.file, encoded.beside, remarks, encoded.companions)

    def _bound(self, accessor: dict[str, Any], positions: Float64[np.ndarray, "rows 3"], elements: Elements) -> None:
        """Bring the bounds of an accessor up to date; they are stored numbers, without their unit."""
        rows = encode(positions / elements.unit, elements.dtype)
        for key, bound in (("min", rows.min(axis=0)), ("max", rows.max(axis=0))):
            if key in accessor and not _states(accessor[key], bound):
                accessor[key] = bound.tolist()


def _states(written: Any, bound: np.ndarray) -> bool:
    """Whether the JSON already states this bound."""
    if not isinstance(written, list) or len(written) != 3:
        return False
    numbers = [item for item in written if isinstance(item, int | float) and abs(item) < 3.4e38]
    return len(numbers) == 3 and bool((np.array(numbers, np.float64).astype(bound.dtype) == bound).all())
