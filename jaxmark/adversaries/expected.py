"""The average behaviour of a detector over keys, which an attacker without the key can compute.

The attacker uses the marked mesh in place of the original, writes marks of random keys into it, and measures what a
displacement leaves of them. All of this is differentiable with respect to the displacement, in diagonals, given a seed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.alignment.observation import observe
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import band_energies, filter
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.coding.keys import new_key
from jaxmark.watermark.interfaces import Displacement, Reader, Received, Scheme
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.perception.visibility import band_visibility
from jaxmark.watermark.reading.detectors import claims

_ATTACKER_BANDS = 64  # bands by which the attacker shapes displacements, over the whole spectrum
_LOGSUMEXP_SHARPNESS = 4.0  # of the smooth maximum over ways of weighting a suspect


class Surrogate(NamedTuple):
    """A marked mesh as the attacker's original; a pytree, to be passed to traced code. Lengths are in diagonals."""

    operator: Laplacian
    signal: Float[Array, "rows 3"]  # coordinates, centred per connected component
    moving: Float[Array, "rows 1"]  # 1 if a face uses the point, else 0
    pose: Float[Array, "rows columns"]  # orthonormal basis of the affine functions of the position
    bands: Float[Array, "bands terms"]  # Chebyshev coefficients of the attacker's bands
    visibility: Float[Array, " bands"]  # visibility of each band per unit of RMS displacement; 1 if the metric is RMS
    reader: Reader  # reader for a random key, which does not matter
    mark: Float[Array, ""]  # RMS displacement that marks are assumed to have


def make_surrogate(
    mesh: Mesh, scheme: str | Scheme, bits: int, mark: float, metric: str = "rms"
) -> tuple[Surrogate, Original]:
    """Prepare a marked mesh as the attacker sees it, by the assumptions of `keyless.make_attack`, and an original.

    Raises:
        JaxmarkError: see `make_marker` and `distortion.compare`.
    """
    marker = make_marker(mesh, new_key(), bits=bits, scheme=scheme)
    original, family = marker.original, scaling(_ATTACKER_BANDS, damping="jackson")
    dtype = original.signal.dtype
    functions = np.c_[np.ones(len(original.used)), original.positions] * original.used[:, None]
    vectors, values, _ = np.linalg.svd(functions, full_matrices=False)
    basis = vectors * (values > 1e-9 * values[0])  # flat meshes have fewer affine functions
    visibility = np.ones(_ATTACKER_BANDS) if metric == "rms" else band_visibility(original, family, [metric])[0]
    surrogate = Surrogate(
        operator=original.operator,
        signal=original.signal,
        moving=original.to_traced(original.used)[:, None],
        pose=original.to_traced(basis),
        bands=jnp.asarray(family, dtype),
        visibility=jnp.asarray(visibility, dtype),
        reader=marker.reader,
        mark=jnp.asarray(mark, dtype),
    )
    return surrogate, original


def rms(surrogate: Surrogate, displacement: Displacement) -> Float[Array, ""]:
    """Return the root mean square length of a displacement over the points that faces use."""
    return jnp.sqrt(jnp.sum((surrogate.moving * displacement) ** 2) / surrogate.moving.sum())


def size(surrogate: Surrogate, displacement: Displacement) -> Float[Array, ""]:
    """Return the metric as it is for small displacements: the RMS after each band is weighted by its visibility."""
    return rms(surrogate, band_filter(surrogate, surrogate.visibility, displacement))


def rescale(surrogate: Surrogate, displacement: Displacement, wanted: Float[Array, ""]) -> Displacement:
    """Scale a displacement to the size `wanted`, and leave points that no face uses where they are."""
    moved = surrogate.moving * displacement
    found = size(surrogate, moved)
    return wanted / jnp.where(found > 0, found, 1) * moved


def band_filter(surrogate: Surrogate, strengths: Float[Array, " bands"], x: Displacement) -> Displacement:
    """Filter a displacement with a strength for each band: Σ_j strength_j f_j(Δ) x."""
    return filter(surrogate.operator, matmul(surrogate.bands.T, strengths), x)


def random_mark(surrogate: Surrogate, seed: Seed) -> tuple[Reader, Displacement]:
    """Make a mark under a random key, and its reader; all its bits are 1, because the key's signs are random."""
    reader = surrogate.reader.with_carrier(surrogate.reader.carrier.redraw(random_key(seed)))
    written = reader.carrier.displacement(jnp.ones(reader.carrier.code_bits, surrogate.signal.dtype))
    return reader, surrogate.mark / rms(surrogate, written) * written


def evidence(surrogate: Surrogate, displacement: Displacement, seed: Seed) -> Float[Array, ""]:
    """Compute the evidence S/‖a‖ of a random mark's claim after a displacement, averaged over the mark and minus it.

    The average cancels what mark and displacement happen to have in common, which would be most of the noise. The
    affine part of the displacement does not count, because the owner undoes affine maps.
    """
    reader, written = random_mark(surrogate, seed)
    bits, pose = jnp.ones(reader.carrier.code_bits, surrogate.signal.dtype), surrogate.pose
    moved = displacement - matmul(pose, matmul(pose.T, displacement))
    suspects = {sign: reader.receive(observe(sign * written + moved)) for sign in (1, -1)}
    both = [strongest_evidence(reader, received, sign * bits) for sign, received in suspects.items()]
    return jnp.mean(jnp.stack(both))


def strongest_evidence(reader: Reader, received: Received, codeword: Float[Array, " code"]) -> Float[Array, ""]:
    """Compute a smooth maximum of S/‖a‖ over all ways of weighting a suspect; an attack lowers all that are near it.

    It exceeds the largest S/‖a‖ by at most a quarter of the logarithm of the number of ways.
    """
    scores, norms = claims(reader, received, codeword)
    return jax.nn.logsumexp(_LOGSUMEXP_SHARPNESS * scores / norms) / _LOGSUMEXP_SHARPNESS


def energies(surrogate: Surrogate, x: Displacement) -> Float[Array, " bands"]:
    """Compute the energy of `x` per band."""
    return jnp.maximum(band_energies(surrogate.operator, surrogate.bands, x, x), 0)
