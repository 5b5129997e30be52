"""Rational functions of the Laplacian by conjugate gradients: bands without ripples (Sohn et al., further work).

Functions are given in second-order sections, as in signal processing: f(λ) is the product of the sections
(b_0 + b_1λ + b_2λ²)/(a_0 + a_1λ + a_2λ²), each a row [b_0, b_1, b_2, a_0, a_1, a_2] of `[sections, 6]`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Operator, Signal, checked_signal
from jaxmark.spectral.recurrence import inner_mass, solve


@partial(jax.jit, static_argnames=("tolerance", "iterations"))
def filter_rational(
    operator: Operator,
    sections: Float[Array | np.ndarray, "sections 6"],
    x: Signal,
    *,
    tolerance: float | None = None,
    iterations: int = 2000,
) -> Float[Array, " vertices *columns"]:
    """Filter a signal by a rational function: f(Δ)x, section by section.

    **Denominators must be positive on [0, 2].** Scaled by M^½, the system of each denominator a(Δ) is symmetric
    positive definite, with condition number κ = max a / min a over [0, 2]. A solve takes about √κ/2 · ln(2/tolerance)
    iterations of two products, or fewer, and has an error of about κ times the larger of `tolerance` and the dtype's
    rounding.

    All bands of a bank are `jax.vmap(filter_rational, (None, 0, None))(operator, bank, x)`. Derivatives with respect to
    `x`, the sections and the operator's weights, in all modes, come by implicit differentiation: further solves, in
    O(sections · N) memory.

    Args:
        operator: the Laplacian, of N vertices.
        sections: `[sections, 6]`, applied in this order. `[[1, 0, 0, 1, τ, 0]] * p` is p steps of implicit smoothing,
            1/(1 + τλ)^p.
        x: `[N]` or `[N, C]`, whose dtype the result keeps.
        tolerance: bound of each solve's residual, relative to the right-hand side, in the M-norm over all columns
            together; by default ten times the machine epsilon of the dtype of `x`.
        iterations: largest number of iterations of each solve.

    Raises:
        JaxmarkError: if the shapes do not fit.
    """
    x = checked_signal("filter_rational", operator, x)
    sections = jnp.asarray(sections).astype(x.dtype)
    if sections.ndim != 2 or sections.shape[1] != 6:
        raise JaxmarkError(f"filter_rational needs sections [sections, 6], got {sections.shape}.")
    product, mass = operator.product(x), operator.enter(inner_mass(operator, x))

    def quadratic(c: Array, y: Array) -> Array:
        first = product(y)
        return c[0] * y + c[1] * first + c[2] * product(first)

    def divide(y: Array, section: Array) -> tuple[Array, None]:
        denominator = partial(quadratic, section[3:])
        right = quadratic(section[:3], y)
        return solve(denominator, right, mass, iterations, tolerance), None

    return operator.leave(jax.lax.scan(divide, operator.enter(x), sections)[0])


def response(
    sections: Float[np.ndarray, "*bands sections 6"], values: Float[np.ndarray, " values"]
) -> Float64[np.ndarray, "*bands values"]:
    """Evaluate f(λ), by which `filter_rational` scales an eigenvector, at given λ, on the host."""
    powers = np.stack([np.ones_like(values), values, values**2])
    return ((sections[..., :3] @ powers) / (sections[..., 3:] @ powers)).prod(axis=-2)


def butterworth(edges: Float[np.ndarray, " edges"], order: int) -> Float64[np.ndarray, "bands sections 6"]:
    """Make bands `[bands, 2 · order, 6]` as differences of Butterworth low-passes 1/(1 + (λ/e)^2p) at inner edges e.

    The bands are a partition of unity within [0, 1], without any overshoot. Every band but the first has a zero of
    order 2p at λ = 0, where meshes have their energy, and every band falls as (λ/e)^∓2p away from its edges. The
    sections follow from 1 + u^2p = Π_i (1 - 2u cos α_i + u²), α_i = (2i + 1)π/2p, with u = λ/e; the two low-passes of a
    band with edges e < e' differ by (1 - (e/e')^2p) u^2p over both denominators.

    The condition number of a solve is up to (2/e + 1)²/sin² α_0: edges below 0.005 or so, and orders above 3 there,
    need float64.

    Args:
        edges: λ `[bands + 1]`, ascending in [0, 2]; the first and last stand for the ends of the spectrum.
        order: p, at least 1: half of what signal processing calls the order.

    Raises:
        JaxmarkError: if the edges do not ascend, there are fewer than three, or the order is below 1.
    """
    if len(edges) < 3 or edges[0] < 0 or not (np.diff(edges) > 0).all():
        raise JaxmarkError(f"butterworth needs three edges or more that ascend from 0 on, got {edges}.")
    if order < 1:
        raise JaxmarkError(f"butterworth(order=...) must be at least 1, got {order}.")
    cosines = np.cos((2 * np.arange(order) + 1) * np.pi / (2 * order))
    inner = edges[1:-1, None]
    poles = np.stack([np.ones((len(inner), order)), -2 * cosines / inner, np.ones(order) / inner**2], axis=-1)
    bank = np.zeros((len(edges) - 1, 2 * order, 6))
    bank[..., [0, 3]] = 1
    # The low-pass at a band's upper edge is 1 over the denominator there, the high-pass at its lower edge u² over each
    # factor of the denominator there.
    bank[:-1, :order, 3:] = poles
    bank[1:, order:, :3] = np.stack([0, 0, 1]) * poles[:, :, 2:]
    bank[1:, order:, 3:] = poles
    bank[1:-1, 0, 0] = 1 - (edges[1:-2] / edges[2:-1]) ** (2 * order)
    return bank
