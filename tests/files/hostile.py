"""Small files that would cost minutes or gigabytes without limits; each function has the amount that makes it large."""

import io
import json
import re
import struct
import zlib
from collections.abc import Callable, Mapping

import numpy as np

_CORE = b"http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_HEAD, _TAIL = b'<model xmlns="' + _CORE + b'"><resources>', b"</resources></model>"
_CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_MODELS = ("3D/3dmodel.model", "3D/b.model", "3D/c.model")


def _mesh(
    vertices: tuple[bytes, int], triangles: tuple[bytes, int] = (b'<triangle v1="0" v2="1" v3="2"/>', 1)
) -> bytes:
    rows = [element * count for element, count in (vertices, triangles)]
    return b'<object id="1"><mesh><vertices>%s</vertices><triangles>%s</triangles></mesh></object>' % tuple(rows)


_TRIANGLE = _mesh((b'<vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>', 1))


def archive(models: int, content: bytes, others: Mapping[str, bytes] | None = None) -> bytes:
    """A 3MF file in which some models have the same content, without what standard modules would check."""
    data = entries = b""
    members = dict.fromkeys(_MODELS[:models], content) | dict(others or {})
    packed = {content: _deflated(content) for content in {*members.values()}}
    for name, content in members.items():
        sizes = (0, 8, 0, 33, zlib.crc32(content), len(packed[content]), len(content), len(name), 0)
        entries += struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, *sizes, 0, 0, 0, 0, len(data)) + name.encode()
        data += struct.pack("<4s5H3I2H", b"PK\3\4", 20, *sizes) + name.encode() + packed[content]
    count = len(members)
    return data + entries + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, len(entries), len(data), 0)


def _deflated(content: bytes) -> bytes:
    packer = zlib.compressobj(9, wbits=-15)
    return packer.compress(content) + packer.flush()


def filler(count: int, models: int = 1) -> bytes:
    """Elements that mean nothing, beside a triangle."""
    return archive(models, _HEAD + _TRIANGLE + b"<a/>" * count + _TAIL)


def nested(count: int) -> bytes:
    """Elements in each other."""
    return archive(1, _HEAD + _TRIANGLE + b"<a>" * count + b"</a>" * count + _TAIL)


def single_quotes(count: int) -> bytes:
    """Vertices whose attributes are in single quotes, which are read one by one."""
    return archive(1, _HEAD + _mesh((b"<vertex x='0' y='0' z='0'/>", count)) + _TAIL)


def plain_vertices(count: int) -> bytes:
    """Vertices as most programs write them."""
    return archive(1, _HEAD + _mesh((b'<vertex x="0" y="0" z="0"/>', count)) + _TAIL)


def triangles(count: int) -> bytes:
    """Triangles as most programs write them."""
    return archive(
        1, _HEAD + _mesh((b'<vertex x="0" y="0" z="0"/>', 3), (b'<triangle v1="0" v2="1" v3="2"/>', count)) + _TAIL
    )


def attributes(count: int) -> bytes:
    """An element of many attributes."""
    return archive(
        1, _HEAD + _TRIANGLE + b"<a" + b"".join(b' a%05x=""' % number for number in range(count)) + b"/>" + _TAIL
    )


def long_name(count: int) -> bytes:
    """An object whose name has many words."""
    return archive(1, _HEAD + _TRIANGLE.replace(b"id=", b'name="' + b"a " * count + b'" id=') + _TAIL)


def relationships(count: int) -> bytes:
    """Many relationships of the archive."""
    return archive(1, _HEAD + _TRIANGLE + _TAIL, {"_rels/.rels": b"<r>" + b"<a/>" * count + b"</r>"})


def comments(count: int) -> bytes:
    """Vertices with comments between them, which are read one by one."""
    return archive(1, _HEAD + _mesh((b'<vertex x="0" y="0" z="0"/><!---->', count)) + _TAIL)


def remarks(count: int) -> bytes:
    """Empty comments outside of meshes."""
    return archive(1, _HEAD + _TRIANGLE + b"<!---->" * count + _TAIL)


