"""Measure the attacks that a mark survives: python benchmarks/robustness/robustness.py MESH... [--case 64:2e-4 ...].

There are up to three tables. The first has the number of messages read after the REQUIRED attacks, for several keys,
messages and random seeds. The second has the largest strength of each attack after which the message can still be read,
by bisection. With --directions, the third compares a mark along coordinates with one along normals that bends the
surface as much. Only the exact message counts; if it cannot be decoded, log10 p is that of a claim. With --processes,
each reading of the first table is a run of `jaxmark detect` on files.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, weld, weld_mesh
from jaxmark.watermark.perception.capacity import least_energy
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.registry import get_nonblind

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.attacks import attacked
from common.detection import compilation_cache, detect
from common.marks import Case, Subject, add_schemes, free_dimensions, mark, parse_case
from common.strengths import GRIDS, OWN, largest
from common.tables import Row, head, line, save, say

# As in OWN and `jaxmark attack`: laplace takes steps of 0.5, smoothing of 0.1, lost adds noise of 2 % of the diagonal;
# the ceiling is the RMS of white noise up to which the keyed scheme should read.
REQUIRED = """none 0; noise 0.005; white ceiling; laplace 10; laplace 50; smoothing 50; taubin 50;
quantisation 10; quantisation 9; quantisation 8; quantisation 7; affine 2; warp 0.01; lost 0.5;
noise 0.005 + laplace 10; quantisation 8 + warp 0.01; affine 2 + noise 0.005; laplace 10 + quantisation 8;
lost 0.5 + affine 2; warp 0.01 + smoothing 50"""


def as_bending(mesh: Mesh, bits: int, budget: float, noise: float | None) -> float:
    """Budget along normals at which neighbouring faces turn, on average, as far as with one along coordinates."""
    import trimesh

    def angles(of: Mesh) -> np.ndarray:
        surface = trimesh.Trimesh(*weld_mesh(of, weld(mesh.vertices)), process=False)
        return np.where(surface.face_adjacency_convex, 1, -1) * surface.face_adjacency_angles

    still, wanted = angles(mesh), angles(mark(mesh, KeyedScheme(), bits, budget, noise).marked)
    for _ in range(3):
        found = angles(mark(mesh, KeyedScheme(direction="normals"), bits, budget, 0.0).marked)
        budget *= np.abs(wanted - still).mean() / np.abs(found - still).mean()
    return budget


def read(marker: jm.watermark.NonBlindMarker, suspect: Mesh, source: Path | None) -> bytes | None:
    """What is read in this process, or in one of its own that is given files, key and payload."""
    if source is None:
        return marker.detect(suspect).message
    run, _ = detect(marker, suspect, source, source.suffix, like=source)
    if run.returncode not in (0, 1):
        raise jm.JaxmarkError(run.stderr.strip())
    return bytes.fromhex(json.loads(run.stdout)["message"] or "") or None


def survived(subjects: list[Subject], steps: str, source: Path | None) -> Row:
    """How many read after an attack; of the others, what a claim of the message still proves."""
    claims, wrong = [], 0
    for seed, (marker, marked, message, _) in enumerate(subjects):
        suspect = attacked(marked, steps, seed, OWN)
        if (found := read(marker, suspect, source)) != message:
            claims.append(round(marker.detect(suspect, message).log10_p, 1))
            wrong += found is not None
    cell = f"{len(subjects) - len(claims)}/{len(subjects)}" + f" {wrong} WRONG" * (wrong > 0)
    cell += f" (log10 p {', '.join(map(str, claims))})" * bool(claims)
    return {"cell": cell, "steps": steps, "log10_p_claimed": claims, "wrong": wrong}


def measure(mesh: Mesh, source: Path, wanted: Case, options: argparse.Namespace) -> Iterator[Row]:
    """All rows of one mesh and case."""
    bits, budget, _ = wanted
    probe = jm.make_marker(mesh, bytes(32), bits=bits)
    left = free_dimensions(probe)
    assert left is not None
    kept = left.dimensions @ left.energy
    ceiling = f"{budget * math.sqrt(1.5 * kept / (10**0.25 * least_energy(bits))):.5f}"
    parts = [part for part in ("required", "strengths") if part not in options.skip]
    cases = [(part, name, get_nonblind(name), budget, options.noise) for part in parts for name in options.schemes]
    if options.directions:
        equal = as_bending(mesh, bits, budget, options.noise)
        cases += [("directions", "coordinates", KeyedScheme(), budget, options.noise)]
        cases += [("directions", "normals", KeyedScheme(direction="normals"), equal, 0.0)]
    for part, name, scheme, size, noise in cases:
        row = {"part": part, "scheme": name, "attack": "budget"}
        try:
            subjects = [mark(mesh, scheme, bits, size, noise, seed) for seed in range(options.seeds)]
        except jm.JaxmarkError as error:
            yield row | {"cell": "refused", "note": str(error)}
            continue
        promised = f" for noise {subjects[0].noise:g}" if free_dimensions(subjects[0].marker) else ""
        yield row | {"cell": f"{size:.3g}{promised}"}
        if part == "required":
            yield row | {"attack": "ceiling", "cell": ceiling}
            for steps in " ".join(REQUIRED.split()).split("; "):
                file = source if options.processes else None
                yield row | {"attack": steps} | survived(subjects, steps.replace("ceiling", ceiling), file)
        else:
            for kind in GRIDS:
                yield row | {"attack": kind} | largest(subjects, kind)


def tables(rows: list[Row]) -> str:
    """A Markdown table for each part and case: a line for each attack and mesh, a column for each scheme."""
    text = []
    heads = {"required": "Messages read", "strengths": "Largest strength", "directions": "The same at equal bending"}
    for part, case in dict.fromkeys((row["part"], row["case"]) for row in rows):
        mine = [row for row in rows if (row["part"], row["case"]) == (part, case)]
        cells = {(row["attack"], row["mesh"], row["scheme"]): row["cell"] for row in mine}
        schemes = list(dict.fromkeys(row["scheme"] for row in mine))
        text += [f"## {heads[part]}: {case}", "", head("attack", "mesh", *schemes)]
        for attack, mesh in sorted({key[:2] for key in cells}, key=[key[:2] for key in cells].index):
            unit = f", {GRIDS[attack][1]}" if attack in GRIDS else ""
            found = [cells.get((attack, mesh, scheme), "-") for scheme in schemes]
            text += [line(attack + unit, mesh, *found)]
        text += ["", *(f"{row['mesh']}, {row['scheme']}: {row['note']}\n" for row in mine if "note" in row)]
    return "\n".join(text)


def picture(rows: list[Row], path: Path) -> None:
    """The largest strengths, a panel for each attack; stronger is further right."""
    from matplotlib.figure import Figure

    height = len({(row["mesh"], row["case"]) for row in rows})
    figure = Figure(figsize=(13, 2.6 + 1.2 * height), layout="constrained")
    for axis, (kind, (grid, unit)) in zip(figure.subplots(2, 3, sharey=True).flat, GRIDS.items(), strict=True):
        schemes = dict.fromkeys(row["scheme"] for row in rows)
        for scheme, marker, colour in zip(schemes, "osD^v", ["#0072B2", "#E69F00", "k", "#CC79A7", "c"], strict=False):
            mine = [row for row in rows if (row["attack"], row["scheme"]) == (kind, scheme)]
            lines = [f"{row['mesh']}\n{row['case']}" for row in mine]
            axis.plot([row["place"] for row in mine], lines, marker, c=colour, ms=9, fillstyle="none", label=scheme)
        ticks = range(len(grid) - 1, 2, -5)
        axis.set_xticks([-1, *ticks], ["none", *(f"{grid[tick]:g}" for tick in ticks)])
        axis.set(xlim=(-1.6, len(grid) - 0.4), ylim=(-0.5, height - 0.5), title=kind, xlabel=unit)
        axis.grid(axis="x", alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper")
    figure.suptitle("Largest strength from which the message still reads")
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--bits", type=int, default=64)
    parser.add_argument("--budget", type=float, default=2e-4)
    parser.add_argument(
        "--case", nargs="+", type=parse_case, metavar="BITS:BUDGET", help="in place of --bits and --budget"
    )
    add_schemes(parser, noise=None)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--output", type=Path, help="for robustness.md, .json and .png, rewritten after each case")
    parser.add_argument("--processes", action="store_true")
    parser.add_argument("--skip", nargs="+", default=[], choices=["required", "strengths"])
    parser.add_argument("--directions", action="store_true")
    options = parser.parse_args()
    rows: list[Row] = []
    with compilation_cache():
        cases = options.case or [parse_case(f"{options.bits}:{options.budget}")]
        for source, wanted in product(options.meshes, cases):
            for row in measure(jm.load_mesh(source), source, wanted, options):
                rows.append({"mesh": source.name, "case": wanted.name} | row)
                say(*rows[-1].values(), sep=", ")
            if options.output:
                save(options.output, "robustness", tables(rows), rows)
                if placed := [row for row in rows if "place" in row]:
                    picture(placed, options.output / "robustness.png")
    print(tables(rows))


if __name__ == "__main__":
    main()
