"""Compiled kernels of the recurrence for processors, where the distribution `jaxmark-kernels` is installed.

They compute several degrees on a block of rows while it is in cache (matrix-power blocking: Alappat, Hager, Schenk,
Wellein, "Level-based blocking for sparse matrices: sparse matrix-power-vector multiplication", IEEE TPDS 34(2), 2023),
where a scan in XLA reads all rows again for each degree. Their results agree with those of the scan to rounding, so
that the two need no option: kernels are used where they are installed, in programs for processors.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

Computation = Callable[..., Array]


class Rows(NamedTuple):
    """The rows of Δ - I as arrays: (Δ - I)x at a row is `own` x - `inverse` Σ_s `weights`_s x[`table`_s]."""

    table: Int[Array | np.ndarray, "slots rows"]
    weights: Float[Array, "slots rows"] | None  # None if all are 1
    own: Float[Array, " rows"]
    inverse: Float[Array, " rows"]
    rest: Int[Array | np.ndarray, "rest 3"]  # row, column and anything, of entries without a slot, by rows
    rest_weights: Float[Array, " rest"] | None  # None if all are 1
    order: Int[Array | np.ndarray, " rows"] | None  # the vertex of each row; None if the orders are the same


@cache
def installed() -> bool:
    """Whether there are kernels; the first call registers them with JAX."""
    try:
        from jaxmark_kernels import TARGETS  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    for name, target in TARGETS.items():
        jax.ffi.register_ffi_target(f"jaxmark_{name}", target, platform="cpu")
    return True


def where_installed(kernel: Computation | None, scan: Computation) -> Computation:
    """Choose between two ways to compute a function of an operator and arrays on processors.

    Args:
        kernel: called with `Rows` and the arrays, of which the last is the signal; None if there is none.
        scan: called with the operator and the arrays, where no kernel is installed or the operator has no `Rows`.
    """
    if kernel is None:
        return scan

    def compute(operator: Any, *arrays: Array) -> Array:
        rows = operator.rows(arrays[-1]) if installed() and arrays[-1].size else None
        return scan(operator, *arrays) if rows is None else kernel(rows, *arrays)

    return compute


def filter_rows(rows: Rows, c: Float[Array, " terms *series"], x: Float[Array, " rows *columns"]) -> Array:
    """Compute f(Δ)x of a Chebyshev series for each column of x, if it has columns, or for all."""
    return component_rows(rows, c[None], x)[0]


def component_rows(rows: Rows, c: Float[Array, "bands terms *series"], x: Float[Array, " rows *columns"]) -> Array:
    """Compute all f_b(Δ)x, as `filter_rows`: `[bands, *x.shape]`."""
    columns = x.reshape(len(x), -1)
    series = c if c.ndim == 3 else c[..., None]
    result = jax.ShapeDtypeStruct((len(series), *columns.shape), x.dtype)
    return _call("filter", result, rows, series, columns).reshape(len(series), *x.shape)


def project_rows(terms: int, rows: Rows, x: Float[Array, " rows *columns"], u: Float[Array, " rows *columns"]) -> Array:
    """Compute Σ_v u_v (T_k(Δ - I)x)_v for each of some k, column by column: `[terms, *columns]`."""
    columns = x.reshape(len(x), -1)
    result = jax.ShapeDtypeStruct((terms, columns.shape[1]), x.dtype)
    return _call("project", result, rows, columns, u.reshape(columns.shape)).reshape(terms, *x.shape[1:])


def _call(name: str, result: jax.ShapeDtypeStruct, rows: Rows, *arrays: Array) -> Array:
    dtype = result.dtype
    given = [np.zeros(0, dtype) if part is None else part for part in rows[:-1]]
    order = np.zeros(0, np.int32) if rows.order is None else rows.order
    # Members of a batch run one after the other; each keeps all cores busy.
    return jax.ffi.ffi_call(f"jaxmark_{name}_{dtype}", result, vmap_method="sequential")(*given, order, *arrays)
