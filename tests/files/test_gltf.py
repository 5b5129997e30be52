"""glTF in both of its forms: several meshes, other files, Draco, quantised positions."""

import base64
import json
import struct
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from hypothesis import given

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, load_mesh, load_scene, save_mesh, save_scene
from jaxmark.files.gltf.document import Document
from jaxmark.files.gltf.json_text import rewrite
from jaxmark.geometry.mesh import Mesh
from tests.files.test_glb import glb
from tests.samples import bumpy_sphere

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-9, 9)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text('a"\\é'),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab", max_size=2), inner, max_size=3),
    max_leaves=12,
)


@given(old=JSON, new=JSON, indent=st.sampled_from([None, 1]))
def test_text_is_rewritten_where_it_differs(old: Any, new: Any, indent: int | None) -> None:
    text = " " + json.dumps(old, indent=indent, ensure_ascii=False) + "\n"
    assert rewrite(text, old) == text
    assert json.loads(rewrite(text, new)) == new


def test_neighbours_of_a_changed_value_keep_their_spelling() -> None:
    text = '{"a" : [1.50, 2e0,\n3], "b":"\\u00e9", "a2":{"x":1 }}'
    assert rewrite(text, {"a": [1.5, 7, 3], "b": "é", "a2": {"x": 1}}) == text.replace("2e0", "7")
    assert rewrite(text, {"a": [1.5, 2.0, 3, 4], "b": "é", "a2": {"x": 1}}) == text.replace("3]", "3,4]")


BALLS = [bumpy_sphere(1, seed) for seed in range(3)]


def scene() -> tuple[dict[str, Any], bytes]:
    """Three meshes, of which two are used several times, one by a strip; and their buffer."""
    views, accessors, data = [], [], b""

    def add(array: np.ndarray, kind: str, component: int) -> int:
        nonlocal data
        data += bytes(-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        data += array.tobytes()
        return len(accessors) - 1

    meshes = []
    for number, ball in enumerate(BALLS):
        points = np.asarray(ball.vertices, "<f4")
        position = add(points, "VEC3", 5126)
        accessors[position] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
        indices = add(np.asarray(ball.faces, "<u2").ravel(), "SCALAR", 5123)
        meshes.append({"name": "ball", "primitives": [{"attributes": {"POSITION": position}, "indices": indices}]})
        if number == 2:
            meshes[-1]["primitives"].append({"attributes": {"POSITION": position}, "mode": 0})  # points
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}, {"mesh": 1}, {"mesh": 2}],
        "scenes": [{"nodes": [0, 1, 2, 3]}],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
        "images": [{"uri": "a%20picture.png"}, {"uri": "missing.png"}, {"uri": "data:image/png;base64,AAAA"}],
    }
    return document, data


def write_form(folder: Path, form: str) -> Path:
    """The scene in one of the forms that a file may have."""
    document, data = scene()
    (folder / "a picture.png").write_bytes(b"picture")
    if form == "glb":
        path = folder / "scene.glb"
        path.write_bytes(glb(json.dumps(document), data))
        return path
    coded = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document["buffers"][0]["uri"] = coded if form == "embedded" else "the%20buffer.bin"
    (folder / "the buffer.bin").write_bytes(data)
    path = folder / "scene.gltf"
    path.write_text(json.dumps(document, indent=1))
    return path


