"""What enemies must pay: python benchmarks/adversarial.py MESH... --output FOLDER [--schemes keyed host eigen].

For each attacker, the least distortion that brings a mark of 64 bits at 0.08 % RMS below detection at 1e-6, its message
claimed, over the mark's own distortion, in each metric; and the least of all attackers who know as much:

  program: the marked mesh and this library
  oracle:  the answers of the owner's detector besides, of which so many are asked
  copies:  more copies with other messages under the same key
  key:     key, original and message; subtracting the mark itself costs 1

"noise by theory" is noise of the mark's own spectrum that leaves so little evidence, by `jaxmark.channels.margins`:
what an attacker who only adds noise pays in RMS. Resumable: the same command goes on where it was ended.
"""

import argparse
import math
import sys
import zlib
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark import cells
from jaxmark.attacks import adversarial as enemies
from jaxmark.attacks import low_pass
from jaxmark.mesh import Mesh
from jaxmark.schemes import Scheme

BITS, BUDGET, ALPHA = 64, 8e-4, 1e-6
METRICS = ("rms", "dame", "msdm2")
KEY = jm.Key(bytes(range(32)))
MESSAGE = b"jaxmark!"
QUERIES = 300
TOLERANCE = 0.1
THEORY = "noise by theory"
# By the share of the spectrum that is kept, which is what little of it matters here.
CUT = jm.Attack(lambda mesh, kept, key: low_pass(mesh, 1 - 1 / kept, key), "1 / share kept", (2, 3e3))

Subject = tuple[jm.Marker, Mesh, float]  # what reads it, the marked mesh, the least noise by theory over the mark


@lru_cache(maxsize=1)
def subject(path: str, scheme: str) -> Subject:
    return mark(jm.load_mesh(path), scheme)


def mark(mesh: Mesh, scheme: str | Scheme) -> Subject:
    marker = jm.make_marker(mesh, KEY, bits=BITS, scheme=scheme)
    marked, _ = marker.embed(MESSAGE, BUDGET, noise=0)
    evidence, needed = enemies.score_oracle(marker, MESSAGE)(marked) ** 2 / 2, -math.log(ALPHA)
    return marker, marked, math.sqrt(max(evidence / needed - 1, 0.0))


def around(attack: jm.Attack, theory: float, unit: float = BUDGET) -> jm.Attack:
    """Strengths about that of noise by theory: a search among all would take long."""
    return attack._replace(strengths=(unit * max(theory, 1) / 8, 2 * unit * max(theory, 1)))


def sought(attack: Callable[..., jm.Attack], **options) -> Callable[..., jm.Attack]:
    """An attacker without the key who optimises; knows scheme and payload."""

    def make(subject: Subject, scheme: str, steps: int) -> jm.Attack:
        more = {"steps": steps} if attack is enemies.descent else {}
        return around(attack(scheme=scheme, bits=BITS, **options, **more), subject[2])

    return make


def visible(subject: Subject, scheme: str, steps: int) -> jm.Attack:
    """The best by what is seen: strengths are values of DAME, which the mark's own is measured against."""
    marker, marked, theory = subject
    dame = jm.compare(marker.original.mesh, marked, ["dame"]).dame or BUDGET
    found = enemies.descent("vertices", scheme=scheme, bits=BITS, metric="dame", steps=steps)
    return around(found, theory, dame)


