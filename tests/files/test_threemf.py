import io
import locale
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.app.mark_files import mark_file
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, load_scene, save_mesh, save_scene
from jaxmark.geometry.mesh import make_mesh
from tests.files.helpers import loaded, noisy, patched, shifted, written
from tests.meshes import shared_mesh

pytestmark = pytest.mark.core

CORE = b"http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
RELATIONS = (
    b'<?xml version="1.0"?><Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    b"<Relationship Id='a' Type='http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel' Target='/%s'/>"
    b"</Relationships>"
)
# Everything that XML allows: prefixes, either quote, attributes in any order, comments, CDATA, other namespaces.
MODEL = (
    b'\xef\xbb\xbf<?xml version="1.0" encoding="utf-8"?>\r\n'
    b'<!-- <vertices><vertex x="9" y="9" z="9"/></vertices> -->\r\n'
    b"<c:model unit='inch' xmlns:c='" + CORE + b"' xmlns:s='other'>\r\n<c:metadata name='Title'>"
    b'<![CDATA[<object><mesh><vertices><vertex x="8"/>]]></c:metadata><c:resources>\r\n'
    b'<c:object name="caf\xc3\xa9 &amp; &#10;tea" id="1"><c:mesh>\r\n<c:vertices>'
    b'<c:vertex x="0.50" y="0.25" z="0.125"/>\r\n <c:vertex\r\n z=\'0.00\'  x = " 1.00 "  y="0.00" ></c:vertex>'
    b'<!-- <c:vertex x="7" y="7" z="7"/> --><c:vertex x="1.00" s:x="6" y="1.00" z="0.00" s:note=\'> x="5"\'/>'
    b'<s:vertex x="4" y="4" z="4"/><c:vertex x="0.00" y="1.00" z="0.00"/></c:vertices>\r\n'
    b'<c:triangles><c:triangle v1="0" v2="1" v3="2" pid="1" p1="0"/><c:triangle v3="3" v1="0" v2=\'2\'/></c:triangles>'
    b"<s:vertices><c:vertex x='3' y='3' z='3'/></s:vertices></c:mesh></c:object>\r\n"
    b'<c:object id="2"><c:mesh><c:vertices>\n<c:vertex x="1e0" y="-1.5E+00" z="0"/><c:vertex x="0" y="2" z="0"/>'
    b'<c:vertex x="0" y="0" z="3.25"/>\n</c:vertices><c:triangles><c:triangle v1="0" v2="1" v3="2"/></c:triangles>'
    b'</c:mesh></c:object><c:object id="3" name="flat"><c:mesh><c:vertices><c:vertex x="0" y="0" z="0"/></c:vertices>'
    b'<c:triangles/></c:mesh></c:object><c:object id="4"><c:components>'
    b'<c:component objectid="2" transform="1 0 0 0 1 0 0 0 1 9 9 9"/>'
    b"</c:components></c:object></c:resources><c:build><c:item objectid='1'/><c:item objectid='4'/></c:build></c:model>"
)
# With digits enough for what random changes do to it.
FINE = MODEL.replace(b"-1.5E+00", b"-1.500E+00")
PLAIN = (
    b'<model xmlns="' + CORE + b'"><resources><object id="7"><mesh><vertices>'
    b'<vertex x="0.0" y="0.0" z="0.0"/><vertex x="1.0" y="0.0" z="0.0"/><vertex x="0.0" y="1.0" z="0.0"/></vertices>'
    b'<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object></resources>'
    b'<build><item objectid="7"/></build></model>'
)


def packed(members: dict[str, bytes], **options: Any) -> bytes:
    """An archive with these members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", options.pop("compression", zipfile.ZIP_DEFLATED), **options) as archive:
        for number, (name, content) in enumerate(members.items()):
            info = zipfile.ZipInfo(name, (2001, 2, 3, 4, 5, 2 * number))
            info.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else archive.compression
            info.comment = b"of " + name.encode()
            info.extra = struct.pack("<HH3s", 0x7777, 3, b"own")
            info.external_attr = 0o640 << 16
            archive.writestr(info, content)
        archive.comment = b"written by hand"
    return out.getvalue()


RICH = packed({
    "Metadata/thumbnail.png": b"a picture" * 30,
    "3D/Other.model": PLAIN,
    "_rels/.rels": RELATIONS % b"3D/My%20Model.model",
    "3D/my model.model": MODEL,
    "__MACOSX/3D/._my model.model": b"\0\5\26\7",
    "last.txt": b"the end" * 99,
})  # fmt: skip


def contents(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        return {info.filename: archive.read(info) for info in archive.infolist()}


def raw(data: bytes) -> dict[str, bytes]:
    """The bytes of each member as they are in the archive, its header included."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        starts = [info.header_offset for info in archive.infolist()]
        return {
            info.filename: data[start:end]
            for info, start, end in zip(archive.infolist(), starts, [*starts[1:], archive.start_dir], strict=True)
        }


