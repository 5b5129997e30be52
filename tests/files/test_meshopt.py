"""glTF whose buffer views are compressed with meshoptimizer."""

import json
from pathlib import Path
from typing import Any

import meshopt
import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, load_mesh, load_scene, save_mesh
from tests.files.helpers import noisy, written
from tests.files.test_glb import glb, split
from tests.samples import bumpy_sphere

BALL = bumpy_sphere(1, 0)
POINTS = np.asarray(BALL.vertices, np.float32)
COUNT = len(POINTS)
STEPS = np.zeros((COUNT, 4), "<u2")  # quantised positions, padded to eight bytes
STEPS[:, :3] = np.rint((POINTS - POINTS.min(0)) * 9000)
#: Rows of positions, their component, and the filter, by the form that gltfpack writes.
FORMS: dict[str, tuple[np.ndarray, int, str]] = {
    "floats": (POINTS, 5126, "NONE"),
    "exponential": (meshopt.encode_filter_exp(POINTS, 15), 5126, "EXPONENTIAL"),
    "quantised": (STEPS, 5123, "NONE"),
}
FALLBACK = {"EXT_meshopt_compression": {"fallback": True}}


def packed(form: str, name: str = "EXT_meshopt_compression") -> tuple[dict[str, Any], bytes]:
    """A document, and its buffer: an image, and compressed positions, faces and colours, which nothing reads."""
    rows, component, filtered = FORMS[form]
    faces = np.asarray(BALL.faces, np.uint16)
    version = int(name.startswith("KHR"))
    colours = np.arange(4 * COUNT, dtype=np.uint8).reshape(-1, 4)
    blobs = [
        (meshopt.encode_gltf_buffer(rows, "ATTRIBUTES", version), COUNT, rows.nbytes // COUNT, "ATTRIBUTES", filtered),
        (meshopt.encode_gltf_buffer(faces.ravel(), "TRIANGLES"), faces.size, 2, "TRIANGLES", "NONE"),
        (meshopt.encode_gltf_buffer(colours, "ATTRIBUTES", version), COUNT, 4, "ATTRIBUTES", "NONE"),
    ]
    data, views, place = b"a picture...", [{"buffer": 0, "byteLength": 12}], 0
    for blob, count, stride, mode, filter_ in blobs:
        source = {"buffer": 0, "byteOffset": len(data), "byteLength": len(blob), "byteStride": stride, "count": count}
        source |= {"mode": mode} | ({"filter": filter_} if filter_ != "NONE" else {})
        view = {"buffer": 1, "byteOffset": place, "byteLength": count * stride, "extensions": {name: source}}
        views.append(view | ({"byteStride": stride} if mode == "ATTRIBUTES" else {}))
        data += blob + bytes(-len(blob) % 4)
        place += count * stride
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 1, "componentType": component, "count": COUNT, "type": "VEC3", "min": [0] * 3},
            {"bufferView": 2, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
            {"bufferView": 3, "componentType": 5121, "count": COUNT, "type": "VEC4"},
        ],
        "bufferViews": views,
        "images": [{"bufferView": 0, "mimeType": "image/png"}],
        "buffers": [{"byteLength": len(data)}, {"byteLength": place, "extensions": FALLBACK}],
    }
    return document, data


def blobs_of(document: dict[str, Any], chunk: bytes) -> list[bytes]:
    """The stored bytes of each view."""
    places = [next(iter(view.get("extensions", {"": view}).values())) for view in document["bufferViews"]]
    return [chunk[one.get("byteOffset", 0) :][: one["byteLength"]] for one in places]


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_meshopt_compression"])
@pytest.mark.parametrize("form", FORMS)
def test_positions_are_decoded_and_encoded_again(tmp_path: Path, form: str, name: str) -> None:
    document, data = packed(form, name)
    source = written(tmp_path, "a.glb", glb(json.dumps(document), data))
    mesh = load_mesh(source)
    np.testing.assert_array_equal(np.sort(mesh.faces), np.sort(BALL.faces))  # triangles may begin at another corner
    expected = STEPS[:, :3] if form == "quantised" else POINTS
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-3 if form == "exponential" else 0)
    moved = noisy(mesh, 0.01 * np.ptp(mesh.vertices))
    save_mesh(moved, tmp_path / "b.glb", like=source)
    tolerance = 0.5 if form == "quantised" else 1e-6
    inside = np.clip(moved.vertices, 0, None) if form == "quantised" else moved.vertices
    np.testing.assert_allclose(load_mesh(tmp_path / "b.glb").vertices, inside, atol=tolerance)
    text, chunk = split((tmp_path / "b.glb").read_bytes())
    before, after = blobs_of(document, data), blobs_of(json.loads(text), chunk)
    assert [one == other for one, other in zip(before, after, strict=True)] == [True, False, True, True]
    assert before[1] not in chunk  # nothing is left of the mesh as it was
    assert before[1][0] == after[1][0]  # the version of the format


