"""No small file costs minutes or gigabytes: it is read within its budget, or refused in one sentence."""

import json
import os
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from jaxmark.app.limited import Worker
from jaxmark.errors import JaxmarkError
from jaxmark.files import atomic, limits, load_mesh, load_scene, save_mesh, threemf_xml
from jaxmark.files.gltf.document import Document
from jaxmark.files.limits import Limit
from jaxmark.files.source import unique_names
from jaxmark.files.unpacking import Unpacker
from tests.files import hostile
from tests.files.helpers import loaded, written

_SECONDS, _MEGABYTES = 60.0, 800  # on a busy machine; a process that loads nothing has some 200 megabytes more
REFUSED = {
    "filler": "more than 100 XML elements",
    "three": "more than 100 XML elements",
    "nested": "more than 100 XML elements",
    "comments": "more than 100 XML elements",
    "relationships": "more than 100 XML elements",
    "lists": "more than 100 XML elements",
    "meshes": "more than 10 meshes",
    "remarks": "more than 100 XML elements",
    "hidden": "a tag or comment has more than 1000 bytes",
    "doctype": "The XML has a document type|a tag or comment has more than 1000 bytes",
    "attributes": "a tag or comment has more than 1000 bytes",
    "name": "a tag or comment has more than 1000 bytes",
}


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let limits be small."""
    monkeypatch.setattr(limits, "ELEMENTS", Limit("XML elements", 100, 0))
    monkeypatch.setattr(limits, "MESHES", Limit("meshes", 10, 0))
    monkeypatch.setattr(threemf_xml, "_MAX_TOKEN", 1000)
    monkeypatch.setattr(threemf_xml, "_BLOCK", 500)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(("kind", "message"), REFUSED.items())
def test_elements_of_3mf_files_are_limited(tmp_path: Path, kind: str, message: str) -> None:
    with pytest.raises(JaxmarkError, match=rf"bad\.3mf: .*{message}[^.]*\.$"):
        loaded(tmp_path, "bad.3mf", hostile.threemf(kind, 2**13 + 2**12))


@pytest.mark.usefixtures("small")
def test_three_models_share_a_limit(tmp_path: Path) -> None:
    loaded(tmp_path, "one.3mf", hostile.filler(60))
    with pytest.raises(JaxmarkError, match="more than 100 XML elements"):
        loaded(tmp_path, "three.3mf", hostile.filler(60, 3))


@pytest.mark.usefixtures("small")
def test_vertices_and_triangles_are_no_other_elements(tmp_path: Path) -> None:
    for kind in ("single", "plain"):
        source = written(tmp_path, "good.3mf", hostile.threemf(kind, 2**14))
        np.testing.assert_array_equal(load_mesh(source).vertices, np.zeros(((2**14 - 2**12) // 27, 3)))
    assert len(loaded(tmp_path, "good.3mf", hostile.triangles(1000)).faces) == 1000


@pytest.mark.parametrize(
    "make",
    [
        lambda count: hostile.hidden(count),
        lambda count: hostile.hidden(count, b"<![CDATA[", b"]]>"),
        lambda count: hostile.hidden(count, b"<?a ", b"?>"),
        hostile.doctype,
    ],
    ids=["comment", "text", "instruction", "document type"],
)
def test_words_in_comments_are_parsed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[int], bytes]
) -> None:
    feed, fed = threemf_xml._Parser.feed, list[int]()

    def spy(parser: threemf_xml._Parser, start: int, end: int, *, final: bool) -> None:
        fed.append(end - start)
        feed(parser, start, end, final=final)

    monkeypatch.setattr(threemf_xml._Parser, "feed", spy)
    try:
        assert len(loaded(tmp_path, "a.3mf", make(90_000)).faces) == 1
    except JaxmarkError as error:
        assert make is hostile.doctype
        assert "document type" in str(error)  # noqa: PT017
    assert len(fed) <= 4
    assert max(fed) > 900_000


def test_one_expression_is_made_for_all_lists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(written(tmp_path, "a.3mf", hostile.prefixes(5)))
    assert [len(mesh.faces) for mesh in scene.meshes.values()] == [1] * 5
    monkeypatch.setattr(limits, "ELEMENTS", Limit("XML elements", 37, 0))
    with pytest.raises(JaxmarkError, match="more than 37 XML elements"):
        load_scene(tmp_path / "a.3mf")


def test_namespaces_are_those_of_the_nearest_declaration(tmp_path: Path) -> None:
    core = hostile._CORE
    mesh = hostile._TRIANGLE
    other = mesh.replace(b"<mesh>", b'<mesh xmlns="other">').replace(b'id="1"', b'id="2"')
    back = b'<q:a xmlns:q="other" xmlns="other"/>' + mesh.replace(b'id="1"', b'id="3"')
    declared = re.sub(rb"<(/?)", rb"<\1p:", mesh).replace(b' id="1"', b' xmlns:p="%s" id="4"' % core)
    names = load_scene(
        written(tmp_path, "a.3mf", hostile.archive(1, hostile._HEAD + mesh + other + back + declared + hostile._TAIL))
    )
    assert sorted(names.meshes) == ["object 1", "object 3", "object 4"]
    loose = declared.replace(b"xmlns:p", b"xmlns:q")
    with pytest.raises(JaxmarkError, match=r"the namespace 'p' is not declared"):
        loaded(tmp_path, "b.3mf", hostile.archive(1, hostile._HEAD + loose + hostile._TAIL))


def test_the_binary_chunk_of_a_glb_is_there_once(tmp_path: Path) -> None:
    data = hostile.gltf({"buffers": [{"byteLength": 8}] * 5}, bytes(8))
    assert len(Document(data, lambda path: b"").data) == 8


def test_glb_files_that_are_nested_deeply_are_written(tmp_path: Path) -> None:
    nest: object = 0
    for _ in range(600):
        nest = [nest]
    data = hostile.fans(1, 300, 4)
    size = struct.unpack_from("<I", data, 12)[0]
    deep = hostile.gltf(json.loads(data[20 : 20 + size]) | {"extras": nest}, data[28 + size :])
    mesh = load_mesh(written(tmp_path, "a.glb", deep))
    save_mesh(mesh._replace(vertices=2 * mesh.vertices), tmp_path / "b.glb", like=tmp_path / "a.glb")
    np.testing.assert_array_equal(load_mesh(tmp_path / "b.glb").vertices, 2 * mesh.vertices)


def test_draco_may_take_what_its_file_allows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draco = pytest.importorskip("DracoPy")
    points = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    faces = np.arange(39).reshape(-1, 3).astype(np.uint32)
    for ordered in (True, False):
        blob = bytes(draco.encode(points, faces, preserve_order=ordered))
        found = draco.decode(blob)
        assert len(loaded(tmp_path, "a.glb", hostile.compressed(1, blob, len(found.points))).faces) == len(found.faces)
        with pytest.raises(JaxmarkError, match="holds other numbers of POSITION than the document says"):
            loaded(tmp_path, "a.glb", hostile.compressed(1, blob, 1))
    cloud = bytes(draco.encode(points))
    for bad in (hostile.many_points(), cloud, b"DRACO", blob[:40]):
        with pytest.raises(JaxmarkError, match="cannot be decoded by Draco"):
            loaded(tmp_path, "a.glb", hostile.compressed(1, bad, 40))
    monkeypatch.setattr(limits, "UNPACKED", Limit("bytes of unpacked content", 20_000, 0))
    scene = load_scene(written(tmp_path, "a.glb", hostile.compressed(100, blob, len(found.points))))
    assert 20_000 // 1000 < len(scene.meshes) < 20_000 // (12 * len(found.points))
    assert all("more than 20000 bytes of unpacked content" in reason for reason in scene.skipped.values())


@pytest.mark.parametrize("kind", hostile.DAMAGED_LAZ)
def test_laz_files_that_end_their_decoder_are_refused(tmp_path: Path, kind: str) -> None:
    """A decoder that panics, or reserves more memory than there is, ends its own process only."""
    pytest.importorskip("lazrs")
    with pytest.raises(JaxmarkError, match=r"no LAZ file that laspy reads: [^.]*\.$|does not hold the 1000 points"):
        loaded(tmp_path, "a.laz", hostile.DAMAGED_LAZ[kind](hostile.laz(1000, 0)))


def test_unpacking_takes_limited_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("lazrs")
    data = hostile.laz(1_000_000, 0)
    monkeypatch.setattr(limits, "UNPACKING_SECONDS", Limit("seconds of unpacking", 1, 0))
    unpack = Unpacker("laz", len(data))
    with pytest.raises(JaxmarkError, match=r"its decoder ended; the data are damaged, or take more than 1 s"):
        _ = [unpack(data) for _ in range(100)]


def test_rows_of_ply_that_differ_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROWS", Limit("rows", 100, 0))
    assert len(loaded(tmp_path, "a.ply", hostile.rows(100)).vertices) == 3
    with pytest.raises(JaxmarkError, match="more than 100 rows"):
        loaded(tmp_path, "a.ply", hostile.rows(101))
    with pytest.raises(JaxmarkError, match="more than 100 rows"):
        loaded(tmp_path, "a.ply", hostile.rows(60, 2))


@pytest.mark.parametrize("names", [["a #2", "a", "a"], ["a", "a", "a #2", "a"], ["a", "a #2", "a #2", "a"]])
def test_meshes_have_names_of_their_own(names: list[str]) -> None:
    unique = unique_names(names)
    assert len({*unique}) == len(names)
    assert all(one == name or one.startswith(f"{name} #") for one, name in zip(unique, names, strict=True))


def test_corners_of_strips_and_fans_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ACCESSED", Limit("elements of accessors", 5000, 0))
    for mode in (5, 6):
        assert len(loaded(tmp_path, "a.glb", hostile.fans(1, 1000, mode)).faces) == 998
        with pytest.raises(JaxmarkError, match="more than 5000 elements of accessors"):
            loaded(tmp_path, "a.glb", hostile.fans(2, 1000, mode))
    assert len(loaded(tmp_path, "a.glb", hostile.fans(4, 999, 4)).faces) == 4 * 333


def test_a_file_that_is_many_buffers_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, paths = atomic.read_file, list[str]()
    monkeypatch.setattr(atomic, "read_file", lambda path, *rest: paths.append(str(path)) or read(path, *rest))
    names = ["a.glb", "./a.glb", "b/../a.glb", "%61.glb"] * 250
    data = hostile.itself(names, hostile.fans(1, 300, 4))
    document = Document(data, atomic.read_beside(written(tmp_path, "a.glb", data).parent, 2**20, 2**20))
    assert len(paths) == 1
    assert len(document.data) == 348 + 4  # each buffer states 4 bytes
    assert {buffer.place for buffer in document.buffers if not isinstance(buffer, str)} == {
        range(348),
        range(348, 348 + 4),
    }
    assert len(load_mesh(tmp_path / "a.glb").faces) == 100


def test_a_buffer_is_read_as_far_as_the_document_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sparse file may have any size."""
    content = b"0123456789"
    written(tmp_path, "big.bin", content)
    os.truncate(tmp_path / "big.bin", 2**40)
    written(tmp_path, "small.bin", content)
    read = atomic.read_beside(tmp_path, 2**20, 2**20)
    assert read("big.bin", 4) == content[:4]
    assert read("./big.bin", 10) == content
    assert read("big.bin", 3) is read("big.bin", 10)
    for path, count in (("big.bin", 2**30), ("big.bin", None)):
        with pytest.raises(JaxmarkError, match=f"'big.bin' .* has {2**40} bytes, more than"):
            read(path, count)
    read = atomic.read_beside(tmp_path, 100, 11)
    assert (read("small.bin", None), read("small.bin", 2**53)) == (content, content)
    with pytest.raises(JaxmarkError, match=r"more than 1$"):  # all files together
        read("big.bin", 2)
    monkeypatch.setattr(limits, "BUFFERS", Limit("bytes of buffers in other files", 1000, 0))
    with pytest.raises(JaxmarkError, match="has 1099511627776 bytes, more than 1000"):
        loaded(tmp_path, "a.gltf", hostile.triangle_beside("big.bin", 2**40))
    written(tmp_path, "big.bin", np.eye(3, dtype="<f4").tobytes())
    os.truncate(tmp_path / "big.bin", 2**40)
    assert len(loaded(tmp_path, "a.gltf", hostile.triangle_beside("big.bin", 36)).faces) == 1