def model_with(change: tuple[bytes, bytes]) -> bytes:
    assert change[0] in PLAIN
    return packed({"3D/3dmodel.model": PLAIN.replace(*change)})


def test_everything_that_xml_allows(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path, "a.3mf", RICH))
    assert [*scene.meshes] == ["object 7", "caf\xe9 & tea", "object 2"]
    assert scene.skipped == {"flat": "it has no triangles, and beams and the like cannot be marked"}
    _, first, second = scene.meshes.values()
    np.testing.assert_array_equal(first.vertices, [[0.5, 0.25, 0.125], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(first.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(second.vertices, [[1, -1.5, 0], [0, 2, 0], [0, 0, 3.25]])
    whole = load_mesh(tmp_path / "a.3mf")
    np.testing.assert_array_equal(whole.vertices, np.concatenate([mesh.vertices for mesh in scene.meshes.values()]))
    np.testing.assert_array_equal(whole.faces, [[0, 1, 2], [3, 4, 5], [3, 5, 6], [7, 8, 9]])


def test_only_moved_digits_change_and_other_members_stay_as_they_are_packed(tmp_path: Path) -> None:
    source = written(tmp_path, "a.3mf", RICH)
    meshes = load_scene(source).meshes
    name = "caf\xe9 & tea"
    moved = {name: shifted(shifted(meshes[name], 1, [0.5, 0, -2]), 2, [0, 1.25, 0])}
    save_scene(moved, tmp_path / "out.3mf", like=source)
    out = (tmp_path / "out.3mf").read_bytes()
    expected = MODEL.replace(b"z='0.00'  x = \" 1.00 \"", b"z='-2.000'  x = \" 1.500 \"")
    expected = expected.replace(b's:x="6" y="1.00"', b's:x="6" y="2.250"')
    assert contents(out) == contents(RICH) | {"3D/my model.model": expected}
    assert {key for key in raw(out) if raw(out)[key] != raw(RICH)[key]} == {"3D/my model.model"}
    with zipfile.ZipFile(source) as before, zipfile.ZipFile(io.BytesIO(out)) as after:
        assert before.comment == after.comment
        for old, new in zip(before.infolist(), after.infolist(), strict=True):
            for key in ("filename", "date_time", "comment", "extra", "external_attr", "compress_type", "flag_bits"):
                assert getattr(old, key) == getattr(new, key)


def test_several_models_change(tmp_path: Path) -> None:
    source = written(tmp_path, "a.3mf", RICH)
    mesh = noisy(load_mesh(source), 5.0)
    out = contents(patched(source, mesh))
    assert {name for name in out if out[name] != contents(RICH)[name]} == {"3D/Other.model", "3D/my model.model"}
    error = np.abs(np.asarray(load_mesh(tmp_path / "out.3mf").vertices) - mesh.vertices)
    assert error[:3].max() <= 0.051  # each object is written with its own digits
    assert error[3:7].max() <= 0.000501


def test_objects_without_triangles_are_named_where_nothing_can_be_marked(tmp_path: Path) -> None:
    source = written(tmp_path, "a.3mf", RICH)
    key, budget = jm.Key(bytes(32)), jm.Budget()
    with pytest.raises(JaxmarkError, match="left unchanged: 'flat': it has no triangles, and beams"):
        mark_file(source, tmp_path / "b.3mf", tmp_path / "b.json", key=key, message=b"message", budget=budget)


def streamed(wide: bool, signature: bytes, stored: bool, model: bytes = PLAIN) -> bytes:
    """An archive written as to a pipe: sizes follow the data. Wide ones are in ZIP64 fields."""
    data, entries = b"", b""
    members = {"3D/3dmodel.model": model, "after.txt": b"after" * 20}
    for name, content in members.items():
        packer = zlib.compressobj(wbits=-15)
        body = content if stored else packer.compress(content) + packer.flush()
        method, crc, start = 0 if stored else 8, zlib.crc32(content), len(data)
        extra = struct.pack("<HHQQ", 1, 16, 0, 0) if wide else b""
        full = 0xFFFFFFFF
        sizes = (full, full) if wide else (0, 0)
        data += struct.pack("<4s5H3I2H", b"PK\3\4", 45, 8, method, 0, 33, 0, *sizes, len(name), len(extra))
        data += name.encode() + extra + body
        data += signature + struct.pack("<IQQ" if wide else "<III", crc, len(body), len(content))
        extra = struct.pack("<HHQQQ", 1, 24, len(content), len(body), start) if wide else b""
        sizes = (full, full) if wide else (len(body), len(content))
        head = struct.pack("<4s6H3I", b"PK\1\2", 45, 45, 8, method, 0, 33, crc, *sizes)
        entries += head + struct.pack("<5H2I", len(name), len(extra), 0, 0, 0, 0, full if wide else start)
        entries += name.encode() + extra
    end, at = b"", len(data)
    if wide:
        end = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, 2, 2, len(entries), at)
        end += struct.pack("<4sIQI", b"PK\6\7", 0, at + len(entries), 1)
        at = 0xFFFFFFFF
    return data + entries + end + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 2, 2, len(entries), at, 0)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("signature", [b"PK\7\x08", b""])
@pytest.mark.parametrize("stored", [False, True])
def test_archives_written_as_streams_and_large_ones(tmp_path: Path, wide: bool, signature: bytes, stored: bool) -> None:
    data = streamed(wide, signature, stored)
    source = written(tmp_path, "s.3mf", data)
    out = patched(source, shifted(load_mesh(source), 1, [9, 0, 0.25]))
    changed = PLAIN.replace(b'<vertex x="1.0" y="0.0" z="0.0"', b'<vertex x="10.0" y="0.0" z="0.2"')
    assert contents(out) == {"3D/3dmodel.model": changed, "after.txt": b"after" * 20}
    with zipfile.ZipFile(io.BytesIO(out)) as archive:
        assert archive.infolist()[0].compress_type == (0 if stored else 8)
        size = archive.infolist()[0].compress_size
    # What follows the data tells readers of streams where they end.
    behind = out[out.index(b"3D/3dmodel.model") + 16 + 20 * wide + size :]
    expected = signature + struct.pack("<IQQ" if wide else "<III", zlib.crc32(changed), size, len(changed))
    assert behind.startswith(expected + b"PK\3\4")


def test_plain_and_odd_spelling_read_alike(tmp_path: Path) -> None:
    """The same mesh in the two ways in which lists are read."""
    rng = np.random.default_rng(0)
    points, faces = rng.normal(size=(50, 3)), rng.integers(0, 50, (80, 3))
    form = '<vertex x="{:.6f}" y="{:.6f}" z="{:.6f}" />\n'
    rows = "".join(form.format(*row) for row in points)
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}" pid="1" e:v1="2"/>'.format(*row) for row in faces)
    text = f'<model xmlns="{CORE.decode()}" xmlns:e="e"><object id="1"><mesh><vertices>{rows}</vertices><triangles>'
    plain = f"{text}{triangles}</triangles></mesh></object></model>".encode()
    expected = make_mesh(np.round(points, 6), faces)
    for number, odd in enumerate([b"<vertex", b"<!-- --><vertex", b"<?ask me?><vertex", b"<vertex e:x='1'"]):
        for also in (b"<triangle ", b"<![CDATA[ ]]><triangle "):
            model = plain.replace(b"<vertex", odd, number).replace(b"<triangle ", also, 1)
            source = written(tmp_path, "p.3mf", packed({"3D/3dmodel.model": model}))
            mesh = load_mesh(source)
            np.testing.assert_array_equal(mesh.vertices, expected.vertices)
            np.testing.assert_array_equal(mesh.faces, expected.faces)
            moved = noisy(mesh, 0.1)
            out = contents(patched(source, moved))["3D/3dmodel.model"]
            rows = "".join(form.format(*row) for row in np.asarray(moved.vertices))
            start = model.index(b"<vertices>") + 10
            if number == 0:
                assert out == model[:start] + rows.encode() + model[model.index(b"</vertices>") :]
            np.testing.assert_allclose(load_mesh(tmp_path / "out.3mf").vertices, moved.vertices, rtol=0, atol=5.1e-7)


