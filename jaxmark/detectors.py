"""Detectors: from what a suspect shows to one soft value per bit.

`correlate` and `decorrelate` go with any carrier; `joint` needs a keyed one, which knows its host.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jax.scipy.sparse.linalg import cg
from jax.scipy.special import erf
from jaxtyping import Array, Float

from jaxmark.carriers import Carrier, KeyedCarrier
from jaxmark.carriers.carrier import Strength
from jaxmark.chebyshev import filter, transpose
from jaxmark.errors import JaxmarkError
from jaxmark.observation import Observation
from jaxmark.reception import clean, receive

Detector = Callable[[Carrier, Observation, Strength], Float[Array, " bits"]]

# Joint decoding stops here: what remains to be gained is below the noise of the soft values.
_STEPS = 12
_TOLERANCE = 1e-2


def correlate(carrier: Carrier, seen: Observation, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """W_i = ⟨residual, Σ_j p_j^(i) x_j⟩_D, the paper's detection value (2.2.2, with the D it leaves out).

    Its sign is the bit, where components are nearly orthogonal.
    """
    return carrier.adjoint(seen.weigh(seen.residual), beta)


def decorrelate(carrier: Carrier, seen: Observation, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Least-squares amplitudes of the bits: the correlations, with the bits' interference solved out.

    With the embedding's β they are ±1 where nothing was attacked. Directions that the carrier does not span within
    rounding are held at zero by a ridge of 16 eps times the energy of all bits.
    """
    products = carrier.gram(beta)
    ridge = 16 * jnp.finfo(products.dtype).eps * jnp.trace(products)
    # A carrier without energy must give zeros, not the quotient of two.
    ridge = jnp.where(ridge > 0, ridge, 1)
    factor = jsl.cho_factor(products + ridge * jnp.eye(len(products), dtype=products.dtype), lower=True)
    return jsl.cho_solve(factor, correlate(carrier, seen, beta))


@jax.jit
def joint(carrier: Carrier, seen: Observation, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """All bits together: least mean square error, by conjugate gradients on the bits, nothing of size bits² formed.

    The nuisance is projected off and each band weighed by its power (`jaxmark.reception`); there the mark is modelled
    as the carrier with each band at the gain that the host has. The balance between interference of bits and noise is
    found from how far the matched filter's values spread about two points.

    Args:
        carrier: a `KeyedCarrier`.
        seen: the residual with its weights and, if only normal components are known, its normals.
        beta: the strengths' profile over the bands, as embedded.

    Returns:
        Soft values, ±1 on average where nothing was attacked and β is the embedding's; their signs are the bits.

    Raises:
        JaxmarkError: if the carrier knows no host.
    """
    if not isinstance(carrier, KeyedCarrier):
        raise JaxmarkError(f"The joint detector reads keyed carriers, not {type(carrier).__name__}.")
    host = carrier.host
    received = receive(host, seen)
    model = carrier.shape(beta, received.gain)
    whitening = host.coefficients.T @ (1 / jnp.sqrt(received.power))

    def forward(bits: Array) -> Array:
        spread = carrier.modulate(bits, model)
        return filter(host.operator, whitening, clean(host, seen, received.factor, spread))

    def backward(white: Array) -> Array:
        dull = transpose(host.operator, whitening, white)
        return carrier.correlate(clean(host, seen, received.factor, dull), model)

    matched = backward(filter(host.operator, whitening, received.residual))
    probe = jax.random.rademacher(jax.random.key(1), matched.shape, matched.dtype)
    response = backward(forward(probe))
    # The trace of the bits' Gram matrix and of its square, as a probe of random signs estimates them.
    count = len(matched)
    energy = probe @ response / count
    energy = jnp.where(energy > 0, energy, 1)
    interference = jnp.maximum(response @ response / count / energy**2 - 1, 0)
    noise = jnp.maximum(1 / _signal_to_noise(matched) - interference, 0.02)
    ridge = jax.lax.stop_gradient(noise * energy)
    return cg(lambda bits: backward(forward(bits)) + ridge * bits, matched, tol=_TOLERANCE, maxiter=_STEPS)[0]


def _signal_to_noise(values: Float[Array, " bits"]) -> Float[Array, ""]:
    """a²/σ² of values ±a with Gaussian noise σ, from the ratio of their first absolute and second moments."""
    grid = jnp.asarray(np.geomspace(1e-2, 1e3, 101), values.dtype)
    root = jnp.sqrt(grid / 2)
    folded = jnp.sqrt(2 / np.pi) * jnp.exp(-grid / 2) + jnp.sqrt(grid) * erf(root)
    second = jnp.mean(values**2)
    found = jnp.mean(jnp.abs(values)) ** 2 / jnp.where(second > 0, second, 1)
    return jnp.interp(found, folded**2 / (1 + grid), grid)
