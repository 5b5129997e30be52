"""One filter against SciPy, same work, one run: python benchmarks/filter.py MESH [--degree 64] [--repeat 5].

Three float32 columns through a Chebyshev series: SciPy's CSR product in a Python loop, ours, and ours with both
gradients. Medians over the repeats, and ratios.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from jaxmark import load_mesh
from jaxmark.chebyshev import filter
from jaxmark.laplacian import centre, make_laplacian, sparse_matrices
from jaxmark.mesh import weld, welded_mesh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--degree", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    mesh = load_mesh(arguments.mesh)
    points = welded_mesh(mesh, weld(np.asarray(mesh.vertices)))
    operator = make_laplacian(points)
    x = centre(operator, np.asarray(points.vertices)).astype(np.float32)
    c = np.random.default_rng(0).normal(size=arguments.degree + 1).astype(np.float32)

    stiffness, mass = sparse_matrices(operator)
    degree = mass.diagonal()
    inverse = sparse.diags_array(np.where(degree > 0, 1 / np.where(degree > 0, degree, 1), 0))
    shifted = sparse.csr_array(inverse @ stiffness - sparse.eye_array(len(x)), dtype=np.float32)

    def by_scipy() -> np.ndarray:
        before, current = x, shifted @ x
        total = c[0] * before + c[1] * current
        for c_k in c[2:]:
            before, current = current, 2 * (shifted @ current) - before
            total += c_k * current
        return total

    traced = jax.tree.map(jnp.asarray, operator)
    forward = jax.jit(lambda c, x: filter(traced, c, x))
    both = jax.jit(jax.value_and_grad(lambda c, x: jnp.sum(filter(traced, c, x) ** 2), (0, 1)))
    cj, xj = jnp.asarray(c), jnp.asarray(x)
    error = np.abs(np.asarray(forward(cj, xj)) - by_scipy()).max() / np.abs(by_scipy()).max()
    seconds = {
        "SciPy CSR": median_time(by_scipy, arguments.repeat),
        "filter": median_time(lambda: jax.block_until_ready(forward(cj, xj)), arguments.repeat),
        "value and both gradients": median_time(lambda: jax.block_until_ready(both(cj, xj)), arguments.repeat),
    }
    print(f"{arguments.mesh}: {len(x)} points, degree {arguments.degree}, largest relative difference {error:.1e}")
    for name, value in seconds.items():
        print(f"{name:<26} {value * 1e3:9.1f} ms   {value / seconds['filter']:5.2f} x filter")


def median_time(function: Callable[[], object], repeat: int) -> float:
    """Median seconds of a call, after one that does not count."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


if __name__ == "__main__":
    main()
