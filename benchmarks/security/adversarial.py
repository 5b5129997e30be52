"""Measure the cost of removing a mark: python benchmarks/security/adversarial.py MESH... --output FOLDER.

For each attacker, the table has the least distortion that brings a mark of 64 bits at 0.08 % RMS below detection at
1e-6, with its message claimed, relative to the mark's own distortion, in each metric; and the least of all attackers
with the same knowledge:

  program: the marked mesh and this library
  oracle:  also the answers of the owner's detector to a number of queries
  copies:  also more copies with other messages under the same key
  key:     key, original and message; subtracting the mark itself costs 1

"noise by theory" is noise of the mark's own spectrum that leaves too little evidence, by
`jaxmark.evaluation.channels.margins`: the RMS cost of an attacker who only adds noise. The same command resumes an
interrupted run.
"""

import math
import sys
import zlib
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark import adversaries as enemies
from jaxmark.adversaries.by_name import low_pass
from jaxmark.evaluation import cells

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, folder_of, make_parser
from common.costs import ALPHA, BITS, METRICS, Target, around, cell, make_target, paid
from common.marks import BUDGET, MESSAGE
from common.tables import head, line, say

QUERIES = 300
THEORY = "noise by theory"
# By the share of the spectrum that is kept, which is what little of it matters here.
CUT = jm.attacks.Attack(lambda mesh, kept, key: low_pass(mesh, 1 - 1 / kept, key), "1 / share kept", (2, 3e3))


@lru_cache(maxsize=1)
def target_of(path: str, scheme: str) -> Target:
    return make_target(jm.load_mesh(path), scheme)


def sought(attack: Callable[..., jm.attacks.Attack], **options) -> Callable[..., jm.attacks.Attack]:
    """An attacker without the key who optimises; knows scheme and payload."""

    def make(target: Target, scheme: str, steps: int) -> jm.attacks.Attack:
        more = {"steps": steps} if attack is enemies.descent else {}
        return around(attack(scheme=scheme, bits=BITS, **options, **more), target.theory)

    return make


def visible(target: Target, scheme: str, steps: int) -> jm.attacks.Attack:
    """The best by what is seen: strengths are values of DAME, which the mark's own is measured against."""
    marker, marked, theory = target
    dame = jm.compare(marker.original.mesh, marked, ["dame"]).dame or BUDGET
    found = enemies.descent("vertices", scheme=scheme, bits=BITS, metric="dame", steps=steps)
    return around(found, theory, dame)


