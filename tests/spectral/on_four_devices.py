"""What needs four devices: `test_sharding.py` runs this file in a process that has them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral import chebyshev, sharding
from jaxmark.spectral.graphs import from_mesh
from tests.dense import laplacian_matrix, tolerance

pytestmark = pytest.mark.skipif("jax.device_count() < 4", reason="needs four devices")


def close(found, expected, dtype) -> None:
    """To rounding: relative 1e-5 in float32, 1e-12 in float64."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.dtype == expected.dtype == dtype
    assert np.abs(found - expected).max() <= {4: 1e-5, 8: 1e-12}[dtype.itemsize] * np.abs(expected).max()


@pytest.mark.parametrize(
    ("along", "lowering", "count", "columns"),
    [("curve", "gather", 4, ()), ("graph", "segments", 3, (2,))],
)  # neither 3 nor 4 divides 642
def test_filter_and_gradients_are_those_of_one_device(sphere: Mesh, along, lowering, count, columns, dtype):
    operator = from_mesh(sphere, "cotangent", lowering=lowering)
    positions = sphere.vertices if along == "curve" else None
    sharded = sharding.shard(operator, jax.devices()[:count], positions)
    random = np.random.default_rng(0)
    x = random.normal(size=(642, *columns)).astype(dtype)
    c = random.normal(size=(*columns, 12)).astype(dtype)
    there = sharded.scatter(x)
    assert [shard.data.shape for shard in there.addressable_shards] == [(1, -(-642 // count), *columns)] * count
    np.testing.assert_array_equal(sharded.gather(there), x)

    @partial(jax.jit, static_argnums=0)
    def derived(filter, operator, c, x):
        def loss(c, x):
            y = filter(operator, c, x)
            return jnp.sum(jnp.sin(y)), y

        return jax.grad(loss, (0, 1), has_aux=True)(c, x)

    (c_bar, x_bar), y = derived(sharding.filter_sharded, sharded, c, there)
    (c_expected, x_expected), expected = derived(chebyshev.filter, operator, c, x)
    assert y.sharding.is_equivalent_to(there.sharding, y.ndim)
    close(sharded.gather(y), expected, dtype)
    close(c_bar, c_expected, dtype)
    close(sharded.gather(x_bar), x_expected, dtype)


def test_parts_of_a_hard_graph(hard_graph: Mesh, dtype):
    """Isolated vertices and several components; one device's block has hardly an edge."""
    operator = from_mesh(hard_graph)
    x = np.random.default_rng(1).normal(size=(11, 3)).astype(dtype)
    for count in (1, 2, 4):
        sharded = sharding.shard(operator, jax.devices()[:count])
        # The series λ = T_1 + T_0 is Δ itself.
        found = sharded.gather(sharding.filter_sharded(sharded, np.ones(2, dtype), sharded.scatter(x)))
        np.testing.assert_allclose(found, laplacian_matrix(operator) @ x, atol=tolerance(dtype))


def test_more_devices_than_some_blocks_have_neighbours(x64):
    """A path in one piece and four vertices on four devices: every edge is cut."""
    mesh = Mesh(np.eye(4, 3), np.array([[0, 1, 1], [1, 2, 2], [2, 3, 3]]))
    operator = from_mesh(mesh)
    sharded = sharding.shard(operator, jax.devices()[:4])
    assert sharding.traffic(sharded) == (6, 6, 3)
    found = sharded.gather(sharding.filter_sharded(sharded, np.ones(2), sharded.scatter(mesh.vertices)))
    np.testing.assert_allclose(found, laplacian_matrix(operator) @ mesh.vertices, atol=1e-12)


def test_what_is_refused(sphere: Mesh, unchecked):
    operator = from_mesh(sphere)
    parts = sharding.partition(operator, 4)
    sharded = sharding.place(parts, jax.devices()[:4])
    x = np.asarray(sphere.vertices)
    for refused in (
        lambda: sharding.place(parts, jax.devices()[:3]),
        lambda: sharding.place(parts, jax.devices()[:1] * 4),
        lambda: parts.scatter(x),
        lambda: sharded.scatter(x[1:]),
        lambda: sharded.gather(jnp.zeros((3, 4))),
        lambda: sharding.filter_sharded(sharded, np.ones(3), jnp.zeros((3, 4))),
        lambda: sharding.filter_sharded(sharded, np.ones((2, 3)), sharded.scatter(x)),
    ):
        with pytest.raises(JaxmarkError):
            refused()
