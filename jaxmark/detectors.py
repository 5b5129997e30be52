"""Detectors: from what a suspect shows to one soft value per bit.

`correlate` and `decorrelate` go with any carrier; `projected` and `joint` need a keyed one, which knows its host.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxmark.carriers import Carrier, KeyedCarrier
from jaxmark.carriers.carrier import Strength
from jaxmark.chebyshev import filter, transpose
from jaxmark.errors import JaxmarkError
from jaxmark.observation import Observation
from jaxmark.precision import matmul
from jaxmark.reception import Receiver, Reception, clean, even, make_receiver, normal_factor, whitening

Detector = Callable[[Carrier, Observation, Strength], Float[Array, " bits"]]

# Joint decoding stops here: what remains to be gained is below the noise of the soft values.
_STEPS = 12
_TOLERANCE = 1e-2
_BALANCE = (0.02, 1e3)  # least and largest noise, relative to the energy of a bit, that is believed


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


def projected(carrier: Carrier, seen: Observation, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Plain correlations of what is seen once the nuisance is projected off: little work, for what nobody attacked.

    Bits are noise to each other, and no band is weighed. Arguments and errors as `joint`.
    """
    carrier = _keyed("projected", carrier)
    return _projected(carrier, make_receiver(carrier.host), seen, beta)


def claims(
    carrier: Carrier, seen: Observation | Reception, codeword: Float[Array, " code"]
) -> tuple[Float[Array, " ways"], Float[Array, " ways"]]:
    """Score S and norm ‖a‖ of a claimed codeword in each way of weighing a suspect; see `Carrier.claim`.

    A keyed carrier has two: by what the suspect shows of each band, which tells most, and all alike, which costs most
    to attack. Each is a proof; who takes the best of them pays for both (`evidence.any_of`).
    """
    ways: tuple[Observation | Reception, ...] = (seen,)  # pyright: ignore[reportAssignmentType]
    if isinstance(carrier, KeyedCarrier):
        received = carrier.received(seen)
        ways = received, even(received)
    pairs = [carrier.claim(way, codeword) for way in ways]  # pyright: ignore[reportArgumentType]
    scores, norms = (jnp.stack(values) for values in zip(*pairs, strict=True))
    return scores, norms


@jax.jit
def _projected(carrier: KeyedCarrier, host: Receiver, seen: Observation, beta: Strength) -> Float[Array, " bits"]:
    residual = clean(host, seen, normal_factor(host, seen), seen.residual)
    return carrier.correlate(residual, carrier.shape(beta))


def joint(carrier: Carrier, seen: Observation | Reception, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """All bits together: least mean square error, by conjugate gradients on the bits, nothing of size bits² formed.

    The nuisance is projected off and each band weighed by its power (`jaxmark.reception`); there the mark is modelled
    as the carrier with each band at the gain that the host has. The balance between interference of bits and noise is
    found from the energy before and after matching.

    Args:
        carrier: a `KeyedCarrier`.
        seen: the residual with its weights and, if only normal components are known, its normals; or what
            `KeyedCarrier.received` made of it, to be made only once.
        beta: the strengths' profile over the bands, as embedded.

    Returns:
        Soft values, ±1 on average where nothing was attacked and β is the embedding's; their signs are the bits.

    Raises:
        JaxmarkError: if the carrier knows no host.
    """
    carrier = _keyed("joint", carrier)
    return _decoded(carrier, carrier.received(seen), beta, _TOLERANCE, _STEPS)


def _keyed(name: str, carrier: Carrier) -> KeyedCarrier:
    if not isinstance(carrier, KeyedCarrier):
        raise JaxmarkError(f"The {name} detector reads keyed carriers, not {type(carrier).__name__}.")
    return carrier


@partial(jax.jit, static_argnames=("tolerance", "steps"))
def _decoded(
    carrier: KeyedCarrier, received: Reception, beta: Strength, tolerance: float, steps: int
) -> Float[Array, " bits"]:
    host = received.host
    model = carrier.shape(beta, received.gain)
    equaliser = whitening(host, received.power)

    def forward(bits: Array) -> Array:
        spread = carrier.modulate(bits, model)
        return white(matmul(clean(host, received.seen, received.factor, spread), received.axes))

    def backward(white: Array) -> Array:
        dull = matmul(transpose(host.operator, equaliser, white), received.axes)
        return carrier.correlate(clean(host, received.seen, received.factor, dull), model)

    def white(x: Array) -> Array:
        return filter(host.operator, equaliser, x)

    observed = white(received.residual)
    # What one bit of unit amplitude, and noise of the residual's spectrum and unit strength, contribute to the energy
    # before and after matching, as probes of random signs estimate it.
    key_bits, key_noise = jax.random.split(jax.random.key(1))
    bits = jax.random.rademacher(key_bits, carrier.chips.population.shape, observed.dtype)
    signs = jax.random.rademacher(key_noise, observed.shape, observed.dtype)
    coloured = filter(host.operator, matmul(host.coefficients.T, jnp.sqrt(received.power)), signs)
    noise = white(clean(host, received.seen, received.factor, coloured))
    # One after the other, so that there is less to compile.
    matched, response, after = jax.lax.map(backward, jnp.stack([observed, forward(bits), noise]))
    ridge = _noise_to_signal(
        jnp.stack([jnp.sum(observed**2), jnp.sum(matched**2)]),
        jnp.stack([jnp.sum(bits * response), jnp.sum(response**2)]),
        jnp.stack([jnp.sum(noise**2), jnp.sum(after**2)]),
    )
    energy = jnp.sum(bits * response) / len(bits)
    ridge = jax.lax.stop_gradient(jnp.where(energy > 0, energy * jnp.clip(ridge / energy, *_BALANCE), 1))
    return cg(lambda bits: backward(forward(bits)) + ridge * bits, matched, tol=tolerance, maxiter=steps)[0]


def _noise_to_signal(
    energy: Float[Array, " 2"], of_signal: Float[Array, " 2"], of_noise: Float[Array, " 2"]
) -> Float[Array, ""]:
    """σ²/A² where energy = A² of_signal + σ² of_noise, two equations; infinite if A² is not positive."""
    determinant = of_signal[1] * of_noise[0] - of_signal[0] * of_noise[1]
    signal = (energy[1] * of_noise[0] - energy[0] * of_noise[1]) * jnp.sign(determinant)
    noise = (energy[0] * of_signal[1] - energy[1] * of_signal[0]) * jnp.sign(determinant)
    return jnp.where(signal > 0, jnp.maximum(noise, 0) / jnp.where(signal > 0, signal, 1), jnp.inf)