def colluders(rule: enemies.Rule, count: int, target: Target, scheme: str, steps: int) -> jm.attacks.Attack:
    marker, _, theory = target
    messages = [bytes(np.random.default_rng(seed).bytes(BITS // 8)) for seed in range(1, count)]
    others = [marker.embed(message, jm.Budget(rms=BUDGET, noise=0), read_back="never")[0] for message in messages]
    return around(enemies.collude(others, rule), theory / count)


def named(kind: str, *strengths: float) -> Callable[..., jm.attacks.Attack]:
    return lambda target, scheme, steps: jm.adversaries.ATTACKS[kind]._replace(strengths=strengths)


def asked(attack: Callable[..., jm.attacks.Attack], target: Target, scheme: str, steps: int) -> jm.attacks.Attack:
    found = attack(enemies.score_oracle(target.marker, MESSAGE), queries=QUERIES)
    return around(found, target.theory)


def decided(target: Target, scheme: str, steps: int) -> jm.attacks.Attack:
    found = enemies.boundary(enemies.decision_oracle(target.marker, MESSAGE, ALPHA))
    return found._replace(strengths=(QUERIES, QUERIES))


ATTACKERS: dict[tuple[str, str], Callable[..., jm.attacks.Attack]] = {
    ("program", "uniform noise"): named("noise", 1e-3, 0.3),
    ("program", "quantisation"): named("quantisation", 10, 2),
    ("program", "Laplacian smoothing"): named("smoothing", 10, 10_000),
    ("program", "low-pass filter"): lambda target, scheme, steps: CUT,
    ("program", "non-local means"): named("non-local-means", 0.3, 300),
    ("program", "shrinkage of wavelets"): named("shrinkage", 3e-5, 3e-2),
    ("program", "random warp"): named("warp", 0.01, 1),
    ("program", "Wiener estimate subtracted"): sought(enemies.subtraction),
    ("program", "another mark"): sought(enemies.rewatermarking),
    ("program", "vertices, by gradient"): sought(enemies.descent, family="vertices"),
    ("program", "vertices, by gradient, for DAME"): visible,
    ("program", "bands, by gradient"): sought(enemies.descent, family="bands"),
    ("program", "bands, by evolution"): sought(enemies.evolution, family="bands"),
    ("program", "warps, by gradient"): sought(enemies.descent, family="warps"),
    ("oracle", f"gradients of scores, {QUERIES} queries"): partial(asked, enemies.estimated_gradient),
    ("oracle", f"random search by scores, {QUERIES} queries"): partial(asked, enemies.random_search),
    ("oracle", f"boundary by decisions, {QUERIES} queries"): decided,
    ("copies", "mean of 2, another mark"): partial(colluders, "mean", 2),
    ("copies", "mixture of 2, another mark"): partial(colluders, "mixing", 2),
    ("copies", "mean of 4, another mark"): partial(colluders, "mean", 4),
    ("copies", "mixture of 4, another mark"): partial(colluders, "mixing", 4),
    ("key", "closed form"): lambda target, scheme, steps: enemies.erasure(target.marker, MESSAGE),
    ("key", "by gradient"): lambda target, scheme, steps: enemies.erasure_by_descent(
        target.marker, MESSAGE, steps=2 * steps
    ),
}

LEVELS = list(dict.fromkeys(level for level, _ in ATTACKERS))
NAMES = [*LEVELS, THEORY, *(name for _, name in ATTACKERS)]


def work(folder: Path, steps: int, one: cells.Cell) -> cells.Row:
    mesh, scheme, level, name = map(str, one)
    target = target_of(str(folder / mesh), scheme)
    if name == THEORY:
        return {"cost": {"rms": target.theory}, "strength": target.theory * BUDGET, "log10_p": math.log10(ALPHA)}
    try:
        return paid(target, ATTACKERS[level, name](target, scheme, steps), zlib.crc32(repr(one).encode()) % 2**31)
    except jm.JaxmarkError as error:
        return {"refused": str(error)}


def report(rows: list[dict], meshes: list[str], schemes: list[str], attackers: list[tuple[str, str]]) -> str:
    found = {tuple(row["cell"]): row for row in rows}
    lines = []
    for scheme in schemes:
        lines += ["", f"{scheme}: distortion over the mark's, {' / '.join(METRICS)}", ""]
        lines.append(head("knows", "attacker", *meshes))
        for level in dict.fromkeys(level for level, _ in attackers):
            own = [name for one, name in attackers if one == level]
            for name in own:
                lines.append(line(level, name, *(cell(found[mesh, scheme, level, name]) for mesh in meshes)))
            real = [[found[mesh, scheme, level, name] for name in own if name != THEORY] for mesh in meshes]
            least = [" / ".join(f"{_least(rows, metric):.3g}" for metric in METRICS) for rows in real]
            lines.append(line(level, "**least**", *least))
    return "\n".join(lines).strip() + "\n"


def _least(rows: list[dict], metric: str) -> float:
    return min((row["cost"].get(metric, math.inf) for row in rows if "cost" in row), default=math.inf)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, help="files of one folder")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--schemes", nargs="+", default=["keyed"])
    parser.add_argument("--steps", type=int, default=30, help="of optimisers")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=LEVELS, help="levels, or attackers by name")
    arguments = parser.parse_args()
    folder = folder_of(parser, arguments.meshes)
    meshes = [mesh.name for mesh in arguments.meshes]
    attackers = [one for one in [("program", THEORY), *ATTACKERS] if {*one} & {*arguments.only}]
    if unknown := {*arguments.only} - {name for one in attackers for name in one}:
        parser.error(f"there is no level or attacker {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    wanted = [(mesh, scheme, *one) for mesh in meshes for scheme in arguments.schemes for one in attackers]
    arguments.output.mkdir(parents=True, exist_ok=True)
    rows = cells.run(
        wanted,
        partial(work, folder, arguments.steps),
        cells.processes(arguments.workers),
        arguments.output / "cells.jsonl",
        say,
    )
    print(report(rows, meshes, arguments.schemes, attackers))


if __name__ == "__main__":
    main()
