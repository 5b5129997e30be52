"""Embedding, detection and evidence as three pure functions of arrays.

`embed_bits`, `detect_bits` and `log_evidence` take carriers as arguments and work under all transformations of JAX.
`jaxmark.watermark.markers` provides the same operations for meshes, messages and keys.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.alignment.observation import observe
from jaxmark.errors import JaxmarkError
from jaxmark.spectral.precision import check_precision
from jaxmark.watermark.carriers import Carrier
from jaxmark.watermark.interfaces import Detector, Strength
from jaxmark.watermark.reading.detectors import claims


def embed_bits(
    x: Float[Array, "vertices 3"], bits: Float[Array, " bits"], carrier: Carrier, beta: Strength
) -> Float[Array, "vertices 3"]:
    """Compute the marked coordinates x + displacement(bits, β) (Sohn et al., 2.2.1).

    Args:
        x: the original's coordinates `[N, 3]`.
        bits: -1 or +1, `[k]`; any real amplitudes are allowed.
        carrier: see `jaxmark.watermark.carriers`.
        beta: strength: a scalar, one number per band, or one per band and coordinate. For components of unit norm, it
            is the D-norm of one bit in one band, in the units of `x`. For components as printed in the paper, it is
            relative to the host's own component.

    Returns:
        Marked coordinates `[N, 3]`.

    Raises:
        JaxmarkError: if bits or β have a wrong shape.
    """
    _check_bits(bits, carrier)
    return x + carrier.displacement(bits, beta)


def detect_bits(
    suspect: Float[Array, "vertices 3"],
    x: Float[Array, "vertices 3"],
    carrier: Carrier,
    detector: Detector | None = None,
    beta: Strength = 1.0,
    *,
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, " bits"]:
    """Compute soft decisions of a suspect's bits, given the original; their signs are the bits (Sohn et al., 2.2.2).

    Args:
        suspect: coordinates `[N, 3]` in the original's vertex order.
        x: the original's coordinates `[N, 3]`.
        carrier: the carrier that the bits were embedded with.
        detector: see `jaxmark.watermark.reading.detectors`; by default, the carrier's own.
        beta: relative strengths of the bands, as embedded; a common factor only rescales the result.
        weights: relative inverse variance of each vertex `[N]`, 0 where nothing is known; by default, all are equal.
            Isolated vertices, such as the rows that pad `Marker.original.signal`, carry nothing and never count.
        normals: unit vectors `[N, 3]`, if the displacement is known only along them; by default, all of it is known.

    Returns:
        Soft decisions, `[k]`.

    Raises:
        JaxmarkError: if the suspect is neither float32 nor float64, or an argument has a wrong shape.
    """
    _check_suspect(suspect, x, weights, normals)
    reader = carrier.reader()
    return (detector or carrier.detector)(reader, reader.receive(observe(suspect - x, weights, normals)), beta)


def log_evidence(
    suspect: Float[Array, "vertices 3"],
    x: Float[Array, "vertices 3"],
    carrier: Carrier,
    codeword: Float[Array, " code"],
    *,
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, ""]:
    """Compute -ln p of a claimed codeword in nats, where p bounds the probability of a false detection.

    Gradient attacks decrease this value, and defences increase it. It is a differentiable function of the suspect and,
    through the carrier, of the bands and their strengths. Keyed signs and codeword are made once on the host
    (`Marker.reader.carrier`, `Marker.codeword`), and gradients treat them as constants.

    Args:
        suspect: see `detect_bits`.
        x: see `detect_bits`.
        carrier: see `detect_bits`; `KeyedCarrier.with_bands` replaces its bands and strengths.
        codeword: ±1, `[code bits]`, fixed before the suspect was seen.
        weights: see `detect_bits`.
        normals: see `detect_bits`.

    Returns:
        max t²/2 - ln(ways) over the ways of weighting the suspect, with t = S/‖a‖ (Hoeffding's bound with a Bonferroni
        correction); negative if nothing is proven.

    Raises:
        JaxmarkError: if the suspect is neither float32 nor float64, or an argument has a wrong shape.
    """
    _check_suspect(suspect, x, weights, normals)
    _check_bits(codeword, carrier)
    reader = carrier.reader()
    return best_evidence(*claims(reader, reader.receive(observe(suspect - x, weights, normals)), codeword))


def best_evidence(scores: Float[Array, " ways"], norms: Float[Array, " ways"]) -> Float[Array, ""]:
    """Compute -ln p of the best of several ways of weighting; see `log_evidence`.

    As in `jaxmark.watermark.evidence.bounds.log10_p_score`, scores and norms that are not positive or not finite prove
    nothing; those of a suspect that is the original itself are 0.
    """
    proves = (norms > 0) & jnp.isfinite(norms) & jnp.isfinite(scores)
    ratios = jnp.where(proves, jnp.maximum(scores, 0) / jnp.where(proves, norms, 1), 0)
    return jnp.max(ratios) ** 2 / 2 - math.log(len(ratios))


def _check_bits(bits: Float[Array, " bits"], carrier: Carrier) -> None:
    if jnp.shape(bits) != (carrier.code_bits,):
        raise JaxmarkError(f"This carrier has {carrier.code_bits} code bits; got the shape {jnp.shape(bits)}.")


def _check_suspect(suspect: Array, x: Array, weights: Array | None, normals: Array | None) -> None:
    check_precision("a suspect", jnp.asarray(suspect))
    for name, given, shape in (
        ("the suspect", suspect, jnp.shape(x)),
        ("weights", weights, jnp.shape(x)[:1]),
        ("normals", normals, jnp.shape(x)),
    ):
        if given is not None and jnp.shape(given) != shape:
            raise JaxmarkError(
                f"The original has {len(x)} rows in its order, and so must {name}; got the shape {jnp.shape(given)}."
                " jaxmark.detect aligns any mesh with its original."
            )
