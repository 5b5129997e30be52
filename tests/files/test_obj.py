import re
from pathlib import Path

import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_texture, save_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, turned, written

pytestmark = pytest.mark.core

# A square of two triangles on a UV seam, with whatever else such files hold. No newline at the end.
RICH = (
    b"# caf\xe9, not UTF-8\r\n"
    b"mtllib scene.mtl\r\n"
    b"o thing # 1\r\n"
    b"v 0.500000 0.000000  0.000000 0.1 0.2 0.3\r\n"
    b"\tv\t1.000000\t0.000000\t0.000000 1 1 1 # red\r\n"
    b"v 1.000000 1.000000 -0.000000 0 0 1\r\n"
    b"vt 0.5 0.5\r\n"
    b"v 0.000000 1.000000 0.000000\r\n"
    b"v 7.000000 7.000000 7.000000\r\n"
    b"vt 0.25 0.75\r\n"
    b"vn 0.0000 0.0000 1.0000\r\n"
    b"vn 1.0000 0.0000 0.0000\r\n"
    b"g left\r\n"
    b"usemtl wood\r\n"
    b"s 1\r\n"
    b"f 1/1/1 2/2/1 3/1/1\r\n"
    b"f -5//-2 -3//1 \\\r\n 4/2/1\r\n"
    b"l 1 2"
)


def masked(data: bytes) -> bytes:
    """The file without its coordinates and normals."""
    return re.sub(rb"(?m)^(\s*vn?[ \t]+)\S+([ \t]+)\S+([ \t]+)\S+", rb"\1*\2*\3*", data)


def test_vertices_and_faces_are_the_files_own(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "rich.obj", RICH)
    np.testing.assert_array_equal(mesh.vertices, [[0.5, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [7, 7, 7]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])


def test_moving_one_coordinate_changes_only_its_digits(tmp_path: Path) -> None:
    source = written(tmp_path, "rich.obj", RICH)
    data = patched(source, shifted(load_mesh(source), 0, [-0.25, 0, 0]))
    assert data == RICH.replace(b"v 0.500000", b"v 0.250000")


def test_everything_but_positions_and_normals_stays(tmp_path: Path) -> None:
    source = written(tmp_path, "rich.obj", RICH)
    moved = noisy(load_mesh(source), 0.1)
    data = patched(source, moved)
    assert masked(data) == masked(RICH)
    assert data != RICH
    again = loaded(tmp_path, "again.obj", data)
    np.testing.assert_allclose(again.vertices, moved.vertices, rtol=0, atol=0.5000001e-6)


def test_used_normals_turn_with_their_faces_and_others_stay(tmp_path: Path) -> None:
    upright = RICH.replace(b"v 1.000000 1.000000 -0.000000", b"v 1.000000 0.000000 1.000000")
    upright = upright.replace(b"v 0.000000 1.000000 0.000000", b"v 0.000000 0.000000 1.000000")
    upright = upright.replace(b"vn 0.0000 0.0000 1.0000", b"vn 0.6000 -0.8000 0.0000")
    source = written(tmp_path, "upright.obj", upright)
    data = patched(source, turned(load_mesh(source)))
    # The faces' normal goes from -y to +x, and the normal that leans away from it goes along.
    assert re.findall(rb"vn [^\r]*", data) == [b"vn 0.8000 0.6000 0.0000", b"vn 1.0000 0.0000 0.0000"]


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        (b"f 1 2 3 4", [[0, 1, 2], [0, 2, 3]]),
        (b"f 1// 2// 3//", [[0, 1, 2]]),
        (b"f 1/7 2/8 3/9", [[0, 1, 2]]),
        (b"f\t1/7/99  2/8/99\t3/9/99 # no such normals", [[0, 1, 2]]),
        (b"f -1 -2 -3", [[3, 2, 1]]),
        (b"f 1 2 \\\n3 \\\n4\nf 1 2 3", [[0, 1, 2], [0, 2, 3], [0, 1, 2]]),
        (b"# f 1 2 3 \\\nf 4 3 2", [[3, 2, 1]]),
        (b"  f 3 3 1", [[2, 2, 0]]),
    ],
)
def test_faces_are_read_in_all_their_forms(tmp_path: Path, text: bytes, faces: list[list[int]]) -> None:
    data = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\n" + text
    np.testing.assert_array_equal(loaded(tmp_path, "some.obj", data).faces, faces)
    np.testing.assert_array_equal(loaded(tmp_path, "some.obj", data + b"\n").faces, faces)
    np.testing.assert_array_equal(loaded(tmp_path, "some.obj", data.replace(b"\n", b"\r\n")).faces, faces)


