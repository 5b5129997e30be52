"""The pass band that suits a budget: what a mark proves depends on how strong it may be.

Where little displacement is allowed, noise covers a mark that is spread over many dimensions, and low bands, in which
as much displacement is seen less, prove more. Which pass band proves most is predicted for noise from the original and
the budget alone, without a key, and without an attack. Where only an RMS displacement is given, which counts alike in
all bands, the usual pass band stays. Readers without a record try all pass bands, and pay for it.
"""

import math

from jaxmark.watermark.evidence.bounds import MIN_LOG10_P
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE, Capacity, Conditions
from jaxmark.watermark.schemes.scheme import KeyedScheme, Scheme, stands_for

_PLENTY = -2 * MIN_LOG10_P * math.log(10)  # nats: with twice what can be proven, another pass band has no use
_LEAST_GAIN = 1.1  # of the evidence, for which it is another one: predictions are as good as that


def suited(usual: Capacity, bits: int, budget: Budget, noise: float = NOISE) -> Scheme:
    """Choose among the pass bands of the default scheme the one with most evidence for a claimed message in noise.

    Args:
        usual: what an original can carry with its scheme, which stands for several if it is the default.
        bits: size of the payload in bits.
        budget: the bounds to keep.
        noise: the noise that evidence is predicted for, as in `Conditions`, positive.

    Returns:
        The scheme with the pass band; any scheme but the default as it is.

    Raises:
        JaxmarkError: if a limit cannot be measured or kept by any displacement, see `budget.write`.
    """
    original, best = usual.original, usual.scheme
    if best != KeyedScheme() or not budget.limits:
        return best
    reached = usual.glimpse(bits, budget, usual.needed(bits, _PLENTY, noise))
    most = usual.evidence(bits, reached, noise) * (1 + 1e-6)  # as numbers are rounded
    for other in stands_for(best)[1:]:
        # Without any noise, half of the dimensions are left.
        if most >= min(_PLENTY, other.dimensions(original, bits) / 2):
            break
        capacity = Capacity(original, other, reference=usual.reference)
        if not math.isfinite(capacity.least_budget(bits, Conditions(budget, noise, COVERAGE))):
            break  # no room for the payload
        found = capacity.evidence(bits, capacity.glimpse(bits, budget), noise)
        if found > _LEAST_GAIN * most:
            best, most = other, found
    return best
