"""Point clouds and splats: marked, saved, attacked, read, and refused where a surface is needed."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.adversaries.by_name import ATTACKS
from jaxmark.alignment.attempts import align
from jaxmark.alignment.nearest import find_heights, find_partners
from jaxmark.alignment.original import make_original
from jaxmark.app import cli
from jaxmark.errors import AlignmentError
from jaxmark.files import number_check
from jaxmark.geometry.clouds import Cloud, planes, spacings
from jaxmark.geometry.mesh import Mesh, diagonal, make_mesh, used_vertices
from jaxmark.plot.meshes import roughness_masking
from jaxmark.watermark.perception.budget import CLOUD_VISIBILITY, VISIBILITY
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import FINE, rough_sphere

NONE = np.zeros((0, 3), int)
MESSAGE = b"jaxmark!"


def cloud(points) -> Mesh:
    return make_mesh(points, NONE)


def ball(count: int, seed: int = 0) -> np.ndarray:
    """Points on one bumpy surface, others for every seed."""
    random = np.random.default_rng(seed)
    around = random.normal(size=(count, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    waves = np.random.default_rng(7).normal(size=(3, 6))
    return around * (1 + 0.05 * np.sin(2 * around @ waves).sum(axis=1))[:, None] * [1, 0.8, 1.3]


@pytest.fixture(scope="module")
def host() -> Mesh:
    return cloud(ball(4000))


@pytest.fixture(scope="module")
def marker(host: Mesh) -> jm.watermark.NonBlindMarker:
    return jm.make_marker(host, bytes(range(32)), bits=64)


@pytest.fixture(scope="module")
def marked(marker: jm.watermark.NonBlindMarker) -> Mesh:
    return marker.embed(MESSAGE, jm.Budget(noise=0))[0]


def anywhere(mesh: Mesh, seed: int = 0) -> Mesh:
    """In any pose, size and order."""
    random = np.random.default_rng(seed)
    turn = Rotation.random(rng=random).as_matrix()
    return cloud(3.7 * random.permutation(np.asarray(mesh.vertices)) @ turn.T + [1, 2, 3])


# Clouds as meshes


def test_all_points_of_a_cloud_count():
    points = np.array([[0.0, 0, 0], [3, 4, 12], [1, 1, 1]])
    mesh = cloud(points)
    assert mesh.faces.shape == (0, 3)
    assert used_vertices(mesh).all()
    assert diagonal(mesh) == 13


def test_a_cloud_is_the_graph_of_nearest_neighbours(host: Mesh):
    original = make_original(host)
    x = original.positions[:500]
    x = x[np.lexsort(x.T[::-1])]  # in the canonical order
    small = make_original(cloud(x), FINE)
    square = ((x[:, None] - x) ** 2).sum(axis=2)
    np.fill_diagonal(square, np.inf)
    nearest = np.argsort(square, axis=1)[:, :10]
    pairs = {tuple(sorted((i, int(j)))) for i, row in enumerate(nearest) for j in row}
    edges = np.asarray(small.operator.edges)
    assert {tuple(sorted(pair)) for pair in edges[edges[:, 0] < 500].tolist()} == pairs
    assert original.used.all()


def test_a_cloud_has_its_hash_whatever_its_order(host: Mesh):
    shuffled = cloud(np.random.default_rng(0).permutation(host.vertices))
    moved = cloud(np.vstack([host.vertices[:-1], host.vertices[-1:] + 0.01]))
    grid = make_original(host).grid
    first, again, other = (make_original(one, grid).geometry for one in (host, shuffled, moved))
    assert first == again != other


def test_planes_and_spacings():
    """On a tilted plane, and against all distances."""
    random = np.random.default_rng(0)
    turn = Rotation.random(rng=random).as_matrix()
    points = np.column_stack([random.uniform(size=(300, 2)), np.zeros(300)]) @ turn.T
    found = planes(KDTree(points), points)
    np.testing.assert_allclose(np.abs(found.normals @ turn[:, 2]), 1, atol=1e-9)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    np.testing.assert_allclose(spacings(points, 3), np.sort(distance, axis=1)[:, 1:4].mean(axis=1))
    above, _ = Cloud(points).closest(points + 0.01 * turn[:, 2])
    np.testing.assert_allclose(above, points, atol=1e-9)
    sparse = Cloud(points).sample(50).points
    assert len(sparse) <= 50
    np.testing.assert_allclose(sparse @ turn[:, 2], 0, atol=1e-9)


# Marks


def test_a_hidden_mark_in_a_cloud_keeps_its_limits(host: Mesh, marked: Mesh, marker: jm.watermark.NonBlindMarker):
    limits, found = CLOUD_VISIBILITY["hidden"], jm.compare(host, marked)
    assert limits.keys() != VISIBILITY["hidden"].keys()
    assert found.rms == pytest.approx(limits["rms"], rel=0.01)
    assert (found.point_to_plane or 1) <= limits["point_to_plane"]
    assert marker.detect(marked).log10_p < -6
    assert jm.make_marker(host, jm.new_key(), bits=64).detect(marked).message is None


@pytest.mark.slow
def test_the_capacity_of_a_cloud_is_kept(host: Mesh, key: jm.Key):
    bits = jm.capacity(host, jm.Budget(noise=1e-3))
    assert bits >= 64
    jm.make_marker(host, key, bits=bits).embed(bytes(bits // 8), jm.Budget(noise=1e-3))
    with pytest.raises(jm.JaxmarkError, match="carries at most"):
        jm.embed(host, bytes(bits // 8 + 50), key, budget=jm.Budget(noise=1e-3))


def test_points_across_a_plane():
    """Of points on a plane, moved along it and across it, in closed form."""
    random = np.random.default_rng(1)
    flat = np.column_stack([random.uniform(size=(2000, 2)), np.zeros(2000)])
    across = random.uniform(-1e-3, 1e-3, 2000)
    moved = flat + np.column_stack([1e-3 * random.normal(size=(2000, 2)), across])
    spacing = np.sort(np.linalg.norm(flat[:, None] - flat, axis=2), axis=1)[:, 1].mean()
    found = jm.compare(cloud(flat), cloud(moved))
    assert found.point_to_plane == pytest.approx(np.quantile(np.abs(across), 0.95) / spacing, rel=1e-3)
    assert found.rms is not None
    assert found.shading is None


@pytest.mark.parametrize(
    ("steps", "method"),
    [
        ([("diagonal-noise", 2e-4)], "same"),
        pytest.param([("quantisation", 11)], "same", marks=pytest.mark.slow),
        pytest.param([("outliers", 0.1)], "same", marks=pytest.mark.slow),
        pytest.param([("reordering", 1)], "points", marks=pytest.mark.slow),
        ([("subsampling", 0.5), ("diagonal-noise", 2e-4)], "points"),
        ([("cropping", 0.5)], "points"),
        pytest.param([("floaters", 0.2)], "points", marks=pytest.mark.slow),
        ([("merging", 1e-3)], "points"),
        pytest.param([("outliers", 0.1), ("reordering", 1)], "points", marks=pytest.mark.slow),
    ],
    ids=lambda steps: steps if isinstance(steps, str) else "+".join(kind for kind, _ in steps),
)
def test_marks_survive(steps, method, marker: jm.watermark.NonBlindMarker, marked: Mesh):
    found = marker.detect(jm.adversaries.chain(marked, steps, seed=1))
    assert found.message == MESSAGE
    assert found.registration.method == method


@pytest.mark.slow
def test_half_of_a_cloud_in_any_pose_and_order_shows_its_points(marker: jm.watermark.NonBlindMarker, marked: Mesh):
    half = jm.attack(marked, "subsampling", 0.5, seed=2)
    straight, found = (marker.detect(one) for one in (half, anywhere(half)))
    assert found.message == straight.message == MESSAGE
    assert found.coverage == pytest.approx(0.5, abs=0.01)
    seen = found.registration.weights > 0
    true = (np.asarray(marked.vertices) - marker.original.mesh.vertices)[marker.original.weld.first]
    shown = found.registration.displacement[seen] * marker.original.diagonal
    assert np.sqrt(np.mean((shown - true[seen]) ** 2)) < 0.1 * np.sqrt(np.mean(true**2))


def test_a_saved_original_will_do(host: Mesh, marked: Mesh, marker: jm.watermark.NonBlindMarker):
    record = marker.write(marker.codeword(MESSAGE), 4e-4, content=MESSAGE)[1].record
    again = cloud(np.random.default_rng(3).permutation(host.vertices).astype(np.float32).astype(float))
    found = jm.detect(marked, original=again, key=marker.key, record=record)
    assert found.message == MESSAGE
    assert not found.evidence.caveats
    assert found.registration.method == "points"


@pytest.mark.slow
def test_a_mesh_without_its_faces_is_read(key: jm.Key):
    """And a cloud that was given faces."""
    mesh = rough_sphere(1500)
    marker = jm.make_marker(mesh, key, bits=16)
    points = cloud(marker.embed(b"16", jm.Budget(rms=8e-4, noise=0))[0].vertices)
    assert marker.detect(points).message == b"16"
    assert marker.detect(anywhere(points)).message == b"16"
    bare = jm.make_marker(cloud(mesh.vertices), key, bits=16)
    with_faces = make_mesh(bare.embed(b"16", jm.Budget(rms=8e-4, noise=0))[0].vertices, mesh.faces)
    assert bare.detect(with_faces).message == b"16"


# Nearest points


def test_partners_are_mutually_nearest():
    x, y = ball(300), ball(400, 1)
    distance = np.linalg.norm(x[:, None] - y, axis=2)
    found = find_partners(x, y)
    np.testing.assert_array_equal(found.place, distance.argmin(axis=1))
    assert not (found.known & (distance.argmin(axis=0)[found.place] != np.arange(300))).any()


def test_points_that_survive_are_told_from_another_sampling():
    x = ball(3000)
    random = np.random.default_rng(0)
    for count in (1500, 3000, 9000):
        assert not find_partners(x, ball(count, 1)).surviving
    for y in (x[:1500], x[x[:, 0] > 0], x + 1e-3 * random.normal(size=x.shape), np.vstack([x, ball(3000, 1)])):
        assert find_partners(x, y).surviving


def test_another_sampling_shows_how_high_its_surface_is():
    x, y = ball(6000), 1.01 * ball(9000, 1)
    found = find_heights(Cloud(x), y)
    outward = np.sign(np.sum(found.normals * x, axis=1))
    expected = 0.01 * np.abs(np.sum(found.normals * x, axis=1))
    assert found.known.mean() > 0.99
    error = found.height * outward - expected
    assert np.abs(error.mean()) < 0.02 * expected.mean()
    assert np.sqrt(np.mean(error**2)) < 0.15 * expected.mean()


def test_copies_of_points_show_the_same_heights():
    x, y = Cloud(ball(2000)), 1.01 * ball(3000, 1)
    expected = find_heights(x, y)
    for copies in (np.repeat(y, 2, axis=0), np.vstack([y, y[:1600]])):
        found = find_heights(x, copies)
        np.testing.assert_allclose(found.height, expected.height, atol=1e-9)
        np.testing.assert_array_equal(found.known, expected.known)


def test_points_that_all_coincide_show_nothing(host: Mesh, marker: jm.watermark.NonBlindMarker):
    for count in (1, 100):
        with pytest.raises(AlignmentError, match="at one place"):
            marker.detect(cloud(np.tile([[0.1, 0.2, 0.3]], (count, 1))))
    for x, y in ((ball(50), np.zeros((50, 3))), (1e-40 * ball(50), ball(50)), (ball(50), 1e-40 * ball(50))):
        assert np.isfinite(find_heights(Cloud(x), y).height).all()


@pytest.mark.parametrize("turn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_cloud_that_was_sampled_anew_is_read_by_its_planes(
    turn: bool, host: Mesh, marker: jm.watermark.NonBlindMarker
):
    shown = np.asarray(marker.embed(MESSAGE, jm.Budget(rms=1e-3, noise=0), read_back="never")[0].vertices)
    # The mark at other points of the surface: the mean of what the nearest points show.
    other = ball(12000, 5)
    distance, nearest = KDTree(np.asarray(host.vertices)).query(other, 4)
    share = (1 / distance**2) / (1 / distance**2).sum(axis=1, keepdims=True)
    suspect = cloud(other + np.einsum("pk,pkc->pc", share, (shown - host.vertices)[nearest]))
    found = marker.detect(anywhere(suspect) if turn else suspect, MESSAGE)
    assert found.registration.method == "surface"
    assert found.log10_p < -6


@pytest.mark.slow
def test_what_is_no_copy_is_not_aligned(marker: jm.watermark.NonBlindMarker):
    random = np.random.default_rng(0)
    with pytest.raises(jm.JaxmarkError, match="could not be aligned"):
        align(marker.original, cloud(random.uniform(-1, 1, (2000, 3))))


# Files


def splats(count: int) -> np.ndarray:
    """Rows of a splat file: positions, and what else is in one."""
    random = np.random.default_rng(0)
    rest = ["nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "rot_0"]
    rows = np.zeros(count, [(name, "<f4") for name in ("x", "y", "z", *rest)])
    for axis, column in zip("xyz", ball(count).T, strict=True):
        rows[axis] = column
    for name in rest[3:]:
        rows[name] = random.normal(size=count)
    return rows


def splat_file(rows: np.ndarray) -> tuple[bytes, bytes]:
    """Header and body."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [*(f"property float {name}" for name in rows.dtype.names or ()), "end_header", ""]
    return "\n".join(lines).encode(), rows.tobytes()