@pytest.mark.parametrize("form", ["glb", "embedded", "separate"])
def test_one_mesh_of_several_is_changed(tmp_path: Path, form: str) -> None:
    (source := tmp_path / "in").mkdir()
    (out := tmp_path / "out").mkdir()
    path = write_form(source, form)
    before = {file.name: file.read_bytes() for file in source.iterdir()}
    meshes, left = load_scene(path)
    assert (list(meshes), left) == (["ball", "ball #2", "ball #3"], {})
    for ball, mesh in zip(BALLS, meshes.values(), strict=True):
        np.testing.assert_array_equal(mesh.vertices, np.asarray(ball.vertices, np.float32))
        np.testing.assert_array_equal(mesh.faces, ball.faces)
    moved = meshes["ball #2"]._replace(vertices=1.5 * np.asarray(meshes["ball #2"].vertices))
    target = out / ("marked" + path.suffix)
    assert save_scene({"ball #2": moved}, target, like=path) == ()
    again = load_scene(target).meshes
    np.testing.assert_array_equal(again["ball #2"].vertices, np.asarray(moved.vertices, np.float32))
    for name in ("ball", "ball #3"):
        np.testing.assert_array_equal(again[name].vertices, meshes[name].vertices)
    assert {file.name: file.read_bytes() for file in source.iterdir()} == before
    # Another program sees it, too; the picture came along, the buffer as it was did not.
    other = trimesh.load_scene(target, process=False)
    surfaces = [mesh for mesh in other.geometry.values() if isinstance(mesh, trimesh.Trimesh)]
    found = sorted(np.abs(mesh.vertices).max() for mesh in surfaces)
    expected = sorted(np.abs(mesh.vertices).max() for mesh in again.values())
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    names = {file.name for file in out.iterdir()}
    buffers = {name for name in names if name.startswith("marked.") and name.endswith(".bin")}
    assert names - buffers == {target.name, "a picture.png"}
    assert len(buffers) == (form == "separate")


def test_files_that_are_there_are_not_replaced(tmp_path: Path) -> None:
    (source := tmp_path / "in").mkdir()
    (out := tmp_path / "out").mkdir()
    path = write_form(source, "separate")
    (out / "a picture.png").write_bytes(b"another picture")
    meshes = load_scene(path).meshes
    moved = {name: mesh._replace(vertices=1.5 * np.asarray(mesh.vertices)) for name, mesh in meshes.items()}
    with pytest.raises(JaxmarkError, match="there already"):
        save_scene(moved, out / "marked.gltf", like=path)
    assert [file.name for file in out.iterdir()] == ["a picture.png"]
    save_scene(moved, source / "marked.gltf", like=path)  # beside its source, everything is there
    assert len(list(source.iterdir())) == 5


def test_files_outside_of_its_folder_are_not_read(tmp_path: Path) -> None:
    (source := tmp_path / "in").mkdir()
    path = write_form(source, "separate")
    (source / "the buffer.bin").rename(tmp_path / "secret.bin")
    path.write_text(path.read_text().replace("the%20buffer.bin", "../secret.bin"))
    with pytest.raises(JaxmarkError, match="outside of its folder"):
        load_mesh(path)


def test_meshes_that_share_positions_are_one(tmp_path: Path) -> None:
    document, data = scene()
    document["meshes"][1]["primitives"][0]["attributes"] = document["meshes"][0]["primitives"][0]["attributes"]
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data))
    meshes = load_scene(tmp_path / "a.glb").meshes
    assert list(meshes) == ["ball", "ball #3"]
    assert len(meshes["ball"].faces) == 2 * len(BALLS[0].faces)


def test_what_cannot_be_used_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    document, data = scene()
    document["accessors"][0]["sparse"] = {}
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data))
    meshes, left = load_scene(tmp_path / "a.glb")
    assert list(meshes) == ["ball #2", "ball #3"]
    assert list(left) == ["ball"]
    assert "sparse" in left["ball"]


