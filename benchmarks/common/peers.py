"""The filter f(Δ)x by other means, for `speed.py` and others: Chebyshev coefficients, evaluated by the recurrence.

Each function takes Δ - I as a SciPy matrix, coefficients and a signal, and returns a function that filters once.
"""

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from scipy import sparse

from jaxmark.errors import require
from jaxmark.spectral import Laplacian

Run = Callable[[], Any]


def by_scipy(shifted: sparse.csr_array, c: np.ndarray, x: np.ndarray) -> Run:
    """A CSR product in a Python loop, on one core; nothing is copied that need not be."""
    doubled = 2 * shifted

    def run() -> np.ndarray:
        before, current = x, shifted @ x
        total = c[0] * before + c[1] * current
        for c_k in c[2:]:
            following = doubled @ current
            following -= before
            total += c_k * following
            before, current = current, following
        return total

    return run


def by_pygsp(shifted: sparse.csr_array, c: np.ndarray, x: np.ndarray) -> Run:
    """`cheby_op` on our Δ in place of PyGSP's Laplacian: same numbers of vertices, non-zeros and terms.

    It takes the first coefficient twice, stores the diagonal, which is zero in Δ - I, and computes in float64 whatever
    it is given.
    """
    cheby_op = require("pygsp.filters.approximations", "peers").cheby_op
    laplacian = sparse.csr_matrix(shifted + sparse.eye_array(len(x), dtype=shifted.dtype))
    graph, twice = SimpleNamespace(N=len(x), L=laplacian, lmax=2.0), c * np.r_[2, np.ones(len(c) - 1)]
    return lambda: cheby_op(graph, twice, x)


def by_torch(shifted: sparse.csr_array, c: np.ndarray, x: np.ndarray) -> Run:
    """Sparse CSR products, each fused with the difference, on all cores or on the GPU that JAX computes on."""
    torch = require("torch", "peers")
    torch.set_num_threads(os.cpu_count() or 1)
    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    parts = (shifted.indptr, shifted.indices, shifted.data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that CSR is in beta
        matrix = torch.sparse_csr_tensor(*map(torch.from_numpy, parts), size=shifted.shape, device=device)
    first = torch.tensor(x, device=device)
    numbers = [float(c_k) for c_k in c]

    def run() -> Any:
        before, current = first, matrix @ first
        total = numbers[0] * before + numbers[1] * current
        for c_k in numbers[2:]:
            before, current = current, torch.addmm(before, matrix, current, beta=-1, alpha=2)
            total.add_(current, alpha=c_k)
        if device == "cuda":
            torch.cuda.synchronize()
        return total

    return run


@dataclass(frozen=True)
class Launched:
    """What a card computes, as JAX's own arrays: `jax.block_until_ready` waits for it, and NumPy reads it."""

    block_until_ready: Callable[[], None]
    read: Callable[[], np.ndarray]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        self.block_until_ready()
        return np.asarray(self.read(), dtype)


_STEP = r"""
extern "C" __global__ void step(const float4* __restrict__ current, float4* before, float4* total,
    const int* __restrict__ table, const float* __restrict__ own, const float* __restrict__ inverse,
    int rows, int slots, float factor, float c) {
  int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= rows) return;
  float4 s = make_float4(0, 0, 0, 0), x = current[i], b = before[i], t = total[i];
  for (int k = 0; k < slots; ++k) {
    float4 y = current[table[k * (long long)rows + i]];
    s.x += y.x; s.y += y.y; s.z += y.z; s.w += y.w;
  }
  float p = factor * own[i], q = factor * inverse[i];
  x = make_float4(p * x.x - q * s.x - b.x, p * x.y - q * s.y - b.y, p * x.z - q * s.z - b.z, p * x.w - q * s.w - b.w);
  before[i] = x;
  total[i] = make_float4(t.x + c * x.x, t.y + c * x.y, t.z + c * x.z, t.w + c * x.w);
}
"""


def by_cuda(operator: Laplacian, c: np.ndarray, x: np.ndarray) -> Run:
    """A kernel of one launch a degree on our table of neighbours, all launched as one graph; three float32 columns.

    It is near the limit of what one pass over the mesh a degree can do on a GPU. Edges have weight 1, and all have a
    slot in the table. CuPy has to be installed for the version of CUDA at hand; no extra does that.
    """
    cupy = require("cupy", "peers")
    kernel, table = cupy.RawModule(code=_STEP).get_function("step"), operator.neighbours
    if table is None or len(table.rest) or operator.weights is not None:
        raise ValueError("the kernel takes meshes whose neighbours all have slots, with weights 1")
    (slots, rows), same = np.shape(table.vertices), np.arange(len(x))
    order, rank = (same if part is None else np.asarray(part) for part in (table.order, table.rank))
    degree = np.asarray(operator.degree)[order]
    inverse = np.where(degree > 0, 1 / np.maximum(degree, 1), 0)
    own = (degree > 0) - 1 + inverse * np.asarray(table.empty)
    arrays = [cupy.asarray(part, dtype) for part, dtype in ((table.vertices, "i4"), (own, "f4"), (inverse, "f4"))]
    first = cupy.asarray(np.pad(x[order], ((0, 0), (0, 1))))
    one, other, total = (cupy.zeros_like(first) for _ in range(3))
    stream = cupy.cuda.Stream(non_blocking=True)

    def launch() -> None:
        one[...], other[...] = first, 0
        cupy.multiply(first, np.float32(c[0]), out=total)
        current, before = one, other
        for k, c_k in enumerate(c[1:]):
            numbers = (np.int32(rows), np.int32(slots), np.float32(2 if k else 1), np.float32(c_k))
            kernel((-(-rows // 256),), (256,), (current, before, total, *arrays, *numbers))
            current, before = before, current

    with stream:
        launch()  # what CuPy compiles for it cannot be compiled while a graph is recorded
        stream.synchronize()
        stream.begin_capture()
        launch()
        graph = stream.end_capture()

    def run() -> Launched:
        graph.launch(stream)
        return Launched(stream.synchronize, lambda: cupy.asnumpy(total)[rank, :3])

    return run


PEERS: Mapping[str, Callable[[sparse.csr_array, np.ndarray, np.ndarray], Run]] = {
    "SciPy CSR, Python loop": by_scipy,
    "PyGSP cheby_op, float64": by_pygsp,
    "torch.sparse CSR": by_torch,
}


def installed(package: str) -> str:
    """A package's version, or that it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
