from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry.mesh import Mesh, make_mesh
from tests.files.helpers import noisy, shifted, written

pytestmark = pytest.mark.core

SUFFIXES = [".obj", ".off", ".ply", ".stl", ".glb", ".gltf", ".3mf"]
# Doubled vertices, an isolated one, a degenerate face, numbers of all sizes.
MESH = make_mesh(
    [[1 / 3, 0, 0], [1, 1e-12, 0], [0, 1, 2 / 7], [1 / 3, 0, 0], [-7.7, 0.1, 1e-5]], [[0, 1, 2], [3, 2, 1], [1, 1, 2]]
)


def soup(mesh: Mesh) -> np.ndarray:
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_new_files_hold_the_mesh(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"new{suffix}"
    save_mesh(MESH, path)
    mesh = load_mesh(path)
    exact = suffix in (".obj", ".off", ".3mf")
    np.testing.assert_array_equal(soup(mesh), soup(MESH) if exact else soup(MESH).astype(np.float32))
    if suffix != ".stl":
        assert len(mesh.vertices) == 5
        np.testing.assert_array_equal(mesh.faces, MESH.faces)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_other_readers_agree(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"new{suffix}"
    save_mesh(MESH, path)
    source = path.read_bytes()
    moved = noisy(load_mesh(path), 0.1)
    save_mesh(moved, tmp_path / f"out{suffix}", like=path)
    assert path.read_bytes() == source
    other = trimesh.load_mesh(tmp_path / f"out{suffix}", process=False)
    np.testing.assert_allclose(np.asarray(other.vertices)[other.faces], soup(moved), rtol=0, atol=1e-6)


def test_exactness_at_all_sizes(tmp_path: Path) -> None:
    sizes = 10.0 ** np.arange(-320, 300, 7)
    vertices = np.stack([sizes, -sizes / 3, sizes / 7], axis=1)
    mesh = make_mesh(vertices, [[0, 1, 2]])
    for suffix in (".obj", ".off"):
        save_mesh(mesh, tmp_path / f"wide{suffix}")
        np.testing.assert_array_equal(load_mesh(tmp_path / f"wide{suffix}").vertices, vertices)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
@pytest.mark.parametrize("offset", [1e9, 1e39])
def test_single_precision_that_would_spoil_the_mesh_is_refused(tmp_path: Path, suffix: str, offset: float) -> None:
    far = make_mesh(np.asarray(MESH.vertices) + offset, MESH.faces)
    with pytest.raises(JaxmarkError, match="single precision"):
        save_mesh(far, tmp_path / f"far{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_equal_mesh_is_a_copy_and_the_source_may_be_overwritten(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"new{suffix}"
    save_mesh(MESH, path)
    data = path.read_bytes()
    mesh = load_mesh(path)
    save_mesh(mesh, tmp_path / f"copy{suffix.upper()}", like=path)
    assert (tmp_path / f"copy{suffix.upper()}").read_bytes() == data
    moved = shifted(mesh, 0, [0.5, 0, 0])
    save_mesh(moved, path, like=path)
    np.testing.assert_allclose(load_mesh(path).vertices, moved.vertices, atol=1e-6)


def test_what_does_not_fit_the_source_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "source.obj"
    save_mesh(MESH, source)
    with pytest.raises(JaxmarkError, match="same suffix"):
        save_mesh(MESH, tmp_path / "out.off", like=source)
    with pytest.raises(JaxmarkError, match="does not have the vertices and faces"):
        save_mesh(MESH._replace(faces=np.asarray(MESH.faces)[:2]), tmp_path / "out.obj", like=source)
    with pytest.raises(JaxmarkError, match="does not have the vertices and faces"):
        save_mesh(MESH._replace(vertices=np.ones((6, 3))), tmp_path / "out.obj", like=source)
    with pytest.raises(JaxmarkError, match="Cannot read"):
        save_mesh(MESH, tmp_path / "out.obj", like=tmp_path / "absent.obj")
    with pytest.raises(JaxmarkError, match="finite"):
        save_mesh(shifted(MESH, 0, [np.nan, 0, 0]), tmp_path / "out.obj", like=source)
    assert [path.name for path in tmp_path.iterdir()] == ["source.obj"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.fbx", r"'\.fbx' .*OBJ, PLY, OFF, STL, GLB"),
        ("bare", "OBJ, PLY, OFF, STL, GLB"),
        ("absent.obj", "Cannot read .*absent.obj: No such file"),
        ("folder.ply", "Cannot read .*folder.ply: Is a directory"),
    ],
)
def test_unreadable(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(JaxmarkError, match=message):
        load_mesh(tmp_path / name)
    with pytest.raises(JaxmarkError, match=r"known mesh format|Cannot write|not an ordinary"):
        save_mesh(MESH, tmp_path / "absent" / name)


def test_displacements_beyond_all_numbers(tmp_path: Path) -> None:
    source = tmp_path / "source.ply"
    save_mesh(MESH, source)
    with pytest.raises(JaxmarkError, match="beyond the range"):
        save_mesh(shifted(load_mesh(source), 0, [1e300, 0, 0]), source, like=source)
    tiny = shifted(load_mesh(source), 0, [0, 1e-300, 0])
    with pytest.raises(JaxmarkError, match="apart"):
        save_mesh(tiny, source, like=source)


@settings(max_examples=60, deadline=None)
@given(
    decimals=st.integers(0, 9),
    exponent=st.booleans(),
    moves=st.lists(st.floats(-1e4, 1e4), min_size=9, max_size=9),
)
def test_text_is_rounded_to_the_files_own_digits(
    tmp_path_factory: pytest.TempPathFactory, decimals: int, exponent: bool, moves: list[float]
) -> None:
    form = f"%.{decimals}{'e' if exponent else 'f'}"
    text = "\n".join("v " + " ".join(form % (10 * i + j + 1) for j in range(3)) for i in range(3)) + "\nf 1 2 3\n"
    source = written(tmp_path_factory.mktemp("round"), "s.obj", text.encode())
    moved = load_mesh(source)
    moved = moved._replace(vertices=np.asarray(moved.vertices) + np.reshape(moves, (3, 3)))
    try:
        save_mesh(moved, source, like=source)
    except JaxmarkError as error:
        assert "apart" in str(error)  # noqa: PT017
        return
    # The very digits that Python's own rounding gives, except for a zero's sign.
    for line, row in zip(source.read_text().splitlines(), np.asarray(moved.vertices), strict=False):
        assert [float(token) for token in line.split()[1:]] == [float(form % value) for value in row]