def test_classic_mac_line_ends(tmp_path: Path) -> None:
    data = RICH.replace(b"\r\n", b"\r").replace(b"\\\r 4", b"4")
    assert len(loaded(tmp_path, "mac.obj", data).faces) == 2
    source = written(tmp_path, "mac.obj", data)
    assert masked(patched(source, noisy(load_mesh(source), 0.1)).replace(b"\r", b"\n")) == masked(
        data.replace(b"\r", b"\n")
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"f 1 2\n", "line 4.*three corners"),
        (b"\nf 1 2 4\n", "line 5.*'4'.*3 vertices"),
        (b"f 0 1 2\n", "line 4"),
        (b"f 1 2 -4\n", "line 4"),
        (b"f 1 2 x\n", "line 4.*'x'"),
        (b"f 1 2 /3\n", "line 4.*missing"),
        (b"f 1 2 99999999999999999999999\n", "line 4.*digits"),
        (b"v 1 2\nf 1 2 3\n", "line 4.*three numbers"),
        (b"v 1 2 1_0\nf 1 2 3\n", "line 4.*'1_0'"),
        (b"v 1 2 3.0.0\nf 1 2 3\n", "line 4.*'3.0.0'"),
        (b"v 1 2 \x00\nf 1 2 3\n", "line 4"),
        (b"v 1 2 nan\nf 1 2 3\n", "Vertex 3 .*finite"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.obj: {message}"):
        loaded(tmp_path, "bad.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\n" + text)


def test_numbers_are_read_as_python_reads_them(tmp_path: Path) -> None:
    tokens = ["0.1", "+1e-3", "-2.5E+07", ".5", "5.", "0.30000000000000004", "1e300", "1234567890" * 3, "4.9e-324"]
    data = "\n".join(f"v {' '.join(tokens[i : i + 3])}" for i in (0, 3, 6)) + "\nf 1 2 3\n"
    mesh = loaded(tmp_path, "exact.obj", data.encode())
    assert np.asarray(mesh.vertices).ravel().tolist() == [float(token) for token in tokens]


def test_exponents_keep_their_letter_and_digits(tmp_path: Path) -> None:
    data = b"v 1.250E-05 2.5e+01 0.125\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    source = written(tmp_path, "exponent.obj", data)
    moved = shifted(load_mesh(source), 0, [10.0, 0.0, 0.0])
    moved = shifted(moved, 0, [0.0, 1.25, 0.25])
    assert patched(source, moved) == data.replace(b"1.250E-05 2.5e+01 0.125", b"1.000E+01 2.625e+01 0.375")


def test_short_exponent_tokens_among_longer_numbers_get_as_many_digits(tmp_path: Path) -> None:
    data = b"v 1e-06 15.3644 -1.47466\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    source = written(tmp_path, "mixed.obj", data)
    moved = shifted(load_mesh(source), 0, [0.0123456, 0.0, 0.0])
    assert patched(source, moved) == data.replace(b"1e-06", b"1.23466e-02")


def test_no_negative_zero_appears(tmp_path: Path) -> None:
    data = b"v 0.25 0.00 1.00\nv -0.00 9.00 0.00\nv 0.00 1.00 0.00\nf 1 2 3\n"
    source = written(tmp_path, "zero.obj", data)
    moved = shifted(load_mesh(source), 0, [-0.251, -0.001, 0])
    assert patched(source, shifted(moved, 1, [-0.001, 1, 0])) == data.replace(b"0.25", b"0.00").replace(
        b"9.00", b"10.00"
    )


def test_coarse_numbers_are_refused_with_advice(tmp_path: Path) -> None:
    source = written(tmp_path, "coarse.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    before = source.read_bytes()
    with pytest.raises(JaxmarkError, match=r"coarse\.obj.* 0\.0173 .* 1 apart.*at least 3 decimals"):
        save_mesh(shifted(load_mesh(source), 0, [0.03, 0, 0]), source, like=source)
    assert source.read_bytes() == before


def test_more_digits_are_not_advised_where_doubles_end(tmp_path: Path) -> None:
    source = written(tmp_path, "far.obj", b"v 1e6 0 0\nv 1000000.00000000001 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(JaxmarkError, match="double precision"):
        save_mesh(shifted(load_mesh(source), 2, [3e-11, 0, 0]), source, like=source)


def test_digits_beyond_doubles_are_not_invented(tmp_path: Path) -> None:
    data = b"v 0.062389490071134229288 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    source = written(tmp_path, "long.obj", data)
    moved = shifted(load_mesh(source), 0, [0.5, 0, 0])
    assert patched(source, moved).startswith(b"v 0.5623894900711343 0 0\n")


def test_texture_coordinates_of_corners(tmp_path):
    """By `vt` lines, whose indices may be negative or absent, of polygons that are split as faces are."""
    path = tmp_path / "quad.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nvt 0 0\nvt 1 0 0\nvt 1 1\nvt 0 0.5\nvn 0 0 1\n"
        "f 1/1/1 2/-3/1 3/3/1 4/4/1\nf 2 5//1 3/9\n"
    )
    found = load_texture(path)
    assert found is not None
    np.testing.assert_array_equal(found[0], [[0, 0], [1, 0], [1, 1]])
    np.testing.assert_array_equal(found[1], [[0, 0], [1, 1], [0, 0.5]])
    assert np.isnan(found[2]).all()
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt a b\nf 1/1 2/1 3/1\n")
    assert load_texture(path) is None
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_texture(path) is None
