"""USD: layers in text and binary, and archives of them."""

import importlib
import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, load_mesh, load_scene, load_texture, may_stay, save_mesh, save_scene, usd
from jaxmark.files.atomic import replacing
from jaxmark.files.pair import writing_pair
from tests.files.helpers import noisy, shifted, turned, written
from tests.samples import bumpy_sphere

Sdf, Usd, UsdGeom = (importlib.import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom"))
BALL = bumpy_sphere(1, 0)
CORNERS = "[(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.5)]"
UP = "(0, 0, 1)"
SQUARE = f"""
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = {CORNERS}
    uniform token subdivisionScheme = "none"
"""


def layer(meshes: dict[str, str], head: str = "", more: str = "") -> bytes:
    """A layer in text: the bodies of meshes by name, beneath a node that moves them."""
    bodies = "\n".join(f'    def Mesh "{name}"\n    {{\n{body}\n    }}' for name, body in meshes.items())
    move = 'double3 xformOp:translate = (1, 2, 3)\n    uniform token[] xformOpOrder = ["xformOp:translate"]'
    return f'#usda 1.0\n(\n{head}\n)\ndef Xform "A"\n{{\n    {move}\n{bodies}\n{more}\n}}\n'.encode()


def ball() -> str:
    """A mesh with a generous extent, a colour and normals of corners."""
    points = ", ".join("({}, {}, {})".format(*row) for row in np.asarray(BALL.vertices, np.float32).tolist())
    normals = ", ".join(BALL.faces.size * [UP])
    return f"""
        float3[] extent = [(-9, -9, -9), (9, 9, 9)]
        int[] faceVertexCounts = [{", ".join(len(BALL.faces) * ["3"])}]
        int[] faceVertexIndices = [{", ".join(map(str, BALL.faces.ravel()))}]
        normal3f[] normals = [{normals}] ( interpolation = "faceVarying" )
        point3f[] points = [{points}]
        color3f[] primvars:displayColor = [(1, 0, 0.1)]
        uniform token subdivisionScheme = "none"
    """


def binary(data: bytes, folder: Path) -> bytes:
    (folder / "text.usda").write_bytes(data)
    Sdf.Layer.FindOrOpen(str(folder / "text.usda")).Export(str(folder / "binary.usdc"))
    return (folder / "binary.usdc").read_bytes()


def opinions(path: Path) -> dict[str, object]:
    """All values of a composed stage, by the paths of attributes."""
    stage = Usd.Stage.Open(str(path))
    return {str(a.GetPath()): a.Get() for prim in stage.Traverse() for a in prim.GetAttributes()}


@pytest.mark.parametrize("form", ["usda", "usd", "usdc", "usdz"])
def test_points_and_normals_change_and_nothing_else(tmp_path: Path, form: str) -> None:
    data = layer({"Ball": ball(), "Square": SQUARE})
    if form == "usdc":
        data = binary(data, tmp_path)
    if form == "usdz":
        data = usd.pack(None, {"a.usdc": binary(data, tmp_path), "0/picture.png": b"an image"})
    source, out = written(tmp_path, f"a.{form}", data), tmp_path / f"b.{form}"
    scene = load_scene(source)
    assert list(scene.meshes) == ["/A/Ball", "/A/Square"]
    np.testing.assert_array_equal(scene.meshes["/A/Ball"].vertices, np.float32(BALL.vertices))
    np.testing.assert_array_equal(scene.meshes["/A/Square"].faces, [[0, 1, 2], [0, 2, 3]])
    moved = turned(scene.meshes["/A/Ball"])
    notes = save_scene({"/A/Ball": moved}, out, like=source)
    before, after = opinions(source), opinions(out)
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} == {"/A/Ball.points", "/A/Ball.normals"}
    np.testing.assert_array_equal(np.array(after["/A/Ball.points"]), moved.vertices)
    np.testing.assert_allclose(np.linalg.norm(after["/A/Ball.normals"], axis=1), 1, atol=1e-6)
    assert len(notes) == (form in ("usda", "usd"))  # this text is not as USD would write it
    if form == "usdz":
        assert out.read_bytes().index(b"an image") % 64 == 0
        assert out.read_bytes().index(b"PXR-USDC") % 64 == 0
        with zipfile.ZipFile(out) as archive:
            assert archive.namelist() == ["a.usdc", "0/picture.png"]


