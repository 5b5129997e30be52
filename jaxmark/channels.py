"""What attacks leave of a mark, band by band: parallel Gaussian channels, and what they let through.

The bands f_j ≥ 0 with Σ_j f_j = 1 share each eigenvector's energy: ⟨u, v⟩ = Σ_j ⟨u, f_j(Δ)v⟩. All is had from moments,
in O(N) memory however many the bands.
"""

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.carriers.carrier import Displacement
from jaxmark.chebyshev import cross_moments
from jaxmark.laplacian import Laplacian
from jaxmark.observation import Observation
from jaxmark.precision import matmul
from jaxmark.reception import Receiver, clean, receive

Margin = Literal["rate", "evidence", "snr"]

_FEW = 3  # dimensions of which no variance can be told


class Channels(NamedTuple):
    """What attacks do to a mark of strength β_j in band j: SNR_aj = gain_aj² β_j² / noise_aj in each dimension."""

    gain: Float[Array, "attacks bands"]  # share of the band's amplitude that the attack leaves
    noise: Float[Array, "attacks bands"]  # variance it adds to each dimension of the band, in units of β², positive
    dimensions: Float[Array, "attacks bands"]  # how many dimensions of the band are left for evidence


def margins(channels: Channels, power: Float[Array, " bands"], margin: Margin = "rate") -> Float[Array, " attacks"]:
    """What each attack leaves readable of a mark with powers β_j²; concave in them.

    Args:
        channels: of the attacks.
        power: β², one per band.
        margin: `"rate"`, in bits: Σ_j (n_j/2) log₂(1 + SNR_j), the capacity of parallel Gaussian channels (Cover,
            Thomas, "Elements of Information Theory", 9.4). `"evidence"`, in nats: Σ_j (n_j/2) SNR_j/(1 + SNR_j), what a
            claimed message's S²/2‖a‖² comes to (`evidence.log10_p_claimed`), for ‖a‖ holds the mark as well as the
            noise. `"snr"`: Σ_j (n_j/2) SNR_j, the limit of both for weak marks, up to the unit; it is brittle: the best
            of it lies in as many bands as there are attacks.
    """
    ratio = channels.gain**2 * power / channels.noise
    worth = {"rate": lambda: jnp.log2(1 + ratio), "evidence": lambda: ratio / (1 + ratio), "snr": lambda: ratio}
    return (channels.dimensions / 2 * worth[margin]()).sum(axis=1)


def rate(channels: Channels, beta: Float[Array, " bands"]) -> Float[Array, " attacks"]:
    """Bits that each attack leaves readable of a mark with strengths β; see `margins`."""
    return margins(channels, beta**2)


def band_energies(
    operator: Laplacian, coefficients: Float[Array, "bands terms"], u: Displacement, v: Displacement
) -> Float[Array, " bands"]:
    """⟨u, f_j(Δ)v⟩ for each band, with vertices weighed by valence over its mean; of unit noise, the dimensions."""
    moments = cross_moments(operator, u, v, degree=coefficients.shape[1] - 1)
    mass = operator.degree.astype(u.dtype)
    return matmul(coefficients, moments.sum(axis=1)) * (jnp.sum(jnp.sign(mass)) / mass.sum())


@jax.jit
def measure(host: Receiver, seen: Observation, mark: Displacement) -> Channels:
    """One attack's channel, from a suspect with a known mark; can be differentiated with respect to `seen`.

    Args:
        host: the original, with the bands that share its spectrum as coefficients.
        seen: the suspect.
        mark: what had been written, with some strength in each band.

    Returns:
        One row. A band of less than three dimensions tells nothing, and leaves nothing.
    """
    received = receive(host, seen)
    host = received.host

    def kept(x: Array) -> Array:
        return matmul(clean(host, received.seen, received.factor, x), received.axes)

    written, found = kept(mark), received.residual
    probe = kept(jax.random.rademacher(jax.random.key(3), mark.shape, mark.dtype))
    energies = partial(band_energies, host.operator, host.coefficients)
    dimensions = energies(probe, probe)
    sound = dimensions > _FEW
    own, cross, whole = energies(written, written), energies(found, written), energies(found, found)
    marked = sound & (own > 0)
    gain = jnp.where(marked, jnp.maximum(cross, 0) / jnp.where(marked, own, 1), 0)
    # Weak bands are small differences of large numbers: below this it is rounding.
    floor = 10 * jnp.finfo(mark.dtype).eps * whole.sum() / len(whole)
    left = jnp.maximum(whole - gain * jnp.maximum(cross, 0), floor)
    noise = jnp.where(sound, left / jnp.where(sound, dimensions, 1), 1)
    # A suspect that is its original has no noise at all.
    noise = jnp.maximum(noise, jnp.finfo(mark.dtype).tiny)
    return Channels(gain[None], noise[None], jnp.where(sound, dimensions, 0)[None])
