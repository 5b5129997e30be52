"""Compressed Gaussian splats: packed PLY and SPZ."""

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, load_mesh, number_check, save_mesh
from tests.files.helpers import written

POINTS = np.random.default_rng(0).normal(0, 20, (600, 3))


def packed(chunks: int = 3) -> bytes:
    """A PLY file as SuperSplat writes it: positions in the box of their 256 splats."""
    boxes, words = [], []
    for part in np.split(POINTS, [256, 512]):
        low, high = (np.float32(bound) for bound in (part.min(axis=0), part.max(axis=0)))
        steps = np.rint(np.clip((part - low) / (high - low), 0, 1) * [2047, 1023, 2047]).astype(np.uint32)
        boxes.append(np.concatenate([low, high]))
        words.append(steps[:, 0] << 21 | steps[:, 1] << 11 | steps[:, 2])
    head = f"ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n"
    head += "".join(f"property float {end}_{axis}\n" for end in ("min", "max") for axis in "xyz")
    head += f"element vertex {len(POINTS)}\nproperty uint packed_position\nproperty uint packed_color\nend_header\n"
    rows = np.stack([np.concatenate(words), np.arange(len(POINTS), dtype=np.uint32)], axis=1)
    return head.encode() + np.asarray(boxes, "<f4")[:chunks].tobytes() + rows.astype("<u4").tobytes()


def spz(version: int, *, count: int = len(POINTS), fraction: int = 12, magic: bytes = b"NGSP") -> bytes:
    """An SPZ file, and other properties behind its positions."""
    if version == 1:
        body = POINTS.astype("<f2").tobytes()
    else:
        whole = np.rint(POINTS * 2**fraction).astype("<i4")
        body = whole.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    opaque = bytes(len(POINTS))
    if version != 4:
        return gzip.compress(struct.pack("<4s2I4B", magic, version, count, 0, fraction, 0, 0) + body + opaque)
    streams = [zstandard.compress(part) for part in (body, opaque)]
    table = b"".join(struct.pack("<2Q", len(one), 0) for one in streams)
    head = struct.pack("<4s2I4BI12x", magic, version, count, 0, fraction, 0, len(streams), 36)
    return head + bytes(4) + table + b"".join(streams)  # four bytes of an extension


@pytest.mark.parametrize(
    ("name", "data", "step"),
    [
        ("a.ply", packed(), 0.1),
        ("a.spz", spz(1), 0.05),
        ("a.spz", spz(2), 2**-13),
        ("a.spz", spz(3), 2**-13),
        ("a.spz", spz(4), 2**-13),
    ],
)
def test_positions_are_read_and_not_written(tmp_path: Path, name: str, data: bytes, step: float) -> None:
    path = written(tmp_path, name, data)
    cloud = load_mesh(path)
    assert not len(cloud.faces)
    np.testing.assert_allclose(cloud.vertices, POINTS, atol=step)
    with pytest.raises(JaxmarkError, match="read but not written; mark the splat as uncompressed PLY"):
        number_check(path)
    moved = cloud._replace(vertices=np.asarray(cloud.vertices) + 1)
    with pytest.raises(JaxmarkError, match="read but not written"):
        save_mesh(moved, tmp_path / f"b{path.suffix}", like=path)
    save_mesh(cloud, tmp_path / f"c{path.suffix}", like=path)
    assert (tmp_path / f"c{path.suffix}").read_bytes() == data


def test_new_spz_files_are_not_written(tmp_path: Path) -> None:
    cloud = load_mesh(written(tmp_path, "a.spz", spz(3)))
    with pytest.raises(JaxmarkError, match="A new SPZ file is not written"):
        save_mesh(cloud, tmp_path / "b.spz")


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.ply", lambda: packed(2), "needs a chunk for each 256"),
        ("a.spz", lambda: spz(4)[:18], "ends after"),
        ("a.spz", lambda: spz(4)[:-2000], "ends after|cannot be unpacked"),
        ("a.spz", lambda: spz(4).replace(b"\x28\xb5\x2f\xfd", bytes(4)), "cannot be unpacked"),
        ("a.spz", lambda: spz(4, count=1000), "ends after"),
        ("a.spz", lambda: spz(4, count=2**32 - 1), "bytes of unpacked content"),
        ("a.spz", lambda: spz(4).replace(b"NGSP\4", b"NGSP\5"), "no SPZ file of version 1 to 4"),
        ("a.spz", lambda: spz(5), "no SPZ file of version 1 to 4"),
        ("a.spz", lambda: spz(3, magic=b"PNGS"), "no SPZ file"),
        ("a.spz", lambda: spz(3, count=0), "no points"),
        ("a.spz", lambda: spz(3, count=1000), "ends after"),
        ("a.spz", lambda: spz(3)[:1000], "cannot be unpacked"),
        ("a.spz", lambda: b"", "ends after 0 bytes"),
        ("a.spz", lambda: b"plain text", "cannot be unpacked"),
        ("a.spz", lambda: spz(3, count=2**32 - 1), "bytes of unpacked content"),
    ],
)
def test_damaged_splats_are_refused(tmp_path: Path, name: str, make: Callable[[], bytes], message: str) -> None:
    with pytest.raises(JaxmarkError, match=message):
        load_mesh(written(tmp_path, name, make()))


def test_no_more_is_unpacked_than_positions_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "UNPACKED", limits.Limit("bytes of unpacked content", 9 * len(POINTS), 0))
    for version in (3, 4):
        assert len(load_mesh(written(tmp_path, "a.spz", spz(version))).vertices) == len(POINTS)
