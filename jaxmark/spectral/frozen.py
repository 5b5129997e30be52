"""Operators as parts of trained models that no optimiser changes.

An optimiser changes all floating-point leaves of a model, so a Laplacian among its fields would drift away from its
graph: its degrees would no longer be sums of its weights. Keep operators out of models and pass them as arguments, or
freeze them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.lax import bitcast_convert_type as bitcast
from jaxtyping import Array

from jaxmark.spectral.laplacian import Laplacian

_WHOLE = {2: jnp.int16, 4: jnp.int32, 8: jnp.int64}  # by the size of a number in bytes
_FLOATING = ("weights", "degree", "lumped_mass", "scale")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrozenLaplacian:
    """A Laplacian whose floating-point arrays are stored as whole numbers, which no optimiser takes for parameters.

    It is a pytree. Gradients, weight decay and casts to other precisions leave it as it is.
    """

    bits: Laplacian  # the operator, with the bit patterns of its floating-point arrays

    @property
    def operator(self) -> Laplacian:
        """The operator, for filters; derivatives with respect to it are zero."""
        return _converted(self.bits, lambda bits: bitcast(bits, jnp.dtype(f"float{8 * bits.dtype.itemsize}")))


def freeze(operator: Laplacian) -> FrozenLaplacian:
    """Freeze an operator, so that it can be a field of a model that is trained; use its `operator` for filters.

    The arrays take JAX's default precision: float32, unless `jax_enable_x64` is set. To train weights of edges, do not
    freeze the operator, but make it in each step by `Laplacian.with_weights`.
    """
    return FrozenLaplacian(_converted(operator, lambda values: bitcast(values, _WHOLE[values.dtype.itemsize])))


def _converted(operator: Laplacian, convert: Callable[[Array], Array]) -> Laplacian:
    """Convert the fields that have, or stand for, floating-point numbers; those that are None stay None."""
    fields = {name: getattr(operator, name) for name in _FLOATING}
    return operator._replace(**jax.tree.map(lambda values: convert(jnp.asarray(values)), fields))