@pytest.mark.slow
def test_numbers_that_are_referred_to_too_often_are_refused(tmp_path: Path) -> None:
    document, data = scene()
    for mesh in document["meshes"]:
        mesh["primitives"] *= 10_000
    (tmp_path / "many.glb").write_bytes(glb(json.dumps(document), data))
    with pytest.raises(JaxmarkError, match="elements of accessors"):
        load_scene(tmp_path / "many.glb")


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans_are_those_of_another_program(tmp_path: Path, mode: int) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3)).astype("<f4")
    corners = np.array([0, 1, 2, 3, 3, 4, 5, 6] if mode == 5 else [0, 1, 2, 3, 4, 5, 6], "<u2")
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 7, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": len(corners), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 84},
            {"buffer": 0, "byteOffset": 84, "byteLength": corners.nbytes},
        ],
        "buffers": [{"byteLength": 84 + corners.nbytes}],
    }
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), points.tobytes() + corners.tobytes()))
    faces = np.asarray(load_mesh(tmp_path / "a.glb").faces)
    first = np.arange(len(corners) - 2)
    if mode == 5:  # (v_i, v_{i+1+i%2}, v_{i+2-i%2}), as the specification of glTF 2.0 has it
        expected = corners[np.stack([first, first + 1 + first % 2, first + 2 - first % 2], axis=1)]
        expected = expected[[len(set(face)) == 3 for face in expected.tolist()]]
    else:
        expected = corners[np.stack([0 * first, first + 1, first + 2], axis=1)]
    np.testing.assert_array_equal(faces, expected)


def quantised(path: Path, normalised: bool) -> tuple[Mesh, float]:
    """Write a mesh of integers that fill their range; returns it as it is read, and the step of its positions."""
    points = np.asarray(BALLS[0].vertices)
    stored = np.rint(32767 * points / np.abs(points).max()).astype("<i2")
    faces = np.asarray(BALLS[0].faces, "<u2").ravel()
    padded = np.zeros((len(stored), 4), "<i2")
    padded[:, :3] = stored
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_mesh_quantization"],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                **{"bufferView": 0, "componentType": 5122, "count": len(stored), "type": "VEC3"},
                **{"normalized": normalised, "min": stored.min(0).tolist(), "max": stored.max(0).tolist()},
            },
            {"bufferView": 1, "componentType": 5123, "count": len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": padded.nbytes, "byteStride": 8},
            {"buffer": 0, "byteOffset": padded.nbytes, "byteLength": faces.nbytes},
        ],
        "buffers": [{"byteLength": padded.nbytes + faces.nbytes}],
    }
    path.write_bytes(glb(json.dumps(document), padded.tobytes() + faces.tobytes()))
    return load_mesh(path), 1 / 32767 if normalised else 1


@pytest.mark.parametrize("normalised", [False, True])
def test_quantised_positions_move_by_their_own_step(tmp_path: Path, normalised: bool) -> None:
    mesh, step = quantised(tmp_path / "a.glb", normalised)
    assert np.abs(mesh.vertices).max() == pytest.approx(32767 * step)
    # What lies at the end of the range stays there.
    moved = np.asarray(mesh.vertices) + 12.3 * step
    save_mesh(mesh._replace(vertices=moved), tmp_path / "b.glb", like=tmp_path / "a.glb")
    again = np.asarray(load_mesh(tmp_path / "b.glb").vertices)
    np.testing.assert_allclose(again, np.minimum(moved, 32767 * step), atol=0.501 * step)
    text = json.loads((tmp_path / "b.glb").read_bytes()[20:].split(b"BIN\0")[0][:-4].decode())
    assert text["accessors"][0]["max"] == np.rint(again.max(0) / step).tolist()
    for share, loss in ((3, 0), (0.7, 43), (0.6, 67)):
        moved = mesh._replace(vertices=np.asarray(mesh.vertices) - np.sign(mesh.vertices) * share * step)
        notes = save_mesh(moved, tmp_path / "c.glb", like=tmp_path / "a.glb")
        assert notes == ((f"rounding to the numbers of the file changes the displacement by {loss} %",) * (loss > 0))
    with pytest.raises(JaxmarkError, match="rounding takes 100 %"):
        save_mesh(mesh._replace(vertices=0.4 * step + mesh.vertices), tmp_path / "c.glb", like=tmp_path / "a.glb")


