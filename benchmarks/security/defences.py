"""Measure the gain from each defence: python benchmarks/security/defences.py MESH [--attackers NAME...].

As in `adversarial.py`, a mark of 64 bits at 0.08 % RMS is brought below detection at 1e-6 with its message claimed, and
the table has the cost relative to the mark's own distortion. Defences of the mark come first, against attackers who
have the program and, if strengths are tuned, these strengths. Defences of the detector's answers follow, against
attackers with a limited number of queries.

  tuned: strengths by `jaxmark.tune`, in rounds; in each round the attackers attack the strengths of the round before,
         and their attacks are added to those that the next strengths are tuned to (min-max by fictitious play)
  jittered: the strength of each band times a keyed log-normal factor with spread 0.5; the attacker assumes the median

The attackers of marks are `bands` and `vertices`, by gradient, unless others are named: `shrinkage` of wavelets, and
`rewatermarking`, another mark of the same strengths. The table also has the other costs of a defence: the mark's own
DAME and MSDM2, and log10 p of a claim after noise of 0.5 % and 50 steps of smoothing, without its floor.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxmark as jm
from jaxmark import adversaries as enemies
from jaxmark.alignment.original import make_original
from jaxmark.evaluation._robustness import Breaking
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.keyed import KeyedScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.costs import ALPHA, BITS, METRICS, Target, around, costs, least_distortion, make_target
from common.marks import BUDGET, KEY, MESSAGE
from common.tables import head, line

JITTER = 0.5
STEP, SPREAD = 5.0, 5.0  # of scores, in units of their noise in meshes without a mark


class Attacker(NamedTuple):
    """Who goes against a mark whose strengths are known."""

    attack: Callable[[Scheme, int], jm.attacks.Attack]  # by the strengths, and the number of steps
    strength: float | None  # that marks are tuned to; None is the least one that succeeded
    reach: tuple[float, float] | None = None  # of strengths; None are displacements about noise by theory


def descent(family: enemies.Family, known: Scheme, steps: int) -> jm.attacks.Attack:
    return enemies.descent(family, scheme=known, bits=BITS, steps=steps)


ATTACKERS = {
    "bands": Attacker(partial(descent, "bands"), 4 * BUDGET),
    "vertices": Attacker(partial(descent, "vertices"), 4 * BUDGET),
    "shrinkage": Attacker(lambda known, steps: jm.adversaries.ATTACKS["shrinkage"], None, (3e-5, 3e-2)),
    "rewatermarking": Attacker(lambda known, steps: enemies.rewatermarking(scheme=known, bits=BITS), None),
}
ELSEWHERE = (("noise", 0.005), ("smoothing", 50))


def go_against(target: Target, name: str, known: Scheme, steps: int) -> Breaking:
    attack, reach = ATTACKERS[name].attack(known, steps), ATTACKERS[name].reach
    ranged = around(attack, target.theory) if reach is None else attack._replace(strengths=reach)
    return least_distortion(target, ranged, seed=1)


def tuned(mesh: Mesh, names: Sequence[str], steps: int, rounds: int) -> Iterator[tuple[str, Scheme, Scheme]]:
    scheme: Scheme = KeyedScheme()
    attacks = []
    for count in range(1, rounds + 1):
        for name in names:
            strength = ATTACKERS[name].strength
            if strength is None:
                weakest = go_against(make_target(mesh, scheme), name, scheme, steps).weakest
                if weakest is None:
                    continue
                strength = weakest.strength
            attacks.append((ATTACKERS[name].attack(scheme, steps), strength))
        found = jm.tune(mesh, attacks, BUDGET, seed=0, bits=BITS, margin="evidence")
        scheme = found.scheme
        yield f"tuned, round {count}" + (" (the default)" if found.report.default_kept else ""), scheme, scheme


def jittered(mesh: Mesh) -> tuple[str, KeyedScheme, KeyedScheme]:
    original, known = make_original(mesh), KeyedScheme()
    random = np.random.default_rng(
        int.from_bytes(Choices(KEY, original.geometry).derive("benchmark/jitter", 16), "little")
    )
    strengths = known.strengths(original, BITS)
    jitter = np.exp(JITTER * random.normal(size=len(strengths)))
    return "jittered strengths", replace(known, profile=tuple(map(float, strengths * jitter))), known


def broken(found: Breaking) -> str:
    return costs({metric: found.cost(metric) for metric in METRICS}) if found.weakest else "detected"


def elsewhere(target: Target) -> Iterator[str]:
    seen = jm.compare(target.marker.original.mesh, target.marked, ["dame", "msdm2"])
    yield from (f"{value:.3g}" for value in (seen.dame, seen.msdm2))
    for kind, strength in ELSEWHERE:
        found = target.marker.detect(jm.attack(target.marked, kind, strength, seed=1), MESSAGE)
        yield f"{found.evidence.log10_p_unfloored:.1f}"


def marks(mesh: Mesh, names: Sequence[str], steps: int, rounds: int) -> None:
    after = [f"{kind} {strength:g}" for kind, strength in ELSEWHERE]
    print(head("defence of the mark", "noise by theory, rms", *names, "own DAME", "own MSDM2", *after))
    schemes = [("none", KeyedScheme(), KeyedScheme()), *tuned(mesh, names, steps, rounds), jittered(mesh)]
    for name, scheme, known in schemes:
        target = make_target(mesh, scheme)
        cells = [broken(go_against(target, attacker, known, steps)) for attacker in names]
        print(line(name, f"{target.theory:.3g}", *cells, *elsewhere(target)), flush=True)


def answers(mesh: Mesh, queries: int) -> None:
    target = make_target(mesh, KeyedScheme())
    exact = enemies.score_oracle(target.marker, MESSAGE)
    oracles: dict[str, Callable[[Mesh], float]] = {
        "exact scores": exact,
        f"scores rounded to {STEP:g}": enemies.quantise_scores(exact, STEP),
        f"scores with noise of {SPREAD:g}": enemies.randomise_scores(exact, SPREAD, KEY),
    }
    print()
    print(head("answers of the detector", "gradients of scores", "random search by scores"))
    for name, oracle in oracles.items():
        ways = [search(oracle, queries=queries) for search in (enemies.estimated_gradient, enemies.random_search)]
        found = [least_distortion(target, around(way, target.theory), seed=1) for way in ways]
        print(line(name, *map(broken, found)), flush=True)
    print()
    print(head("decisions of the detector", "boundary by decisions"))
    decisions = {
        "exact threshold": enemies.decision_oracle(target.marker, MESSAGE, ALPHA),
        f"threshold with noise of {SPREAD:g}": enemies.decide_by_score(
            enemies.randomise_scores(exact, SPREAD, KEY), ALPHA
        ),
    }
    for name, decision in decisions.items():
        attack = enemies.boundary(decision)._replace(strengths=(queries, queries))
        print(line(name, broken(least_distortion(target, attack, seed=1))), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--attackers", nargs="+", choices=list(ATTACKERS), default=["bands", "vertices"])
    parser.add_argument("--steps", type=int, default=20, help="of optimisers")
    parser.add_argument("--rounds", type=int, default=2, help="of tuning")
    parser.add_argument("--queries", type=int, default=300, help="of attackers who ask; 0 leaves them out")
    arguments = parser.parse_args()
    mesh = load(parser, arguments.mesh)
    print(f"Distortion over the mark's, {' / '.join(METRICS)}:\n")
    marks(mesh, arguments.attackers, arguments.steps, arguments.rounds)
    if arguments.queries:
        answers(mesh, arguments.queries)


if __name__ == "__main__":
    main()
