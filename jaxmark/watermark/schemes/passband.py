"""The adaptive pass band: the pass band of a mark is chosen from the mesh and the budget.

If only a small displacement is allowed, a mark that is spread over many dimensions is lost in noise. Low bands, where
the same displacement is less visible, then give more evidence. The pass band with most evidence in noise is predicted
from the original and the budget alone, without a key and without an attack. If the budget is only an RMS displacement,
which counts equally in all bands, the usual pass band is kept. Readers without a record try all pass bands, which the
ledger charges.
"""

import math
from dataclasses import replace

from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.perception.budget import Bounds, reference_of
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.schemes.keyed import KeyedScheme

#: The pass bands that marks of the default scheme can have, the usual one first.
ADAPTIVE = ("tapered", "low", "lowest")
_PLENTY = -2 * MIN_LOG10_P * math.log(10)  # nats; with twice the evidence of the floor, no other pass band is needed
_LEAST_GAIN = 1.1  # least factor of evidence for choosing another pass band: predictions are no more precise


def candidates(scheme: Scheme) -> tuple[Scheme, ...]:
    """List the schemes that marks may have if a scheme is given by name: one per pass band for the default scheme."""
    if scheme != KeyedScheme():
        return (scheme,)
    return tuple(replace(KeyedScheme(), passband=name) for name in ADAPTIVE)


def choose_pass_band(usual: Capacity, bits: int, bounds: Bounds, noise: float = NOISE) -> Scheme:
    """Choose the pass band of the default scheme that gives most evidence for a claimed message in noise.

    Args:
        usual: the capacity of an original with its scheme; only the default scheme has several pass bands.
        bits: size of the payload in bits.
        bounds: the bounds on the distortion.
        noise: the noise for which the evidence is predicted, as in `Conditions`, positive.

    Returns:
        The scheme with the chosen pass band; any other scheme than the default is returned unchanged.

    Raises:
        JaxmarkError: if a limit cannot be measured, or no displacement keeps it, see `displace_within`.
    """
    original, best = usual.original, usual.scheme
    if best != KeyedScheme() or not bounds.limits:
        return best
    reference_of(original).begin(bounds.limits)
    reached = usual.estimate_reach(bits, bounds, usual.needed(bits, _PLENTY, noise))
    most = usual.evidence(bits, reached, noise) * (1 + 1e-6)  # the factor allows for rounding
    for other in candidates(best)[1:]:
        # Even without noise, the evidence is at most half of the number of dimensions, in nats.
        if most >= min(_PLENTY, other.dimensions(original, bits) / 2):
            break
        capacity = Capacity(original, other)
        if not math.isfinite(capacity.least_budget(bits, Conditions(bounds, noise, COVERAGE))):
            break  # the payload does not fit
        evidence = capacity.evidence(bits, capacity.estimate_reach(bits, bounds), noise)
        if evidence > _LEAST_GAIN * most:
            best, most = other, evidence
    return best
