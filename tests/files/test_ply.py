import struct
from pathlib import Path

import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, turned, written

pytestmark = pytest.mark.core

ASCII = (
    b"ply\r\nformat ascii 1.0\r\ncomment by hand, caf\xe9\r\nobj_info x 1\r\n"
    b"element vertex 4\r\nproperty uchar red\r\nproperty float z\r\nproperty float y\r\nproperty float32 x\r\n"
    b"property float quality\r\n"
    b"element face 2\r\nproperty uchar flags\r\nproperty list uchar int vertex_index\r\n"
    b"property list uchar float texcoord\r\nend_header\r\n"
    b"255 0.50 0.25  0.125 7.5\r\n0 0.00 0.00 1.00 1\r\n0 0.00 1.00 1.00 2\r\n9 0.00 1.00 0.00 3\r\n"
    b"1 3 0 1 2 2 0.5 0.5\r\n2 4 0 1 2 3 0"
)


def binary(order: str, coordinate: str, quads: bool) -> tuple[bytes, list[int]]:
    """A file with the faces before the vertices, and the byte offsets of each vertex's z, y and x."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    kind = {"f": "float", "d": "float64"}[coordinate]
    header = (
        f"ply\nformat {name} 1.0\nelement face 2\nproperty list uint8 uint vertex_indices\nproperty short group\n"
        f"property list ushort char tags\nelement vertex 4\nproperty {kind} z\nproperty uchar red\nproperty {kind} y\n"
        f"property {kind} x\nproperty int custom\nelement other 1\nproperty double w\nend_header\n"
    )
    data = header.encode()
    for face in [[0, 1, 2], [0, 1, 2, 3] if quads else [0, 2, 3]]:
        data += struct.pack(f"{order}B{len(face)}IhH2b", len(face), *face, -5, 2, -1, 1)
    offsets = []
    for x, y, z in [(0.5, 0.25, 0.125), (1, 0, 0), (1, 1, 0), (0, 1, 0)]:
        offsets.append(len(data))
        data += struct.pack(f"{order}{coordinate}B2{coordinate}i", z, 200, y, x, -7)
    return data + struct.pack(order + "d", 3.25) + b"tail", offsets


VERTICES = [[0.5, 0.25, 0.125], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_text_with_everything(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "a.ply", ASCII)
    np.testing.assert_array_equal(mesh.vertices, [[0.125, 0.25, 0.5], *VERTICES[1:]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])


def test_text_changes_only_moved_digits(tmp_path: Path) -> None:
    source = written(tmp_path, "a.ply", ASCII)
    data = patched(source, shifted(load_mesh(source), 0, [0.5, 0, -1]))
    assert data == ASCII.replace(b"0.50 0.25  0.125", b"-0.500 0.25  0.625")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("coordinate", ["f", "d"])
@pytest.mark.parametrize("quads", [False, True])
def test_binary(tmp_path: Path, order: str, coordinate: str, quads: bool) -> None:
    data, offsets = binary(order, coordinate, quads)
    source = written(tmp_path, "b.ply", data)
    mesh = load_mesh(source)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]] if quads else [[0, 1, 2], [0, 2, 3]])
    expected = bytearray(data)
    size = struct.calcsize(coordinate)
    struct.pack_into(order + coordinate, expected, offsets[2], 0.375)
    struct.pack_into(order + coordinate, expected, offsets[2] + 2 * size + 1, -9.5)
    assert patched(source, shifted(mesh, 2, [-10.5, 0, 0.375])) == bytes(expected)


def test_normals_turn_and_custom_properties_stay(tmp_path: Path) -> None:
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n" + b"".join(
        b"property float %s\n" % name for name in (b"nx", b"ny", b"nz", b"s", b"x", b"y", b"z")
    )
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [(0, -1, 0, 5, 0, 0, 0), (0, -2, 0, 6, 1, 0, 0), (0, 0, 0, 7, 0, 0, 1)]
    face = struct.pack("<B3i", 3, 0, 1, 2)
    source = written(tmp_path, "n.ply", header + b"".join(struct.pack("<7f", *row) for row in rows) + face)
    data = patched(source, turned(load_mesh(source)))
    assert data[: len(header)] == header
    assert data[-len(face) :] == face
    got = np.frombuffer(data[len(header) : -len(face)], "<f4").reshape(3, 7)
    expected = [(1, 0, 0, 5, 0, 0, 0), (2, 0, 0, 6, 0, 1, 0), (0, 0, 0, 7, 0, 0, 1)]
    np.testing.assert_allclose(got, expected, atol=1e-7)


def test_normals_of_faces_turn(tmp_path: Path) -> None:
    """A triangle and a quadrilateral, with normals; a face whose corners do not move keeps its own."""
    points = ["0.00 0 0", "1 0 0", "0 0 1", "0 5 0", "1 5 0", "1 5 1", "0 5 1"]
    faces = ["3 0 1 2 0.00000000 -1 0", "4 3 4 5 6 0 -2 0"]
    header = ["ply", "format ascii 1.0", "element vertex 7", *(f"property float {name}" for name in "xyz")]
    header += ["element face 2", "property list uchar int vertex_indices"]
    header += [*(f"property float n{name}" for name in "xyz"), "end_header"]
    source = written(tmp_path, "f.ply", "\n".join([*header, *points, *faces, ""]).encode())
    mesh = load_mesh(source)
    data = patched(source, turned(mesh))
    for line, expected in zip(data.decode().split("\n")[-3:], ([1, 0, 0], [2, 0, 0]), strict=False):
        np.testing.assert_allclose(np.array(line.split()[-3:], float), expected, atol=1e-6)
    moved = patched(source, shifted(mesh, 0, [0, 0.5, 0])).decode().split("\n")
    assert moved[-3] != faces[0]
    assert moved[-2] == faces[1]


def test_spacing_of_single_precision_far_from_the_origin(tmp_path: Path) -> None:
    data, offsets = binary("<", "f", False)
    far = bytearray(data)
    struct.pack_into("<f", far, offsets[0], 4096.0)  # there the next number is 2**-11 away
    source = written(tmp_path, "far.ply", bytes(far))
    save_mesh(noisy(load_mesh(source), 0.01), tmp_path / "out.ply", like=source)
    (note,) = save_mesh(shifted(load_mesh(source), 0, [0, 0, 0.0008]), tmp_path / "out.ply", like=source)
    assert note == "rounding to the numbers of the file changes the displacement by 22 %"
    with pytest.raises(JaxmarkError, match=r"0\.000488 apart.* takes 100 % .*centre the mesh"):
        save_mesh(shifted(load_mesh(source), 0, [0, 0, 0.0001]), tmp_path / "out.ply", like=source)


def test_integer_coordinates(tmp_path: Path) -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty int x\nproperty int y\nproperty int z\n"
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    source = written(tmp_path, "i.ply", header + b"0 0 0\n100 0 0\n0 100 0\n3 0 1 2\n")
    assert patched(source, shifted(load_mesh(source), 1, [0, 41.7, 0])).endswith(
        b"\n0 0 0\n100 42 0\n0 100 0\n3 0 1 2\n"
    )
    with pytest.raises(JaxmarkError, match="float or double"):
        patched(source, noisy(load_mesh(source), 0.1))
    body = struct.pack("<9bB3i", 0, 0, 0, 100, 0, 0, 0, 100, 0, 3, 0, 1, 2)
    packed = header.replace(b"ascii", b"binary_little_endian").replace(b"int ", b"char ", 3) + body
    source = written(tmp_path, "c.ply", packed)
    assert load_mesh(source).vertices[1, 0] == 100
    with pytest.raises(JaxmarkError, match="beyond the range"):
        patched(source, shifted(load_mesh(source), 1, [50, 0, 0]))


def test_lists_of_vertices(tmp_path: Path) -> None:
    data = (
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty list uchar int tags\nproperty double x\nproperty double y\n"
        b"property double z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0 0\n2 8 8 1.5 0 0\n1 5 0 1 0\n3 0 1 2\n"
    )
    np.testing.assert_array_equal(loaded(tmp_path, "l.ply", data).vertices, [[0, 0, 0], [1.5, 0, 0], [0, 1, 0]])


HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
STRIPS = b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
BODY = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
BOXES = b"ply\nformat ascii 1.0\nelement chunk 1\n"
BOXES += b"".join(
    b"property float %s\n" % name for name in (b"min_x", b"min_y", b"min_z", b"max_x", b"max_y", b"max_z")
)
BOXES += b"element vertex 1\nproperty uint packed_position\nend_header\n"


@pytest.mark.parametrize("other", [b"1 0", b"5 0 1 2 0 1"])
def test_of_two_lists_of_corners_one_gives_faces_and_their_normals(tmp_path: Path, other: bytes) -> None:
    lists = b"element face 1\nproperty list uchar int vertex_index\n" + FACE[len("element face 1\n") :]
    normals = b"".join(b"property float %s\n" % name for name in (b"nx", b"ny", b"nz"))
    data = (
        HEAD
        + lists.replace(b"end_header", normals + b"end_header")
        + BODY.replace(b"3 0 1 2", other + b" 3 0 1 2 0 0 1")
    )
    np.testing.assert_array_equal(loaded(tmp_path, "two.ply", data).faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"plyx", "line 1"),
        (HEAD, "inside the header"),
        (HEAD.replace(b"float y", b"floaty y") + FACE + BODY, "line 5: .property floaty y. does"),
        (HEAD.replace(b"float y", b"float x") + FACE + BODY, "line 5"),
        (HEAD.replace(b"ascii", b"utf8") + FACE + BODY, "line 2.*utf8"),
        (HEAD.replace(b"format ascii 1.0\n", b"") + FACE + BODY, "line 3|no format"),
        (HEAD.replace(b"vertex 3", b"vertex -3") + FACE + BODY, "line 3"),
        (HEAD.replace(b"vertex 3", b"vertex 999999999999999") + FACE + BODY, "ends in row 4 .*vertex"),
        (HEAD.replace(b"float z", b"float w") + FACE + BODY, "x, y and z"),
        (HEAD.replace(b"float x", b"uint packed_position") + FACE + BODY, "compressed splat without the boxes"),
        (BOXES.replace(b"uint", b"list uchar uint") + b"0 0 0 1 1 1\n0\n", "compressed splat without"),
        (HEAD + FACE.replace(b"uchar int", b"uchar float") + BODY, "integers"),
        (HEAD + FACE.replace(b"uchar int", b"float int") + BODY, "line 8"),
        (HEAD + FACE.replace(b"_indices", b"s") + BODY, "vertex_indices"),
        (HEAD + HEAD[21:] + FACE + BODY, "more than once"),
        (HEAD + FACE + BODY.replace(b"3 0 1 2", b"3 0 1"), "ends in row 0 .*face"),
        (HEAD + FACE + BODY.replace(b"3 0 1 2", b"2 0 1"), "three"),
        (HEAD + FACE + BODY.replace(b"3 0 1 2", b"-3 0 1"), "length -3"),
        (HEAD + FACE + BODY.replace(b"3 0 1 2", b"3 0 1 5"), r"Face 0 .*\[0, 1, 5\]"),
        (HEAD + FACE + BODY.replace(b"1 0 0", b"1 o 0"), "line 11: 'o'"),
        (HEAD + STRIPS.replace(b"int vertex", b"float vertex") + b"0 0 0 1 0 0 0 1 0 3 0 1 2", "tristrips .*integers"),
        (HEAD + STRIPS.replace(b"_indices", b"s") + b"0 0 0 1 0 0 0 1 0 3 0 1 2", "tristrips has no list"),
        (HEAD + STRIPS + b"0 0 0 1 0 0 0 1 0 4 0 1 2", "ends in row 0 .*tristrips"),
        (HEAD + STRIPS + b"0 0 0 1 0 0 0 1 0 4 0 1 2 3", r"Face 1 .*\[2, 1, 3\]"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 0\n"
            b"property float x\nproperty float y\nproperty float z\nend_header\n",
            "no vertices",
        ),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.ply: .*({message})"):
        loaded(tmp_path, "bad.ply", data)


def test_every_truncation_of_a_binary_file_is_refused(tmp_path: Path) -> None:
    data, _ = binary("<", "f", True)
    for length in range(len(data) - len(b"tail")):
        with pytest.raises(JaxmarkError):
            loaded(tmp_path, "short.ply", data[:length])


def test_rows_of_different_length_with_fractions(tmp_path: Path) -> None:
    """A triangle before quads, and a number with a fraction behind each list."""
    path = tmp_path / "mixed.ply"
    path.write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 3\nproperty list uchar int vertex_indices\nproperty float q\nend_header\n"
        b"5 0 0.5\n1 5 0\n0 1 5.25\n0 6 1\n3 0 1 2 .9\n4 0 1 2 3 .9\n3 1 2 3 .8\n"
    )
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [1, 2, 3]])
    path.write_bytes(path.read_bytes().replace(b"4 0 1 2 3 .9", b".4 0 1 2 3 .9"))
    with pytest.raises(JaxmarkError, match=r"'\.4' is not a whole number"):
        load_mesh(path)


def striped(order: str, normals: bool) -> tuple[bytes, list[int]]:
    """A grid of 3 by 3 points in two rows of strips, and the byte offset of each vertex; text if the order is empty.

    The first row leads from one strip to another through triangles without area, the second has a restart in it.
    """
    rows = [[0, 3, 1, 4, 2, 5, 5, 3, 3, 6, 4, 7], [4, 7, 5, -1, 8, 5, 7, -1, 1, 2]]
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    names = ["x", "y", "z", "nx", "ny", "nz"][: 6 if normals else 3]
    header = f"ply\nformat {name} 1.0\nelement vertex 9\n" + "".join(f"property float {name}\n" for name in names)
    data = (header + "element tristrips 2\nproperty list int int vertex_indices\nend_header\n").encode()
    offsets = []
    for number in range(9):
        offsets.append(len(data))
        values = [number % 3, number // 3, 0.25, 0, 0, 1][: len(names)]
        data += struct.pack(f"{order}{len(names)}f", *values) if order else b"%.2f " * len(names) % (*values,) + b"\n"
    for row in rows:
        form = " ".join(map(str, [len(row), *row])).encode() + b"\n"
        data += struct.pack(f"{order}{len(row) + 1}i", len(row), *row) if order else form
    return data, offsets


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_strips(tmp_path: Path, order: str) -> None:
    data, offsets = striped(order, normals=False)
    source = written(tmp_path, "s.ply", data)
    mesh = load_mesh(source)
    first = [[0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5], [3, 6, 4], [4, 6, 7]]
    np.testing.assert_array_equal(mesh.faces[:4], first[:4])
    turns = np.cross(*np.moveaxis(np.diff(mesh.vertices[mesh.faces], axis=1), 1, 0))[:, 2]
    assert len(turns) == 8  # the grid has eight triangles, all of them turned the same way
    np.testing.assert_array_equal(turns, -1)
    assert {frozenset(face) for face in mesh.faces.tolist()} >= {frozenset(face) for face in first}
    out = patched(source, shifted(mesh, 4, [0, 0, 0.5]))
    if order:
        expected = bytearray(data)
        struct.pack_into(order + "f", expected, offsets[4] + 8, 0.75)
        assert out == bytes(expected)
    else:
        assert out == data[: offsets[4]] + data[offsets[4] :].replace(b"0.25", b"0.75", 1)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_normals_of_strips_turn(tmp_path: Path, order: str) -> None:
    data, offsets = striped(order, normals=True)
    source = written(tmp_path, "s.ply", data)
    x, y, z = np.asarray(load_mesh(source).vertices).T
    out = patched(source, load_mesh(source)._replace(vertices=np.stack([z, y, 0 - x], axis=1)))
    if order:
        got = np.array([struct.unpack_from(order + "6f", out, offset) for offset in offsets])
        assert (out[: offsets[0]], out[offsets[-1] + 24 :]) == (data[: offsets[0]], data[offsets[-1] + 24 :])
    else:
        lines = out.decode().splitlines()
        got = np.array([line.split() for line in lines[12:21]], dtype=float)
        assert (lines[:12], lines[21:]) == (data.decode().splitlines()[:12], data.decode().splitlines()[21:])
    np.testing.assert_allclose(got, np.stack([z, y, 0 - x, x * 0 + 1, x * 0, x * 0], axis=1), atol=1e-6)


def test_faces_and_strips(tmp_path: Path) -> None:
    face = FACE.removesuffix(b"end_header\n")
    for data in (HEAD + STRIPS.replace(b"end_header\n", FACE), HEAD + face + STRIPS):
        strips_first = data.index(b"tristrips") < data.index(b"element face")
        lists = [b"3 2 1 0\n", b"3 0 1 2\n"] if strips_first else [b"3 0 1 2\n", b"3 2 1 0\n"]
        mesh = loaded(tmp_path, "b.ply", data + BODY.removesuffix(b"3 0 1 2\n") + b"".join(lists))
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [2, 1, 0]])
