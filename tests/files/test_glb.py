import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_texture, save_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, turned, written

pytestmark = pytest.mark.core

POINTS = [[0.5, 0, 0], [1, 0, 0], [0, 0, 1]]
MORE = [[5, 0, 0], [6, 0, 0], [5, 0, 1]]
# Position, colour and normal of each vertex beside each other (28 bytes), then indices, then plain positions.
INTERLEAVED = b"".join(struct.pack("<3f4B3f", *point, 1, 2, 3, 4, 0, -1, 0) for point in POINTS)
INDICES = struct.pack("<3HH", 0, 1, 2, 0xFFFF)
BIN = INTERLEAVED + INDICES + struct.pack("<9f", *np.ravel(MORE))


def document() -> dict[str, Any]:
    return {
        "asset": {"version": "2.0", "generator": 'min "max" [1,2] caf\xe9'},
        "scene": 0,
        "nodes": [{"mesh": 0, "translation": [9, 9, 9]}, {"name": "camera"}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "COLOR_0": 1, "NORMAL": 2}, "indices": 3, "material": 0},
                    {"attributes": {"POSITION": 4}},
                ]
            }
        ],
        "materials": [{"name": "gold"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "max": [1, 0, 1], "min": [0.0, 0, 0]},
            {"bufferView": 0, "byteOffset": 12, "componentType": 5121, "count": 3, "type": "VEC4", "normalized": True},
            {"bufferView": 0, "byteOffset": 16, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC3", "max": [6, 0, 1], "min": [5, 0, 0]},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 84, "byteStride": 28},
            {"buffer": 0, "byteOffset": 84, "byteLength": 6},
            {"buffer": 0, "byteOffset": 92, "byteLength": 36},
        ],
        "buffers": [{"byteLength": 128}],
    }


def glb(text: str, bin_: bytes = BIN) -> bytes:
    chunk = text.encode()
    chunk = chunk.ljust(-(-len(chunk) // 4) * 4)
    body = struct.pack("<I4s", len(chunk), b"JSON") + chunk + struct.pack("<I4s", len(bin_), b"BIN\0") + bin_
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


RICH = glb(json.dumps(document(), indent=1, ensure_ascii=False))


def split(data: bytes) -> tuple[str, bytes]:
    """The chunks, with all lengths checked."""
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    bin_size, bin_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (bin_kind, 28 + size + bin_size, size % 4) == (b"BIN\0", len(data), 0)
    return data[20 : 20 + size].decode(), data[28 + size :]


def test_local_coordinates_of_all_primitives(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "a.glb", RICH)
    np.testing.assert_array_equal(mesh.vertices, POINTS + MORE)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [3, 4, 5]])


def test_one_vertex_and_its_bounds_change(tmp_path: Path) -> None:
    source = written(tmp_path, "a.glb", RICH)
    text, bin_ = split(patched(source, shifted(load_mesh(source), 3, [-0.5, 0, -0.25])))
    old, _ = split(RICH)
    smaller = old.replace('"min": [\n    5,\n    0,\n    0\n   ]', '"min": [\n    4.5,\n    0.0,\n    -0.25\n   ]')
    assert smaller != old
    assert text.rstrip(" ") == smaller.rstrip(" ")
    moved = bytearray(BIN)
    struct.pack_into("<3f", moved, 92, 4.5, 0, -0.25)
    assert bin_ == bytes(moved)


def test_bounds_that_need_room_lengthen_the_chunk(tmp_path: Path) -> None:
    source = written(tmp_path, "a.glb", glb(json.dumps(document(), separators=(",", ":"))))
    moved = noisy(load_mesh(source), 0.1)
    text, bin_ = split(patched(source, moved))
    expected = document()
    for number, rows in ((0, moved.vertices[:3]), (4, moved.vertices[3:])):
        single = np.asarray(rows, np.float32)
        expected["accessors"][number]["min"] = single.min(axis=0).tolist()
        expected["accessors"][number]["max"] = single.max(axis=0).tolist()
    assert json.loads(text) == expected
    assert bin_[12:16] == BIN[12:16]  # the colour between position and normal
    assert bin_[84:92] == BIN[84:92]  # the indices and the byte that pads them
    np.testing.assert_array_equal(
        loaded(tmp_path, "b.glb", (tmp_path / "out.glb").read_bytes()).faces, [[0, 1, 2], [3, 4, 5]]
    )


def test_normals_turn(tmp_path: Path) -> None:
    source = written(tmp_path, "a.glb", RICH)
    _, bin_ = split(patched(source, turned(load_mesh(source))))
    for vertex in range(3):
        np.testing.assert_allclose(struct.unpack_from("<3f", bin_, 28 * vertex + 16), [1, 0, 0], atol=1e-7)


@pytest.mark.parametrize("normals", [[(0, -1, 0)] * 3, [(0, -1, 0), (0, -2, 0), (np.nan, 0, 0)]])
def test_bounds_of_normals_follow(tmp_path: Path, normals: list[tuple[float, float, float]]) -> None:
    content, bin_ = document(), bytearray(BIN)
    for vertex, normal in enumerate(normals):
        struct.pack_into("<3f", bin_, 28 * vertex + 16, *normal)
    content["accessors"][2] |= {"min": [0, -1, 0], "max": [0, -1, 0]}
    source = written(tmp_path, "a.glb", glb(json.dumps(content), bytes(bin_)))
    assert patched(source, load_mesh(source)) == source.read_bytes()
    text, bin_ = split(patched(source, turned(load_mesh(source))))
    found = np.array([struct.unpack_from("<3f", bin_, 28 * vertex + 16) for vertex in range(3)])
    accessor = json.loads(text)["accessors"][2]
    assert accessor["min"] == np.nanmin(found, axis=0).tolist()
    assert accessor["max"] == np.nanmax(found, axis=0).tolist()


