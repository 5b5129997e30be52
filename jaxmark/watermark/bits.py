"""Embedding, detection and evidence as three pure functions of arrays.

`embed_bits`, `detect_bits` and `log_evidence` take carriers as arguments, and work under every transformation of JAX.
`jaxmark.watermark.markers` does the same for meshes, messages and keys.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.alignment.observation import observe
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.carriers import Carrier
from jaxmark.watermark.interfaces import Detector, Strength
from jaxmark.watermark.reading.detectors import claims, decorrelate


def embed_bits(
    x: Float[Array, "vertices 3"], bits: Float[Array, " bits"], carrier: Carrier, beta: Strength
) -> Float[Array, "vertices 3"]:
    """Compute the marked coordinates x + displacement(bits, β) (Sohn et al., 2.2.1).

    Args:
        x: the original's coordinates `[N, 3]`.
        bits: -1 or +1, `[k]`; any real amplitudes are allowed.
        carrier: see `jaxmark.watermark.carriers`.
        beta: strength: a scalar, or one number per band, or one per band and coordinate. For components of unit norm it
            is the D-norm that one bit writes in one band, in the units of `x`; for components as printed, it is
            relative to the host's own component.

    Returns:
        Marked coordinates `[N, 3]`.

    Raises:
        JaxmarkError: if bits or β have another shape.
    """
    _check_bits(bits, carrier)
    return x + carrier.displacement(bits, beta)


def detect_bits(
    suspect: Float[Array, "vertices 3"],
    x: Float[Array, "vertices 3"],
    carrier: Carrier,
    detector: Detector = decorrelate,
    beta: Strength = 1.0,
    *,
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, " bits"]:
    """Compute soft values of the bits in a suspect, given the original; their signs are the bits (Sohn et al., 2.2.2).

    Args:
        suspect: coordinates `[N, 3]` in the original's vertex order.
        x: the original's coordinates `[N, 3]`.
        carrier: the carrier that the bits were embedded with.
        detector: see `jaxmark.watermark.reading.detectors`.
        beta: the strengths' profile over the bands, as embedded; a common factor only rescales the result.
        weights: relative inverse variance of each vertex `[N]`, 0 where nothing is known; by default all are equal.
        normals: unit vectors `[N, 3]`, if only the displacement along them is known; by default all of it is.

    Returns:
        Soft values, `[k]`.

    Raises:
        JaxmarkError: if an argument has another shape.
    """
    _check_suspect(suspect, x, weights, normals)
    reader = carrier.reader()
    return detector(reader, reader.receive(observe(suspect - x, weights, normals)), beta)


def log_evidence(
    suspect: Float[Array, "vertices 3"],
    x: Float[Array, "vertices 3"],
    carrier: Carrier,
    codeword: Float[Array, " code"],
    *,
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, ""]:
    """Compute -ln p of a claimed codeword, for p the bound on the probability of a false detection, in nats.

    It is what gradient attacks lower and defences raise: a function of the suspect and, through the carrier, of the
    bands and their strengths. Keyed signs and codeword are made once on the host (`Marker.reader.carrier`,
    `Marker.codeword`), and gradients hold them fixed.

    Args:
        suspect: see `detect_bits`.
        x: see `detect_bits`.
        carrier: see `detect_bits`; `KeyedCarrier.with_bands` puts other bands and strengths in.
        codeword: ±1, `[code bits]`, fixed before the suspect was seen.
        weights: see `detect_bits`.
        normals: see `detect_bits`.

    Returns:
        max t²/2 - ln(ways) over the ways of weighting the suspect, for t = S/‖a‖ (Hoeffding's bound, and Bonferroni's);
        negative where nothing is proven.

    Raises:
        JaxmarkError: if the suspect is neither float32 nor float64, or an argument has another shape.
    """
    _check_suspect(suspect, x, weights, normals)
    _check_bits(codeword, carrier)
    reader = carrier.reader()
    scores, norms = claims(reader, reader.receive(observe(suspect - x, weights, normals)), codeword)
    ratios = jnp.maximum(scores / norms, 0)
    return jnp.max(ratios) ** 2 / 2 - math.log(len(ratios))


def _check_bits(bits: Float[Array, " bits"], carrier: Carrier) -> None:
    if jnp.shape(bits) != (carrier.code_bits,):
        raise JaxmarkError(f"This carrier has {carrier.code_bits} code bits; got the shape {jnp.shape(bits)}.")


def _check_suspect(suspect: Array, x: Array, weights: Array | None, normals: Array | None) -> None:
    for name, given, shape in (
        ("the suspect", suspect, jnp.shape(x)),
        ("weights", weights, jnp.shape(x)[:1]),
        ("normals", normals, jnp.shape(x)),
    ):
        if given is not None and jnp.shape(given) != shape:
            raise JaxmarkError(
                f"The original has {len(x)} rows in its order, and so must {name}; got the shape {jnp.shape(given)}."
                " jaxmark.detect brings any mesh back to its original."
            )