@pytest.mark.parametrize("normalised", [False, True])
def test_quantised_positions_are_held_at_the_end_of_their_range(tmp_path: Path, normalised: bool) -> None:
    mesh, step = quantised(tmp_path / "a.glb", normalised)
    for factor in (1.005, 1.03):  # by up to 164 and 983 steps beyond the range of 65,536
        moved = mesh._replace(vertices=factor * np.asarray(mesh.vertices))
        save_mesh(moved, tmp_path / "b.glb", like=tmp_path / "a.glb")
        again = np.asarray(load_mesh(tmp_path / "b.glb").vertices)
        np.testing.assert_allclose(again, np.clip(moved.vertices, -32768 * step, 32767 * step), atol=0.501 * step)
    with pytest.raises(JaxmarkError, match="beyond the range"):
        save_mesh(mesh._replace(vertices=1.05 * mesh.vertices), tmp_path / "c.glb", like=tmp_path / "a.glb")


def compressed(joints: type) -> tuple[dict[str, Any], bytes]:
    """A mesh with normals and joints, compressed by Draco."""
    draco = pytest.importorskip("DracoPy")
    points = np.asarray(BALLS[0].vertices, np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    bones = (np.arange(4 * len(points)).reshape(-1, 4) % 7).astype(joints)
    faces = np.asarray(BALLS[0].faces, np.uint32)
    generic = {1: normals, 2: bones if joints != np.int16 else bones.astype(np.uint16)}
    blob = draco.encode(points, faces, quantization_bits=14, preserve_order=True, generic_attributes=generic)
    component = {np.uint8: 5121, np.uint16: 5123, np.int16: 5122}[joints]
    named = {"POSITION": 0, "NORMAL": 1, "JOINTS_0": 2}
    ids = {"POSITION": 3, "NORMAL": 1, "JOINTS_0": 2}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_draco_mesh_compression"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": named,
                        "indices": 3,
                        "extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": ids}},
                    }
                ]
            }
        ],
        "accessors": [
            {"componentType": 5126, "count": len(points), "type": "VEC3", "min": [-9] * 3, "max": [9] * 3},
            {"componentType": 5126, "count": len(points), "type": "VEC3"},
            {"componentType": component, "count": len(points), "type": "VEC4"},
            {"componentType": 5123, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(blob)}],
        "buffers": [{"byteLength": len(blob)}],
    }
    return document, bytes(blob) + bytes(-len(blob) % 4)


