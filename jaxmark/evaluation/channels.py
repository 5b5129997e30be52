"""The parts of a mark that attacks leave in each band: parallel Gaussian channels, and how much they transmit.

The bands f_j ≥ 0 with Σ_j f_j = 1 share each eigenvector's energy: ⟨u, v⟩ = Σ_j ⟨u, f_j(Δ)v⟩. Everything is computed
from moments, in O(N) memory for any number of bands.
"""

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.alignment.observation import Observation
from jaxmark.seeds import probe_signs
from jaxmark.spectral.chebyshev import band_energies
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.interfaces import Displacement
from jaxmark.watermark.reading.reception import Receiver, clean, receive

Margin = Literal["rate", "evidence", "snr"]

_MIN_BAND_DIMENSIONS = 3  # the variance in a band cannot be estimated from fewer


class Channels(NamedTuple):
    """The effect of attacks on a mark of strengths β_j in bands j: SNR_aj = gain_aj² β_j² / noise_aj per dimension."""

    gain: Float[Array, "attacks bands"]  # share of the band's amplitude that the attack leaves
    noise: Float[Array, "attacks bands"]  # variance that it adds to each dimension, in units of β², positive
    dimensions: Float[Array, "attacks bands"]  # number of the band's dimensions that are left for evidence


def margins(channels: Channels, power: Float[Array, " bands"], margin: Margin = "rate") -> Float[Array, " attacks"]:
    """Compute how much of a mark with powers β_j² remains readable after each attack; concave in the powers.

    The measure is one of:

    - `"rate"`, in bits: Σ_j (n_j/2) log₂(1 + SNR_j), the capacity of parallel Gaussian channels (Cover, Thomas,
      "Elements of Information Theory", 9.4);
    - `"evidence"`, in nats: Σ_j (n_j/2) SNR_j/(1 + SNR_j), the value of S²/2‖a‖² for a claimed message
      (`bounds.log10_p_score`), as ‖a‖ contains the mark as well as the noise;
    - `"snr"`: Σ_j (n_j/2) SNR_j, the limit of both for weak marks, up to the unit; it is brittle, because its optimum
      lies in as many bands as there are attacks.
    """
    ratio = channels.gain**2 * power / channels.noise
    worth = {"rate": lambda: jnp.log2(1 + ratio), "evidence": lambda: ratio / (1 + ratio), "snr": lambda: ratio}
    return (channels.dimensions / 2 * worth[margin]()).sum(axis=1)


def rate(channels: Channels, beta: Float[Array, " bands"]) -> Float[Array, " attacks"]:
    """Compute how many bits of a mark with strengths β remain readable after each attack; see `margins`."""
    return margins(channels, beta**2)


@jax.jit
def measure(receiver: Receiver, observation: Observation, mark: Displacement) -> Channels:
    """Measure the channel of one attack on a known mark; can be differentiated with respect to `observation`.

    Args:
        receiver: the original, with bands that add up to 1 over the spectrum.
        observation: what the attacked mesh shows of the displacement.
        mark: the displacement that was written, with some strength in each band, `[N, 3]`.

    Returns:
        The channel as a single row. A band of three dimensions or fewer gets gain 0 and no dimensions, because no
        variance can be estimated from it.
    """
    received = receive(receiver, observation)

    def project(x: Array) -> Array:
        return matmul(clean(received.receiver, received.observation, received.factor, x), received.axes)

    (signs,) = probe_signs("channels", mark.shape, dtype=mark.dtype)
    written, found, probe = project(mark), received.residual, project(signs)
    energies = partial(band_energies, receiver.operator, receiver.coefficients)
    dimensions = energies(probe, probe)
    sound = dimensions > _MIN_BAND_DIMENSIONS
    own, cross, whole = energies(written, written), energies(found, written), energies(found, found)
    marked = sound & (own > 0)
    gain = jnp.where(marked, jnp.maximum(cross, 0) / jnp.where(marked, own, 1), 0)
    # The energy of a weak band is a small difference of large numbers: below this floor it is rounding noise.
    floor = 10 * jnp.finfo(mark.dtype).eps * whole.sum() / len(whole)
    left = jnp.maximum(whole - gain * jnp.maximum(cross, 0), floor)
    noise = jnp.where(sound, left / jnp.where(sound, dimensions, 1), 1)
    # A suspect that is equal to its original has no noise at all, but noise must be positive.
    noise = jnp.maximum(noise, jnp.finfo(mark.dtype).tiny)
    return Channels(gain[None], noise[None], jnp.where(sound, dimensions, 0)[None])