def check_kept(data: bytes, rows: np.ndarray) -> None:
    """Whatever is no position is byte for byte what it was."""
    top, _ = splat_file(rows)
    assert data.startswith(top)
    found = np.frombuffer(data[len(top) :], rows.dtype)
    for name in rows.dtype.names or ():
        assert np.array_equal(found[name], rows[name]) == (name not in "xyz")


def test_splats_keep_all_but_their_positions(tmp_path: Path):
    rows, path = splats(300), tmp_path / "splats.ply"
    path.write_bytes(b"".join(splat_file(rows)))
    mesh = jm.load_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, np.column_stack([rows[axis] for axis in "xyz"]))
    moved = mesh._replace(vertices=mesh.vertices + 1e-3)
    jm.save_mesh(moved, tmp_path / "moved.ply", like=path)
    check_kept((tmp_path / "moved.ply").read_bytes(), rows)
    np.testing.assert_allclose(jm.load_mesh(tmp_path / "moved.ply").vertices, moved.vertices, atol=1e-6)


@pytest.mark.slow
def test_splats_by_the_command_line(tmp_path: Path, key: jm.Key, monkeypatch, capsys):
    rows = splats(4000)
    path, shown = tmp_path / "splats.ply", tmp_path / "marked.ply"
    path.write_bytes(b"".join(splat_file(rows)))
    jm.watermark.save_key(key, tmp_path / "key")

    def run(*arguments: object) -> dict:
        monkeypatch.setattr(sys, "argv", ["jaxmark", *map(str, arguments), "--json"])
        with pytest.raises(SystemExit) as end:
            sys.exit(cli.main())
        assert not end.value.code
        return json.loads(capsys.readouterr().out)

    assert run("capacity", path, "--noise", 1e-3, "--coverage", 1)["limits"] == CLOUD_VISIBILITY["hidden"]
    run("embed", path, shown, "--key", tmp_path / "key", "--message", MESSAGE.hex(), "--noise", 0)
    check_kept(shown.read_bytes(), rows)
    run("attack", shown, tmp_path / "less.ply", "subsampling", 0.3)
    answer = run("detect", tmp_path / "less.ply", "--original", path, "--key", tmp_path / "key")
    assert answer["message"] == MESSAGE.hex()
    assert set(run("compare", path, shown)) == {"rms", "max", "point_to_plane"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xyz", b"0 0 0 7\n1.50 0 0 8\n0,1.25,0,9 # nine\n"),
        ("a.xyz", b"3\nx y z i\n0;0;0;7\n1.50;0;0;8\n0;1.25;0;9\n"),
        ("a.obj", b"v 0 0 0\nv 1.50 0 0\nv 0 1.25 0\np 1 2 3\n"),
        ("a.off", b"OFF\n3 0 0\n0 0 0\n1.50 0 0\n0 1.25 0\n"),
    ],
)
def test_points_as_text(tmp_path: Path, name: str, text: bytes):
    path = tmp_path / name
    path.write_bytes(text)
    mesh = jm.load_mesh(path)
    assert mesh.faces.shape == (0, 3)
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1.5, 0, 0], [0, 1.25, 0]])
    moved = mesh._replace(vertices=mesh.vertices + np.array([[0, 0, 0], [0.25, 0, 0], [0, 0, 0]]))
    jm.save_mesh(moved, path, like=path)
    assert path.read_bytes() == text.replace(b"1.50", b"1.75")
    new = tmp_path / f"new{path.suffix}"
    jm.save_mesh(moved, new)
    np.testing.assert_array_equal(jm.load_mesh(new).vertices, moved.vertices)


