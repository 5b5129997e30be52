"""Measure the cost of removal by learned attacks: python benchmarks/security/learned.py [MESH...] --output FOLDER.

Attacks are trained on meshes by formula: 20 that this library marks with random keys, and 4 for validation. They attack
marks of 64 bits, at 0.08 % RMS and hidden, on the given meshes. By default, these are ten of the benchmark's corpus,
of which those that are not installed are skipped. As in `adversarial.py`, the table has the least distortion that
brings a mark below detection at 1e-6, with its message claimed, relative to the mark's own, in each metric.

  estimate: a network that estimates the mark, and subtracts it
  removal:  a network that lowers the expected evidence
  chain:    up to four tools one after the other, found by evolution on two marked meshes for the least MSDM2

For comparison, the table has denoising without training. The same command resumes an interrupted run; the folder keeps
networks and chain, and is refused if their settings differ.
"""

import argparse
import json
import sys
import zlib
from collections.abc import Callable
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

import jaxmark as jm
from jaxmark import adversaries as enemies
from jaxmark.adversaries.chains import decode
from jaxmark.adversaries.networks import init_network
from jaxmark.bench.corpus import corpus, make_member
from jaxmark.bench.parametric import creature
from jaxmark.evaluation import cells
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, folder_of, load, make_parser, positive
from common.costs import BITS, METRICS, Target, around, cell, make_target, paid
from common.marks import BUDGET, MESSAGE
from common.tables import head, line, say

SIZE, LEARNED_FROM, HELD_OUT = 3000, 20, 4  # vertices, and meshes
LIMITS = {"0.08 % RMS": BUDGET, "hidden": None}
SUBJECTS = (
    *("asteroid-3k", "creature-1", "box", "cylinder", "superquadric-1.5", "gem"),  # by formula
    *("cow", "bone", "airplane", "bunny-10k"),  # from the package pymeshlab
)
GOALS: tuple[enemies.Goal, ...] = ("estimate", "removal")


def meshes_by_formula(first: int, count: int, size: int) -> list[Mesh]:
    """Asteroids and creatures by turns."""
    return [(asteroid, creature)[seed % 2](size, seed) for seed in range(first, first + count)]


def learn(folder: Path, goal: enemies.Goal, steps: int, size: int) -> enemies.Network:
    """The network of a folder; where it has none, one that learns first."""
    file, unravel = folder / f"{goal}.npz", ravel_pytree(init_network(jax.random.key(0)))[1]
    if not file.exists():
        meshes, others = (
            meshes_by_formula(*part, size) for part in ((100, LEARNED_FROM), (100 + LEARNED_FROM, HELD_OUT))
        )
        found = enemies.learn(meshes, others, seed=0, goal=goal, bits=BITS, steps=steps, log=say)
        say(f"{goal}: held-out loss {found.before:.4f} of the Wiener estimate, {found.after:.4f} of the network")
        numbers = np.asarray(ravel_pytree(found.network)[0])
        np.savez(file, before=found.before, after=found.after, losses=found.losses, network=numbers)
    with np.load(file) as kept:
        return unravel(kept["network"])


def search(folder: Path, generations: int, size: int) -> list[enemies.Gene]:
    """The chain of a folder; where it has none, one that is searched for first."""
    file = folder / "chain.json"
    if not file.exists():
        pairs = []
        for mesh in meshes_by_formula(200, 2, size):
            target = make_target(mesh, "keyed")
            pairs.append((target.marker, target.marked, MESSAGE))
        judge = enemies.projected_cost(pairs, "msdm2")
        found = enemies.search_chain(judge, generations=generations, log=say)
        file.write_text(json.dumps({"cost": found.cost, "genes": found.genes}))
    return [enemies.Gene(*gene) for gene in json.loads(file.read_text())["genes"]]


@lru_cache(maxsize=1)
def target_of(folder: Path | None, name: str, limits: str) -> Target:
    mesh = make_member(corpus()[name]) if folder is None else jm.load_mesh(folder / name)
    return make_target(mesh, "keyed", LIMITS[limits])