def test_an_unchanged_file_is_the_same(tmp_path: Path) -> None:
    document, data = packed("exponential")
    source = written(tmp_path, "a.glb", glb(json.dumps(document), data))
    save_mesh(load_mesh(source), tmp_path / "b.glb", like=source)
    assert (tmp_path / "b.glb").read_bytes() == source.read_bytes()


def test_the_form_without_compression_changes_as_well(tmp_path: Path) -> None:
    document, data = packed("floats")
    document["buffers"][1]["uri"] = "plain.bin"
    source = written(tmp_path, "a.glb", glb(json.dumps(document), data))
    mesh = load_mesh(source)
    moved = noisy(mesh, 0.01)
    with pytest.raises(JaxmarkError, match="cannot be read; put it beside the file"):
        save_mesh(moved, tmp_path / "b.glb", like=source)
    plain = POINTS.tobytes() + bytes(document["buffers"][1]["byteLength"] - POINTS.nbytes)
    written(tmp_path, "plain.bin", plain)
    save_mesh(moved, tmp_path / "b.glb", like=source)
    text, _ = split((tmp_path / "b.glb").read_bytes())
    found = (tmp_path / json.loads(text)["buffers"][1]["uri"]).read_bytes()
    np.testing.assert_array_equal(
        np.frombuffer(found[: POINTS.nbytes], "<f4").reshape(-1, 3), np.float32(moved.vertices)
    )
    assert found[POINTS.nbytes :] == plain[POINTS.nbytes :]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 2**31, "byteStride": 12}, "another length"),
        ({"mode": "OTHER"}, "unknown way"),
        ({"filter": ["NONE"]}, "unknown way"),
        ({"count": 0}, "unknown way"),
        ({"byteStride": 2**20}, "unknown way"),
        ({"byteLength": 20}, "cannot be decoded by meshopt"),
        ({"mode": "TRIANGLES"}, "cannot be decoded by meshopt"),
        ({"filter": "OCTAHEDRAL"}, "cannot be decoded by meshopt"),
        ({"byteOffset": 10**9}, "does not lie inside"),
    ],
)
def test_damaged_views_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    document, data = packed("floats")
    document["bufferViews"][1]["extensions"]["EXT_meshopt_compression"] |= change
    with pytest.raises(JaxmarkError, match=message):
        load_mesh(written(tmp_path, "a.glb", glb(json.dumps(document), data)))


@pytest.mark.parametrize("change", [{"byteOffset": 10**9}, {"buffer": 0}])
def test_views_beyond_the_end_of_their_own_buffer_are_refused(tmp_path: Path, change: dict[str, int]) -> None:
    """The decoded form must lie inside the buffer for programs that cannot decode, whether it is there or not."""
    document, data = packed("floats")
    document["buffers"][0]["byteLength"] = POINTS.nbytes - 1
    document["bufferViews"][1] |= change
    with pytest.raises(JaxmarkError, match=r"bufferViews\[1\] does not lie inside"):
        load_mesh(written(tmp_path, "a.glb", glb(json.dumps(document), data)))


def test_views_that_announce_too_much_are_refused(tmp_path: Path) -> None:
    document, data = packed("floats")
    view = document["bufferViews"][1]
    view["extensions"]["EXT_meshopt_compression"]["count"] = 2**40
    view["byteLength"] = 12 * 2**40
    document["buffers"][1]["byteLength"] = 2**50
    file = glb(json.dumps(document), data)
    with pytest.raises(JaxmarkError, match=f"bytes of unpacked content, the most for a file of {len(file)} bytes"):
        load_mesh(written(tmp_path, "a.glb", file))


def test_views_of_the_same_bytes_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document, data = packed("floats")
    for number in range(1, 100):
        document["bufferViews"].append(document["bufferViews"][1])
        document["accessors"].append(document["accessors"][0] | {"bufferView": 3 + number})
        document["meshes"].append({"primitives": [{"attributes": {"POSITION": 2 + number}, "indices": 1}]})
    monkeypatch.setattr(limits, "UNPACKED", limits.Limit("bytes of unpacked content", 20_000, 0))
    scene = load_scene(written(tmp_path, "a.glb", glb(json.dumps(document), data)))
    assert 1 < len(scene.meshes) < 20_000 // POINTS.nbytes
    assert all("more than 20000 bytes of unpacked content" in reason for reason in scene.skipped.values())
