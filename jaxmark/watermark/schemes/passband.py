"""The adaptive pass band: what a mark proves depends on how strong it may be.

Where little displacement is allowed, noise covers a mark that is spread over many dimensions, and low bands, in which
the same displacement is less visible, prove more. Which pass band proves most is predicted for noise from the original
and the budget alone, without a key and without an attack. Where only an RMS displacement is given, which counts alike
in all bands, the usual pass band stays. Readers without a record try all of them, which the ledger charges.
"""

import math
from dataclasses import replace

from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.perception.budget import Bounds
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.schemes.keyed import KeyedScheme

#: The pass bands that marks of the default scheme may have, the usual one first.
ADAPTIVE = ("tapered", "low", "lowest")
_PLENTY = -2 * MIN_LOG10_P * math.log(10)  # nats: with twice what can be proven, another pass band has no use
_LEAST_GAIN = 1.1  # of the evidence, for which it is another one: predictions are as good as that


def candidates(scheme: Scheme) -> tuple[Scheme, ...]:
    """Return the schemes that marks may have where this one is meant by its name: of the default, one a pass band."""
    if scheme != KeyedScheme():
        return (scheme,)
    return tuple(replace(KeyedScheme(), passband=name) for name in ADAPTIVE)


def choose_pass_band(usual: Capacity, bits: int, bounds: Bounds, noise: float = NOISE) -> Scheme:
    """Choose among the pass bands of the default scheme the one with most evidence for a claimed message in noise.

    Args:
        usual: what an original can carry with its scheme, which stands for several if it is the default.
        bits: size of the payload in bits.
        bounds: the bounds to keep.
        noise: the noise that evidence is predicted for, as in `Conditions`, positive.

    Returns:
        The scheme with the pass band; any scheme but the default as it is.

    Raises:
        JaxmarkError: if a limit cannot be measured or kept by any displacement, see `displace_within`.
    """
    original, best = usual.original, usual.scheme
    if best != KeyedScheme() or not bounds.limits:
        return best
    reached = usual.estimate_reach(bits, bounds, usual.needed(bits, _PLENTY, noise))
    most = usual.evidence(bits, reached, noise) * (1 + 1e-6)  # as numbers are rounded
    for other in candidates(best)[1:]:
        # Without any noise, half of the dimensions are left.
        if most >= min(_PLENTY, other.dimensions(original, bits) / 2):
            break
        capacity = Capacity(original, other, reference=usual.reference)
        if not math.isfinite(capacity.least_budget(bits, Conditions(bounds, noise, COVERAGE))):
            break  # the payload does not fit
        found = capacity.evidence(bits, capacity.estimate_reach(bits, bounds), noise)
        if found > _LEAST_GAIN * most:
            best, most = other, found
    return best