def test_tags_of_any_length_below_the_limit_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = loaded(tmp_path, "a.3mf", hostile.attributes(0)).vertices
    for block in (1, 7, 64):
        monkeypatch.setattr(threemf_xml, "_BLOCK", block)
        np.testing.assert_array_equal(loaded(tmp_path, "b.3mf", hostile.attributes(500)).vertices, expected)


@pytest.mark.parametrize(("name", "data"), [("a.3mf", hostile.filler(5000)), ("a.laz", None)])
def test_unpacked_bytes_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, data: bytes | None
) -> None:
    if data is None:
        pytest.importorskip("lazrs")
        data = hostile.laz(1000, 3000)
    loaded(tmp_path, name, data)
    monkeypatch.setattr(limits, "UNPACKED", Limit("bytes of unpacked content", 10_000, 1))
    with pytest.raises(JaxmarkError, match="more than 10000 bytes of unpacked content, the most for a file of"):
        loaded(tmp_path, name, data)


def test_a_large_file_may_have_more() -> None:
    limit = Limit("things", 10, 2)
    limit.check(10, 1)
    limit.check(200, 100)
    with pytest.raises(JaxmarkError, match="more than 200 things, the most for a file of 100 bytes"):
        limit.check(201, 100)


@pytest.mark.usefixtures("small")
def test_objects_of_obj_files_are_limited(tmp_path: Path) -> None:
    assert len(load_scene(written(tmp_path, "a.obj", hostile.tetrahedra(10))).meshes) == 10
    with pytest.raises(JaxmarkError, match="more than 10 meshes"):
        load_scene(written(tmp_path, "a.obj", hostile.tetrahedra(11)))


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    running = Worker(_SECONDS, _MEGABYTES)
    yield running
    running.end()


