"""Detectors, which compute one soft decision per bit from the data that a reader extracted from a suspect.

`correlate` and `decorrelate` work with any carrier; `joint` needs the reader of a keyed carrier, which uses the host.
"""

from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from jaxmark.errors import JaxmarkError
from jaxmark.seeds import probe_signs
from jaxmark.spectral.chebyshev import filter, transpose
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.interfaces import ChipCarrier, Claim, Reader, Received, Strength
from jaxmark.watermark.reading.reception import Reception, clean, whitening

# The conjugate gradients of joint decoding stop here: further gains are below the noise of the soft decisions.
_MAX_ITERATIONS = 12
_TOLERANCE = 1e-2  # relative residual
_NOISE_RANGE = (0.02, 1e3)  # bounds on the estimated noise, relative to the energy of a bit


def correlate(reader: Reader, received: Received, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Compute the paper's detection value, W_i = ⟨residual, Σ_j p_j^(i) x_j⟩_D (2.2.2, with the D that it omits).

    Its sign is the bit if the components are nearly orthogonal.
    """
    observation = received.observed
    return reader.carrier.adjoint(observation.weigh(observation.residual), beta)


def decorrelate(reader: Reader, received: Received, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Compute least-squares amplitudes of the bits: correlations without the interference between the bits.

    With the β of the embedding, they are ±1 for a mark that was not attacked. In directions that the carrier does not
    span within rounding, a ridge of 16 eps times the energy of all bits holds them at zero.
    """
    products = reader.carrier.gram(beta)
    ridge = 16 * jnp.finfo(products.dtype).eps * jnp.trace(products)
    # A carrier without energy must give zeros, not 0/0.
    ridge = jnp.where(ridge > 0, ridge, 1)
    factor = jsl.cho_factor(products + ridge * jnp.eye(len(products), dtype=products.dtype), lower=True)
    return jsl.cho_solve(factor, correlate(reader, received, beta))


def claims(
    reader: Reader, received: Received, codeword: Float[Array, " code"]
) -> tuple[Float[Array, " ways"], Float[Array, " ways"]]:
    """Compute score S and norm ‖a‖ of a claimed codeword for each way of weighting a suspect; see `Reader.ways`.

    Each way is a test of its own; taking the best one is charged (`jaxmark.watermark.evidence.ledger`).
    """
    scores, norms = zip(*claims_by_way(reader, received, codeword), strict=True)
    return jnp.stack(scores), jnp.stack(norms)


def claims_by_way(reader: Reader, received: Received, codeword: Float[Array, " code"]) -> list[Claim]:
    """Compute the same as `claims`, one claim for each way."""
    return [reader.claim(way, codeword) for way in reader.ways(received)]


def joint(reader: Reader, received: Any, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Estimate all bits jointly, with least mean square error, by conjugate gradients and without a matrix of the bits.

    The nuisance is projected off and each band is weighted by its power (`jaxmark.watermark.reading.reception`). The
    mark is modelled as the carrier's displacement, with each band attenuated as that of the host. The ratio of noise to
    the interference of the bits is estimated from the energy before and after matched filtering.

    Args:
        reader: the reader of a keyed carrier.
        received: the data that the reader extracted from the suspect.
        beta: the relative strengths of the bands, as embedded.

    Returns:
        Soft decisions `[k]`, whose signs are the bits; ±1 on average if the mark was not attacked and β is that
        of the embedding.

    Raises:
        JaxmarkError: if the reader is not that of a keyed carrier.
    """
    if not isinstance(received, Reception):
        raise JaxmarkError(f"The joint detector reads keyed carriers, not {type(reader.carrier).__name__}.")
    return _decode_jointly(reader, received, beta, _TOLERANCE, _MAX_ITERATIONS)


@partial(jax.jit, static_argnames=("tolerance", "steps"))
def _decode_jointly(
    reader: Reader, received: Reception, beta: Strength, tolerance: float, steps: int
) -> Float[Array, " bits"]:
    carrier, receiver = cast(ChipCarrier, reader.carrier), received.receiver
    model = carrier.coefficients(beta, received.gain)
    equaliser = whitening(receiver, received.power)

    def forward(bits: Array) -> Array:
        spread = carrier.modulate(bits, model)
        return whiten(matmul(clean(receiver, received.observation, received.factor, spread), received.axes))

    def backward(white: Array) -> Array:
        filtered = matmul(transpose(receiver.operator, equaliser, white), received.axes)
        return carrier.correlate(clean(receiver, received.observation, received.factor, filtered), model)

    def whiten(x: Array) -> Array:
        return filter(receiver.operator, equaliser, x)

    observed = whiten(received.residual)
    # Probes with random signs estimate the energy before and after matched filtering of one bit of unit amplitude, and
    # of noise of unit strength with the residual's spectrum.
    bits, signs = probe_signs("detection", (carrier.code_bits,), observed.shape, dtype=observed.dtype)
    coloured = filter(receiver.operator, matmul(receiver.coefficients.T, jnp.sqrt(received.power)), signs)
    noise = whiten(clean(receiver, received.observation, received.factor, coloured))
    # The three are filtered one after the other, so that there is less to compile.
    matched, response, after = jax.lax.map(backward, jnp.stack([observed, forward(bits), noise]))
    ridge = _noise_to_signal(
        jnp.stack([jnp.sum(observed**2), jnp.sum(matched**2)]),
        jnp.stack([jnp.sum(bits * response), jnp.sum(response**2)]),
        jnp.stack([jnp.sum(noise**2), jnp.sum(after**2)]),
    )
    energy = jnp.sum(bits * response) / len(bits)
    ridge = jax.lax.stop_gradient(jnp.where(energy > 0, energy * jnp.clip(ridge / energy, *_NOISE_RANGE), 1))
    return cg(lambda bits: backward(forward(bits)) + ridge * bits, matched, tol=tolerance, maxiter=steps)[0]


def _noise_to_signal(
    energy: Float[Array, " 2"], of_signal: Float[Array, " 2"], of_noise: Float[Array, " 2"]
) -> Float[Array, ""]:
    """Solve the two equations energy = A² of_signal + σ² of_noise for σ²/A²; infinite if A² is not positive."""
    determinant = of_signal[1] * of_noise[0] - of_signal[0] * of_noise[1]
    signal = (energy[1] * of_noise[0] - energy[0] * of_noise[1]) * jnp.sign(determinant)
    noise = (energy[0] * of_signal[1] - energy[1] * of_signal[0]) * jnp.sign(determinant)
    return jnp.where(signal > 0, jnp.maximum(noise, 0) / jnp.where(signal > 0, signal, 1), jnp.inf)
