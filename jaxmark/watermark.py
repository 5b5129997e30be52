"""The heart: `embed` and `detect` as two pure functions of arrays.

What carries the bits and how they are read are arguments; both functions work under `jit`, `vmap` and `grad`.
`jaxmark.marking` wraps them for meshes, messages and keys.
"""

from jaxtyping import Array, Float

from jaxmark.carriers import Carrier
from jaxmark.carriers.carrier import Strength
from jaxmark.detectors import Detector, decorrelate
from jaxmark.observation import observe


def embed(
    x: Float[Array, "vertices 3"], bits: Float[Array, " bits"], carrier: Carrier, beta: Strength
) -> Float[Array, "vertices 3"]:
    """Marked coordinates x + displacement(bits, β) (Sohn et al., 2.2.1).

    Args:
        x: the original's coordinates `[N, 3]`.
        bits: -1 or +1, `[k]`; any real amplitudes are allowed.
        carrier: see `jaxmark.carriers`.
        beta: strength, a scalar, per band, or per band and coordinate. For unit-norm components it is the D-norm that
            one bit writes in one band, in the units of `x`; as printed, relative to the host's own component.

    Returns:
        Marked coordinates `[N, 3]`.
    """
    return x + carrier.displacement(bits, beta)


def detect(
    suspect: Float[Array, "vertices 3"],
    x: Float[Array, "vertices 3"],
    carrier: Carrier,
    detector: Detector = decorrelate,
    beta: Strength = 1.0,
    *,
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Float[Array, " bits"]:
    """Soft values of the bits in a suspect, given the original; their signs are the bits (Sohn et al., 2.2.2).

    Args:
        suspect: coordinates `[N, 3]` in the original's vertex order.
        x: the original's coordinates `[N, 3]`.
        carrier: the one that was embedded with.
        detector: see `jaxmark.detectors`.
        beta: the strengths' profile over the bands, as embedded; a common factor only rescales the result.
        weights: relative inverse variance of each vertex `[N]`, 0 where nothing is known; by default all alike.
        normals: unit vectors `[N, 3]`, if only the component along them is known; by default all three are.

    Returns:
        `[k]` soft values.
    """
    return detector(carrier, observe(suspect - x, weights, normals), beta)