def test_an_avatar_is_a_glb_whose_extensions_stay(tmp_path: Path) -> None:
    content = document() | {
        "extensionsUsed": ["VRM", "VRMC_vrm"],
        "extensions": {"VRM": {"meta": {"title": "\u00e9"}, "humanoid": {"humanBones": []}}, "VRMC_vrm": {"x": 1.50}},
    }
    source = written(tmp_path, "a.vrm", glb(json.dumps(content)))
    mesh = load_mesh(source)
    text, _ = split(patched(source, noisy(mesh, 0.1)))
    found = json.loads(text)
    assert found["extensions"] == content["extensions"]
    assert found["extensionsUsed"] == content["extensionsUsed"]
    save_mesh(mesh, tmp_path / "new.vrm")
    np.testing.assert_array_equal(load_mesh(tmp_path / "new.vrm").vertices, mesh.vertices)


def test_a_mesh_that_no_node_uses(tmp_path: Path) -> None:
    plain = document()
    del plain["nodes"]
    assert len(loaded(tmp_path, "a.glb", glb(json.dumps(plain))).vertices) == 6


def _set(*path: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(target: Any) -> None:
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("meshes", value=[]), "no meshes"),
        (_set("meshes", 0, "primitives", 0, "mode", value=7), "mode 7"),
        (_set("accessors", 0, "sparse", value={}), "sparse"),
        (_set("accessors", 0, "componentType", value=5125), "three numbers"),
        (_set("meshes", 0, "primitives", 1, "extensions", value={"KHR_draco_mesh_compression": {}}), "KHR_draco"),
        (_set("bufferViews", 2, "extensions", value={"EXT_meshopt_compression": {}}), "buffer of bufferViews"),
        (_set("buffers", 0, "uri", value="data.bin"), "data.bin"),
        (_set("accessors", 1, "byteOffset", value=8), "shares bytes"),
        (_set("accessors", 2, "bufferView", value=2), "does not lie|shares bytes"),
        (_set("accessors", 0, "count", value=4), "does not lie"),
        (_set("accessors", 0, "count", value=10**15), "elements"),
        (_set("accessors", 0, "count", value=-1), "count"),
        (_set("accessors", 0, "bufferView", value=True), "bufferView"),
        (_set("bufferViews", 0, "byteStride", value=4), "does not lie"),
        (_set("accessors", 3, "count", value=2), "multiple of three"),
        (_set("accessors", 3, "bufferView", value=2), "refers to vertex"),
        (_set("meshes", 0, "primitives", 0, "attributes", value={}), "POSITION"),
        (_set("meshes", 0, "primitives", 0, "attributes", "POSITION", value=99), r"accessors\[99\]"),
        (_set("meshes", 0, "primitives", value="no"), "list of objects"),
    ],
)
def test_what_is_not_supported_is_named(tmp_path: Path, change: Callable[[Any], None], message: str) -> None:
    changed = document()
    change(changed)
    with pytest.raises(JaxmarkError, match=rf"bad\.glb: .*({message})"):
        loaded(tmp_path, "bad.glb", glb(json.dumps(changed)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "byte 0"),
        (b"glTF" + b"\1\0\0\0" * 4, "version 2"),
        (RICH[:-1], "shorter"),
        (RICH[:40], "shorter"),
        (glb(json.dumps(document()), BIN[:84] + b"\7" + BIN[85:]), "refers to vertex 7, but there are 3"),
        (glb("{"), "JSON"),
        (glb("[" * 100000), "JSON"),
        (glb("[]"), "object"),
        (glb(json.dumps(document()), BIN[:-4]), "does not lie"),
    ],
)
def test_broken_containers(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.glb: .*({message})"):
        loaded(tmp_path, "bad.glb", data)


def _places(node: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The path of every value in the document."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield (*path, key)
        yield from _places(value, (*path, key))


@pytest.mark.parametrize("value", [None, True, -1, 3, 1e300, 10**400, "x", [], ["x"], {}, {"x": {}}], ids=repr)
def test_any_value_may_be_of_any_kind(tmp_path: Path, value: Any) -> None:
    for path in _places(document()):
        changed = document()
        _set(*path, value=value)(changed)
        source = written(tmp_path, "odd.glb", glb(json.dumps(changed)))
        try:
            mesh = load_mesh(source)
        except JaxmarkError:
            continue
        patched(source, noisy(mesh, 0.1))


def test_texture_coordinates_are_those_of_another_program(tmp_path):
    rng = np.random.default_rng(0)
    shape = trimesh.creation.icosphere(1)
    places = rng.uniform(size=(len(shape.vertices), 2)).astype(np.float32)
    shape.visual = TextureVisuals(uv=places)
    path = tmp_path / "ball.glb"
    shape.export(path)
    again: Any = trimesh.load(path, process=False, force="mesh")
    mesh, found = load_mesh(path), load_texture(path)
    assert found is not None
    # glTF counts from the upper edge of a picture, trimesh from the lower one.
    np.testing.assert_allclose(found * [1, -1] + [0, 1], again.visual.uv[mesh.faces], atol=1e-6)
    trimesh.creation.icosphere(1).export(path)
    assert load_texture(path) is None
