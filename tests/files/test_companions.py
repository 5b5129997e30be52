"""Files that come along with one that refers to them: images, buffers and layers in or below its folder."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.files.atomic import write_together
from tests.samples import bumpy_sphere


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A glTF file with a buffer beside it; `refer` makes it refer to images."""
    folder = tmp_path / "source"
    folder.mkdir()
    sphere = bumpy_sphere(1)
    points, faces = np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.uint32)
    (folder / "points.bin").write_bytes(points.tobytes() + faces.tobytes())
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "points.bin", "byteLength": points.nbytes + faces.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": faces.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"}
            | {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    (folder / "model.gltf").write_text(json.dumps(document))
    return folder / "model.gltf"


def refer(model: Path, *names: str) -> None:
    document = json.loads(model.read_text())
    model.write_text(json.dumps(document | {"images": [{"uri": name} for name in names]}))


def saved(model: Path, output: Path) -> tuple[str, ...]:
    """Save the model with moved points in another folder."""
    output.mkdir(parents=True, exist_ok=True)
    mesh = jm.load_mesh(model)
    return jm.save_mesh(jm.Mesh(1.001 * np.asarray(mesh.vertices), mesh.faces), output / "marked.gltf", like=model)


def test_images_come_along_once(model: Path, tmp_path: Path):
    folder = model.parent
    (folder / "textures").mkdir()
    (folder / "textures" / "wood.png").write_bytes(b"wood")
    refer(model, "textures/wood.png", "./textures/wood.png", "textures/../textures/wood.png", "missing.png")
    assert not saved(model, tmp_path / "out")
    assert (tmp_path / "out" / "textures" / "wood.png").read_bytes() == b"wood"


@pytest.mark.parametrize("name", ["owner.key", "model.gltf", "m.ply.jaxmark.json", "notes.txt", "sub/../owner.key"])
def test_keys_originals_and_records_never_come_along(name: str, model: Path, tmp_path: Path):
    """A file that somebody supplied could name them."""
    (model.parent / "sub").mkdir()
    for private in ("owner.key", "m.ply.jaxmark.json", "notes.txt"):
        (model.parent / private).write_text("private")
    refer(model, name)
    (note,) = saved(model, tmp_path / "out")
    assert "is not copied" in note
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".bin", ".gltf"]


@pytest.mark.skipif(os.name == "nt", reason="symbolic links need rights on Windows")
def test_nothing_is_written_outside_of_the_output_folder(model: Path, tmp_path: Path):
    """By a link in the folder of the source, up from which the name goes; or by one in that of the output."""
    folder, output = model.parent, tmp_path / "deep" / "er" / "out"
    (folder / "a" / "b" / "c").mkdir(parents=True)
    (folder / "sub").symlink_to(Path("a") / "b" / "c", target_is_directory=True)
    (folder / "dropped.png").write_bytes(b"dropped")
    refer(model, "sub/../../../dropped.png", "..%2F..%2Fdropped.png", "/etc/x.png")
    assert len(saved(model, output)) == 2  # two of them are one
    assert [path.name for path in tmp_path.rglob("dropped.png")] == ["dropped.png"]
    home = tmp_path / "home"
    home.mkdir()
    (output / "tex").symlink_to(home, target_is_directory=True)
    with pytest.raises(jm.JaxmarkError, match="would lie outside of"):
        write_together(output / "other.gltf", b"{}", {"tex/x.png": b"x"})
    assert not list(home.iterdir())
    assert not (output / "other.gltf").exists()


def test_files_of_any_size_do_not_come_along(model: Path, tmp_path: Path):
    with (model.parent / "sparse.png").open("wb") as file:
        file.truncate(2**33)
    refer(model, "sparse.png")
    saved(model, tmp_path / "out")
    assert not (tmp_path / "out" / "sparse.png").exists()
