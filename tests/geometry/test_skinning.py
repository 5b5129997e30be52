"""Skins: read from files, and poses of a skeleton that are undone, with the mark still there."""

import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.app import cli
from jaxmark.files import load_mesh, load_skin, save_mesh
from jaxmark.geometry import Skinning, asteroid, diagonal, unpose
from jaxmark.geometry.mesh import Mesh
from tests.meshes import shared_mesh

pytestmark = pytest.mark.core

POSED = ["scenes/bevy__Fox.glb", "scenes/draco__CesiumMan.glb", "scenes/engine__bitmoji.glb"]


def skin_along(mesh: Mesh, joints: int) -> Skinning:
    """Joints in a row along x, each vertex between the two that are next to it."""
    x = np.asarray(mesh.vertices)[:, 0]
    place = (x - x.min()) / np.ptp(x) * (joints - 1)
    low = np.minimum(place.astype(np.int64), joints - 2)
    share = place - low
    return Skinning(np.c_[low, low + 1], np.c_[1 - share, share])


def posed(mesh: Mesh, skin: Skinning, degrees: float, seed: int = 0) -> Mesh:
    """Each joint turned about the centre of its vertices by some degrees, and shifted, one joint after the other."""
    random, found = np.random.default_rng(seed), np.zeros_like(mesh.vertices, dtype=float)
    for joint in np.unique(skin.joints):
        weight = (skin.weights * (skin.joints == joint)).sum(axis=1)
        centre = (weight[:, None] * mesh.vertices).sum(axis=0) / max(weight.sum(), 1e-9)
        turn = Rotation.from_rotvec(np.radians(degrees) * random.normal(size=3) / np.sqrt(3))
        shift = 0.02 * diagonal(mesh) * random.normal(size=3)
        found += weight[:, None] * (turn.apply(mesh.vertices - centre) + centre + shift)
    return Mesh(found, mesh.faces)


def skinned_glb(mesh: Mesh, skin: Skinning) -> bytes:
    """A GLB file with a skin, one byte for the number of a joint and float weights."""
    columns = [
        np.asarray(mesh.vertices, "<f4"),
        np.pad(skin.joints, ((0, 0), (0, 2))).astype("<u1"),
        np.pad(skin.weights, ((0, 0), (0, 2))).astype("<f4"),
        np.asarray(mesh.faces, "<u4").ravel(),
    ]
    kinds = [(5126, "VEC3"), (5121, "VEC4"), (5126, "VEC4"), (5125, "SCALAR")]
    views, accessors, body = [], [], b""
    for number, (column, (component, kind)) in enumerate(zip(columns, kinds, strict=True)):
        data = column.tobytes()
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
        accessors.append({"bufferView": number, "componentType": component, "count": len(column), "type": kind})
        body += data.ljust(-(-len(data) // 4) * 4, b"\0")
    joints = int(skin.joints.max()) + 1
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, "skin": 0}, *({"name": f"joint {joint}"} for joint in range(joints))],
        "skins": [{"joints": list(range(1, joints + 1))}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 3}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(document).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return asteroid(1500, seed=4)


def test_a_pose_is_undone_to_rounding(mesh: Mesh):
    skin = skin_along(mesh, 5)
    suspect = posed(mesh, skin, 30)
    far = Mesh(7 * np.asarray(suspect.vertices) + [100.0, 0, 0], mesh.faces)
    for one in (suspect, far):
        back = unpose(mesh, skin, one)
        np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-7 * diagonal(mesh))


@pytest.mark.slow
def test_a_mark_is_read_in_another_pose_of_the_skeleton(mesh: Mesh, key: jm.Key, tmp_path: Path, monkeypatch, capsys):
    """By the command line, from a file with a skin; without the skeleton, the pose hides the message."""
    skin, model = skin_along(mesh, 5), tmp_path / "model.glb"
    model.write_bytes(skinned_glb(mesh, skin))
    mesh = load_mesh(model)
    marker = jm.make_marker(mesh, key, bits=16)
    marked, _ = marker.embed(b"ok", 8e-4)
    suspect = posed(marked, load_skin(model), 60, seed=1)
    assert marker.detect(suspect).message is None
    assert marker.detect(unpose(mesh, load_skin(model), suspect)).message == b"ok"
    wrong = jm.make_marker(mesh, jm.Key(bytes(32)), bits=16)
    assert wrong.detect(unpose(mesh, load_skin(model), suspect)).message is None
    save_mesh(suspect, tmp_path / "posed.ply")
    names = [str(tmp_path / name) for name in ("posed.ply", "model.glb", "back.ply")]
    monkeypatch.setattr(sys, "argv", ["jaxmark", "unpose", *names])
    cli.main()
    assert "back.ply" in capsys.readouterr().out
    assert marker.detect(load_mesh(names[2])).message == b"ok"


