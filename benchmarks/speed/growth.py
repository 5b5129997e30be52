"""Measure how time and memory grow with the mesh: python benchmarks/speed/growth.py [MESH] --output growth.json.

Each stage runs in a process of its own, on a MESH that is simplified to each size, or subdivided and then simplified,
or without a MESH on bumpy tori. The stages are: the filter of degree 64 of three float32 columns, also by SciPy and
PyGSP, and with both gradients; writing marks of 64 bits with default options, and reading them, with the original and
blind; and the lowest 64 eigenvectors by SciPy's eigsh, on which the eigenvector schemes are based. A stage that took
longer than --patience is left out at the larger sizes.

Times are of the second call, without compiling; those of the first, its seconds of compiling and the number of programs
that it compiles are noted beside them. Memory is the maximum during the first call beyond the memory held
before; calls that reuse freed memory show less than they need. Exponents are slopes of logarithms, by least squares
over all sizes of a stage and over its last three. With the extra `plot`, growth.png, in the same folder, shows time and
memory over the number of vertices. An existing output file is extended: its stages are not measured again.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark.plot.figures import Picture, finish, panels, styles

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import json_file, load, make_parser
from common.drawn import keep, small
from common.filters import bumpy_torus, exponent
from common.stages import apart
from common.tables import Row, save_json, say, table

SIZES = (4_000, 16_000, 64_000, 256_000, 1_000_000)
NAMES = {
    "filter": "filter",
    "gradients": "filter with gradients",
    "filter, SciPy CSR, Python loop": "filter by SciPy",
    "filter, PyGSP cheby_op, float64": "filter by PyGSP",
    "eigsh": "64 eigenvectors by eigsh",
    "embed, limits": "embed",
    "detect": "detect",
    "mark, field": "embed, field",
    "read, field": "read, field",
    "mark, local": "embed, local",
    "read, local": "read, local",
}
MEASURES = {"s": "seconds", "GB": "GB"}
FIRST = ("first call, s", "compiling, s", "programs")  # what is also noted of the first call
LAST = 3  # sizes that the second exponent is of
WIDTH = 1560  # pixels


def resized(mesh: jm.Mesh, size: int) -> jm.Mesh:
    """The mesh with about so many vertices."""
    while len(mesh.vertices) < size:
        mesh = jm.attack(mesh, "loop", 1, seed=0)
    return jm.attack(mesh, "simplification", 1 - size / len(mesh.vertices), seed=0)


def measure(meshes: Iterator[jm.Mesh], stages: list[str], patience: float) -> Iterator[Row]:
    """Rows of all stages at all sizes."""
    left = list(stages)
    for mesh in meshes:
        # Detection reads what `embed` leaves.
        for row in apart(mesh, ["embed", *left], 1):
            if row["stage"] not in left:
                continue
            if "later calls, s" not in row:
                say(f"{row['stage']} at {row['vertices']:,}: {row.get('note')}")
                continue
            if row["later calls, s"] > patience:
                left.remove(row["stage"])
            memory = max(row["peak, GB"] - row["held, GB"], 1e-3)
            found = {"vertices": row["vertices"], "stage": row["stage"], "s": row["later calls, s"], "GB": memory}
            yield found | {name: row[name] for name in FIRST}


def exponents(rows: list[Row], stage: str, measure: str) -> tuple[float, float] | None:
    """The slopes over all sizes of a stage, and over its last ones; None for a single size."""
    points = [(row["vertices"], row[measure]) for row in rows if row["stage"] == stage]
    if len(points) < 2:
        return None
    return exponent(*zip(*points, strict=True)), exponent(*zip(*points[-LAST:], strict=True))


def picture(rows: list[Row]) -> Picture:
    """Both measures over the vertices."""
    figure, axes = panels(len(MEASURES), 6, 5)
    for one, (measure, unit) in zip(axes, MEASURES.items(), strict=True):
        for stage, style in zip(dict.fromkeys(row["stage"] for row in rows), styles(1), strict=False):
            points = [(row["vertices"], row[measure]) for row in rows if row["stage"] == stage]
            slopes = exponents(rows, stage, measure)
            # After a round of colours, lines are dashed.
            more = {"linestyle": "-" if list(NAMES).index(stage) < len(NAMES) / 2 else "--"}
            label = NAMES[stage] + ("" if slopes is None else f": {slopes[0]:.2f}")
            one.loglog(*np.transpose(points), label=label, **style, **more)
        finish(one, xlabel="vertices", ylabel=unit)
    return Picture(figure)


def main() -> None:
    """Print the tables, and leave figures and a picture."""
    parser = make_parser(__doc__)
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="VERTICES")
    parser.add_argument("--stages", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--patience", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument("--output", type=json_file, required=True, metavar="FILE.json")
    options = parser.parse_args()
    given = options.mesh and load(parser, options.mesh)
    meshes = (resized(given, size) if given else bumpy_torus(size) for size in sorted(options.sizes))
    rows: list[Row] = json.loads(options.output.read_text()) if options.output.exists() else []
    stages = [stage for stage in options.stages if all(row["stage"] != stage for row in rows)]
    for row in measure(meshes, stages, options.patience):
        say(row)
        rows.append(row)
        save_json(options.output, rows)
    print(table(rows), end="\n\n")
    fitted: list[Row] = []
    for stage in dict.fromkeys(row["stage"] for row in rows):
        found: Row = {"stage": NAMES[stage]}
        for one, unit in MEASURES.items():
            if (slopes := exponents(rows, stage, one)) is not None:
                found |= {f"exponent of {unit}": slopes[0], f"of {unit}, last {LAST}": slopes[1]}
        fitted.append(found)
    print(table(fitted))
    try:
        keep(options.output.with_suffix(".png"), small(picture(rows).png(), WIDTH))
    except jm.JaxmarkError as missing:
        say(missing)


if __name__ == "__main__":
    main()
