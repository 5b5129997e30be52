"""The width and the step of a blind mark that leave most readable after the worst of several attacks."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmark import distortion
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.tuning import Attacker, apply_attack, check_attackers, seed_numbers
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Seed
from jaxmark.watermark.blind.prediction import Left, best_margin, compare
from jaxmark.watermark.blind.reading import codeword, register
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.blind.writing import Plan, carried, sureness
from jaxmark.watermark.markers import make_blind_marker
from jaxmark.watermark.perception.budget import Budget, BudgetLike
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, find_blind

_PUBLIC_KEY = bytes(32)  # predictions hardly depend on the key


class TunedBlind(NamedTuple):
    """A blind scheme of the width and the step that are predicted to leave most after the worst attack."""

    scheme: BlindScheme  # `embed` takes it; whoever reads needs no more than the scheme's name
    worst: float  # surplus after the worst of the attacks; if it is negative, messages are not expected to read
    choices: tuple[tuple[float, float], ...]  # all widths and steps that the budget allows
    surplus: Float64[np.ndarray, "choices attacks"]  # in nats, see `jaxmark.watermark.blind.prediction.margin`


def tune_blind(
    mesh: Mesh,
    attacks: Sequence[Attacker],
    budget: BudgetLike = None,
    *,
    seed: Seed,
    bits: int = 64,
    scheme: str | BlindScheme = "field",
    samples: int = 1,
) -> TunedBlind:
    """Choose width and step of a mark that is read without the original, for the attacks that it must survive.

    The original is attacked, and looked at as a suspect is; how far its values are from what they were tells what would
    be left of any mark. A wide average survives more smoothing, a narrow one gives more anchors; a large step survives
    more noise, a small one is met more exactly within the same budget. All that a budget allows are compared, by how
    much the information that is left exceeds what payload and tag need. If that is negative after the worst of the
    attacks, the mark is not expected to survive it.

    Args:
        mesh: the original.
        attacks: see `jaxmark.evaluation.tuning.tune`.
        budget: see `jaxmark.watermark.everyday.embed`.
        seed: see `jaxmark.evaluation.tuning.tune`.
        bits: size of the payload in bits.
        scheme: a blind scheme, whose widths and steps are compared.
        samples: number of times that each attack is tried; predictions are averaged.

    Raises:
        JaxmarkError: if the mesh, an attack, the budget or a number is unusable, the scheme is no blind one, or the
            budget leaves nothing to write in.
    """
    if not attacks or samples < 1:
        raise JaxmarkError(f"tune_blind needs at least one attack and one sample, got {len(attacks)} and {samples}.")
    check_attackers(attacks)
    blind = find_blind(scheme)
    if blind is None:
        raise JaxmarkError(
            f"tune_blind tunes the schemes that are read without the original ({', '.join(BLIND_SCHEMES)}), not"
            f" {scheme!r}; for the others there is tune."
        )
    numbers = seed_numbers(seed, samples)
    writer = make_blind_marker(mesh, _PUBLIC_KEY, bits=bits, scheme=blind).writer
    word = codeword(bytes(bits // 8), writer.choices)
    allowances = writer.allowances(word, Budget.of(budget).bounds(mesh), distortion.Reference(mesh))
    plans = [one.plan(step) for one in allowances for step in writer.steps(one)]
    if not plans:
        raise JaxmarkError(f"This mesh, or the budget for it, leaves the scheme {blind.name!r} nothing to write in.")

    def looks(suspect: Mesh) -> dict[float, list[Look]]:
        found = sorted(blind.views(register(suspect), writer.choices), key=lambda look: look.width)
        return {width: list(some) for width, some in groupby(found, key=lambda look: look.width)}

    before = {width: some[0] for width, some in looks(mesh).items()}

    def left(attacker: Attacker, seed: int) -> dict[float, list[Left]]:
        seen = looks(apply_attack(attacker, mesh, seed))
        return {width: [way for look in some for way in compare(before[width], look)] for width, some in seen.items()}

    found = [[left(one, int(seed)) for seed in numbers] for one in attacks]
    size = carried(bits)

    def left_of(plan: Plan, row: list[dict[float, list[Left]]]) -> float:
        ways = (one[plan.width] for one in row)
        return float(np.mean([best_margin(some, plan.step, plan.alpha, size).surplus for some in ways]))

    surplus = np.array([[left_of(plan, row) for row in found] for plan in plans])
    worst = surplus.min(axis=1)
    chosen = max(range(len(plans)), key=lambda one: (sureness(plans[one], bits), worst[one]))
    return TunedBlind(
        blind.fixed(plans[chosen].width, plans[chosen].step),
        float(worst[chosen]),
        tuple((plan.width, plan.step) for plan in plans),
        surplus,
    )
