"""What a mark survives: python benchmarks/robustness.py MESH... [--case 64:2e-4 ...] [--schemes keyed host eigen].

Up to three tables: how many messages read after REQUIRED attacks, for several keys, messages and random seeds; the
largest strength of each attack that still reads, by bisection; and with --directions a mark along coordinates beside
one along normals that bends the surface as much. Only the exact message counts; log10 p is of a claim of it where it
does not read. With --processes each reading of the first table is a run of `jaxmark detect`, on files.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy import sparse
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.carriers import KeyedCarrier
from jaxmark.marking import NOISE
from jaxmark.mesh import Mesh, boundary_vertices, diagonal, edges, used_vertices, weld, welded_mesh
from jaxmark.payload import least_energy, room
from jaxmark.schemes import KeyedScheme, Scheme, get_scheme

Row = dict[str, Any]
Subject = tuple[jm.Marker, Mesh, bytes, float]  # what reads it, the marked mesh, its message, the noise declared


def smooth(points: Mesh, steps: int) -> np.ndarray:
    """Half way to the mean of the neighbours, step by step; boundary vertices stay, as in `jaxmark.attacks`."""
    v, (i, j) = np.array(points.vertices), edges(points.faces).T
    graph = sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (len(v), len(v))).tocsr()
    degree = graph.sum(axis=1)[:, None]
    moving = degree > 0
    moving[boundary_vertices(points.faces)] = False
    for _ in range(steps):
        v += 0.5 * moving * (graph @ v / np.maximum(degree, 1) - v)
    return v


def white(points: Mesh, rms: float, rng: Generator) -> Any:
    """White Gaussian noise; RMS length over the diagonal."""
    return points.vertices + diagonal(points) * rms / math.sqrt(3) * rng.normal(size=points.vertices.shape)


def affine(points: Mesh, most: float, rng: Generator) -> np.ndarray:
    """A random rotation and shift, shears up to 0.5, and scales from 1 / most to most."""
    rotation = Rotation.random(rng=rng).as_matrix()
    shear = np.eye(3) + np.triu(rng.uniform(-0.5, 0.5, (3, 3)), 1)
    scales = rng.permutation([1 / most, most ** rng.uniform(-1, 1), most])
    return points.vertices @ (rotation @ shear * scales).T + diagonal(points) * rng.normal(size=3)


def lost(points: Mesh, share: float, rng: Generator) -> np.ndarray:
    """So many of the vertices, on one side of a plane, moved by Gaussian noise of 2 % RMS of the diagonal."""
    side = points.vertices @ rng.normal(size=3)
    beyond = side > np.quantile(side[used_vertices(points)], 1 - share)
    return np.where(beyond[:, None], white(points, 0.02, rng), points.vertices)


OWN: dict[str, Callable[[Mesh, float, Generator], Any]] = {
    "laplace": lambda points, steps, rng: smooth(points, int(steps)),
    **{"white": white, "affine": affine, "lost": lost},
}
# As in OWN and `jaxmark attack`: laplace takes steps of 0.5, smoothing of 0.1, lost adds noise of 2 % of the diagonal;
# the ceiling is the RMS of white noise up to which the keyed scheme should read.
REQUIRED = """none 0; noise 0.005; white ceiling; laplace 10; laplace 50; smoothing 50; taubin 50;
quantisation 10; quantisation 9; quantisation 8; quantisation 7; affine 2; warp 0.01; lost 0.5;
noise 0.005 + laplace 10; quantisation 8 + warp 0.01; affine 2 + noise 0.005; laplace 10 + quantisation 8;
lost 0.5 + affine 2; warp 0.01 + smoothing 50"""
COUNTS = sorted({round(2 ** (step / 2)) for step in range(23)})
# Strengths from weak to strong, and their unit.
GRIDS: dict[str, tuple[list[float], str]] = {
    "noise": ([float(f"{x:.2g}") for x in np.geomspace(5e-4, 0.256, 28)], "half width / mean radius"),
    "laplace": ([*COUNTS], "steps of 0.5"),
    "taubin": ([*COUNTS], "pairs of steps 0.5, -0.53"),
    "quantisation": ([*range(16, 2, -1)], "bits per coordinate"),
    "warp": ([float(f"{x:.2g}") for x in np.geomspace(1e-3, 0.256, 25)], "RMS / diagonal"),
    "lost": ([percent / 100 for percent in range(5, 100, 5)], "share of the vertices"),
}


def attacked(mesh: Mesh, steps: str, seed: int) -> Mesh:
    """A mesh after attacks one by one, copies of a point moving together."""
    for place, (kind, strength) in enumerate(step.split() for step in steps.split(" + ")):
        if kind in OWN:
            welded = weld(mesh.vertices)
            moved = OWN[kind](welded_mesh(mesh, welded), float(strength), np.random.default_rng([seed, place]))
            mesh = Mesh(moved[welded.point], mesh.faces)
        elif kind != "none":
            mesh = jm.attack(mesh, kind, float(strength), seed=seed)
    return mesh


def mark(mesh: Mesh, scheme: Scheme, bits: int, budget: float, noise: float | None, seed: int = 0) -> Subject:
    """Mark for the usual noise, or where that is refused for the one given."""
    rng = np.random.default_rng([bits, seed])
    marker, message = jm.make_marker(mesh, rng.bytes(32), bits=bits, scheme=scheme), rng.bytes(bits // 8)
    try:
        return marker, marker.embed(message, budget)[0], message, NOISE
    except jm.JaxmarkError:
        if noise is None:
            raise
    return marker, marker.embed(message, budget, noise=noise)[0], message, noise


def as_bending(mesh: Mesh, bits: int, budget: float, noise: float | None) -> float:
    """Budget along normals at which neighbouring faces turn, on average, as far as with one along coordinates."""
    import trimesh

    def angles(of: Mesh) -> np.ndarray:
        surface = trimesh.Trimesh(*welded_mesh(of, weld(mesh.vertices)), process=False)
        return np.where(surface.face_adjacency_convex, 1, -1) * surface.face_adjacency_angles

    still, wanted = angles(mesh), angles(mark(mesh, KeyedScheme(), bits, budget, noise)[1])
    for _ in range(3):
        found = angles(mark(mesh, KeyedScheme(direction="normals"), bits, budget, 0.0)[1])
        budget *= np.abs(wanted - still).mean() / np.abs(found - still).mean()
    return budget


def read(marker: jm.Marker, suspect: Mesh, source: Path | None) -> bytes | None:
    """What is read in this process, or in one of its own that is given files, key and payload."""
    if source is None:
        return marker.detect(suspect).message
    with tempfile.TemporaryDirectory() as folder:
        file, key = Path(folder) / f"suspect{source.suffix}", Path(folder) / "owner.key"
        jm.save_mesh(suspect, file, like=source)
        jm.save_key(marker.key, key)
        options = f"-m jaxmark detect --bits {marker.bits} --scheme {marker.scheme.name} --json".split()
        command = [sys.executable, *options, file, "--original", source, "--key", key]
        run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode not in (0, 1):
        raise jm.JaxmarkError(run.stderr.strip())
    return bytes.fromhex(json.loads(run.stdout)["message"] or "") or None


def survived(subjects: list[Subject], steps: str, source: Path | None) -> Row:
    """How many read after an attack; of the others, what a claim of the message still proves."""
    claims, wrong = [], 0
    for seed, (marker, marked, message, _) in enumerate(subjects):
        suspect = attacked(marked, steps, seed)
        if (found := read(marker, suspect, source)) != message:
            claims.append(round(marker.detect(suspect, message).log10_p, 1))
            wrong += found is not None
    cell = f"{len(subjects) - len(claims)}/{len(subjects)}" + f" {wrong} WRONG" * (wrong > 0)
    cell += f" (log10 p {', '.join(map(str, claims))})" * bool(claims)
    return {"cell": cell, "steps": steps, "log10_p_claimed": claims, "wrong": wrong}


def largest(subjects: list[Subject], kind: str) -> Row:
    """Place on the grid of the strongest attack that reads, the lower median over the subjects; -1 for none."""
    grid, found = GRIDS[kind][0], []
    for seed, (marker, marked, message, _) in enumerate(subjects):
        reads, fails = -1, len(grid)
        while fails - reads > 1:
            place = min(2 * reads + 3, fails - 1) if fails == len(grid) else (reads + fails) // 2
            good = read(marker, attacked(marked, f"{kind} {grid[place]}", seed), None) == message
            reads, fails = (place, fails) if good else (reads, place)
        found.append(reads)
    place = sorted(found)[(len(found) - 1) // 2]
    cell = "none" if place < 0 else "≥ " * (place == len(grid) - 1) + f"{grid[place]:g}"
    return {"cell": cell, "place": place, "places": found}


def measure(mesh: Mesh, source: Path, bits: int, budget: float, options: argparse.Namespace) -> Iterator[Row]:
    """All rows of one mesh and case."""
    probe = jm.make_marker(mesh, bytes(32), bits=bits)
    assert isinstance(probe.carrier, KeyedCarrier)
    left = room(probe.carrier, probe.original)
    kept = left.dimensions @ left.energy
    ceiling = f"{budget * math.sqrt(1.5 * kept / (10**0.25 * least_energy(bits))):.5f}"
    parts = [part for part in ("required", "strengths") if part not in options.skip]
    cases = [(part, name, get_scheme(name), budget, options.noise) for part in parts for name in options.schemes]
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
        yield row | {"cell": f"{size:.3g}" + f" for noise {subjects[0][3]:g}" * isinstance(scheme, KeyedScheme)}
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
        text += [f"## {heads[part]}: {case}", "", f"| attack | mesh | {' | '.join(schemes)} |"]
        text += ["|---" * (len(schemes) + 2) + "|"]
        for attack, mesh in sorted({key[:2] for key in cells}, key=[key[:2] for key in cells].index):
            unit = f", {GRIDS[attack][1]}" if attack in GRIDS else ""
            found = " | ".join(cells.get((attack, mesh, scheme), "-") for scheme in schemes)
            text += [f"| {attack}{unit} | {mesh} | {found} |"]
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="+", type=Path)
    parser.add_argument("--bits", type=int, default=64)
    parser.add_argument("--budget", type=float, default=2e-4)
    parser.add_argument("--case", nargs="+", metavar="BITS:BUDGET", help="in place of --bits and --budget")
    parser.add_argument("--schemes", nargs="+", default=["keyed"], choices=["keyed", "host", "eigen"])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--output", type=Path, help="for robustness.md, .json and .png, rewritten after each case")
    parser.add_argument("--processes", action="store_true")
    parser.add_argument("--noise", type=float, help=f"what to declare where {NOISE:g} is refused")
    parser.add_argument("--skip", nargs="+", default=[], choices=["required", "strengths"])
    parser.add_argument("--directions", action="store_true")
    options = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as cache:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = cache  # for the processes to come
        for source, case in product(options.mesh, options.case or [f"{options.bits}:{options.budget}"]):
            bits, budget = case.split(":")
            for row in measure(jm.load_mesh(source), source, int(bits), float(budget), options):
                rows.append({"mesh": source.name, "case": f"{bits} bits at {budget}"} | row)
                print(*rows[-1].values(), sep=", ", file=sys.stderr, flush=True)
            if options.output:
                options.output.mkdir(parents=True, exist_ok=True)
                (options.output / "robustness.md").write_text(tables(rows))
                (options.output / "robustness.json").write_text(json.dumps(rows, indent=1))
                if placed := [row for row in rows if "place" in row]:
                    picture(placed, options.output / "robustness.png")
    print(tables(rows))


if __name__ == "__main__":
    main()
