"""What an attacker without the key knows of a detector: how it does on average over keys.

The attacker takes the marked mesh for the original, writes marks of random keys in it, and sees what a displacement
leaves of them. All of it is differentiable with respect to the displacement, given the key of the randomness.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.bands import scaling
from jaxmark.carriers import Carrier, KeyedCarrier, ModulatedCarrier
from jaxmark.carriers.carrier import Displacement
from jaxmark.channels import band_energies
from jaxmark.chebyshev import filter
from jaxmark.detectors import claims
from jaxmark.errors import JaxmarkError
from jaxmark.keys import new_key
from jaxmark.laplacian import Laplacian
from jaxmark.marking import make_marker
from jaxmark.mesh import Mesh
from jaxmark.observation import Observation, observe
from jaxmark.original import Original
from jaxmark.precision import matmul
from jaxmark.reception import Reception
from jaxmark.schemes import Scheme
from jaxmark.visibility import band_visibility

BANDS = 64  # of the attacker's own, over the whole spectrum
_SHARPNESS = 4.0


class Surrogate(NamedTuple):
    """A marked mesh as the attacker's original; lengths are in diagonals. A pytree, to be passed to traced code."""

    operator: Laplacian
    signal: Float[Array, "rows 3"]
    moving: Float[Array, "rows 1"]  # 1 where a face uses the point
    pose: Float[Array, "rows columns"]  # an orthonormal basis of the affine functions of the position
    bands: Float[Array, "bands terms"]
    seen: Float[Array, " bands"]  # how visible each band is, relative to its RMS; 1 where RMS is what counts
    carrier: KeyedCarrier | ModulatedCarrier  # of a key that does not matter
    mark: Float[Array, ""]  # RMS that marks are taken to have


def make_surrogate(
    mesh: Mesh, scheme: str | Scheme, bits: int, mark: float, metric: str = "rms"
) -> tuple[Surrogate, Original]:
    """Prepare a marked mesh as the attacker sees it.

    Args:
        mesh: the marked mesh.
        scheme: that it was marked with; see `make_marker`.
        bits: of the payload.
        mark: RMS displacement that the mark is taken to have, relative to the diagonal.
        metric: of `distortion.METRICS`, by which displacements are measured, see `size`.

    Raises:
        JaxmarkError: see `make_marker` and `distortion.compare`; or if the scheme's carrier is of an unknown kind.
    """
    marker = make_marker(mesh, new_key(), bits=bits, scheme=scheme)
    if not isinstance(marker.reader, KeyedCarrier | ModulatedCarrier):
        raise JaxmarkError(f"Carriers of the scheme {marker.scheme.name!r} cannot be given random keys.")
    original, family = marker.original, scaling(BANDS, damping="jackson")
    dtype = original.signal.dtype
    seen = np.ones(BANDS) if metric == "rms" else band_visibility(original, family, [metric])[0]
    surrogate = Surrogate(
        operator=original.operator,
        signal=original.signal,
        moving=original.traced(original.used)[:, None],
        pose=original.traced(_affine(original)),
        bands=jnp.asarray(family, dtype),
        seen=jnp.asarray(seen, dtype),
        carrier=marker.reader,
        mark=jnp.asarray(mark, dtype),
    )
    return surrogate, original


def _affine(original: Original) -> Float64[np.ndarray, "points columns"]:
    functions = np.c_[np.ones(len(original.used)), original.positions] * original.used[:, None]
    vectors, values, _ = np.linalg.svd(functions, full_matrices=False)
    return vectors * (values > 1e-9 * values[0])  # flat meshes have fewer


def rms(surrogate: Surrogate, displacement: Displacement) -> Float[Array, ""]:
    """Root mean square length over the points that faces use."""
    return jnp.sqrt(jnp.sum((surrogate.moving * displacement) ** 2) / surrogate.moving.sum())


def size(surrogate: Surrogate, displacement: Displacement) -> Float[Array, ""]:
    """The metric as small displacements make it: RMS once each band is weighed by how visible it is."""
    return rms(surrogate, band_filter(surrogate, surrogate.seen, displacement))


def sized(surrogate: Surrogate, displacement: Displacement, wanted: Float[Array, ""]) -> Displacement:
    """A displacement scaled to a size, points that no face uses left out."""
    moved = surrogate.moving * displacement
    found = size(surrogate, moved)
    return wanted / jnp.where(found > 0, found, 1) * moved


def band_filter(surrogate: Surrogate, strengths: Float[Array, " bands"], x: Displacement) -> Displacement:
    """Σ_j strength_j f_j(Δ) x."""
    return filter(surrogate.operator, matmul(surrogate.bands.T, strengths), x)


def random_mark(surrogate: Surrogate, key: PRNGKeyArray) -> tuple[KeyedCarrier | ModulatedCarrier, Displacement]:
    """A mark by a random key, and the carrier that wrote it; its bits are all 1, for the key's signs are random."""
    carrier = surrogate.carrier
    if isinstance(carrier, KeyedCarrier):
        old, moving = carrier.chips, surrogate.moving.astype(jnp.int8)
        signs = moving * jax.random.rademacher(key, jnp.shape(old.signs), jnp.int8)
        carrier = carrier._replace(chips=old._replace(signs=signs))
    else:
        sequences = jax.random.rademacher(key, jnp.shape(carrier.sequences), jnp.int8)
        carrier = carrier._replace(sequences=sequences)
    written = carrier.displacement(_ones(surrogate, carrier))
    return carrier, surrogate.mark / rms(surrogate, written) * written


def evidence(surrogate: Surrogate, displacement: Displacement, key: PRNGKeyArray) -> Float[Array, ""]:
    """S/‖a‖ of a claim of a random mark in the mesh with it, once displaced: the mean of the mark and its opposite.

    What mark and displacement happen to have in common cancels out, which would be most of the noise. The owner undoes
    affine maps, so they do not count.
    """
    carrier, written = random_mark(surrogate, key)
    bits = _ones(surrogate, carrier)
    pose = surrogate.pose
    moved = displacement - matmul(pose, matmul(pose.T, displacement))
    both = [strongest(carrier, observe(sign * written + moved), sign * bits) for sign in (1, -1)]
    return jnp.mean(jnp.stack(both))


def strongest(carrier: Carrier, seen: Observation | Reception, codeword: Float[Array, " code"]) -> Float[Array, ""]:
    """The largest S/‖a‖ of all ways of weighing a suspect, smoothed so that an attack goes against all that are near.

    It lies above the largest by at most a quarter of the logarithm of their number.
    """
    scores, norms = claims(carrier, seen, codeword)
    return jax.nn.logsumexp(_SHARPNESS * scores / norms) / _SHARPNESS


def energies(surrogate: Surrogate, x: Displacement) -> Float[Array, " bands"]:
    """Of each band."""
    return jnp.maximum(band_energies(surrogate.operator, surrogate.bands, x, x), 0)


def _ones(surrogate: Surrogate, carrier: KeyedCarrier | ModulatedCarrier) -> Float[Array, " bits"]:
    count = len(carrier.chips.population) if isinstance(carrier, KeyedCarrier) else len(carrier.sequences)
    return jnp.ones(count, surrogate.signal.dtype)
