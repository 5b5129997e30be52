"""Learned filters: graph convolution by Chebyshev polynomials of the Laplacian, as layers of neural networks.

Functions of a dictionary of arrays, for any optimiser, and `ChebConv`, the same as an Equinox module (extra `learned`).
Reference: Defferrard, Bresson, Vandergheynst, "Convolutional Neural Networks on Graphs with Fast Localized Spectral
Filtering", NeurIPS 2016, eq. 4 – 5.
"""

import importlib.util
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.spectral.laplacian import Operator, check_signal
from jaxmark.spectral.recurrence import convolution, inner_mass

if TYPE_CHECKING:
    from jaxmark.spectral._equinox import ChebConv as ChebConv

Form = Literal["random-walk", "symmetric", "transposed"]

_POWERS: Mapping[Form, float] = {"random-walk": 0.0, "symmetric": 0.5, "transposed": 1.0}


def __getattr__(name: str) -> Any:
    if name == "ChebConv":  # imported when it is first used, since Equinox may not be there
        require("equinox", "learned")
        from jaxmark.spectral._equinox import ChebConv

        return ChebConv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *(["ChebConv"] if importlib.util.find_spec("equinox") else [])]


def init_cheb_conv(key: PRNGKeyArray, inputs: int, outputs: int, degree: int) -> dict[str, Float[Array, "..."]]:
    """Draw the parameters of a Chebyshev convolution.

    Args:
        key: any random key.
        inputs: number of columns of the signals that go in.
        outputs: number of columns that come out.
        degree: of the polynomials, at least 0; one less than the K of PyTorch Geometric.

    Returns:
        `"weight"`, `[degree + 1, inputs, outputs]`, uniform within ±√(6/(inputs + outputs)) (Glorot, Bengio 2010), and
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
    weight = jax.random.uniform(key, (degree + 1, inputs, outputs), minval=-limit, maxval=limit)
    return {"weight": weight, "bias": jnp.zeros(outputs, weight.dtype)}


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
    form as `{"weight": [lin.weight.T for lin in layer.lins], "bias": layer.bias}`, stacked as NumPy arrays; those
    trained with "rw", which propagates against the edges' direction, in the transposed form. Only isolated vertices
    differ: their eigenvalue is 0 here and 1 there.

    Args:
        operator: the Laplacian, of N vertices.
        parameters: `"weight"`, `[degree + 1, inputs, outputs]`, and `"bias"`, `[outputs]`; see `init_cheb_conv`.
        x: `[N, inputs]`.
        form: the matrix that polynomials are taken of: `"random-walk"`, Δ itself, by which a constant signal stays
            constant; `"symmetric"`, M^½ΔM^-½, for M = D that of the paper, I - D^-½WD^-½; `"transposed"`, Δᵀ = MΔM⁻¹.

    Returns:
        `[N, outputs]`, in the dtype of `x`.

    Raises:
        JaxmarkError: if shapes do not fit, the signal is not floating, or the form is unknown.
    """
    x = jnp.asarray(x)
    weight, bias = (jnp.asarray(parameters[name]) for name in ("weight", "bias"))
    check_signal("cheb_conv", operator, x)
    if x.ndim != 2:
        raise JaxmarkError(f"cheb_conv needs a signal [N, inputs], got {x.shape}.")
    if weight.ndim != 3 or len(weight) == 0 or weight.shape[1] != x.shape[1] or bias.shape != weight.shape[2:]:
        raise JaxmarkError(
            f"cheb_conv needs weight [degree + 1, {x.shape[1]}, outputs] and bias [outputs], got {weight.shape} and"
            f" {bias.shape}."
        )
    if form not in get_args(Form):
        raise JaxmarkError(f"form is {', '.join(map(repr, get_args(Form)))}, not {form!r}.")
    weight, bias = weight.astype(x.dtype), bias.astype(x.dtype)
    if form == "random-walk":
        return convolution(operator, weight, x) + bias
    scale = inner_mass(operator, x) ** _POWERS[form]
    return scale * convolution(operator, weight, x / scale) + bias