@pytest.mark.parametrize("text", [b"", b"3\n", b"x y z\n1 2\n", b"1 2 3\n4 five 6\n"])
def test_text_without_points_is_refused(tmp_path: Path, text: bytes):
    (tmp_path / "bad.xyz").write_bytes(text)
    with pytest.raises(jm.JaxmarkError, match=r"bad\.xyz: (The file has no points|line 2)"):
        jm.load_mesh(tmp_path / "bad.xyz")


def test_new_files_of_points(tmp_path: Path):
    mesh = cloud(ball(50))
    jm.save_mesh(mesh, tmp_path / "new.ply")
    np.testing.assert_allclose(jm.load_mesh(tmp_path / "new.ply").vertices, mesh.vertices, atol=1e-6)
    for name in ("new.stl", "new.glb", "new.las"):
        with pytest.raises(jm.JaxmarkError, match="PLY or XYZ"):
            jm.save_mesh(mesh, tmp_path / name)
    with pytest.raises(jm.JaxmarkError, match="without faces"):
        jm.save_mesh(rough_sphere(30), tmp_path / "new.xyz")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_laser_scans_keep_all_but_their_positions(suffix: str, tmp_path: Path):
    """As laspy reads them."""
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [1e-4] * 3, [100.0, 200, 0]
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = (ball(500) + np.array([100, 200, 0])).T
    scan.intensity = np.arange(500)
    path = tmp_path / f"scan{suffix}"
    scan.write(str(path))
    mesh = jm.load_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, np.asarray(scan.xyz))
    shift = np.where(np.arange(500)[:, None] % 2, 0.01, 0) * np.random.default_rng(0).normal(size=(500, 3))
    jm.save_mesh(mesh._replace(vertices=mesh.vertices + shift), tmp_path / f"moved{suffix}", like=path)
    found = laspy.read(tmp_path / f"moved{suffix}")
    np.testing.assert_allclose(found.xyz, mesh.vertices + shift, atol=0.50001e-4)
    np.testing.assert_array_equal(found.xyz[::2], scan.xyz[::2])
    np.testing.assert_array_equal(found.intensity, scan.intensity)
    np.testing.assert_allclose(found.header.maxs, np.asarray(found.xyz).max(axis=0))
    if suffix == ".las":
        before, after = (np.frombuffer(one.read_bytes(), np.uint8) for one in (path, tmp_path / "moved.las"))
        records = np.ones(len(before), bool)
        records[179:227] = False
        start, size = int.from_bytes(path.read_bytes()[96:100], "little"), scan.header.point_format.size
        (tmp_path / "cut.las").write_bytes(path.read_bytes()[: -10 * size])
        with pytest.raises(jm.JaxmarkError, match="header counts 500 points"):
            jm.load_mesh(tmp_path / "cut.las")
        records[(start + size * np.arange(500)[:, None] + np.arange(12)).ravel()] = False
        np.testing.assert_array_equal(before[records], after[records])
    with pytest.raises(jm.JaxmarkError, match="scale of at most"):
        jm.save_mesh(mesh._replace(vertices=mesh.vertices + 1e-3 * shift), path, like=path)
    path.write_bytes(b"no scan")
    with pytest.raises(jm.JaxmarkError, match="no LAS or LAZ file"):
        jm.load_mesh(path)