@pytest.mark.parametrize("joints", [np.uint8, np.uint16, np.int16])
def test_draco_is_decoded_and_encoded_again(tmp_path: Path, joints: type) -> None:
    document, data = compressed(joints)
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data))
    mesh = load_mesh(tmp_path / "a.glb")
    np.testing.assert_array_equal(mesh.faces, BALLS[0].faces)
    np.testing.assert_allclose(mesh.vertices, BALLS[0].vertices, atol=2e-4)
    moved = mesh._replace(vertices=np.asarray(mesh.vertices) * [1.01, 1, 0.99])
    notes = save_scene({"mesh": moved}, tmp_path / "b.glb", like=tmp_path / "a.glb")
    again = load_mesh(tmp_path / "b.glb")
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.vertices, moved.vertices, atol=5e-7)
    written = (tmp_path / "b.glb").read_bytes()
    size = struct.unpack_from("<I", written, 12)[0]
    text, chunk = json.loads(written[20 : 20 + size]), written[28 + size :]
    assert data.rstrip(b"\0") not in chunk  # nothing is left of the mesh as it was
    plain = joints == np.int16  # which the encoder does not know
    assert len(notes) == plain
    assert ("extensionsRequired" in text) != plain
    if plain:
        other = next(iter(trimesh.load_scene(tmp_path / "b.glb", process=False).geometry.values()))
        np.testing.assert_allclose(other.vertices, moved.vertices, atol=1e-6)
    else:
        view = text["bufferViews"][0]
        begin = view.get("byteOffset", 0)
        found = pytest.importorskip("DracoPy").decode(chunk[begin : begin + view["byteLength"]])
        by_id = {item["unique_id"]: item["data"] for item in found.attributes}
        ids = text["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]["attributes"]
        np.testing.assert_array_equal(by_id[ids["JOINTS_0"]], np.arange(4 * len(BALLS[0].vertices)).reshape(-1, 4) % 7)


@pytest.mark.parametrize("joints", [np.uint8, np.int16])
@pytest.mark.parametrize("shared", [False, True])
def test_nothing_is_left_of_draco_and_later_bytes_follow(tmp_path: Path, joints: type, shared: bool) -> None:
    """An image behind the compressed view, which two primitives may share."""
    document, data = compressed(joints)
    image = b"a picture "
    document["images"] = [{"bufferView": 1, "mimeType": "image/png"}]
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(image)})
    document["buffers"] = [{"byteLength": len(data + image)}]
    if shared:
        document["meshes"].append(json.loads(json.dumps(document["meshes"][0])))
        document["accessors"] += [dict(accessor) for accessor in document["accessors"]]
        primitive = document["meshes"][1]["primitives"][0]
        primitive |= {"attributes": {"POSITION": 4, "NORMAL": 5, "JOINTS_0": 6}, "indices": 7}
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data + image + bytes(2)))
    meshes = load_scene(tmp_path / "a.glb").meshes
    factors = {name: 1.01 + 0.01 * number for number, name in enumerate(meshes)}
    moved = {name: mesh._replace(vertices=factors[name] * mesh.vertices) for name, mesh in meshes.items()}
    save_scene(moved, tmp_path / "b.glb", like=tmp_path / "a.glb")
    for name, mesh in load_scene(tmp_path / "b.glb").meshes.items():
        np.testing.assert_allclose(mesh.vertices, moved[name].vertices, atol=1e-6)
    written = (tmp_path / "b.glb").read_bytes()
    size = struct.unpack_from("<I", written, 12)[0]
    text, chunk = json.loads(written[20 : 20 + size]), written[28 + size :]
    places = [(view.get("byteOffset", 0), view["byteLength"]) for view in text["bufferViews"]]
    assert chunk[places[1][0] :][: len(image)] == image
    assert data.rstrip(b"\0") not in chunk
    assert len(chunk) - sum(length for _, length in places) < 4 * len(places) + 4
    assert all(begin % 4 == 0 for begin, _ in places)


def test_numbers_decoded_by_draco_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document, data = compressed(np.uint8)
    points, faces = len(BALLS[0].vertices), len(BALLS[0].faces)
    enough = 3 * points + faces + 2 * points  # announced, decoded, and read as positions and normals
    for limit, refused in ((enough, False), (enough - 1, True)):
        monkeypatch.setattr(limits, "ACCESSED", limits.Limit("elements of accessors", limit, 0))
        (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data))
        with pytest.raises(JaxmarkError, match="elements of accessors") if refused else nullcontext():
            load_mesh(tmp_path / "a.glb")


def test_many_decoded_numbers_are_added_without_copies() -> None:
    document = Document(b'{"buffers": [{"uri": "data:;base64,AAAA"}]}', lambda path: b"")
    begins = [document.add(b"ab") for _ in range(3)]
    assert begins == [3, 5, 7]
    same = document.data
    document.add(b"c")
    assert document.data is same
    assert bytes(same) == b"\0\0\0abababc"


def test_draco_that_announces_too_much_is_refused(tmp_path: Path) -> None:
    document, data = compressed(np.uint8)
    for accessor in document["accessors"]:
        accessor["count"] = 2**30
    (tmp_path / "a.glb").write_bytes(glb(json.dumps(document), data))
    with pytest.raises(JaxmarkError, match="bytes of unpacked content"):
        load_mesh(tmp_path / "a.glb")
