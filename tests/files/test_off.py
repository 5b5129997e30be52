import re
from pathlib import Path

import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, turned, written

pytestmark = pytest.mark.core

RICH = (
    b"# made by hand\n"
    b"COFF # with colours\n"
    b"\n"
    b"4 2 0 # counts\n"
    b"  0.50  0.00  0.00 255 0 0 255\n"
    b"# between\n"
    b"1.00 0.00 0.00\t0 255 0 255 # green\n"
    b"1.00 1.00 0.00 0 0 255 255\n"
    b"\n"
    b"0.00 1.00 0.00 0 0 0 255\n"
    b"3  0 1 2  0.1 0.2 0.3\n"
    b"4  0 1 2 3 # a square"
)
NORMALS = (
    b"NOFF\n3 1 3\n0.000 0.000 0.000 0.00 -1.00 0.00\n1.000 0.000 0.000 0.00 -2.00 0.00\n"
    b"0.000 0.000 1.000 0.60 -0.80 0.00\n3 0 1 2\n"
)


def test_colours_comments_and_polygons(tmp_path: Path) -> None:
    for data in (RICH, RICH.replace(b"\n", b"\r\n")):
        mesh = loaded(tmp_path, "rich.off", data)
        np.testing.assert_array_equal(mesh.vertices, [[0.5, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])


def test_only_the_moved_digits_change(tmp_path: Path) -> None:
    source = written(tmp_path, "rich.off", RICH)
    data = patched(source, shifted(load_mesh(source), 1, [0, 0.5, 0]))
    assert data == RICH.replace(b"1.00 0.00 0.00\t0 255", b"1.00 0.50 0.00\t0 255")


def test_all_vertices_move_and_the_rest_stays(tmp_path: Path) -> None:
    source = written(tmp_path, "rich.off", RICH)
    moved = noisy(load_mesh(source), 1.0)
    data = patched(source, moved)
    mask = re.compile(rb"(?m)^(\s*)-?\d+\.\d\d([ \t]+)-?\d+\.\d\d([ \t]+)-?\d+\.\d\d(?=\s+\d+ \d+ \d+ 255)")
    assert mask.sub(rb"\1*\2*\3*", data) == mask.sub(rb"\1*\2*\3*", RICH)
    np.testing.assert_allclose(loaded(tmp_path, "a.off", data).vertices, moved.vertices, rtol=0, atol=0.00501)


def test_normals_turn(tmp_path: Path) -> None:
    source = written(tmp_path, "normals.off", NORMALS)
    assert patched(source, turned(load_mesh(source))) == (
        b"NOFF\n3 1 3\n0.000 0.000 0.000 1.00 0.00 0.00\n0.000 1.000 0.000 2.00 0.00 0.00\n"
        b"0.000 0.000 1.000 0.80 0.60 0.00\n3 0 1 2\n"
    )


@pytest.mark.parametrize("header", [b"OFF\n3 1 0", b"  OFF3 1 0", b"OFF 3 1 0", b"STOFF\n3 1", b"STCOFF\n3 1 9 # c"])
def test_headers(tmp_path: Path, header: bytes) -> None:
    data = header + b"\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    np.testing.assert_array_equal(loaded(tmp_path, "some.off", data).faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"OFF BINARY\n\0\0\0\3", "binary"),
        (b"4OFF\n1 1 0\n", "4OFF"),
        (b"nOFF\n3\n1 1 0\n", "nOFF"),
        (b"C4nOFF\n3\n1 1 0\n", "C4nOFF"),
        (b"3 1 0\n", "line 1"),
        (b"", "line 1"),
        (b"OFF\n", "missing"),
        (b"OFF\n3\n1\n", "missing"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "line 2: 3 vertices and 1 faces .* 3 lines"),
        (b"OFF\n-3 1 0\n", "line 2"),
        (b"OFF\n999999999999 1 0\n", "line 2"),
        (b"OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "line 4.*needs 3"),
        (b"NOFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "line 3.*needs 6"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 x\n0 1 0\n3 0 1 2\n", "line 4.*'x'"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2\n", "line 6.*fewer"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n", "line 6.*three corners"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "line 6.*vertex 3"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n", "line 6.*'1.5'"),
        (b"OFF\n0 0 0\n", "no vertices"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.off: .*{message}"):
        loaded(tmp_path, "bad.off", data)
