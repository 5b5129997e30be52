"""Learned filters: graph convolution by Chebyshev polynomials of the Laplacian, as layers of neural networks.

`cheb_conv` is a function of a dictionary of arrays, for any optimiser; `ChebConv` is the same as an Equinox module
(extra `learned`). Reference: Defferrard, Bresson, Vandergheynst, "Convolutional Neural Networks on Graphs with Fast
Localized Spectral Filtering", NeurIPS 2016, eq. 4 – 5.
"""

from collections.abc import Mapping
from functools import cache, partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.errors import JaxmarkError, available, require
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.laplacian import Operator, checked_signal
from jaxmark.spectral.recurrence import convolution, inner_mass

Form = Literal["random-walk", "symmetric", "transposed"]

_POWERS: Mapping[Form, float] = {"random-walk": 0.0, "symmetric": 0.5, "transposed": 1.0}


def __getattr__(name: str) -> Any:
    if name != "ChebConv":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("equinox", "learned")
    return _equinox_module()


def __dir__() -> list[str]:
    return [*globals(), *(["ChebConv"] if available("equinox") else [])]


@cache
def _equinox_module() -> type:
    """Make the class when it is first used, since Equinox may not be installed."""
    import equinox as eqx

    class ChebConv(eqx.Module):
        """Chebyshev convolution as an Equinox module, called as `layer(operator, x)`; see `cheb_conv`.

        Attributes:
            weight: `[inputs, outputs, degree + 1]`.
            bias: `[outputs]`.
            form: the matrix that polynomials are taken of; static.
        """

        weight: Float[Array | np.ndarray, "inputs outputs terms"]
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

    ChebConv.__qualname__ = "ChebConv"  # pickles name a class by where it is imported from
    return ChebConv


def init_cheb_conv(seed: Seed, inputs: int, outputs: int, degree: int) -> dict[str, Float[Array, "..."]]:
    """Draw the parameters of a Chebyshev convolution.

    Args:
        seed: a number or a JAX random key.
        inputs: number of columns of the signals that go in.
        outputs: number of columns that come out.
        degree: of the polynomials, at least 0; one less than the K of PyTorch Geometric.

    Returns:
        `"weight"`, `[inputs, outputs, degree + 1]`, uniform within ±√(6/(inputs + outputs)) (Glorot, Bengio 2010), and
        `"bias"`, `[outputs]`, zeros; both in JAX's default precision.

    Raises:
        JaxmarkError: if there is no column, or the degree is negative.
    """
    if min(inputs, outputs) < 1 or degree < 0:
        raise JaxmarkError(
            f"A Chebyshev convolution has one input and output at least and a degree of 0 or more, got {inputs},"
            f" {outputs} and {degree}."
        )
    limit = (6 / (inputs + outputs)) ** 0.5
    by_term = jax.random.uniform(random_key(seed), (degree + 1, inputs, outputs), minval=-limit, maxval=limit)
    return {"weight": jnp.moveaxis(by_term, 0, -1), "bias": jnp.zeros(outputs, by_term.dtype)}


@partial(jax.jit, static_argnames="form")
def cheb_conv(
    operator: Operator,
    parameters: Mapping[str, Float[Array | np.ndarray, "..."]],
    x: Float[Array | np.ndarray, "vertices inputs"],
    *,
    form: Form = "random-walk",
) -> Float[Array, "vertices outputs"]:
    """Convolve a signal: y = Σ_k T_k(Δ - I) x W_k + b, by `degree` products with Δ and one `lax.scan`.

    It takes O(N) memory at any degree, and so do its derivatives, which are as those of
    `jaxmark.spectral.chebyshev.filter`: x̄ is a convolution with the transposed weights, since Δ is self-adjoint, and
    W̄_k = (T_k x)ᵀȳ is computed by running the recurrence again.

    The weights of a `ChebConv` of PyTorch Geometric, trained with its default normalisation, serve in the symmetric
    form as `{"weight": np.stack([lin.weight.T for lin in layer.lins], -1), "bias": layer.bias}`, of NumPy arrays; those
    trained with "rw", which propagates against the edges' direction, in the transposed form. Only isolated vertices
    differ: their eigenvalue is 0 here and 1 there.

    Args:
        operator: the Laplacian, of N vertices.
        parameters: `"weight"`, `[inputs, outputs, degree + 1]`, the Chebyshev series of the filter from each input to
            each output, and `"bias"`, `[outputs]`; see `init_cheb_conv`.
        x: `[N, inputs]`.
        form: the matrix that polynomials are taken of: `"random-walk"`, Δ itself, by which a constant signal stays
            constant; `"symmetric"`, M^½ΔM^-½, for M = D that of the paper, I - D^-½WD^-½; `"transposed"`, Δᵀ = MΔM⁻¹.

    Returns:
        `[N, outputs]`, in the dtype of `x`.

    Raises:
        JaxmarkError: if shapes do not fit, the signal is not floating, or the form is unknown.
    """
    x = checked_signal("cheb_conv", operator, x)
    weight, bias = (jnp.asarray(parameters[name]) for name in ("weight", "bias"))
    if x.ndim != 2:
        raise JaxmarkError(f"cheb_conv needs a signal [N, inputs], got {x.shape}.")
    if weight.ndim != 3 or not weight.shape[2] or weight.shape[:2] != (x.shape[1], *bias.shape):
        raise JaxmarkError(
            f"cheb_conv needs weight [{x.shape[1]}, outputs, degree + 1] and bias [outputs], got {weight.shape} and"
            f" {bias.shape}."
        )
    if form not in get_args(Form):
        raise JaxmarkError(f"form is {', '.join(map(repr, get_args(Form)))}, not {form!r}.")
    weight, bias = jnp.moveaxis(weight, -1, 0).astype(x.dtype), bias.astype(x.dtype)
    if form == "random-walk":
        return convolution(operator, weight, x) + bias
    scale = inner_mass(operator, x) ** _POWERS[form]
    return scale * convolution(operator, weight, x / scale) + bias
