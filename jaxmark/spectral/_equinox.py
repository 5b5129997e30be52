"""Learned filters as Equinox modules. Needs the extra `learned`; import them from `jaxmark.spectral.learned`."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.spectral.laplacian import Operator
from jaxmark.spectral.learned import Form, cheb_conv, init_cheb_conv


class ChebConv(eqx.Module):
    """Chebyshev convolution as an Equinox module, called as `layer(operator, x)`; see `cheb_conv`.

    Attributes:
        weight: `[degree + 1, inputs, outputs]`.
        bias: `[outputs]`.
        form: the matrix that polynomials are taken of; static.
    """

    weight: Float[Array | np.ndarray, "terms inputs outputs"]
    bias: Float[Array | np.ndarray, " outputs"]
    form: Form = eqx.field(static=True)

    def __init__(
        self, inputs: int, outputs: int, degree: int, *, form: Form = "random-walk", key: PRNGKeyArray
    ) -> None:
        """Draw the parameters; for the arguments, see `init_cheb_conv` and `cheb_conv`."""
        drawn = init_cheb_conv(key, inputs, outputs, degree)
        self.weight, self.bias, self.form = drawn["weight"], drawn["bias"], form

    def __call__(
        self, operator: Operator, x: Float[Array | np.ndarray, "vertices inputs"]
    ) -> Float[Array, "vertices outputs"]:
        """Convolve a signal; see `cheb_conv`."""
        return cheb_conv(operator, {"weight": self.weight, "bias": self.bias}, x, form=self.form)


# Pickles and pages name it by where it is imported from.
ChebConv.__module__ = "jaxmark.spectral.learned"
