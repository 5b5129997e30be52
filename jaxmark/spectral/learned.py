"""Learned filters: graph convolution by Chebyshev polynomials of the Laplacian, as layers of neural networks.

Functions of a dictionary of arrays, for any optimiser, and `ChebConv`, the same as an Equinox module (extra `learned`).
Reference: Defferrard, Bresson, Vandergheynst, "Convolutional Neural Networks on Graphs with Fast Localized Spectral
Filtering", NeurIPS 2016, eq. 4 – 5.
"""

import importlib.util
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.spectral.chebyshev import _scan_terms
from jaxmark.spectral.laplacian import Operator, per_row
from jaxmark.spectral.precision import matmul

if TYPE_CHECKING:
    from jaxmark.spectral._equinox import ChebConv as ChebConv

Form = Literal["random-walk", "symmetric", "transposed"]

_MAX_SUMMED_COLUMNS = 6  # up to which sums took less time than matrix products, by measurement
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

    It takes O(N) memory, also in forward and reverse mode with respect to parameters and signal, at any degree: x̄ is a
    convolution with the transposed weights, since Δ is self-adjoint, and W̄_k = (T_k x)ᵀȳ is computed by running the
    recurrence again. Derivatives with respect to the operator's weights and degrees, and second derivatives, take
    O(degree · N) in reverse mode.

    The weights of a `ChebConv` of PyTorch Geometric, trained with its default normalisation, serve in the symmetric
    form as `{"weight": [lin.weight.T for lin in layer.lins], "bias": layer.bias}`, stacked as NumPy arrays; those
    trained with "rw", which propagates against the edges' direction, in the transposed form. Only isolated vertices
    differ: their eigenvalue is 0 here and 1 there.

    Args:
        operator: the Laplacian, of N vertices.
        parameters: `"weight"`, `[degree + 1, inputs, outputs]`, and `"bias"`, `[outputs]`; see `init_cheb_conv`.
        x: `[N, inputs]`.
        form: the matrix that polynomials are taken of: `"random-walk"`, Δ itself, by which a constant signal stays
            constant; `"symmetric"`, D^½ΔD^-½ = I - D^-½WD^-½, that of the paper; `"transposed"`, Δᵀ = DΔD⁻¹.

    Returns:
        `[N, outputs]`, in the dtype of `x`.

    Raises:
        JaxmarkError: if shapes do not fit, the signal is not floating, or the form is unknown.
    """
    x = jnp.asarray(x)
    weight, bias = (jnp.asarray(parameters[name]) for name in ("weight", "bias"))
    size = operator.degree.shape[0]
    if x.ndim != 2 or len(x) != size or not jnp.issubdtype(x.dtype, jnp.floating):
        raise JaxmarkError(
            f"cheb_conv needs a floating-point signal [N, inputs] with N = {size} vertices, got {x.dtype} {x.shape}."
        )
    if weight.ndim != 3 or len(weight) == 0 or weight.shape[1] != x.shape[1] or bias.shape != weight.shape[2:]:
        raise JaxmarkError(
            f"cheb_conv needs weight [degree + 1, {x.shape[1]}, outputs] and bias [outputs], got {weight.shape} and"
            f" {bias.shape}."
        )
    if form not in get_args(Form):
        raise JaxmarkError(f"form is {', '.join(map(repr, get_args(Form)))}, not {form!r}.")
    weight, bias = weight.astype(x.dtype), bias.astype(x.dtype)
    if form == "random-walk":
        return _convolve(operator, weight, x) + bias
    scale = _mass(operator, x) ** _POWERS[form]
    return scale * _convolve(operator, weight, x / scale) + bias


@jax.custom_jvp
def _convolve(operator: Operator, weight: Array, x: Array) -> Array:
    return _sum_terms(operator, weight, x)


def _sum_terms(operator: Operator, weight: Array, x: Array) -> Array:
    """Σ_k T_k(Δ - I) x W_k, as JAX differentiates it."""

    def add(total: Array, t: Array, _: Array, w_k: Array) -> tuple[Array, None]:
        return total + _mix(t, w_k), None

    x = operator.enter(x)
    return operator.leave(_scan_terms(operator, x, weight, add, _mix(x, weight[0]))[0])


def _mix(x: Array, weight: Array) -> Array:
    """The product xW; by sums over columns where these are few, as processors are slow at such narrow matrices."""
    if x.shape[1] > _MAX_SUMMED_COLUMNS:
        return matmul(x, weight)
    return sum((x[:, i, None] * weight[i] for i in range(1, x.shape[1])), x[:, :1] * weight[0])


def _correlate(operator: Operator, x: Array, y: Array, terms: int) -> Array:
    """(T_k(Δ - I) x)ᵀy for each of so many terms: `[terms, inputs, outputs]`."""
    x, y = operator.enter(x), operator.enter(y)

    def project(_: None, t: Array, __: Array, ___: Array) -> tuple[None, Array]:
        return None, matmul(t.T, y)

    _, rest = _scan_terms(operator, x, jnp.zeros(terms, x.dtype), project, None)
    return jnp.concatenate([matmul(x.T, y)[None], rest])


def _mass(operator: Operator, x: Array) -> Array:
    """D as a column; an isolated vertex is its own block of Δ, so any positive mass serves."""
    mass = per_row(operator.degree, x)
    return jnp.where(mass > 0, mass, 1)


@partial(_convolve.defjvp, symbolic_zeros=True)
def _convolve_jvp(primals: tuple[Any, Array, Array], tangents: tuple[Any, Any, Any]) -> tuple[Array, Array]:
    """One linear map for each argument that moves; those of weight and signal have a transpose that takes O(N)."""
    operator, weight, x = primals
    operator_dot, weight_dot, x_dot = tangents
    y = _sum_terms(operator, weight, x)
    y_dot = jnp.zeros_like(y)
    if not _is_zero(weight_dot):
        y_dot += _apply_linear(
            lambda w: _sum_terms(operator, w, x),
            lambda y_bar: _correlate(operator, x, y_bar, len(weight)),
            weight_dot,
        )
    if not _is_zero(x_dot):
        mass = _mass(operator, x)
        y_dot += _apply_linear(
            lambda v: _sum_terms(operator, weight, v),
            lambda y_bar: mass * _sum_terms(operator, weight.mT, y_bar / mass),
            x_dot,
        )
    leaves, structure = jax.tree.flatten(operator)
    moving = {i: dot for i, dot in enumerate(jax.tree.leaves(operator_dot, is_leaf=_is_zero)) if not _is_zero(dot)}
    if moving:

        def by_operator(moved: dict[int, Array]) -> Array:
            replaced = [moved.get(i, leaf) for i, leaf in enumerate(leaves)]
            return _sum_terms(jax.tree.unflatten(structure, replaced), weight, x)

        y_dot += jax.jvp(by_operator, ({i: leaves[i] for i in moving},), (moving,))[1]
    return y, y_dot


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _apply_linear(function: Callable[[Array], Array], transpose: Callable[[Array], Array], x: Array) -> Array:
    """Apply a linear function with a transpose of its own, in every mode of differentiation and under `vmap`.

    y = Ax is part of the solution of [[I, 0], [-A, I]] [x, y] = [x, 0], and JAX takes the inverse of such a system and
    that of its transpose, [[I, Aᵀ], [0, I]], as they are given. By the system itself it differentiates with respect to
    what A is made of.
    """

    def system(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        return pair[0], pair[1] - function(pair[0])

    def solve(_: Any, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        return pair[0], pair[1] + function(pair[0])

    def solve_transposed(_: Any, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        return pair[0] + transpose(pair[1]), pair[1]

    # JAX differentiates a system only if all its parts move: zeros are sums over nothing, of x and of the solution's x.
    zeros = jnp.full(jax.eval_shape(function, x).shape, jnp.sum(x.ravel()[:0]))
    solved, y = jax.lax.custom_linear_solve(system, (x, zeros), solve, solve_transposed)
    return y + jnp.sum(solved.ravel()[:0])
