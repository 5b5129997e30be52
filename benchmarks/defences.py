"""What each defence buys: python benchmarks/defences.py MESH [--steps 20] [--rounds 2] [--queries 300].

As `adversarial.py`: a mark of 64 bits at 0.08 % RMS, brought below detection at 1e-6 with its message claimed; what
that costs over the mark's own distortion. First defences of the mark, against who knows the program and, where
strengths are tuned, these; then of the detector's answers, against who may ask so many times.

  tuned: strengths by `jaxmark.tune`, in rounds; in each the attackers go against the strengths of the last, and what
         they do is added to all that the next are tuned to (min-max by fictitious play)
  jittered: the strength of each band times a factor that the key draws, log-normal, spread 0.5; the attacker takes its
         median for it
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import jax
import numpy as np
from adversarial import ALPHA, BITS, BUDGET, KEY, MESSAGE, METRICS, TOLERANCE, Subject, around, costs, mark

import jaxmark as jm
from jaxmark.attacks import adversarial as enemies
from jaxmark.keys import derive
from jaxmark.mesh import Mesh
from jaxmark.original import prepare
from jaxmark.schemes import KeyedScheme

JITTER = 0.5
STEP, SPREAD = 5.0, 5.0  # of scores, in units of their noise in meshes without a mark


def descent(family: enemies.Family, known: KeyedScheme, steps: int) -> jm.Attack:
    return enemies.descent(family, scheme=known, bits=BITS, steps=steps)


def tuned(mesh: Mesh, steps: int, rounds: int) -> Iterator[tuple[str, KeyedScheme, KeyedScheme]]:
    scheme, attacks = KeyedScheme(), []
    for count in range(1, rounds + 1):
        attacks += [(descent(family, scheme, steps), 4 * BUDGET) for family in ("bands", "vertices")]
        found = jm.tune(mesh, attacks, BUDGET, key=jax.random.key(0), bits=BITS, margin="evidence")
        scheme = found.scheme
        yield f"tuned, round {count}", scheme, scheme


def jittered(mesh: Mesh) -> tuple[str, KeyedScheme, KeyedScheme]:
    original, known = prepare(mesh), KeyedScheme()
    random = np.random.default_rng(int.from_bytes(derive(KEY, original.geometry, "benchmark/jitter", 16), "little"))
    strengths = known.strengths(original, BITS)
    jitter = np.exp(JITTER * random.normal(size=len(strengths)))
    return "jittered strengths", replace(known, profile=tuple(map(float, strengths * jitter))), known


def broken(subject: Subject, attack: jm.Attack) -> str:
    marker, marked, _ = subject
    found = jm.minimum_distortion(
        marker, marked, MESSAGE, attack, alpha=ALPHA, metrics=METRICS, tolerance=TOLERANCE, seed=1
    )
    return costs({metric: found.cost(metric) for metric in METRICS}) if found.weakest else "detected"


def line(*cells: str) -> None:
    print("|", " | ".join(cells), "|", flush=True)


def marks(mesh: Mesh, steps: int, rounds: int) -> None:
    line("defence of the mark", "noise by theory, rms", "bands, by gradient", "vertices, by gradient")
    print("|---|---|---|---|")
    schemes = [("none", KeyedScheme(), KeyedScheme()), *tuned(mesh, steps, rounds), jittered(mesh)]
    for name, scheme, known in schemes:
        subject = mark(mesh, scheme)
        ways = [around(descent(family, known, steps), subject[2]) for family in ("bands", "vertices")]
        line(name, f"{subject[2]:.3g}", *(broken(subject, way) for way in ways))


def answers(mesh: Mesh, queries: int) -> None:
    subject = mark(mesh, KeyedScheme())
    exact = enemies.score_oracle(subject[0], MESSAGE)
    oracles: dict[str, Callable[[Mesh], float]] = {
        "exact scores": exact,
        f"scores rounded to {STEP:g}": enemies.quantised(exact, STEP),
        f"scores with noise of {SPREAD:g}": enemies.randomised(exact, SPREAD, KEY),
    }
    print()
    line("answers of the detector", "gradients of scores", "random search by scores")
    print("|---|---|---|")
    for name, oracle in oracles.items():
        ways = [search(oracle, queries=queries) for search in (enemies.estimated_gradient, enemies.random_search)]
        line(name, *(broken(subject, around(way, subject[2])) for way in ways))
    print()
    line("decisions of the detector", "boundary by decisions")
    print("|---|---|")
    decisions = {
        "exact threshold": enemies.decision_oracle(subject[0], MESSAGE, ALPHA),
        f"threshold with noise of {SPREAD:g}": enemies.decided(enemies.randomised(exact, SPREAD, KEY), ALPHA),
    }
    for name, decision in decisions.items():
        line(name, broken(subject, enemies.boundary(decision)._replace(strengths=(queries, queries))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh")
    parser.add_argument("--steps", type=int, default=20, help="of optimisers")
    parser.add_argument("--rounds", type=int, default=2, help="of tuning")
    parser.add_argument("--queries", type=int, default=300)
    arguments = parser.parse_args()
    try:
        mesh = jm.load_mesh(arguments.mesh)
    except jm.JaxmarkError as error:
        sys.exit(str(error))
    print(f"Distortion over the mark's, {' / '.join(METRICS)}:\n")
    marks(mesh, arguments.steps, arguments.rounds)
    answers(mesh, arguments.queries)


if __name__ == "__main__":
    main()
