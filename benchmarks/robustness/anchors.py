"""Validate published methods against published rates: python benchmarks/robustness/anchors.py MESH... [options].

Cho, Prost, Jung 2007 and Wang et al. 2011, as implemented in `jaxmark.bench.methods`, write 64 bits as strongly as the
limits of SMI 2010 allow, and are read after its attacks. The tables have the bit error rates, means over meshes and
trials, and those of the protocol's result page for its model Venus, a head of 100,759 vertices. A method is anchored if
the mean difference over the attacks is at most TOLERANCE. Closer agreement is not expected, because meshes, keys and
programs differ, and perceptual limits allow different displacements. As in the protocol, the reader of volume moments
knows the step. The other methods have no published rate to validate against.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark.bench import TRACKS, Method, fit
from jaxmark.bench.methods.moments import moments
from jaxmark.bench.methods.vertex_norms import cho

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.tables import Row, head, line, save, say

BITS = 64
TOLERANCE = 0.10  # of the mean difference of bit error rates
STEPS = tuple(np.geomspace(0.2, 0.001, 200))  # that moments are quantised by, so fine that limits are met
METHODS: Mapping[str, Method] = {"cho": cho(BITS), "wang": moments(BITS, STEPS)}
LEAGUE = TRACKS["smi2010"]
WHERE = {"perceptual": 0, "geometric": 1}
RATED = {name: row for name, row in LEAGUE.lines.items() if row.cho is not None}


def trial(name: str, limits: str, mesh: jm.Mesh, seed: int) -> Row:
    """One mark as strong as limits allow, and the share of wrong bits after each attack."""
    random = np.random.default_rng([seed, BITS])
    key, message = random.bytes(32), random.random(BITS) < 0.5
    marked = fit(METHODS[name], mesh, message, key, LEAGUE.bounds(limits, mesh))
    step = next((step for step in STEPS if step <= marked.strength * (1 + 1e-9)), STEPS[-1])
    method = moments(BITS, (step,)) if name == "wang" else METHODS[name]
    attacks = {"none": LEAGUE.lines["none"], **RATED}
    wrong = {
        attack: [
            float(np.mean(method.read(suspect, key, None).message != message))
            for suspect in row.suspects(marked.mesh, seed)
        ]
        for attack, row in attacks.items()
    }
    return {
        "method": name,
        "limits": limits,
        "strength": marked.strength,
        **marked.reached,
        "wrong": {attack: float(np.mean(rates)) for attack, rates in wrong.items()},
    }


def published(attack: str, name: str, limits: str) -> float:
    """The rate of the protocol's result page."""
    return getattr(RATED[attack], name)[WHERE[limits]]


def table(rows: list[Row], limits: str, names: list[str]) -> Iterator[str]:
    """A line for each attack: ours / published; last, the mean difference."""
    found = {
        name: {
            attack: float(
                np.mean([row["wrong"][attack] for row in rows if (row["method"], row["limits"]) == (name, limits)])
            )
            for attack in ["none", *RATED]
        }
        for name in names
    }
    yield head("attack", *(f"{name}, here / published" for name in names))
    yield line("none", *(f"{found[name]['none']:.2f} / 0" for name in names))
    for attack in RATED:
        yield line(attack, *(f"{found[name][attack]:.2f} / {published(attack, name, limits):.2f}" for name in names))
    cells = []
    for name in names:
        off = [found[name][attack] - published(attack, name, limits) for attack in RATED]
        mean = float(np.mean(np.abs(off)))
        verdict = "anchored" if mean <= TOLERANCE else "not anchored"
        cells.append(f"{mean:.3f}, {verdict} ({np.mean(off):+.3f} with its sign)")
    yield line("mean difference", *cells)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--limits", nargs="+", choices=WHERE, default=list(WHERE))
    parser.add_argument("--trials", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("anchors-output"))
    options = parser.parse_args()
    text = run(parser, options)
    print(text)


def run(parser: argparse.ArgumentParser, options: argparse.Namespace) -> str:
    """All trials, and the tables of them."""
    rows: list[Row] = []
    for path in options.meshes:
        mesh = load(parser, path)
        for name in options.methods:
            for limits in options.limits:
                for seed in range(options.trials):
                    rows.append({"mesh": path.name, **trial(name, limits, mesh, seed)})
                    say({key: value for key, value in rows[-1].items() if key != "wrong"})
    text = [f"{BITS} bits, {len(options.meshes)} meshes, {options.trials} trials; tolerance {TOLERANCE:g}."]
    for limits in options.limits:
        text += ["", f"## At the {limits} limits", "", *table(rows, limits, options.methods)]
    whole = "\n".join(text) + "\n"
    save(options.output, "anchors", whole, rows)
    return whole


if __name__ == "__main__":
    main()
