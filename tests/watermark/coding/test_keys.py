import hashlib
import os
import stat

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.errors import JaxmarkError
from jaxmark.geometry import geometry_hash
from jaxmark.geometry.mesh import make_mesh
from jaxmark.watermark.coding.keys import Choices, commitment
from jaxmark.watermark.coding.sequences import orthogonal_sequences

pytestmark = pytest.mark.core

TETRAHEDRON = make_mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
)


def test_golden(key: jm.Key):
    """Held exactly, for ever: marks made by any version must stay readable."""
    geometry = geometry_hash(TETRAHEDRON)
    assert geometry.hex() == "27361168d6b23513850f93bbee6ed2f850b8d363b5d0a9afee491ff245ef89e6"
    assert commitment(key) == "b75b5a184bfa6e43a060bbe68ea429ba59b3b4cce15f89a27633415e126ea277"
    assert (
        "".join("+" if s > 0 else "-" for s in Choices(key, geometry).signs("signs", 24)) == "++++--+-+-+-+-+--++-+-++"
    )
    assert Choices(key, geometry).permutation("rows", 12).tolist() == [0, 4, 11, 3, 5, 6, 2, 10, 1, 9, 7, 8]
    rows = ["".join("+" if s > 0 else "-" for s in row) for row in orthogonal_sequences(Choices(key, geometry), 3, 12)]
    assert rows == ["-++++----+++", "+--+++-+++++", "+-++-+---+--"]


def test_is_shake_256_with_a_label(key: jm.Key):
    expected = hashlib.shake_256(bytes(range(32)) + b"g" * 32 + b"jaxmark/2/signs\0data").digest(40)
    assert Choices(key, b"g" * 32).derive("signs", 40, b"data") == expected
    assert Choices(key, b"g" * 32).derive("signs", 9) == hashlib.shake_256(key + b"g" * 32 + b"jaxmark/2/signs").digest(
        9
    )
    bits = "".join(f"{byte:08b}" for byte in Choices(key, b"g" * 32).derive("signs", 2))
    np.testing.assert_array_equal(Choices(key, b"g" * 32).signs("signs", 11), [1 - 2 * int(b) for b in bits[:11]])


def test_labels_keys_and_meshes_share_nothing(key: jm.Key):
    geometry = geometry_hash(TETRAHEDRON)
    moved = geometry_hash(make_mesh(TETRAHEDRON.vertices * (1 + 1e-15), TETRAHEDRON.faces))
    base = Choices(key, geometry).signs("signs", 4096).astype(int)
    for other in (
        Choices(key, geometry).signs("rows", 4096),
        Choices(key, moved).signs("signs", 4096),
        Choices(jm.new_key(), geometry).signs("signs", 4096),
    ):
        assert abs(base @ other) < 6 * 64  # 6 standard deviations


def test_geometry_hash_is_canonical():
    geometry = geometry_hash(TETRAHEDRON)
    soup = make_mesh(TETRAHEDRON.vertices[TETRAHEDRON.faces].reshape(-1, 3), np.arange(12).reshape(-1, 3))
    reordered = make_mesh(soup.vertices, soup.faces)
    assert geometry_hash(reordered) == geometry_hash(soup)
    seam = make_mesh(
        np.vstack([TETRAHEDRON.vertices, -0.0 * TETRAHEDRON.vertices[:1]]),
        np.vstack([TETRAHEDRON.faces[:3], [[2, 4, 3]]]),
    )
    assert geometry_hash(seam) == geometry
    assert geometry_hash(make_mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[::-1])) != geometry


def test_permutation_is_one(key: jm.Key):
    np.testing.assert_array_equal(np.sort(Choices(key, b"").permutation("rows", 1000)), np.arange(1000))


@pytest.mark.usefixtures("unchecked")
def test_key_hides_itself():
    key = jm.new_key()
    assert isinstance(key, bytes)
    assert len(key) == 32
    assert key != jm.new_key()
    for shown in (repr(key), str(key), f"{key}", f"{[key]}", f"{key!r}"):
        assert "jaxmark key" in shown
    for bad in (b"", b"x" * 31, "x" * 32):
        with pytest.raises(JaxmarkError, match="32 bytes"):
            jm.Key(bad)  # type: ignore[arg-type]


@pytest.mark.usefixtures("unchecked")
def test_key_files(tmp_path):
    path = tmp_path / "owner.key"
    key = jm.new_key()
    old = os.umask(0)
    try:
        jm.watermark.save_key(key, path)
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert jm.watermark.load_key(path) == key
    with pytest.raises(JaxmarkError, match="never overwritten"):
        jm.watermark.save_key(jm.new_key(), path)
    assert jm.watermark.load_key(path) == key
    for content in (b"", b"12" * 31, b"zz" * 32, b"\xff\xfe", key):
        bad = tmp_path / "bad.key"
        bad.write_bytes(content)
        with pytest.raises(JaxmarkError, match="no key file") as refusal:
            jm.watermark.load_key(bad)
        assert key.hex() not in str(refusal.value)
    with pytest.raises(JaxmarkError, match="cannot be read"):
        jm.watermark.load_key(tmp_path / "absent")
    with pytest.raises(JaxmarkError, match="cannot be written"):
        jm.watermark.save_key(key, tmp_path / "no" / "folder.key")


def test_equal_words_keep_their_order(monkeypatch):
    """Else the permutation would depend on the processor that sorts."""
    words = np.random.default_rng(0).integers(0, 7, 4000).astype("<u8")
    monkeypatch.setattr(Choices, "derive", lambda *_: words.tobytes())
    found = Choices(jm.Key(bytes(32)), b"").permutation("slots", len(words))
    np.testing.assert_array_equal(found, np.lexsort([np.arange(len(words)), words]))
