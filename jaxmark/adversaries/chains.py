"""Chains of tools, found by evolution on marks of the attacker's own: no gradient, and any program may be a step.

Chains are judged on marks that the attacker makes. A step is a name in `ATTACKS` and a strength.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxmark.adversaries.by_name import attack, get_attack
from jaxmark.attacks.attack import Attack
from jaxmark.distortion import METRICS, Reference
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Randomness, generator
from jaxmark.watermark.markers import NonBlindMarker

Tools = Mapping[str, tuple[float, float]]  # kinds of steps, with the weakest and the strongest strength of each
Steps = Sequence[tuple[str, float]]
Judge = Callable[[Steps], float]  # the cost of a chain

#: The kinds of steps by default; whole numbers stay whole.
TOOLS: Tools = {
    "noise": (0.0003, 0.05),
    "jamming": (0.0001, 0.01),
    "smoothing": (1, 300),
    "taubin": (1, 300),
    "bilateral": (1, 30),
    "shrinkage": (0.00003, 0.01),
    "non-local-means": (1, 300),
    "quantisation": (12, 4),
    "isotropic": (0.5, 3),
    "simplification": (0.05, 0.95),
    "loop": (1, 1),
}
_REFUSED = 1e9  # what a chain costs that a mesh refuses
_MOST_GROWTH = 4  # of the number of vertices
_STEP = 0.25  # of strengths in one change, over the way from the weakest to the strongest
_FACTOR = 16.0  # by which strengths change over that way in the unit of `chain_attack`


class Gene(NamedTuple):
    """A step of a chain."""

    kind: str
    place: float  # between the weakest strength of its kind, 0, and the strongest, 1


class Chain(NamedTuple):
    """A chain that was tried."""

    genes: tuple[Gene, ...]
    cost: float  # by the judge


def search_chain(
    judge: Judge,
    *,
    tools: Tools = TOOLS,
    steps: int = 4,
    population: int = 12,
    generations: int = 8,
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> Chain:
    """Search for the chain of tools that costs least, by evolution: the best third lives on and has changed copies.

    The first generation has one chain of a single step for each tool. A changed copy has one strength moved, one step
    replaced, added, left out or put elsewhere, or the head of one parent and the tail of another.

    Args:
        judge: function that returns the cost of a chain, such as `projected_cost`; a chain that is refused by a
            `JaxmarkError` costs most.
        tools: the kinds of steps.
        steps: length of the longest chain.
        population: number of chains in a generation after the first.
        generations: number of generations that are judged.
        seed: seed of all random choices.
        say: function that is called with a line after each generation.

    Raises:
        JaxmarkError: if there is no tool, an attack is unknown, a strength is not positive, or a number is below 1; or
            if the judge returns NaN.
    """
    for kind in tools:
        get_attack(kind)
    if none := [kind for kind, strengths in tools.items() if not min(strengths) > 0]:
        raise JaxmarkError(f"The strengths of a tool must be positive, got {tools[none[0]]} for {none[0]!r}.")
    if not tools or min(steps, population, generations) < 1:
        raise JaxmarkError(
            f"A search needs a tool, a step, a chain and a generation; got {len(tools)} tools, {steps}, {population}"
            f" and {generations}."
        )
    random, kinds = np.random.default_rng(seed), list(tools)
    known: dict[tuple[tuple[str, float], ...], Chain] = {}
    some = [(Gene(kind, float(random.random())),) for kind in kinds]
    for generation in range(generations):
        for one in some:
            if (decoded := decode(one, tools)) not in known:
                try:
                    known[decoded] = Chain(one, judge(decoded))
                except JaxmarkError:
                    known[decoded] = Chain(one, _REFUSED)
                if math.isnan(known[decoded].cost):
                    raise JaxmarkError(f"The judge says that the chain {decoded} costs no number.")
        best = sorted(known.values(), key=lambda one: one.cost)[: max(population // 3, 1)]
        say(f"generation {generation + 1}: {best[0].cost:.4g} by {decode(best[0].genes, tools)}")
        some = [_changed([one.genes for one in best], kinds, steps, random) for _ in range(population)]
    return min(known.values(), key=lambda one: one.cost)


def decode(genes: Sequence[Gene], tools: Tools = TOOLS) -> tuple[tuple[str, float], ...]:
    """Return the steps of a chain with their strengths, which grow geometrically from the weakest to the strongest."""
    steps = []
    for kind, place in genes:
        weakest, strongest = tools[kind]
        strength = weakest * (strongest / weakest) ** min(max(place, 0.0), 1.0)
        whole = float(weakest).is_integer() and float(strongest).is_integer() and max(tools[kind]) >= 1
        steps.append((kind, float(round(strength)) if whole else float(f"{strength:.3g}")))
    return tuple(steps)


def projected_cost(
    pairs: Sequence[tuple[NonBlindMarker, Mesh, bytes]],
    metric: str = "msdm2",
    *,
    log10_alpha: float = -6.0,
    seed: int = 0,
) -> Judge:
    """Judge chains by the cost of bringing marks below detection with them: the mean over meshes.

    The cost of a chain is the distortion of the marked mesh over that of the mark. If the claim of the message is
    still proven, it grows as noise would have to: noise of n times the mark's size leaves E = E₀/(1 + n²/c) of the
    evidence E₀ = -log10 p, so that n must be √((E₀/E₁ - 1)/(E₀/E - 1)) times as large to leave E₁ = -log10 α.

    Args:
        pairs: markers of the attacker's own meshes, with meshes that they marked and the messages.
        metric: a metric of `distortion.METRICS`; one that needs the connectivity makes remeshing cost most.
        log10_alpha: log10 of the false-positive probability of detection.
        seed: seed of the attacks.

    Raises:
        JaxmarkError: if there is no such metric, no mark, or one that is not proven before any attack.
    """
    if metric not in METRICS:
        raise JaxmarkError(f"There is no metric {metric!r}; there are {', '.join(METRICS)}.")
    if not pairs:
        raise JaxmarkError("A search for chains needs marks of the attacker's own to judge them by.")
    references = [Reference(marked) for _, marked, _ in pairs]
    proven = [-_log10_p(*pair) for pair in pairs]
    if min(proven) <= -log10_alpha:
        raise JaxmarkError("A mark that is not proven before any attack says nothing about attacks; make it stronger.")
    own = [Reference(marker.original.mesh).measure(marked, [metric])[metric] for marker, marked, _ in pairs]

    def judge(steps: Steps) -> float:
        costs = []
        for (marker, marked, message), reference, mark, first in zip(pairs, references, own, proven, strict=True):
            suspect = run_chain(marked, steps, seed=seed)
            paid = reference.measure(suspect, [metric])[metric]
            left = max(-_log10_p(marker, suspect, message), -log10_alpha)
            if paid is None or not mark or left >= first:  # the chain removes no evidence, however often it is applied
                return _REFUSED
            costs.append(paid / mark * math.sqrt((first / -log10_alpha - 1) / (first / left - 1)))
        return float(np.mean(costs))

    return judge


def run_chain(mesh: Mesh, steps: Steps, *, seed: int) -> Mesh:
    """Apply the steps of a chain; refuse one that makes more than four times as many vertices."""
    most = _MOST_GROWTH * len(mesh.vertices)
    for place, (kind, strength) in enumerate(steps):
        mesh = attack(mesh, kind, strength, seed=seed + place)
        if len(mesh.vertices) > most:
            raise JaxmarkError(f"The chain makes more than {_MOST_GROWTH} times as many vertices; refine less.")
    return mesh


def chain_attack(genes: Sequence[Gene], tools: Tools = TOOLS) -> Attack:
    """Make a chain an attack: all strengths grow together by a factor of 16 from the weakest to the strongest."""

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        shift = math.log(max(strength, 1e-300)) / math.log(_FACTOR)
        moved = [gene._replace(place=gene.place + shift) for gene in genes]
        return run_chain(mesh, decode(moved, tools), seed=int(generator(seed).integers(2**31)))

    return Attack(apply, "strengths over those that were found", (1 / _FACTOR, 1, _FACTOR), host=True, faces=True)


def _log10_p(marker: NonBlindMarker, suspect: Mesh, message: bytes) -> float:
    try:
        return marker.detect(suspect, message).evidence.log10_p_unfloored
    except JaxmarkError:  # what cannot be aligned is not detected
        return 0.0


def _changed(
    parents: Sequence[tuple[Gene, ...]], kinds: Sequence[str], longest: int, random: np.random.Generator
) -> tuple[Gene, ...]:
    """Make a changed copy of one of the parents, or a child of two."""

    def below(count: int) -> int:
        return int(random.integers(count))

    def fresh() -> Gene:
        return Gene(kinds[below(len(kinds))], float(random.random()))

    genes = list(parents[below(len(parents))])
    place, change = below(len(genes)), random.random()
    if change < 0.4:
        moved = genes[place].place + _STEP * random.normal()
        genes[place] = genes[place]._replace(place=min(max(moved, 0.0), 1.0))
    elif change < 0.55:
        genes[place] = fresh()
    elif change < 0.75 and len(genes) < longest:
        genes.insert(below(len(genes) + 1), fresh())
    elif change < 0.85 and len(genes) > 1:
        del genes[place]
    elif change < 0.92:
        genes.insert(below(len(genes)), genes.pop(place))
    else:
        other = parents[below(len(parents))]
        genes = [*genes[: place + 1], *other[below(len(other)) :]][:longest]
    return tuple(genes)
