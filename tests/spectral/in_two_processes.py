"""One of two processes with two devices each: python tests/spectral/in_two_processes.py INDEX PORT.

`test_sharding.py` runs it; pytest does not collect it.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxmark.spectral import chebyshev, sharding
from jaxmark.spectral.graphs import from_mesh
from tests.samples import bumpy_sphere


def main(index: int, port: str) -> None:
    """Filter and differentiate with half of the parts here, and compare with this process alone."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    jax.distributed.initialize(f"localhost:{port}", num_processes=2, process_id=index)
    mesh = bumpy_sphere(3)
    operator = from_mesh(mesh)
    sharded = sharding.shard(operator, jax.devices(), mesh.vertices)
    x, c = np.asarray(mesh.vertices), np.random.default_rng(0).normal(size=12)
    there = sharded.scatter(x)
    for leaf in jax.tree.leaves((sharded, there)):
        assert leaf.shape[0] == 4
        assert [shard.index[0].start for shard in leaf.addressable_shards] == [2 * index, 2 * index + 1]

    def loss(c, x, operator):
        return jnp.sum(jnp.sin(sharding.filter_sharded(operator, c, x)))

    found = jax.jit(jax.grad(loss, (0, 1)))(c, there, sharded)
    expected = jax.grad(lambda c, x: jnp.sum(jnp.sin(chebyshev.filter(operator, c, x))), (0, 1))(c, x)
    pairs = [
        (sharded.gather(sharding.filter_sharded(sharded, c, there)), chebyshev.filter(operator, c, x)),
        (found[0], expected[0]),
        (sharded.gather(found[1]), expected[1]),
    ]
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * float(np.abs(other).max()))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
