"""Chains of attacks that remove marks, found by an evolutionary search without gradients.

A step of a chain is a name in `ATTACKS` and a strength; every program can be a step, because no gradients are needed.
Chains are judged on marks that the attacker makes.
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
_REFUSED = 1e9  # the cost of a chain that cannot be applied
_MOST_GROWTH = 4  # largest growth of the number of vertices
_STEP = 0.25  # standard deviation of a change of `Gene.place`
_FACTOR = 16.0  # factor of the strength of `chain_attack` that corresponds to a change of `Gene.place` by 1


class Gene(NamedTuple):
    """A step of a chain."""

    kind: str
    place: float  # position between the weakest strength of its kind (0) and the strongest (1)


class Chain(NamedTuple):
    """A chain, with its cost."""

    genes: tuple[Gene, ...]
    cost: float  # the cost that the judge returned


def search_chain(
    judge: Judge,
    *,
    tools: Tools = TOOLS,
    steps: int = 4,
    population: int = 12,
    generations: int = 8,
    seed: int = 0,
    log: Callable[[str], None] = lambda line: None,
) -> Chain:
    """Search for the chain of tools with the least cost, by evolution.

    The first generation has one chain of a single step for each tool. Each later generation consists of mutations of
    the best chains found so far, a third of `population`. A mutation changes one strength; replaces, adds, removes or
    moves one step; or combines the head of one chain with the tail of another.

    Args:
        judge: function that returns the cost of a chain, such as `projected_cost`; a chain that is refused by a
            `JaxmarkError` costs most.
        tools: the kinds of steps.
        steps: length of the longest chain.
        population: number of chains in a generation after the first.
        generations: number of generations that are judged.
        seed: seed of all random choices.
        log: callback, called with a line after each generation.

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
                    raise JaxmarkError(f"The judge returned NaN for the chain {decoded}; it must return a number.")
        best = sorted(known.values(), key=lambda one: one.cost)[: max(population // 3, 1)]
        log(f"generation {generation + 1}: {best[0].cost:.4g} by {decode(best[0].genes, tools)}")
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
    """Make a judge that estimates the distortion by which a chain makes marks undetectable: the mean over meshes.

    The cost of a chain is its distortion of the marked mesh, divided by the distortion by the mark. If a claim of the
    message is still proven after the chain, the cost is extrapolated as if the chain were noise. Noise of n times the
    mark's size reduces the evidence E₀ = -log10 p to E = E₀/(1 + n²/c). To reduce it to E₁ = -log10 α, n must be
    √((E₀/E₁ - 1)/(E₀/E - 1)) times as large.

    Args:
        pairs: markers of the attacker's own meshes, with meshes that they marked and the messages.
        metric: a metric of `distortion.METRICS`; one that needs the connectivity makes remeshing cost most.
        log10_alpha: log10 of the false-positive probability of detection.
        seed: seed of the attacks.

    Raises:
        JaxmarkError: if there is no such metric, no mark, or a mark that is not proven before any attack.
    """
    if metric not in METRICS:
        raise JaxmarkError(f"There is no metric {metric!r}; there are {', '.join(METRICS)}.")
    if not pairs:
        raise JaxmarkError("A search for chains needs at least one mark of the attacker to judge chains by.")
    references = [Reference(marked) for _, marked, _ in pairs]
    proven = [-_log10_p(*pair) for pair in pairs]
    if min(proven) <= -log10_alpha:
        raise JaxmarkError("A mark is not proven before any attack, so that it cannot judge attacks; make it stronger.")
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
    """Apply the steps of a chain; raise an error if the number of vertices grows by more than a factor of four."""
    most = _MOST_GROWTH * len(mesh.vertices)
    for place, (kind, strength) in enumerate(steps):
        mesh = attack(mesh, kind, strength, seed=seed + place)
        if len(mesh.vertices) > most:
            raise JaxmarkError(f"The chain makes more than {_MOST_GROWTH} times as many vertices; refine less.")
    return mesh


def chain_attack(genes: Sequence[Gene], tools: Tools = TOOLS) -> Attack:
    """Convert a chain to an attack, whose strength 1 is the chain as it is.

    The strengths of all steps change together: a factor of 16 in the attack's strength corresponds to the whole range
    of each step's strength.
    """

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        shift = math.log(max(strength, 1e-300)) / math.log(_FACTOR)
        moved = [gene._replace(place=gene.place + shift) for gene in genes]
        return run_chain(mesh, decode(moved, tools), seed=int(generator(seed).integers(2**31)))

    return Attack(apply, "strength relative to the chain as found", (1 / _FACTOR, 1, _FACTOR), host=True, faces=True)


def _log10_p(marker: NonBlindMarker, suspect: Mesh, message: bytes) -> float:
    try:
        return marker.detect(suspect, message).evidence.log10_p_unfloored
    except JaxmarkError:  # a suspect that cannot be aligned is not detected
        return 0.0


def _changed(
    parents: Sequence[tuple[Gene, ...]], kinds: Sequence[str], longest: int, random: np.random.Generator
) -> tuple[Gene, ...]:
    """Mutate one of the parents, or combine two of them."""

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