def test_an_extent_follows_the_points(tmp_path: Path) -> None:
    data = layer({"Square": SQUARE + "float3[] extent = [(0, 0, 0), (1, 1, 0.5)]"})
    source, out = written(tmp_path, "a.usda", data), tmp_path / "b.usda"
    save_mesh(shifted(load_mesh(source), 3, [-0.5, 0, 1]), out, like=source)
    stage = Usd.Stage.Open(str(out))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/A/Square"))
    assert mesh.GetExtentAttr().Get() == UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get())


def test_text_that_usd_wrote_changes_in_its_numbers_only(tmp_path: Path) -> None:
    source, out = written(tmp_path, "a.usda", layer({"Ball": ball()})), tmp_path / "b.usda"
    Sdf.Layer.FindOrOpen(str(source)).Export(str(tmp_path / "c.usda"))
    like = tmp_path / "c.usda"
    assert save_mesh(load_mesh(like), out, like=like) == ()
    assert out.read_bytes() == like.read_bytes()
    assert save_mesh(noisy(load_mesh(like), 0.01), out, like=like) == ()
    lines = zip(like.read_text().splitlines(), out.read_text().splitlines(), strict=True)
    changed = [one.split(" = ")[0].strip() for one, other in lines if one != other]
    assert changed == ["normal3f[] normals", "point3f[] points"]


@pytest.mark.parametrize(
    ("attribute", "turns"),
    [
        (f"normal3f[] normals = [{UP}, {UP}, {UP}, {UP}]", True),
        (f'normal3f[] normals = [{UP}] ( interpolation = "uniform" )', True),
        (f'normal3f[] normals = [{UP}] ( interpolation = "constant" )', False),
        (f"normal3f[] normals = [{UP}]", False),  # too few
        (
            f'normal3f[] primvars:normals = [{UP}] ( interpolation = "faceVarying" )\n'
            "int[] primvars:normals:indices = [0, 0, 0, 0]",
            True,
        ),
    ],
)
def test_normals_of_every_interpolation(tmp_path: Path, attribute: str, turns: bool) -> None:
    flat = SQUARE.replace("0.5", "0")
    source, out = written(tmp_path, "a.usda", layer({"Square": flat + attribute})), tmp_path / "b.usda"
    mesh = load_mesh(source)
    x, y, z = np.asarray(mesh.vertices).T
    save_mesh(mesh._replace(vertices=np.stack([z, x, y], axis=1)), out, like=source)
    name = "/A/Square." + ("primvars:normals" if "primvars" in attribute else "normals")
    normals = np.array(opinions(out)[name])
    np.testing.assert_allclose(normals, len(normals) * [[1, 0, 0] if turns else [0, 0, 1]], atol=1e-6)


def test_texture_coordinates_of_corners(tmp_path: Path) -> None:
    st = "texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)]"
    data = layer({"B": SQUARE, "Square": SQUARE + st + ' ( interpolation = "faceVarying" )'})
    texture = load_texture(written(tmp_path, "a.usda", data))
    assert texture is not None
    assert np.isnan(texture[:2]).all()
    np.testing.assert_array_equal(texture[2:], [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])


def test_the_first_sample_of_animated_points_changes(tmp_path: Path) -> None:
    later = CORNERS.replace("0.5", "0.7")
    samples = f"point3f[] points.timeSamples = {{ 1: {CORNERS}, 2: {later} }}\n"
    cage = SQUARE.replace("uniform token", "#")
    source, out = written(tmp_path, "a.usda", layer({"Square": cage + samples})), tmp_path / "b.usda"
    moved = shifted(load_mesh(source), 0, [0, 0, 1])
    notes = " ".join(save_mesh(moved, out, like=source))
    assert "1 later samples stay unmarked" in notes
    assert "programs that subdivide this mesh (catmullClark) show the mark smoothed" in notes
    stage = Usd.Stage.Open(str(out))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/A/Square")).GetPointsAttr()
    for time in (Usd.TimeCode.Default(), 1):
        np.testing.assert_allclose(np.array(points.Get(time)), moved.vertices)
    assert np.array(points.Get(2))[0].tolist() == [0, 0, 0]