def test_cloud_optimised_scans_are_read_and_not_written(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-4] * 3
    header.vlrs.append(laspy.VLR(user_id="copc", record_id=1, record_data=bytes(160)))
    scan = laspy.LasData(header)
    scan.xyz = ball(500)
    scan.write(tmp_path / "scan.laz")
    mesh = jm.load_mesh(tmp_path / "scan.laz")
    np.testing.assert_array_equal(mesh.vertices, np.asarray(scan.xyz))
    moved = mesh._replace(vertices=1.01 * np.asarray(mesh.vertices))
    for write in (
        lambda: jm.save_mesh(moved, tmp_path / "moved.laz", like=tmp_path / "scan.laz"),
        lambda: number_check(tmp_path / "scan.laz"),
    ):
        with pytest.raises(jm.JaxmarkError, match=r"scan\.laz: .*COPC.* save it as plain LAZ"):
            write()


def test_what_laspy_cannot_write_is_refused(tmp_path: Path, monkeypatch):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    scan = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    scan.xyz = ball(500)
    scan.write(tmp_path / "scan.laz")
    mesh = jm.load_mesh(tmp_path / "scan.laz")

    def fail(*_: object, **__: object) -> None:
        raise NotImplementedError("no such records")

    monkeypatch.setattr(laspy.LasData, "write", fail)
    with pytest.raises(jm.JaxmarkError, match="laspy cannot write this LAZ file: no such records; save it as LAS"):
        jm.save_mesh(mesh._replace(vertices=2 * mesh.vertices), tmp_path / "m.laz", like=tmp_path / "scan.laz")