def network(goal: enemies.Goal, folder: Path, target: Target) -> jm.attacks.Attack:
    attack = enemies.learned_attack(learn(folder, goal, 0, 0), goal, bits=BITS)
    return around(attack, target.theory)


def named(kind: str, *strengths: float) -> Callable[[Path, Target], jm.attacks.Attack]:
    return lambda folder, target: jm.adversaries.ATTACKS[kind]._replace(strengths=strengths)


ATTACKERS: dict[str, Callable[[Path, Target], jm.attacks.Attack]] = {
    "estimate": partial(network, "estimate"),
    "removal": partial(network, "removal"),
    "chain": lambda folder, target: enemies.chain_attack(search(folder, 0, 0)),
    "non-local means": named("non-local-means", 0.3, 300),
    "shrinkage of wavelets": named("shrinkage", 3e-5, 3e-2),
    "another mark": lambda folder, target: around(enemies.rewatermarking(bits=BITS), target.theory),
}


def work(folder: Path | None, output: Path, one: cells.Cell) -> cells.Row:
    mesh, limits, name = map(str, one)
    try:
        target = target_of(folder, mesh, limits)
        return paid(target, ATTACKERS[name](output, target), zlib.crc32(repr(one).encode()) % 2**31)
    except jm.JaxmarkError as error:
        return {"refused": str(error)}


def keep_settings(parser: argparse.ArgumentParser, output: Path, settings: dict[str, int]) -> None:
    """Leave the settings in the folder; those of another run end the program."""
    file = output / "settings.json"
    if not file.exists():
        file.write_text(json.dumps(settings))
    elif (before := json.loads(file.read_text())) != settings:
        parser.error(f"{output} has results with {before}; choose another folder, or the same settings")


def subjects_of(parser: argparse.ArgumentParser, files: list[Path]) -> tuple[Path | None, list[str]]:
    """The folder of the given files and their names; without files, no folder and the names of corpus meshes."""
    if not files:
        known = corpus()
        for name in [name for name in SUBJECTS if name not in known]:
            say(f"{name}: skipped, because the package pymeshlab is not installed")
        return None, [name for name in SUBJECTS if name in known]
    for file in files:
        load(parser, file)
    return folder_of(parser, files), [file.name for file in files]


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*", help="files of one folder; by default ten meshes of the corpus")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--steps", type=positive, default=400, help="of learning (%(default)s)")
    parser.add_argument("--generations", type=positive, default=8, help="of the search for chains (%(default)s)")
    parser.add_argument("--size", type=positive, default=SIZE, help="vertices of meshes to learn from (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=list(ATTACKERS), default=list(ATTACKERS), help="attackers")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    folder, meshes = subjects_of(parser, arguments.meshes)
    output = arguments.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    keep_settings(parser, output, {name: getattr(arguments, name) for name in ("steps", "generations", "size")})
    for goal in GOALS:
        if goal in arguments.only:
            learn(output, goal, arguments.steps, arguments.size)
            with np.load(output / f"{goal}.npz") as kept:
                print(f"{goal}: held-out loss {kept['before']:.4f} by Wiener, {kept['after']:.4f} learned")
    if "chain" in arguments.only:
        print(
            "chain:",
            ", then ".join(
                f"{kind} {size:g}" for kind, size in decode(search(output, arguments.generations, arguments.size))
            ),
        )
    wanted = [(mesh, limits, name) for mesh in meshes for limits in LIMITS for name in arguments.only]
    rows = cells.run(
        wanted,
        partial(work, folder, output),
        cells.processes(arguments.workers),
        output / "cells.jsonl",
        say,
    )
    found = {tuple(row["cell"]): row for row in rows}
    print(f"\ndistortion over the mark's, {' / '.join(METRICS)}\n")
    print(head("mesh", "mark", *arguments.only))
    for mesh, limits in product(meshes, LIMITS):
        print(line(mesh, limits, *(cell(found[mesh, limits, name]) for name in arguments.only)))


if __name__ == "__main__":
    main()