def hidden(count: int, opening: bytes = b"<!--", closing: bytes = b"-->", each: int = 100_000) -> bytes:
    """Comments, or the like, of up to so many lists each, in front of a mesh."""
    full = opening + b"<vertices>" * each + closing
    rest = opening + b"<vertices>" * (count % each) + closing
    return archive(1, _HEAD + full * (count // each) + rest + _TRIANGLE + _TAIL)


def doctype(count: int) -> bytes:
    """A document type of many lists."""
    return archive(1, b'<!DOCTYPE a SYSTEM "' + b"<vertices>" * count + b'">' + _HEAD + _TRIANGLE + _TAIL)


def prefixes(count: int) -> bytes:
    """Meshes whose elements have a prefix each."""
    meshes = (
        re.sub(rb"<(/?)", rb"<\1p%d:" % number, _TRIANGLE).replace(b" id", b' xmlns:p%d="%s" id' % (number, _CORE))
        for number in range(count)
    )
    return archive(1, _HEAD + b"".join(meshes) + _TAIL)


def spaces(count: int, address: int) -> bytes:
    """Elements in a namespace with a long address."""
    return archive(1, b'<model xmlns="' + b"a" * address + b'">' + b"<a/>" * count + b"</model>")


def prefixed(count: int, address: int) -> bytes:
    """An element of many attributes in a namespace with a long address."""
    named = b"".join(b' p:a%05x=""' % number for number in range(count))
    return archive(1, b'<model xmlns:p="' + b"a" * address + b'"><a' + named + b"/></model>")


def lists(count: int) -> bytes:
    """Lists outside of meshes."""
    return archive(1, _HEAD + _TRIANGLE + b"<vertices/>" * count + _TAIL)


def meshes(count: int) -> bytes:
    """Objects of one triangle."""
    return archive(1, _HEAD + _TRIANGLE * count + _TAIL)


def laz(count: int, size: int) -> bytes:
    """Equal points, and zeros behind them up to a size."""
    import laspy

    header = laspy.LasHeader(point_format=0, version="1.2")
    cloud = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(count, header=header))
    out = io.BytesIO()
    cloud.write(out, do_compress=True)
    return out.getvalue().ljust(size, b"\0")


def _with_place(place: int) -> Callable[[bytes], bytes]:
    """Let a LAZ file say another place of its table of chunks, which it also says at its end, and count 2³² chunks."""

    def damage(data: bytes) -> bytes:
        begin = struct.unpack_from("<I", data, 96)[0]
        true = struct.unpack_from("<q", data, begin)[0]
        many = data[: true + 4] + b"\xff" * 4 + data[true + 8 :]
        return (
            many[:begin]
            + struct.pack("<q", true if place == 1 else place)
            + many[begin + 8 :]
            + struct.pack("<q", true)
        )

    return damage


def _with_field(place: int, form: str, value: int) -> Callable[[bytes], bytes]:
    """Change a field of a LAZ file's description of its packing."""

    def damage(data: bytes) -> bytes:
        at = data.index(b"laszip encoded") + 52 + place
        return data[:at] + struct.pack(form, value) + data[at + struct.calcsize(form) :]

    return damage


#: Functions that damage a LAZ file so that its decoder panics, or reserves gigabytes.
DAMAGED_LAZ: dict[str, Callable[[bytes], bytes]] = {
    **{f"chunks {place}": _with_place(place) for place in (1, 0, -1, -2)},
    "no items": _with_field(32, "<H", 0),
    "empty items": _with_field(36, "<H", 0),
    "wide items": _with_field(36, "<H", 65_535),
    "small chunks": _with_field(12, "<I", 1),
}


def many_points() -> bytes:
    """A mesh in Draco that says it has 2²⁸ points."""
    return b"DRACO\2\2\1\0\0\0" + b"\0" + b"\x80\x80\x80\x80\1" + b"\1\1\1\0\x09\3\0\0\0"


def rows(count: int, elements: int = 1) -> bytes:
    """A PLY file with a triangle, and rows of lists, the first of which is longer than the others."""
    number = "property float "
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{number}x\n{number}y\n{number}z\n"
    head += "element face 1\nproperty list uchar uchar vertex_index\n"
    head += "".join(f"element x{n} {count}\nproperty list uchar uchar a\n" for n in range(elements)) + "end_header\n"
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    return head.encode() + corners + b"\3\0\1\2" + elements * (b"\1\0" + bytes(count - 1))


def tetrahedra(count: int) -> bytes:
    """Objects of four vertices in OBJ."""
    lines = []
    for number in range(count):
        shift = np.array([2 * number, number % 7, 0.1 * (number % 3)])
        lines += [f"o t{number}", *("v {:g} {:g} {:g}".format(*(shift + corner)) for corner in _CORNERS)]
        lines += ["f " + " ".join(str(4 * number + corner) for corner in face) for face in _FACES]
    return "\n".join(lines).encode() + b"\n"


_FACES = ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))
#: Functions that make a 3MF file, and the bytes of one of their elements.
ARCHIVES: dict[str, tuple[Callable[[int], bytes], int]] = {
    "filler": (filler, 4),
    "three": (lambda count: filler(count // 3, 3), 4),
    "nested": (nested, 7),
    "attributes": (attributes, 10),
    "name": (long_name, 2),
    "relationships": (relationships, 4),
    "single": (single_quotes, 27),
    "comments": (comments, 36),
    "plain": (plain_vertices, 27),
    "triangles": (triangles, 32),
    "meshes": (meshes, len(_TRIANGLE)),
    "lists": (lists, 11),
    "remarks": (remarks, 7),
    "hidden": (hidden, 10),
    "doctype": (doctype, 10),
}


#: Pieces that a fuzzer repeats and inserts.
PIECES = (
    b"<a/>",
    b"<a>",
    b"</a>",
    b"<!---->",
    b"<![CDATA[ ]]>",
    b"<?a?>",
    b"text ",
    b"&#49;",
    b"<a b='1' c=\"2\"/>",
    b'<vertex x="0" y="0" z="1"/>',
    b"<vertex x='1' y='0' z='0'/>",
    b'<vertex x="0" y="1e0"\nz=" 0 " a:x="2"></vertex>',
    b'<triangle v1="0" v2="1" v3="2"/>',
    b"<triangle v3='2' v2='1' v1='0'/>",
    b"<vertices>",
    b"</vertices>",
    b"<triangles>",
    b"</triangles>",
    b"<vertices/>",
    b'<object id="1"><mesh>',
    b"</mesh></object>",
    _TRIANGLE,
)


def model(pieces: list[tuple[bytes, int]], room: int) -> bytes:
    """A model of repeated pieces, within so many bytes."""
    parts = [piece * min(count, room // len(pieces) // len(piece)) for piece, count in pieces]
    return _HEAD + _TRIANGLE + b"".join(parts) + _TAIL


def threemf(kind: str, room: int) -> bytes:
    """A hostile 3MF file of a kind whose models have so many bytes, at most."""
    make, size = ARCHIVES[kind]
    return make((room - 2**12) // size)


def gltf(document: dict[str, object], chunk: bytes) -> bytes:
    """A GLB file."""
    text = json.dumps({"asset": {"version": "2.0"}} | document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(chunk), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(chunk), 0x004E4942) + chunk


def triangle_beside(name: str, length: int) -> bytes:
    """A glTF file of a triangle, whose numbers are in another file of a stated length."""
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": name, "byteLength": length}],
    }
    return json.dumps(document).encode()


def fans(count: int, corners: int, mode: int) -> bytes:
    """Primitives that share a list of corners."""
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}
    document = {
        "meshes": [{"primitives": [primitive] * count}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": corners, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": corners},
        ],
        "buffers": [{"byteLength": 48 + corners}],
    }
    chunk = struct.pack("<12f", *(number for corner in _CORNERS for number in corner))
    return gltf(document, chunk + bytes(number % 4 for number in range(corners)) + bytes(-corners % 4))


def compressed(views: int, blob: bytes, count: int) -> bytes:
    """A GLB file with meshes that all name the same bytes, as compressed by Draco."""
    extension = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document = {
        "meshes": [{"primitives": [{"attributes": {"POSITION": n}, "extensions": extension}]} for n in range(views)],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}] * views,
        "bufferViews": [{"buffer": 0, "byteLength": len(blob)}],
        "buffers": [{"byteLength": len(blob)}],
    }
    return gltf(document, blob + bytes(-len(blob) % 4))


def itself(names: list[str], data: bytes) -> bytes:
    """A GLB file with more buffers, which are files."""
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document["buffers"] += [{"uri": name, "byteLength": 4} for name in names]
    return gltf(document, data[28 + size :])
