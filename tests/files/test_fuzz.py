"""Whatever bytes a file holds, it is read or refused in one sentence."""

from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from tests.files import test_glb, test_obj, test_off, test_ply, test_stl, test_threemf

pytestmark = pytest.mark.core

SEEDS = {
    "rich.obj": test_obj.RICH,
    "rich.off": test_off.RICH,
    "normals.off": test_off.NORMALS,
    "text.ply": test_ply.ASCII,
    "little.ply": test_ply.binary("<", "f", True)[0],
    "big.ply": test_ply.binary(">", "d", False)[0],
    "text.stl": test_stl.ASCII,
    "binary.stl": test_stl.binary([([0, -1, 0], [0, 0, 0, 1, 0, 0, 0, 0, 1], 7)]),
    "rich.glb": test_glb.RICH,
    "rich.3mf": test_threemf.packed({"3D/3dmodel.model": test_threemf.FINE, "last.txt": b"the end"}),
    "stream.3mf": test_threemf.streamed(True, b"PK\7\x08", True, test_threemf.FINE),
    "model.3mf": test_threemf.FINE,
}
# Whose bytes are changed before they are packed, as archives notice any change.
PACKED = {"model.3mf": lambda model: test_threemf.packed({"3D/3dmodel.model": model})}
BITS = [b"", b" ", b"\n", b"-", b"0", b"9" * 30, b"1e999", b"nan", b"-0", b"\\\n", b"/", b"_", b"\0", b"\xff" * 4, b"#"]
CHANGE = st.tuples(st.floats(0, 1), st.integers(0, 6), st.sampled_from(BITS) | st.binary(max_size=4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("name", SEEDS)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(CHANGE, min_size=1, max_size=4), kept=st.just(1.0) | st.floats(0, 1))
def test_mutated_files(folder: Path, name: str, changes: list[tuple[float, int, bytes]], kept: float) -> None:
    data = SEEDS[name]
    for where, removed, put in changes:
        at = int(where * len(data))
        data = data[:at] + put + data[at + removed :]
    path = folder / name
    data = data[: int(kept * len(data))]
    path.write_bytes(PACKED[name](data) if name in PACKED else data)
    try:
        mesh = load_mesh(path)
        noise = np.random.default_rng(0).normal(size=np.shape(mesh.vertices))
        moved = mesh._replace(vertices=np.asarray(mesh.vertices) + 0.1 * noise)
        save_mesh(moved, folder / f"out-{name}", like=path)
    except JaxmarkError as error:
        assert str(error).endswith(".")  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
        return
    again = load_mesh(folder / f"out-{name}")
    np.testing.assert_array_equal(again.faces, mesh.faces)
    displaced, rounded = (
        np.sqrt(np.square(moved.vertices - other.vertices).sum(axis=1).mean()) for other in (mesh, again)
    )
    assert rounded <= 0.91 * displaced
