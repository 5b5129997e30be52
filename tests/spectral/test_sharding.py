"""Several devices need processes of their own: a backend, once started, keeps its devices."""

import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import chebyshev, sharding
from jaxmark.spectral.graphs import from_mesh
from tests import ROOT
from tests.samples import bumpy_sphere

pytestmark = [pytest.mark.core, pytest.mark.processor]


def start(*arguments: str, devices: int | None = None) -> subprocess.Popen[str]:
    """This Python once more, from the project's root."""
    flags = {} if devices is None else {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)} | flags
    command = [sys.executable, *arguments]
    output = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, text=True)


@pytest.mark.slow
def test_on_four_devices():
    tests = start("-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/spectral/on_four_devices.py", devices=4)
    output, _ = tests.communicate(timeout=120)
    assert tests.returncode == 0, output
    assert "skipped" not in output


@pytest.mark.long
def test_in_two_processes():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    both = [start("tests/spectral/in_two_processes.py", str(index), port) for index in range(2)]
    try:
        outputs = [one.communicate(timeout=120)[0] for one in both]
    finally:
        for one in both:
            one.kill()
    assert [one.returncode for one in both] == [0, 0], "\n".join(outputs)


@pytest.mark.parametrize("along", ["curve", "graph"])
@pytest.mark.parametrize("count", [2, 3, 4, 8, 32])
def test_traffic_is_within_a_fifth_of_the_edge_cut(count, along):
    mesh = bumpy_sphere(5)
    operator = from_mesh(mesh)
    parts = sharding.partition(operator, count, mesh.vertices if along == "curve" else None)
    # Counted once more from the definitions.
    device = np.empty(len(mesh.vertices), int)
    device[parts.vertices[parts.vertices >= 0]] = np.nonzero(parts.vertices >= 0)[0]
    ends = device[operator.edges]
    cut = operator.edges[ends[:, 0] != ends[:, 1]]
    needed = {(v, device[w]) for v, w in np.concatenate([cut, cut[:, ::-1]]).tolist()}
    found = sharding.traffic(parts)
    assert found[1:] == (len(needed), len(cut))
    assert found.needed <= found.sent <= 1.2 * found.cut
    assert found.per_cut_edge == found.sent / found.cut
    for pairs in parts.plan.rounds:
        assert all(len(set(ends)) == len(pairs) for ends in zip(*pairs, strict=True))


def test_every_vertex_is_in_one_place_and_blocks_are_equal(sphere: Mesh):
    for count in (1, 5, 64, 642):
        vertices = sharding.partition(from_mesh(sphere), count, sphere.vertices).vertices
        sizes = (vertices >= 0).sum(axis=1)
        assert sizes.max() - sizes.min() <= 1
        np.testing.assert_array_equal(np.sort(vertices[vertices >= 0]), np.arange(642))


def test_the_curve_passes_each_cell_of_a_grid_by_steps_of_one():
    """Hilbert's, by its definition: consecutive cells are neighbours."""
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3)
    mesh = Mesh(cells.astype(float), np.zeros((0, 3), int))
    order = sharding.partition(from_mesh(mesh), 1, mesh.vertices).vertices[0]
    assert (np.abs(np.diff(cells[order], axis=0)).sum(axis=1) == 1).all()


def test_one_device_in_this_process(sphere: Mesh):
    operator = from_mesh(sphere)
    sharded = sharding.shard(operator, jax.devices()[:1])
    x = np.asarray(sphere.vertices, np.float32)
    c = jnp.asarray([1.0, -2.0, 0.5], jnp.float32)
    found = sharded.gather(sharding.filter_sharded(sharded, c, sharded.scatter(x)))
    np.testing.assert_allclose(found, chebyshev.filter(operator, c, x), atol=1e-6)
    assert sharding.traffic(sharded) == (0, 0, 0)
    assert sharding.traffic(sharded).per_cut_edge == 0


def test_what_is_refused(sphere: Mesh, unchecked):
    operator = from_mesh(sphere)
    for count, positions in [(643, None), (0, None), (2, np.zeros((3, 3))), (2, np.full((642, 3), np.nan))]:
        with pytest.raises(JaxmarkError):
            sharding.partition(operator, count, positions)
