"""Real files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from tests.files.helpers import noisy
from tests.meshes import MESHES, shared_mesh, shared_meshes

pytestmark = pytest.mark.core

REFUSED = {
    *("empty.obj", "empty.ply", "notenoughindices.obj", "ply_empty_header.ply", "stl_empty_bin.stl"),
}


def name_of(path: Path) -> str:
    return path.name


@pytest.mark.parametrize("path", shared_meshes("hard"), ids=name_of)
def test_hard_files_are_read_or_refused_in_a_sentence(path: Path) -> None:
    if path.name in REFUSED:
        with pytest.raises(JaxmarkError, match=path.name):
            load_mesh(path)
    else:
        mesh = load_mesh(path)
        assert len(mesh.vertices) > np.max(mesh.faces, initial=-1)


@pytest.mark.parametrize(
    "name",
    [
        *("models/armadillo_14587.obj", "models/blub_7106.obj", "models/casting.off", "models/cycloidal.ply"),
        *("models/horse_48485.ply", "models/ADIS16480.STL", "models/20mm-xyz-cube.stl", "models/dragon_vrip_res3.ply"),
        *("hard/multibody.stl", "hard/CubeNonTriangleFaces.off", "models/fandisk_6475.obj", "hard/footbones.ply"),
    ],
)
def test_agrees_with_trimesh_before_and_after_patching(tmp_path: Path, name: str) -> None:
    path = shared_mesh(name)
    mesh = load_mesh(path)
    spread = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    moved = noisy(mesh, 0.2 * spread)
    out = tmp_path / path.name
    save_mesh(moved, out, like=path)
    for file, expected in ((path, mesh), (out, moved)):
        other = trimesh.load_mesh(file, process=False)
        # trimesh may number vertices anew (UV seams) or split quads along the other diagonal.
        got, want = np.asarray(other.vertices)[other.faces], np.asarray(expected.vertices)[np.asarray(expected.faces)]
        assert got.shape == want.shape
        if "NonTriangle" not in name:
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-4 * spread)


@pytest.mark.parametrize("path", shared_meshes("models"), ids=name_of)
def test_moving_back_gives_the_numbers_again(tmp_path: Path, path: Path) -> None:
    mesh = load_mesh(path)
    spread = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    out = tmp_path / path.name
    save_mesh(noisy(mesh, 1e-2 * spread), out, like=path)
    save_mesh(mesh, out, like=out)
    np.testing.assert_allclose(load_mesh(out).vertices, mesh.vertices, rtol=0, atol=1e-6 * spread)


def test_the_folder_is_where_it_is_said_to_be() -> None:
    if not MESHES.is_dir():
        pytest.skip("the shared meshes are absent (set JAXMARK_MESHES)")
    assert shared_meshes("hard")
    assert shared_meshes("models")
