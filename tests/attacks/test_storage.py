"""What files keep of coordinates, against the decimal and struct modules of Python, and trimesh."""

import decimal
import io
import struct

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.attacks import digits, float_bits, soup
from jaxmark.geometry.mesh import Mesh, make_mesh

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def wide() -> Mesh:
    """Coordinates of all sizes that 16 bits have, ties, zeros of both signs, and an isolated vertex beyond them."""
    random = np.random.default_rng(0)
    points = random.normal(size=(200, 3)) * 10.0 ** random.uniform(-7, 4, (200, 3))
    points[:4] = [[0, -0.0, 1], [0.5, 2.5, -2.5], [1.25, 3.75, 2049], [1e-9, 65504, -65519]]
    return make_mesh(np.concatenate([points, [[1e300, 1 / 3, 1 / 3]]]), np.arange(198).reshape(-1, 3))


def check(mesh: Mesh, found: Mesh, expected: np.ndarray) -> None:
    """What faces use is as expected, all else as it was."""
    used = np.unique(mesh.faces)
    np.testing.assert_array_equal(found.vertices[used], expected[used])
    np.testing.assert_array_equal(np.delete(found.vertices, used, axis=0), np.delete(mesh.vertices, used, axis=0))
    np.testing.assert_array_equal(found.faces, mesh.faces)


@pytest.mark.parametrize("count", [1, 3, 6, 16])
def test_digits_are_those_of_exact_decimals(count, wide: Mesh):
    round_to = decimal.Context(prec=count, rounding=decimal.ROUND_HALF_EVEN)
    expected = [[float(round_to.create_decimal(decimal.Decimal(x))) for x in row] for row in wide.vertices.tolist()]
    check(wide, digits(wide, count), np.array(expected))
    np.testing.assert_array_equal(digits(wide, 17).vertices, wide.vertices)


@pytest.mark.parametrize(("bits", "code"), [(64, "d"), (32, "f"), (16, "e")])
def test_floats_are_those_that_are_written(bits, code, wide: Mesh):
    numbers = np.unique(wide.faces)
    expected = wide.vertices.copy()
    for number in numbers:
        packed = struct.pack(f"<3{code}", *wide.vertices[number])
        assert len(packed) == 3 * bits // 8
        expected[number] = struct.unpack(f"<3{code}", packed)
    check(wide, float_bits(wide, bits), expected)


@pytest.mark.parametrize("times", [1, 3])
def test_soup_is_what_trimesh_reads(times, sphere: Mesh):
    found = soup(sphere, times)
    file = trimesh.Trimesh(*sphere, process=False).export(file_type="stl")
    expected = trimesh.load_mesh(io.BytesIO(bytes(file)), file_type="stl", process=False)
    np.testing.assert_array_equal(found.vertices[found.faces], expected.triangles)
    assert len(found.vertices) == 3 * len(sphere.faces)


@pytest.mark.parametrize(("kind", "strength"), [("digits", 3), ("float-bits", 16), ("soup", 1)])
def test_host_function_keeps_copies_together(kind, strength, sphere: Mesh):
    faces = sphere.faces[10:].copy()
    half = faces[::2]
    half[half < 10] += len(sphere.vertices)
    copied = make_mesh(np.concatenate([sphere.vertices, sphere.vertices[:10], [[9.0, 9, 1 / 3]]]), faces)
    found = jm.attack(copied, kind, strength, seed=0)
    close = {"digits": 5e-3, "float-bits": 2**-11, "soup": 2**-24}[kind]
    before, after = copied.vertices[copied.faces], found.vertices[found.faces]
    np.testing.assert_allclose(after, before, rtol=close * 1.001)
    assert (after != before).any()
    assert len(np.unique(after.reshape(-1, 3), axis=0)) <= len(np.unique(before.reshape(-1, 3), axis=0))
    if kind == "soup":
        assert len(found.vertices) == 3 * len(faces)
    else:
        np.testing.assert_array_equal(found.faces, copied.faces)
        np.testing.assert_array_equal(found.vertices[-1], copied.vertices[-1])


@pytest.mark.usefixtures("unchecked")
def test_refusals(sphere: Mesh):
    for kind, strength, sentence in [
        *(("digits", count, "1 to 17") for count in (0, 2.5, 18)),
        *(("float-bits", bits, "64, 32 or 16") for bits in (0, 8, 16.5)),
        *(("soup", times, "1 to 10") for times in (0, 1.5, 11)),
    ]:
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.attack(sphere, kind, strength, seed=0)
    large = make_mesh(sphere.vertices * 1e5, sphere.faces)
    with pytest.raises(jm.JaxmarkError, match="exceeds 65504, the largest float of 16 bits"):
        jm.attack(large, "float-bits", 16, seed=0)
    with pytest.raises(jm.JaxmarkError, match=r"exceeds 3.40282e\+38"):
        jm.attack(make_mesh(sphere.vertices * 1e39, sphere.faces), "float-bits", 32, seed=0)
    with pytest.raises(jm.JaxmarkError, match="single precision"):
        jm.attack(make_mesh(sphere.vertices + 1e6, sphere.faces), "soup", 1, seed=0)