SECURED = RELATIONS.replace(b"2013/01/3dmodel", b"2019/04/keystore")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "no ZIP archive"),
        (b"solid", "no ZIP archive"),
        (packed({"a.txt": b""}), "no model '3D/3dmodel.model'"),
        (packed({"_rels/.rels": RELATIONS % b"a.model", "3D/3dmodel.model": PLAIN}), "no model 'a.model'"),
        (packed({"_rels/.rels": b"<a>", "3D/3dmodel.model": PLAIN}), "'_rels/.rels': line 1: the XML is broken"),
        (packed({"3D/3dmodel.model": PLAIN, "3d/3DModel.model": PLAIN}), "two members"),
        (packed({"3D/3dmodel.model": PLAIN}, compression=zipfile.ZIP_LZMA), "method 14"),
        (packed({"3D/3dmodel.model": PLAIN, "3D/_rels/3dmodel.model.rels": SECURED}), "encrypted"),
        (packed({"3D/3dmodel.model": PLAIN.decode().encode("utf-16")}), "UTF-16"),
        (packed({"3D/3dmodel.model": b"<?xml version='1.0' encoding='latin-1'?>" + PLAIN}), "'latin-1'"),
        (packed({"3D/3dmodel.model": b"<!DOCTYPE model [<!ENTITY a 'b'>]>" + PLAIN}), "document type"),
        (model_with((b"</model>", b"\n")), "'3D/3dmodel.model': line 2: the XML is broken .no element"),
        (model_with((b"</vertices>", b"\n</vertice>")), "line 2: the XML is broken .mismatched"),
        (model_with((b'y="1.0"', b'y="1.0" y="2.0"')), "the XML is broken .duplicate"),
        (model_with((b'y="1.0"', b"")), "a vertex has no y"),
        (model_with((b'v3="2"', b'v4="2"')), "a triangle has no v3"),
        (model_with((b'y="1.0"', b'y="one"')), "'3D/3dmodel.model': line 1: 'one' is not a number"),
        (model_with((b'y="1.0"', b'y="1 0"')), "line 1: '1 0' is not a number"),
        (model_with((b'y="1.0"', b'y="&#49;"')), "'&#49;' is not a number"),
        (model_with((b'y="1.0"', b'y=""')), "a number is missing"),
        (model_with((b'y="1.0"', b'y="inf"')), "not a finite number"),
        (model_with((b'v3="2"', b'v3="2.5"')), "'2.5' is not a whole number"),
        (model_with((b'v3="2"', b'v3="3"')), r"'object 7' .*triangle 0 .*\[0, 1, 3\], but it has 3"),
        (model_with((b'v3="2"', b'v3="-1"')), "triangle 0"),
        (model_with((b'<triangle v1="0" v2="1" v3="2"/>', b"")), "no triangles"),
        (model_with((b"<triangles>", b"<vertices/><triangles>")), "vertices twice"),
        (model_with((b"<mesh>", b"<mesh xmlns='other'>")), "no object with a mesh"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.3mf: .*({message})"):
        loaded(tmp_path, "bad.3mf", data)


def changed(data: bytes, what: bytes, at: int, form: str, *values: int) -> bytes:
    """The bytes with numbers written behind the last place of some others."""
    out = bytearray(data)
    struct.pack_into(form, out, data.rindex(what) + at, *values)
    return bytes(out)


ONE = packed({"3D/3dmodel.model": PLAIN})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (changed(ONE, b"PK\1\2", 8, "<H", 1), "encrypted"),
        (changed(ONE, b"PK\1\2", 16, "<I", 5), "checksum"),
        (changed(ONE, b"PK\1\2", 24, "<I", len(PLAIN) - 1), "damaged"),
        (changed(ONE, b"PK\1\2", 24, "<I", 2**28 + 1), "bytes of unpacked content"),
        (changed(ONE, b"PK\1\2", 20, "<2I", 2**31 - 1, 2**31 + 1), "bytes of unpacked content"),
        (changed(ONE, b"PK\1\2", 20, "<I", len(ONE)), "not all there"),
        (changed(ONE, b"PK\1\2", 42, "<I", 3), "not where it should be"),
        (changed(ONE, b"PK\1\2", 0, "<I", 3), "not where it should be"),
        (changed(ONE, b"PK\5\6", 4, "<H", 3), "volumes"),
        (changed(ONE, b"PK\5\6", 10, "<H", 0), "not where it should be"),
        (changed(ONE, b"PK\5\6", 16, "<I", 2**32 - 1), "not where it should be"),
        (changed(ONE, b"PK\3\4", 60, "<Q", 2**64 - 1), "cannot be unpacked|damaged"),
    ],
)
def test_broken_archives(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.3mf: .*({message})"):
        loaded(tmp_path, "bad.3mf", data)


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = ONE.removesuffix(b"written by hand")
    for length in range(len(data)):
        with pytest.raises(JaxmarkError):
            loaded(tmp_path, "short.3mf", data[:length])


SIGNED = (RELATIONS % b"3D/3dmodel.model").replace(
    b"</",
    b"<Relationship Id='s' Target='/s.psdsor' Type="
    b"'http://schemas.openxmlformats.org/package/2006/relationships/digital-signature/origin'/></",
)


@pytest.mark.parametrize("signature", [{"_xmlsignatures/origin.psdsor": b""}, {"_rels/.rels": SIGNED}])
def test_signed_files_are_read_but_not_written(tmp_path: Path, signature: dict[str, bytes]) -> None:
    source = written(tmp_path, "s.3mf", packed({"3D/3dmodel.model": PLAIN, **signature}))
    mesh = load_mesh(source)
    save_mesh(mesh, tmp_path / "same.3mf", like=source)
    assert (tmp_path / "same.3mf").read_bytes() == source.read_bytes()
    with pytest.raises(JaxmarkError, match=r"s\.3mf: The file is signed"):
        patched(source, noisy(mesh, 10))


def test_headers_that_contradict_each_other_are_not_written(tmp_path: Path) -> None:
    data = changed(ONE, b"PK\3\4", 18, "<I", 5)
    source = written(tmp_path, "s.3mf", data)
    with pytest.raises(JaxmarkError, match="pack it again"):
        patched(source, noisy(load_mesh(source), 10))


def read_by_lib3mf(path: Path, *, strict: bool) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Name, vertices and triangles of each mesh, as the consortium's own library reads them."""
    model = pytest.importorskip("lib3mf").get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(strict)
    reader.ReadFromFile(str(path))
    found, meshes = [], model.GetMeshObjects()
    while meshes.MoveNext():
        mesh = meshes.GetCurrentMeshObject()
        points = np.array([list(vertex.Coordinates) for vertex in mesh.GetVertices()])
        found.append((mesh.GetName(), points, np.array([list(face.Indices) for face in mesh.GetTriangleIndices()])))
    return found


NAMES = ["assimp__test", "trimesh__counterXP", "trimesh__cube_and_sphere_same_name", "trimesh__pyramids"]


@pytest.mark.parametrize("name", NAMES)
def test_lib3mf_sees_the_new_positions(tmp_path: Path, name: str) -> None:
    path = shared_mesh(f"scenes/{name}.3mf")
    moved = {key: noisy(mesh, 30.0) for key, mesh in load_scene(path).meshes.items()}
    out = tmp_path / path.name
    save_scene(moved, out, like=path)
    assert [raw(out.read_bytes())[key] == old for key, old in raw(path.read_bytes()).items()].count(False) == 1
    before, got = (read_by_lib3mf(file, strict=False) for file in (path, out))
    assert [old[0] for old in before] == [new[0] for new in got]
    for (_, points, faces), mesh in zip(got, moved.values(), strict=True):
        np.testing.assert_allclose(points, mesh.vertices, rtol=1e-6, atol=0.51)  # one file has whole numbers
        np.testing.assert_array_equal(faces, mesh.faces)


@pytest.fixture
def same_locale() -> Iterator[None]:
    """Restore the locale, which lib3mf changes when it writes, so that files would be read as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)


@pytest.mark.usefixtures("same_locale")
def test_models_of_the_production_extension_are_patched_in_place(tmp_path: Path) -> None:
    """Parts in model files of their own, which the root model names by paths."""
    library = pytest.importorskip("lib3mf")
    wrapper = library.get_wrapper()
    model, pose = wrapper.CreateModel(), wrapper.GetIdentityTransform()
    shape = trimesh.creation.icosahedron()
    for number in range(3):
        part, assembly = model.AddMeshObject(), model.AddComponentsObject()
        part.SetName(f"part {number}")
        vertices = [library.Position(tuple(row)) for row in (shape.vertices + number).tolist()]
        part.SetGeometry(vertices, [library.Triangle(tuple(row)) for row in shape.faces.tolist()])
        part.SetPackagePart(model.FindOrCreatePackagePart(f"/3D/Objects/{number}.model"))
        assembly.AddComponent(part, pose)
        model.AddBuildItem(assembly, pose)
    model.QueryWriter("3mf").WriteToFile(str(tmp_path / "a.3mf"))
    meshes = load_scene(tmp_path / "a.3mf").meshes
    assert sorted(meshes) == ["part 0", "part 1", "part 2"]
    moved = {"part 0": noisy(meshes["part 0"], 0.1), "part 2": noisy(meshes["part 2"], 0.1)}
    save_scene(moved, tmp_path / "b.3mf", like=tmp_path / "a.3mf")
    before, after = (raw((tmp_path / name).read_bytes()) for name in ("a.3mf", "b.3mf"))
    assert {name for name in before if before[name] != after[name]} == {"3D/Objects/0.model", "3D/Objects/2.model"}
    for name, points, faces in read_by_lib3mf(tmp_path / "b.3mf", strict=True):
        np.testing.assert_allclose(points, (meshes | moved)[name].vertices, atol=1e-5)
        np.testing.assert_array_equal(faces, shape.faces)


@pytest.mark.parametrize("name", NAMES)
def test_trimesh_sees_the_new_positions(tmp_path: Path, name: str) -> None:
    pytest.importorskip("lxml")
    path = shared_mesh(f"scenes/{name}.3mf")
    moved = {key: noisy(mesh, 30.0) for key, mesh in load_scene(path).meshes.items()}
    save_scene(moved, tmp_path / path.name, like=path)
    other = trimesh.load_scene(tmp_path / path.name, process=False)
    assert len(other.geometry) == len(moved)
    for got, mesh in zip(other.geometry.values(), moved.values(), strict=True):
        np.testing.assert_allclose(np.asarray(got.vertices), mesh.vertices, rtol=1e-6, atol=0.51)
        np.testing.assert_array_equal(np.asarray(got.faces), mesh.faces)


def test_new_files_are_exact(tmp_path: Path) -> None:
    mesh = make_mesh([[1 / 3, 0, 0], [1, 1e-12, 0], [0, 1, -2e5 / 7], [0.1, 7, 1e-5]], [[0, 1, 2], [3, 2, 1]])
    save_mesh(mesh, tmp_path / "new.3mf")
    again = load_mesh(tmp_path / "new.3mf")
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    first = (tmp_path / "new.3mf").read_bytes()
    save_mesh(mesh, tmp_path / "new.3mf")
    assert (tmp_path / "new.3mf").read_bytes() == first
    ((_, points, faces),) = read_by_lib3mf(tmp_path / "new.3mf", strict=True)
    np.testing.assert_allclose(points, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(faces, mesh.faces)


@pytest.mark.parametrize("writer", ["jaxmark", "trimesh"])
def test_through_stl_and_back(tmp_path: Path, writer: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    save_mesh(make_mesh(ball.vertices, ball.faces), tmp_path / "first.3mf")
    moved = noisy(load_mesh(tmp_path / "first.3mf"), 1e-4)
    save_mesh(moved, tmp_path / "moved.3mf", like=tmp_path / "first.3mf")
    moved = load_mesh(tmp_path / "moved.3mf")
    trimesh.Trimesh(moved.vertices, moved.faces, process=False).export(tmp_path / "soup.stl")
    merged = trimesh.load_mesh(tmp_path / "soup.stl")  # which merges the vertices
    if writer == "trimesh":
        pytest.importorskip("lxml")
        merged.export(tmp_path / "back.3mf")
    else:
        save_mesh(make_mesh(merged.vertices, merged.faces), tmp_path / "back.3mf")
    back = load_mesh(tmp_path / "back.3mf")
    assert len(back.vertices) == len(moved.vertices)
    centres = [np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1) for mesh in (moved, back)]
    np.testing.assert_allclose(centres[1], centres[0], rtol=0, atol=1e-6)
