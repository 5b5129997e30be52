import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, turned, written

pytestmark = pytest.mark.core

TRIANGLE = [0, 0, 0, 1, 0, 0, 0, 0, 1]  # its normal is -y; turned by a right angle about z it is +x


def binary(
    facets: Sequence[tuple[Sequence[float], Sequence[float], int]], header: bytes = b"solid misleading"
) -> bytes:
    rows = b"".join(struct.pack("<12fH", *normal, *points, extra) for normal, points, extra in facets)
    return header.ljust(80, b"\x01") + struct.pack("<I", len(facets)) + rows


ASCII = (
    b"SOLID first part facet normal\r\n  facet normal 0.00 -1.00 0.00\r\n    outer loop\r\n"
    b"      vertex 0.000 0.000 0.000\r\n      vertex 1.000 0.000 0.000\r\n      vertex 0.000 0.000 1.000\r\n"
    b"    endloop\r\n  endfacet\r\nENDSOLID first part facet normal\r\n"
    b"solid\nFacet Normal 0 0 0 Outer Loop Vertex 5 5 5 Vertex 6 5 5 Vertex 5 6 5 EndLoop EndFacet\nendsolid"
)


def test_binary_soup(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "a.STL", binary([([0, -1, 0], TRIANGLE, 7), ([0, 0, 0], TRIANGLE, 8)]))
    np.testing.assert_array_equal(mesh.vertices, np.reshape(TRIANGLE * 2, (6, 3)))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [3, 4, 5]])


def test_binary_facets_that_move_get_their_normal_and_others_stay(tmp_path: Path) -> None:
    odd = [0.1, 0.2, 0.3]  # no true normal, kept where nothing moves
    source = written(
        tmp_path, "a.stl", binary([([0, -1, 0], TRIANGLE, 7), (odd, TRIANGLE, 8), ([0, 0, 0], TRIANGLE, 9)])
    )
    mesh = load_mesh(source)
    moved = turned(mesh)
    moved.vertices[3:6] = mesh.vertices[3:6]
    rotated = [0, 0, 0, 0, 1, 0, 0, 0, 1]
    expected = binary([([1, 0, 0], rotated, 7), (odd, TRIANGLE, 8), ([0, 0, 0], rotated, 9)])
    assert patched(source, moved) == expected


def test_a_facet_without_area_keeps_its_normal(tmp_path: Path) -> None:
    source = written(tmp_path, "a.stl", binary([([0, -1, 0], TRIANGLE, 0)]))
    flat = shifted(load_mesh(source), 2, [0.5, 0, -1])
    assert patched(source, flat) == binary([([0, -1, 0], [0, 0, 0, 1, 0, 0, 0.5, 0, 0], 0)])


def test_text(tmp_path: Path) -> None:
    source = written(tmp_path, "t.stl", ASCII)
    mesh = load_mesh(source)
    np.testing.assert_array_equal(mesh.vertices, [*np.reshape(TRIANGLE, (3, 3)), [5, 5, 5], [6, 5, 5], [5, 6, 5]])
    moved = turned(mesh)
    moved.vertices[3:] = mesh.vertices[3:]
    assert patched(source, moved) == ASCII.replace(b"0.00 -1.00 0.00", b"1.00 0.00 0.00").replace(
        b"vertex 1.000 0.000 0.000", b"vertex 0.000 1.000 0.000"
    )
    everything = noisy(mesh, 0.1)
    again = loaded(tmp_path, "again.stl", patched(source, everything))
    np.testing.assert_allclose(again.vertices, everything.vertices, rtol=0, atol=0.000501)


@pytest.mark.parametrize("extra", [b"7", b"# colour 0.5 0.5 0.5", b"material steel\r\n  ; a comment"])
@pytest.mark.parametrize("line", [b"outer loop", b"vertex 1.000 0.000 0.000", b"endloop", b"endfacet"])
def test_extra_words_in_text_are_ignored_and_stay(tmp_path: Path, line: bytes, extra: bytes) -> None:
    data = ASCII.replace(line + b"\r\n", line + b" " + extra + b"\r\n")
    assert data != ASCII
    source = written(tmp_path, "t.stl", data)
    mesh = load_mesh(source)
    np.testing.assert_array_equal(mesh.vertices, loaded(tmp_path, "plain.stl", ASCII).vertices)
    assert extra in patched(source, turned(mesh))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "byte 0"),
        (b"\0" * 83, "byte 83"),
        (b"\0" * 84, "no vertices"),
        (b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * 50, "4294967295 facets .* 134"),
        (binary([([0, 0, 1], TRIANGLE, 0)], b"x")[:-1], "1 facets has 134 bytes, but the file has 133"),
        (b"solid x\nendsolid", "no vertices"),
        (ASCII[:-40], "ends inside facet 1|line 10"),
        (ASCII.replace(b"vertex 1.000", b"vertx 1.000"), "line 5: 'vertex'"),
        (ASCII.replace(b"vertex 1.000", b"vertex one"), "line 5: 'one'"),
        (ASCII.replace(b"vertex 1.000", b"vertex inf"), "finite"),
        (ASCII.replace(b"vertex 1.000 0.000 0.000", b"vertex 1.000 0.000"), "'vertex'|'endloop'"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.stl: .*({message})"):
        loaded(tmp_path, "bad.stl", data)
