"""The Khronos validator, of npm, finds nothing in patched glTF files that it does not find in their sources."""

import importlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxmark.files import load_scene, save_scene
from tests.files.helpers import noisy
from tests.meshes import MESHES

npm = importlib.import_module("benchmarks.common.npm")  # by name, as the tests have a folder `benchmarks`, too

pytestmark = pytest.mark.long
PACKAGE = "gltf-validator@2.0.0-dev.3.10"
# Prints all errors and warnings as JSON: their codes, and the places in the document.
SCRIPT = """
const [fs, path, [folder, file]] = [require("fs"), require("path"), process.argv.slice(1)];
const read = (name) => new Uint8Array(fs.readFileSync(name));
const externalResourceFunction = async (uri) => read(path.resolve(path.dirname(file), decodeURIComponent(uri)));
require(path.join(folder, "gltf-validator"))
  .validateBytes(read(file), { maxIssues: 0, externalResourceFunction })
  .then((report) => report.issues.messages.filter((one) => one.severity < 2))
  .then((found) => console.log(JSON.stringify(found.map((one) => [one.code, one.pointer ?? ""]))));
"""
FILES = sorted(
    path
    for folder in (MESHES / "scenes", MESHES.parent / "cases")
    for path in folder.rglob("*")
    if path.suffix in (".glb", ".gltf", ".vrm")
)


@pytest.fixture(scope="module")
def validate() -> Callable[[Path], set[tuple[str, str]]]:
    try:
        folder = npm.install(PACKAGE)
    except npm.NpmError as error:
        pytest.skip(str(error))
    return lambda path: {(code, pointer) for code, pointer in json.loads(npm.run_node("-e", SCRIPT, folder, path))}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_patched_file_is_as_valid_as_its_source(tmp_path: Path, path: Path, validate) -> None:
    if path.parent.name in ("scenes", "cases"):
        shutil.copy(path, tmp_path)
    else:
        shutil.copytree(path.parent, tmp_path, dirs_exist_ok=True)  # with its buffers and textures
    source, out = tmp_path / path.name, tmp_path / f"patched{path.suffix}"
    meshes = load_scene(source).meshes
    moved = {name: noisy(mesh, 1e-3 * float(np.ptp(mesh.vertices, axis=0).max())) for name, mesh in meshes.items()}
    save_scene(moved, out, like=source)
    assert validate(out) <= validate(source)


def test_the_validator_finds_wrong_bounds(tmp_path: Path, validate) -> None:
    """Otherwise the other tests would show nothing."""
    for name, most in (("right", 1), ("wrong", 2)):
        accessor = {"componentType": 5126, "count": 1, "type": "VEC3", "min": [1, 1, 1], "max": [most] * 3}
        mesh = {"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}
        buffer = {"byteLength": 12, "uri": "data:application/octet-stream;base64,AACAPwAAgD8AAIA/"}
        document = {
            "asset": {"version": "2.0"},
            "buffers": [buffer],
            "bufferViews": [{"buffer": 0, "byteLength": 12}],
            "accessors": [{**accessor, "bufferView": 0}],
            "meshes": [mesh],
        }
        (tmp_path / f"{name}.gltf").write_text(json.dumps(document))
    assert validate(tmp_path / "right.gltf") == set()
    assert {code for code, _ in validate(tmp_path / "wrong.gltf")} == {"ACCESSOR_MAX_MISMATCH"}