@pytest.mark.parametrize(("place", "size"), [(100, 4), (107, 4)], ids=["records", "points"])
def test_scans_that_count_more_than_they_hold_are_refused(place: int, size: int, tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    scan = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    scan.xyz = np.zeros((10, 3))
    scan.write(tmp_path / "scan.las")
    data = bytearray((tmp_path / "scan.las").read_bytes())
    data[place : place + size] = b"\xff" * size
    (tmp_path / "scan.las").write_bytes(data)
    with pytest.raises(jm.JaxmarkError, match="is damaged: its header counts"):
        jm.load_mesh(tmp_path / "scan.las")


def test_without_laspy_scans_are_refused_by_the_name_of_the_extra(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    (tmp_path / "scan.las").write_bytes(b"LASF")
    with pytest.raises(jm.JaxmarkError, match=r"jaxmark\[files\]"):
        jm.load_mesh(tmp_path / "scan.las")


# Attacks, and what needs a surface


def test_attacks_on_clouds():
    mesh = cloud(ball(400))
    points = {tuple(row) for row in mesh.vertices.tolist()}

    def shared(kind: str, strength: float) -> tuple[int, int]:
        attacked = jm.attack(mesh, kind, strength, seed=0)
        assert attacked.faces.shape == (0, 3)
        return len(attacked.vertices), len(points & {tuple(row) for row in attacked.vertices.tolist()})

    assert shared("subsampling", 0.25) == (300, 300)
    assert shared("outliers", 0.25) == (400, 300)
    assert shared("floaters", 0.5) == (600, 400)
    assert shared("merging", 1e-3) == (800, 400)
    assert shared("resampling", 0.5)[1] < 40  # of some triangles, all corners are one point
    assert shared("cropping", 0.25) == (300, 300)
    assert shared("holes", 0.1) == (360, 360)
    assert shared("reordering", 1) == (400, 400)


def test_the_others_refuse_what_they_cannot_attack():
    points, mesh = cloud(ball(100)), rough_sphere(100)
    for kind, entry in ATTACKS.items():
        if entry.faces:
            with pytest.raises(jm.JaxmarkError, match=f"'{kind}' needs faces, and a point cloud of 100 points"):
                jm.attack(points, kind, entry.strengths[0], seed=0)
    for kind in ("subsampling", "outliers", "floaters", "merging", "resampling"):
        with pytest.raises(jm.JaxmarkError, match="takes a point cloud"):
            jm.attack(mesh, kind, 0.5, seed=0)
    for kind, strength in (("subsampling", 1), ("outliers", 1), ("resampling", 0), ("subsampling", 0.999)):
        with pytest.raises(jm.JaxmarkError, match=r"share of points|take"):
            jm.attack(points, kind, strength, seed=0)


def test_what_needs_a_surface_is_refused(host: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match="The metric 'dame' needs faces"):
        jm.compare(host, host, ["dame"])
    with pytest.raises(jm.JaxmarkError, match="The metric 'shading' needs faces"):
        jm.embed(host, b"c", key, budget={"shading": 1.0})
    with pytest.raises(jm.JaxmarkError, match="Shading needs faces"):
        jm.distortion.shading_at_vertices(host, host)
    with pytest.raises(jm.JaxmarkError, match="roughness needs faces"):
        roughness_masking(make_original(host))
    with pytest.raises(jm.JaxmarkError, match="along normals needs faces"):
        jm.embed(host, b"c", key, scheme=KeyedScheme(direction="normals"))


@pytest.mark.long
def test_64_bits_in_a_large_cloud_read_from_half_of_it_in_noise(key: jm.Key):
    host = cloud(ball(25_000))
    marker = jm.make_marker(host, key, bits=64)
    shown, info = marker.embed(MESSAGE)
    assert info.rms <= 2e-4 * (1 + 1e-9)
    for steps in (
        [("subsampling", 0.5), ("diagonal-noise", 1e-3)],
        [("merging", 1e-3)],
    ):
        suspect = jm.adversaries.chain(shown, steps, seed=0)
        assert marker.detect(suspect).message == MESSAGE, steps
    assert marker.detect(anywhere(jm.attack(shown, "subsampling", 0.5, seed=0))).message == MESSAGE
