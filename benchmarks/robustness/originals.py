"""Read with originals that were saved again: in another format, rounded, scaled, rotated, or in another order.

Each mesh is marked with 64 bits at 0.08 % RMS, and attacked by noise and smoothing so strong that log10 p is above its
floor of -77. The suspect keeps the vertex order, and is read with the record and each copy of the original, with the
message claimed. The output has log10 p, and "*" if the message can also be decoded. Then, for each kind of copy, it has
the number of meshes that are read and whose evidence is within a tenth of that with the exact original, the largest
difference of log10 p, and the median seconds of preparing and reading.

    python benchmarks/robustness/originals.py MESH...
"""

import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.exchange.obj import export_obj

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, diagonal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.marks import BUDGET, KEY, MESSAGE
from common.tables import Row, head, line, say, table
from common.timing import timed

ATTACKS = [f"noise {noise:g} + smoothing 5" for noise in (0.003, 0.005, 0.007, 0.01, 0.014, 0.02, 0.03, 0.05)]
FLOOR = -70.0  # log10 p that the suspect must be above, so that differences show
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()


def saved(mesh: Mesh, file: Path) -> Mesh:
    """As the library writes it to a new file: exact in OBJ, in single precision in PLY, STL and GLB."""
    jm.save_mesh(mesh, file)
    return jm.load_mesh(file)


def exported(mesh: Mesh, file: Path, digits: int) -> Mesh:
    """As trimesh writes it to an OBJ file, with so many digits after the point."""
    plain = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    file.write_text(export_obj(plain, digits=digits))
    return jm.load_mesh(file)


def six_digits(mesh: Mesh) -> Mesh:
    """Rounded to six significant digits, as many programs write text."""
    vertices = np.asarray(mesh.vertices)
    rounded = np.array([float(f"{number:.6g}") for number in vertices.ravel()])
    return jm.make_mesh(rounded.reshape(vertices.shape), mesh.faces)


def reordered(mesh: Mesh) -> Mesh:
    """Vertices, faces and corners in another order."""
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    return jm.make_mesh(mesh.vertices[order], np.argsort(order)[mesh.faces][::-1][:, [1, 2, 0]])


def soup(mesh: Mesh) -> Mesh:
    """Each face with corners of its own."""
    return jm.make_mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))


#: How an owner's file may have come about, from the mesh and the stem of a file.
COPIES: dict[str, Callable[[Mesh, Path], Mesh]] = {
    "exact": lambda mesh, stem: mesh,
    "float32": lambda mesh, stem: mesh._replace(vertices=mesh.vertices.astype(np.float32).astype(float)),
    "six digits": lambda mesh, stem: six_digits(mesh),
    "STL": lambda mesh, stem: saved(mesh, stem.with_suffix(".stl")),
    "PLY": lambda mesh, stem: saved(mesh, stem.with_suffix(".ply")),
    "GLB": lambda mesh, stem: saved(mesh, stem.with_suffix(".glb")),
    "OBJ, 8 digits": lambda mesh, stem: exported(mesh, stem.with_suffix(".obj"), 8),
    "a thousand times, moved": lambda mesh, stem: six_digits(
        mesh._replace(vertices=1000 * (mesh.vertices + 0.3 * diagonal(mesh)))
    ),
    "turned": lambda mesh, stem: six_digits(mesh._replace(vertices=mesh.vertices @ TURN.T)),
    "reordered": lambda mesh, stem: reordered(mesh),
    "unwelded": lambda mesh, stem: soup(mesh),
    "turned, scaled, reordered, STL": lambda mesh, stem: saved(
        reordered(mesh._replace(vertices=0.1 * mesh.vertices @ TURN.T)), stem.with_suffix(".stl")
    ),
}


def read(original: Mesh, record: jm.Record, suspect: Mesh) -> Row:
    """Evidence of the claimed message, or why there is none."""
    try:
        marker, preparing = timed(jm.make_marker, original, KEY, record=record)
        found, reading = timed(marker.detect, suspect, MESSAGE)
    except jm.JaxmarkError as refusal:
        return {"refused": str(refusal)}
    times = {"prepare": preparing, "detect": reading}
    how: dict[str, Any] = {"method": found.registration.method, "caveats": found.evidence.caveats}
    return {"log10_p": found.log10_p, "reads": found.message == MESSAGE} | times | how


def measured(mesh: Mesh, seed: int) -> tuple[str, dict[str, Row]]:
    """The attack, and what each copy of the original reads after it."""
    marker = jm.make_marker(mesh, KEY)
    marked, info = marker.embed(MESSAGE, BUDGET)
    enough = (steps for steps in ATTACKS if marker.detect(attacked(marked, steps, seed), MESSAGE).log10_p > FLOOR)
    attack = next(enough, ATTACKS[-1])
    suspect, found = attacked(marked, attack, seed), {}
    for name, copy in COPIES.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                kept = copy(mesh, Path(folder) / "original")
            except jm.JaxmarkError as refusal:
                found[name] = {"refused": str(refusal)}
                continue
        found[name] = read(kept, info.record, suspect)
    return attack, found


def cell(row: Row) -> str:
    if "refused" in row:
        return f"refused: {row['refused']}"
    return f"{row['log10_p']:.1f}{'*' * row['reads']}{', an estimate' * bool(row['caveats'])}"


def summary(rows: list[dict[str, Row]]) -> list[Row]:
    """One row for each way to keep an original."""
    lines = []
    for name in COPIES:
        pairs = [(row["exact"], row[name]) for row in rows if "log10_p" in row["exact"]]
        good = [(exact, own) for exact, own in pairs if "log10_p" in own and not own["caveats"]]
        near = sum(own["log10_p"] <= 0.9 * exact["log10_p"] for exact, own in good)
        lines.append(
            {
                "original": name,
                "reads": f"{sum(own['reads'] for _, own in good)}/{sum(exact['reads'] for exact, _ in pairs)}",
                "within a tenth": f"{near}/{len(pairs)}",
                "most lost": max((own["log10_p"] - exact["log10_p"] for exact, own in good), default=""),
                "recognised by": ", ".join(sorted({own["method"] for _, own in good})),
                "prepare, s": statistics.median(own["prepare"] for _, own in good) if good else "",
                "detect, s": statistics.median(own["detect"] for _, own in good) if good else "",
            }
        )
    return lines


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the attacks")
    options = parser.parse_args()
    rows = []
    print(head("mesh", "points", "attack", *COPIES))
    for path in options.meshes:
        mesh = load(parser, path)
        try:
            attack, found = measured(mesh, options.seed)
        except jm.JaxmarkError as refusal:
            say(path.name, "not marked", refusal, sep=", ")
            continue
        rows.append(found)
        print(line(path.name, f"{len(mesh.vertices):,}", attack, *map(cell, found.values())), flush=True)
    print(f"\n{table(summary(rows))}")


if __name__ == "__main__":
    main()
