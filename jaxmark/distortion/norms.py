"""Roots, ratios, norms and percentiles whose derivatives are finite where those of the plain formulas are not."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from jaxmark.errors import JaxmarkError

Tree = TypeVar("Tree")
Positions = Float[Array, "vertices 3"]
PerVertex = Float[Array, " vertices"]
Scalar = Float[Array, ""]


def check_alike(name: str, original: Positions, distorted: Positions) -> None:
    """Refuse positions of different meshes: rows that are missing would be read as others, without an error.

    Raises:
        JaxmarkError: if their shapes differ.
    """
    if jnp.shape(original) != jnp.shape(distorted):
        raise JaxmarkError(
            f"{name} compares positions of the same vertices, got the shapes {jnp.shape(original)} and"
            f" {jnp.shape(distorted)}."
        )


def root(square: Any, xp: Any = jnp) -> Any:
    """√square of numbers of any shape, by JAX or by NumPy; 0 with gradient 0 where `square` is not positive."""
    return _where_positive(xp.sqrt, square, xp)


def cube_root(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Compute ∛values; 0 with gradient 0 for values that are not positive."""
    return _where_positive(jnp.cbrt, values)


def inverse_root(square: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1/√square; 0 with gradient 0 where `square` is not positive."""
    return _where_positive(jax.lax.rsqrt, square)


def _where_positive(function: Callable[[Any], Any], x: Any, xp: Any = jnp) -> Any:
    positive = x > 0
    return xp.where(positive, function(xp.where(positive, x, 1)), 0)


def ratio(numerator: Float[Array, "*shape"], denominator: Float[Array, "*#shape"]) -> Float[Array, "*shape"]:
    """Divide the numerator by the denominator; 0 with gradient 0 for denominators that are not positive."""
    positive = denominator > 0
    return jnp.where(positive, numerator / jnp.where(positive, denominator, 1), 0)


def with_dtype(tree: Tree, dtype: DTypeLike) -> Tree:
    """Convert the arrays of a tree to JAX's, numbers with fractions to `dtype`."""

    def one(leaf: Any) -> Array:
        # `jnp.asarray` would compile a program for each shape.
        return jax.device_put(leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf)

    return jax.tree.map(one, tree)


def lengths(x: Float[Array, "rows 3"]) -> Float[Array, " rows"]:
    """Compute the lengths of vectors; the gradient at 0 is 0."""
    return root(jnp.sum(x**2, axis=1))


def rms(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Scalar | np.ndarray:
    """Compute the unweighted root mean square √(mean over v of |d_v|²); the gradient at 0 is 0.

    A NumPy array gives a NumPy result, so that float64 stays float64 on the host.
    """
    xp: Any = np if isinstance(displacement, np.ndarray) else jnp
    return root(xp.mean(xp.sum(displacement**2, axis=-1)), xp)


def maximum(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Scalar | np.ndarray:
    """Compute the largest |d_v| over the vertices, in the units of `displacement`; the gradient at 0 is 0."""
    xp: Any = np if isinstance(displacement, np.ndarray) else jnp
    return root(xp.max(xp.sum(displacement**2, axis=-1)), xp)


def cubic_mean(values: PerVertex) -> Scalar:
    """Compute the cube root of the mean of cubes; the gradient at 0 is 0."""
    return cube_root(jnp.mean(values**3))


def percentile(values: PerVertex, weights: PerVertex, share: float | Scalar) -> Scalar:
    """Find the least value at or below which lies `share` (0 to 1) of the weight; the gradient is that of this value.

    **Values and weights must not be negative**: such numbers are ordered as the integers that their bits are, and these
    are bisected, which takes a tenth of the time of sorting.
    """
    size = 8 * values.dtype.itemsize
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values), jnp.dtype(f"int{size}"))
    weights = weights.astype(values.dtype)
    enough = jnp.asarray(share).astype(values.dtype) * jnp.sum(weights)

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = low + (high - low) // 2
        inside = jnp.sum(jnp.where(bits <= middle, weights, 0)) >= enough
        return jnp.where(inside, low, middle + 1), jnp.where(inside, middle, high)

    most = jnp.max(bits)
    found, _ = jax.lax.fori_loop(0, size, halve, (jnp.zeros_like(most), most))
    return values[jnp.argmin(jnp.where(bits >= found, bits, jnp.iinfo(bits.dtype).max))]