def test_content_of_other_layers_is_named_and_left_alone(tmp_path: Path) -> None:
    over = f'    over "C" ( prepend references = @other.usda@ )\n    {{\n        point3f[] points = {CORNERS}\n    }}'
    asset = "    asset picture = @pictures/a.png@\n    asset gone = @missing.png@\n    asset far = @../far.png@"
    source = written(tmp_path, "a.usda", layer({"Square": SQUARE, "Empty": ""}, more=f"{over}\n{asset}"))
    (tmp_path / "pictures").mkdir()
    written(tmp_path, "pictures/a.png", b"picture")
    written(tmp_path, "other.usda", layer({"Ball": ball()}))
    scene = load_scene(source)
    assert list(scene.meshes) == ["/A/Square"]
    assert scene.skipped["/A/Empty"] == "its points are in another layer, which is left alone"
    assert scene.skipped["/A/C"] == "it has no faces, or they are in another layer"
    assert scene.skipped["other.usda"] == "it is another file; mark it on its own"
    (tmp_path / "out").mkdir()
    save_scene({"/A/Square": scene.meshes["/A/Square"]}, tmp_path / "out" / "b.usda", like=source)
    found = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert found == {"b.usda", "other.usda", "pictures/a.png"}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A layer with a mesh that refers to another layer with a mesh."""
    written(tmp_path, "ball.usda", layer({"Ball": ball()}))
    return written(
        tmp_path, "scene.usda", layer({"Square": SQUARE}, more='    def "B" ( references = @ball.usda@ ) {}')
    )


@pytest.mark.slow
def test_a_layer_that_was_marked_first_stays(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    square = load_scene(scene).meshes["/A/Square"]
    original = tmp_path / "ball.usda"
    save_mesh(noisy(load_mesh(original), 0.001), out / "ball.usda", like=original)
    marked = (out / "ball.usda").read_bytes()
    with replacing(out / "scene.usda", may_stay) as draft:
        save_scene({"/A/Square": square}, draft, like=scene)
    save_scene({"/A/Square": square}, out / "again.usda", like=scene)
    assert (out / "ball.usda").read_bytes() == marked != original.read_bytes()
    mesh = load_mesh(original)
    first, back = (", ".join(map(str, corners)) for corners in (BALL.faces[0], BALL.faces[0, ::-1]))
    for other in (
        layer({"Ball": ball().replace(first, back)}),
        layer({"Other": ball()}),
        layer({"Ball": SQUARE}),
        b"#usda 1.0\n",
        b"",
    ):
        (out / "ball.usda").write_bytes(other)
        with pytest.raises(JaxmarkError, match=r"ball\.usda is there already, and is another file"):
            save_scene({"/A/Square": square}, out / "third.usda", like=scene)
        assert (out / "ball.usda").read_bytes() == other
    save_mesh(mesh._replace(vertices=1.2 * np.asarray(mesh.vertices)), out / "ball.usda", like=original)
    with pytest.raises(JaxmarkError, match="is another file"):
        save_scene({"/A/Square": square}, out / "third.usda", like=scene)


def test_a_layer_that_came_along_can_be_marked(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    original, target, record = tmp_path / "ball.usda", out / "ball.usda", out / "ball.usda.json"
    save_scene({"/A/Square": load_scene(scene).meshes["/A/Square"]}, out / "scene.usda", like=scene)

    def mark(content: bytes, like: Path | None = original) -> None:
        with writing_pair(target, record, original=like) as pair:
            pair.file.write_bytes(content)
            pair.record.write_bytes(b"{}")

    with pytest.raises(JaxmarkError, match=r"exists; give another name"):
        mark(b"marked", None)
    mark(b"marked")
    assert target.read_bytes() == b"marked"
    with pytest.raises(JaxmarkError, match=r"exists; give another name"):  # it is no copy any more
        mark(b"twice")
    target.write_bytes(original.read_bytes())
    with pytest.raises(JaxmarkError, match=r"exists; give another name"):  # it has a record
        mark(b"twice")
    record.unlink()
    target.unlink()
    target.hardlink_to(original)
    with pytest.raises(JaxmarkError, match=r"exists; give another name"):  # it is the original itself
        mark(b"twice")


def test_all_layers_of_an_archive_are_read(tmp_path: Path) -> None:
    root = layer({"Square": SQUARE}, more='    def "B" ( prepend references = @geometry/b.usda@ )\n    {\n    }')
    inner = layer({"Square": SQUARE}).replace(b"(\n\n)", b'(\n    defaultPrim = "A"\n)')
    packed = usd.pack(None, {"root.usda": root, "geometry/b.usda": inner})
    source, out = written(tmp_path, "a.usdz", packed), tmp_path / "b.usdz"
    scene = load_scene(source)
    assert list(scene.meshes) == ["/A/Square", "geometry/b.usda/A/Square"]
    assert not scene.skipped
    name = "geometry/b.usda/A/Square"
    save_scene({name: shifted(scene.meshes[name], 0, [0, 0, 1])}, out, like=source)
    after = opinions(out)
    assert np.array(after["/A/Square.points"])[0].tolist() == [0, 0, 0]
    assert np.array(after["/A/B/Square.points"])[0].tolist() == [0, 0, 1]
    with zipfile.ZipFile(io.BytesIO(out.read_bytes())) as archive:
        assert archive.read("root.usda") == root


@pytest.mark.parametrize("form", ["usda", "usd", "usdc", "usdz"])
def test_new_files_are_read_by_usd(tmp_path: Path, form: str) -> None:
    mesh = BALL._replace(vertices=np.asarray(BALL.vertices, np.float32).astype(float))
    path = tmp_path / f"a.{form}"
    save_mesh(mesh, path)
    np.testing.assert_array_equal(load_mesh(path).vertices, mesh.vertices)
    stage = Usd.Stage.Open(str(path))
    found = UsdGeom.Mesh(stage.GetDefaultPrim())
    np.testing.assert_array_equal(np.array(found.GetPointsAttr().Get()), mesh.vertices)
    np.testing.assert_array_equal(np.array(found.GetFaceVertexIndicesAttr().Get()), BALL.faces.ravel())
    assert found.GetExtentAttr().Get() == UsdGeom.PointBased.ComputeExtent(found.GetPointsAttr().Get())


def _square(old: str, new: str) -> Callable[[], bytes]:
    return lambda: layer({"Square": SQUARE.replace(old, new)})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: b"#usda 1.0\ndef", "USD cannot read the file: this is no layer"),
        (lambda: b"PXR-USDC" + bytes(100), "USD cannot read the file"),
        (lambda: b"", "USD cannot read the file"),
        (lambda: usd.pack(None, {"a.png": b""}), "no layer"),
        (lambda: usd.pack(None, {"a.usda": b"x"}), "USD cannot read 'a.usda'"),
        (lambda: usd.pack(None, {f"{number}.usda": b"" for number in range(257)}), "more than 256 layers"),
        (lambda: layer({}), "has no mesh"),
        (lambda: layer({}, "    subLayers = [@b.usda@]"), "mark the files it refers to: 'b.usda'"),
        (_square("[4]", "[2, 2]"), "one of its faces has 2 corners"),
        (_square("[4]", "[3]"), "have 3 corners, but there are 4 indices"),
        (
            _square("int[] faceVertexCounts = [4]", f"int64[] faceVertexCounts = {[2**62] * 3 + [2**62 + 4]}"),
            "of 32 bits",
        ),
        (_square("int[] faceVertexCounts", "uchar[] faceVertexCounts"), "of 32 bits"),
        (_square("int[] faceVertexIndices", "int64[] faceVertexIndices"), "of 32 bits"),
        (_square("[0, 1, 2, 3]", "[0, 1, 2, 4]"), "refers to point 4, but there are 4"),
        (_square("[0, 1, 2, 3]", "[0, 1, 2, -1]"), "refers to point -1, but there are 4"),
        (_square("int[] faceVertexCounts", "float[] faceVertexCounts"), "no integers"),
        (_square(f"point3f[] points = {CORNERS}", "int[] points = [1]"), "no triples"),
        (_square(f"point3f[] points = {CORNERS}", "int points = 1"), "no triples"),
        (_square(f"point3f[] points = {CORNERS}", 'string points = "(0, 0, 0)"'), "no triples"),
        (_square(f"point3f[] points = {CORNERS}", "point3f[] points = []"), "it has no points"),
        (_square(f"point3f[] points = {CORNERS}", ""), "it has no points"),
        (lambda: layer({"Empty": ""}, more='    def "B" ( references = </A/Empty> ) {}'), "in another layer"),
        (lambda: layer({"Empty": ""}, more='    def Mesh "B" ( inherits = </A/Empty> ) {}'), "in another layer"),
        (_square("int[] faceVertexIndices = [0, 1, 2, 3]", "int faceVertexIndices = 3"), "no integers"),
        (_square("int[] faceVertexIndices = [0, 1, 2, 3]", ""), "it has no faces$|it has no faces[^,]"),
    ],
)
def test_files_without_a_usable_mesh_are_refused(tmp_path: Path, make: Callable[[], bytes], message: str) -> None:
    with pytest.raises(JaxmarkError, match=message):
        load_mesh(written(tmp_path, "a.usdz", make()))


def test_arrays_that_take_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "UNPACKED", limits.Limit("bytes of unpacked content", 3000, 0))
    with pytest.raises(JaxmarkError, match="more than 3000 bytes"):
        load_mesh(written(tmp_path, "a.usda", layer({"Ball": ball()})))
