"""The filter f(Δ)x in other libraries, for `speed.py`: Chebyshev coefficients, evaluated by the recurrence.

Each function takes Δ - I as a SciPy matrix, coefficients and a signal, and returns a function that filters once.
"""

import os
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from scipy import sparse

from jaxmark.errors import require

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