def colluders(rule: enemies.Rule, count: int, subject: Subject, scheme: str, steps: int) -> jm.Attack:
    marker, _, theory = subject
    messages = [bytes(np.random.default_rng(seed).bytes(BITS // 8)) for seed in range(1, count)]
    others = [marker.embed(message, BUDGET, noise=0, read_back=False)[0] for message in messages]
    return around(enemies.colluded(others, rule), theory / count)


def named(kind: str, *strengths: float) -> Callable[..., jm.Attack]:
    return lambda subject, scheme, steps: jm.ATTACKS[kind]._replace(strengths=strengths)


def asked(attack: Callable[..., jm.Attack], subject: Subject, scheme: str, steps: int) -> jm.Attack:
    found = attack(enemies.score_oracle(subject[0], MESSAGE), queries=QUERIES)
    return around(found, subject[2])


def decided(subject: Subject, scheme: str, steps: int) -> jm.Attack:
    found = enemies.boundary(enemies.decision_oracle(subject[0], MESSAGE, ALPHA))
    return found._replace(strengths=(QUERIES, QUERIES))


ATTACKERS: dict[tuple[str, str], Callable[..., jm.Attack]] = {
    ("program", "uniform noise"): named("noise", 1e-3, 0.3),
    ("program", "quantisation"): named("quantisation", 10, 2),
    ("program", "Laplacian smoothing"): named("smoothing", 10, 10_000),
    ("program", "low-pass filter"): lambda subject, scheme, steps: CUT,
    ("program", "random warp"): named("warp", 0.01, 1),
    ("program", "Wiener estimate subtracted"): sought(enemies.subtraction),
    ("program", "another mark"): sought(enemies.remarking),
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
    ("key", "closed form"): lambda subject, scheme, steps: enemies.erasure(subject[0], MESSAGE),
    ("key", "by gradient"): lambda subject, scheme, steps: enemies.erasure_by_descent(
        subject[0], MESSAGE, steps=2 * steps
    ),
}

LEVELS = list(dict.fromkeys(level for level, _ in ATTACKERS))
NAMES = [*LEVELS, THEORY, *(name for _, name in ATTACKERS)]


def work(folder: str, steps: int, cell: cells.Cell) -> cells.Row:
    mesh, scheme, level, name = map(str, cell)
    marker, marked, theory = given = subject(str(Path(folder, mesh)), scheme)
    if name == THEORY:
        return {"cost": {"rms": theory}, "strength": theory * BUDGET, "log10_p": math.log10(ALPHA)}
    try:
        attack = ATTACKERS[level, name](given, scheme, steps)
        found = jm.minimum_distortion(
            marker, marked, MESSAGE, attack, alpha=ALPHA, metrics=METRICS, tolerance=TOLERANCE,
            seed=zlib.crc32(repr(cell).encode()) % 2**31,
        )  # fmt: skip
    except jm.JaxmarkError as error:
        return {"refused": str(error)}
    if (weakest := found.weakest) is None:
        strongest = found.curve[-1]
        return {"not below": strongest.strength, "log10_p": strongest.log10_p}
    cost = {metric: found.cost(metric) for metric in METRICS}
    return {"cost": cost, "strength": weakest.strength, "log10_p": weakest.log10_p}


def report(rows: list[dict], meshes: list[str], schemes: list[str], attackers: list[tuple[str, str]]) -> str:
    found = {tuple(row["cell"]): row for row in rows}
    lines = []
    for scheme in schemes:
        lines += ["", f"{scheme}: distortion over the mark's, {' / '.join(METRICS)}", ""]
        lines += [f"| knows | attacker | {' | '.join(meshes)} |", "|---" * (2 + len(meshes)) + "|"]
        for level in dict.fromkeys(level for level, _ in attackers):
            own = [name for one, name in attackers if one == level]
            for name in own:
                lines.append(_line(level, name, [_cell(found[mesh, scheme, level, name]) for mesh in meshes]))
            real = [[found[mesh, scheme, level, name] for name in own if name != THEORY] for mesh in meshes]
            least = [" / ".join(f"{_least(rows, metric):.3g}" for metric in METRICS) for rows in real]
            lines.append(_line(level, "**least**", least))
    return "\n".join(lines).strip() + "\n"


def costs(cost: dict[str, float]) -> str:
    return " / ".join(f"{cost[metric]:.3g}" if metric in cost else "-" for metric in METRICS)


def _line(level: str, name: str, rest: list[str]) -> str:
    return f"| {level} | {name} | {' | '.join(rest)} |"


def _least(rows: list[dict], metric: str) -> float:
    return min((row["cost"].get(metric, math.inf) for row in rows if "cost" in row), default=math.inf)


def _cell(row: dict) -> str:
    if "cost" in row:
        return costs(row["cost"])
    return f"refused: {row['refused']}" if "refused" in row else f"detected up to {row['not below']:g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", help="files of one folder")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--schemes", nargs="+", default=["keyed"])
    parser.add_argument("--steps", type=int, default=30, help="of optimisers")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=LEVELS, help="levels, or attackers by name")
    arguments = parser.parse_args()
    folders = {str(Path(mesh).resolve().parent) for mesh in arguments.meshes}
    if len(folders) > 1:
        parser.error("the meshes must be of one folder")
    meshes = [Path(mesh).name for mesh in arguments.meshes]
    attackers = [one for one in [("program", THEORY), *ATTACKERS] if {*one} & {*arguments.only}]
    if unknown := {*arguments.only} - {name for one in attackers for name in one}:
        parser.error(f"there is no level or attacker {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    wanted = [(mesh, scheme, *one) for mesh in meshes for scheme in arguments.schemes for one in attackers]
    arguments.output.mkdir(parents=True, exist_ok=True)
    rows = cells.run(
        wanted,
        partial(work, folders.pop(), arguments.steps),
        cells.processes(arguments.workers),
        arguments.output / "cells.jsonl",
        partial(print, file=sys.stderr, flush=True),
    )
    print(report(rows, meshes, arguments.schemes, attackers))


if __name__ == "__main__":
    main()