def test_skins_are_those_of_the_file(mesh: Mesh, tmp_path: Path):
    skin, model = skin_along(mesh, 4), tmp_path / "model.glb"
    model.write_bytes(skinned_glb(mesh, skin))
    found = load_skin(model)
    np.testing.assert_array_equal(found.joints[:, :2], skin.joints)
    np.testing.assert_allclose(found.weights[:, :2], skin.weights, atol=1e-7)
    np.testing.assert_array_equal(found.weights[:, 2:], 0)


def test_refusals(mesh: Mesh, tmp_path: Path):
    skin = skin_along(mesh, 4)
    with pytest.raises(jm.JaxmarkError, match="the original has 1500, its skin 1500 and the suspect 3"):
        unpose(mesh, skin, Mesh(np.eye(3), np.array([[0, 1, 2]])))
    flat = Mesh(np.asarray(mesh.vertices) * [1.0, 1, 0], mesh.faces)
    with pytest.raises(jm.JaxmarkError, match="flattens the surface at 1500 vertices"):
        unpose(mesh, skin, flat)
    with pytest.raises(jm.JaxmarkError, match="flattens the surface at 1500 vertices"):
        unpose(mesh, skin, Mesh(np.zeros((1500, 3)), mesh.faces))
    with pytest.raises(jm.JaxmarkError, match="The skin has 1500 joints"):
        unpose(mesh, Skinning(np.arange(1500)[:, None], np.ones((1500, 1))), mesh)
    with pytest.raises(jm.JaxmarkError, match="20 joints for each vertex, more than the limit of 16"):
        unpose(mesh, Skinning(np.zeros((1500, 20), int), np.full((1500, 20), 1 / 20)), mesh)
    lost = np.where(np.arange(1500)[:, None] < 2, np.nan, mesh.vertices)
    with pytest.raises(jm.JaxmarkError, match="2 vertices whose coordinates are not finite"):
        unpose(mesh, skin, Mesh(lost, mesh.faces))
    save_mesh(mesh, tmp_path / "plain.glb")
    with pytest.raises(jm.JaxmarkError, match="has no skin"):
        load_skin(tmp_path / "plain.glb")
    with pytest.raises(jm.JaxmarkError, match="has no skin"):
        load_skin(save(mesh, tmp_path / "plain.ply"))
    data = skinned_glb(mesh, skin._replace(weights=0 * skin.weights))
    (tmp_path / "loose.glb").write_bytes(data)
    with pytest.raises(jm.JaxmarkError, match="weights of joints that are negative, or none"):
        load_skin(tmp_path / "loose.glb")
    data = skinned_glb(mesh, skin)
    sets = b"".join(b',"JOINTS_%d":1,"WEIGHTS_%d":2' % (number, number) for number in range(1, 5))
    for old, new, sentence in (
        (b'"skin": 0', b'"skin": -9', "skin of a node is -9, not an index"),
        (b'"VEC4"', b'"MAT4"', "does not lie inside|come in sets of four"),
        (b', "WEIGHTS_0": 2', b', "WEIGHTS_0": 2' + sets, "more than 4 sets of joints and weights"),
    ):
        (tmp_path / "wrong.glb").write_bytes(with_text(data, old, new))
        with pytest.raises(jm.JaxmarkError, match=sentence):
            load_skin(tmp_path / "wrong.glb")


def with_text(data: bytes, old: bytes, new: bytes) -> bytes:
    """A GLB file with other words in its JSON."""
    (length,) = struct.unpack("<I", data[12:16])
    text, body = data[20 : 20 + length], data[20 + length :]
    assert old in text
    text = text.replace(old, new)
    text = text.ljust(-(-len(text) // 4) * 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def save(mesh: Mesh, path: Path) -> Path:
    save_mesh(mesh, path)
    return path


@pytest.mark.parametrize("name", POSED)
def test_poses_of_real_characters_are_undone(name: str):
    path = shared_mesh(name)
    mesh, skin = load_mesh(path), load_skin(path)
    back = unpose(mesh, skin, posed(mesh, skin, 25))
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=2e-6 * diagonal(mesh))
