"""What each defence buys: python benchmarks/security/defences.py MESH [--steps 20] [--rounds 2] [--queries 300].

As `adversarial.py`: a mark of 64 bits at 0.08 % RMS, brought below detection at 1e-6 with its message claimed; what
that costs over the mark's own distortion. First defences of the mark, against who knows the program and, where
strengths are tuned, these; then of the detector's answers, against who may ask so many times.

  tuned: strengths by `jaxmark.tune`, in rounds; in each the attackers go against the strengths of the last, and what
         they do is added to all that the next are tuned to (min-max by fictitious play)
  jittered: the strength of each band times a factor that the key draws, log-normal, spread 0.5; the attacker takes its
         median for it
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import jaxmark as jm
from jaxmark import adversaries as enemies
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.schemes import KeyedScheme, Scheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.costs import ALPHA, BITS, METRICS, Target, around, costs, least_distortion, make_target
from common.marks import BUDGET, KEY, MESSAGE
from common.tables import head, line

JITTER = 0.5
STEP, SPREAD = 5.0, 5.0  # of scores, in units of their noise in meshes without a mark


def descent(family: enemies.Family, known: Scheme, steps: int) -> jm.attacks.Attack:
    return enemies.descent(family, scheme=known, bits=BITS, steps=steps)


def tuned(mesh: Mesh, steps: int, rounds: int) -> Iterator[tuple[str, Scheme, Scheme]]:
    scheme: Scheme = KeyedScheme()
    attacks = []
    for count in range(1, rounds + 1):
        attacks += [(descent(family, scheme, steps), 4 * BUDGET) for family in ("bands", "vertices")]
        found = jm.tune(mesh, attacks, BUDGET, key=jax.random.key(0), bits=BITS, margin="evidence")
        scheme = found.scheme
        yield f"tuned, round {count}", scheme, scheme


def jittered(mesh: Mesh) -> tuple[str, KeyedScheme, KeyedScheme]:
    original, known = make_original(mesh), KeyedScheme()
    random = np.random.default_rng(
        int.from_bytes(Choices(KEY, original.geometry).derive("benchmark/jitter", 16), "little")
    )
    strengths = known.strengths(original, BITS)
    jitter = np.exp(JITTER * random.normal(size=len(strengths)))
    return "jittered strengths", replace(known, profile=tuple(map(float, strengths * jitter))), known


def broken(target: Target, attack: jm.attacks.Attack) -> str:
    found = least_distortion(target, attack, seed=1)
    return costs({metric: found.cost(metric) for metric in METRICS}) if found.weakest else "detected"


def marks(mesh: Mesh, steps: int, rounds: int) -> None:
    print(head("defence of the mark", "noise by theory, rms", "bands, by gradient", "vertices, by gradient"))
    schemes = [("none", KeyedScheme(), KeyedScheme()), *tuned(mesh, steps, rounds), jittered(mesh)]
    for name, scheme, known in schemes:
        target = make_target(mesh, scheme)
        ways = [around(descent(family, known, steps), target.theory) for family in ("bands", "vertices")]
        print(line(name, f"{target.theory:.3g}", *(broken(target, way) for way in ways)), flush=True)


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
        print(line(name, *(broken(target, around(way, target.theory)) for way in ways)), flush=True)
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
        print(line(name, broken(target, attack)), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--steps", type=int, default=20, help="of optimisers")
    parser.add_argument("--rounds", type=int, default=2, help="of tuning")
    parser.add_argument("--queries", type=int, default=300)
    arguments = parser.parse_args()
    mesh = load(parser, arguments.mesh)
    print(f"Distortion over the mark's, {' / '.join(METRICS)}:\n")
    marks(mesh, arguments.steps, arguments.rounds)
    answers(mesh, arguments.queries)


if __name__ == "__main__":
    main()