def _count(path: Path) -> int:
    """Count the meshes of a file, in a worker."""
    return len(load_scene(path).meshes)


def _within_budget(worker: Worker, path: Path) -> str:
    """Read a file in a worker; return why it is refused, or nothing."""
    try:
        assert worker.run(_count, path)
    except JaxmarkError as error:
        assert "limit of this process" not in str(error)  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
        return str(error)
    return ""


@pytest.mark.long
@pytest.mark.parametrize("kind", hostile.ARCHIVES)
def test_the_largest_files_that_are_unpacked(tmp_path: Path, worker: Worker, kind: str) -> None:
    data = hostile.threemf(kind, limits.UNPACKED.least)
    refusal = _within_budget(worker, written(tmp_path, "a.3mf", data))
    assert bool(refusal) == (kind not in ("plain", "single", "triangles", "hidden"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "make", "refused"),
    [
        ("filler.3mf", lambda: hostile.threemf("filler", 2**28), True),
        ("three.3mf", lambda: hostile.threemf("three", 2**29), True),
        ("single.3mf", lambda: hostile.threemf("single", 2**28), True),
        ("plain.3mf", lambda: hostile.threemf("plain", 2**28), True),
        ("spaces.3mf", lambda: hostile.spaces(500_000, 2**20), True),
        ("prefixed.3mf", lambda: hostile.prefixed(30_000, 2**16), True),
        ("padded.laz", lambda: hostile.laz(36_000_000, 361_000), True),
        ("full.laz", lambda: hostile.laz(limits.UNPACKED.least // 20, 361_000), False),
        ("objects.obj", lambda: hostile.tetrahedra(7000), False),
        ("more.obj", lambda: hostile.tetrahedra(20_000), True),
    ],
)
def test_small_files_that_took_minutes_or_gigabytes(
    tmp_path: Path, worker: Worker, name: str, make: Callable[[], bytes], refused: bool
) -> None:
    if name.endswith(".laz"):
        pytest.importorskip("lazrs")
    assert bool(_within_budget(worker, written(tmp_path, name, make()))) == refused


PIECE = st.tuples(st.sampled_from(hostile.PIECES), st.integers(0, 21).map(lambda power: 2**power))
CHANGE = st.tuples(st.floats(0, 1), st.integers(0, 6), st.sampled_from(hostile.PIECES) | st.binary(max_size=4))


@pytest.mark.long
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(pieces=st.lists(PIECE, min_size=1, max_size=5), changes=st.lists(CHANGE, max_size=3), kind=st.integers(0, 4))
def test_mutants(
    tmp_path_factory: pytest.TempPathFactory,
    worker: Worker,
    pieces: list[tuple[bytes, int]],
    changes: list[tuple[float, int, bytes]],
    kind: int,
) -> None:
    """Repeated pieces of models, in any order and number, with some bytes changed; also OBJ and LAZ."""
    folder = tmp_path_factory.mktemp("mutants")
    if kind == 0:
        name, content = "a.obj", hostile.tetrahedra(7000)
    elif kind == 1:
        pytest.importorskip("lazrs")
        name, content = "a.laz", hostile.laz(200_000, 20_000)
    else:
        name, content = "a.3mf", hostile.model(pieces, limits.UNPACKED.least - 2**12)
    for where, removed, put in changes:
        at = int(where * len(content)) if kind else int(where * 300)
        content = content[:at] + put + content[at + removed :]
    data = hostile.archive(1 + pieces[0][1] % 3, content) if name == "a.3mf" else content
    _within_budget(worker, written(folder, name, data))
    (folder / name).unlink()
