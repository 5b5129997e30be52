"""Marks in what other programs make of them: python benchmarks/foreign.py MESH... [--case 64:8e-4 ...].

Each suspect is a marked mesh after ATTACKS, turned, shifted, scaled by 0.01 to 100 and shuffled, written to a file and
read by a process, `jaxmark detect`. Printed are whether the message is exact, what its reading proves, or how many
bits, with their tag, such a suspect could carry at most where it does not read, and how far the pose found is from the
true one. With --controls, also how often something is detected in suspects without this mark.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.random import Generator
from robustness import mark
from scipy import sparse, stats
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment import align
from jaxmark.marking import NOISE
from jaxmark.mesh import Mesh, boundary_vertices, diagonal, edges, used_vertices, weld, welded_mesh
from jaxmark.original import prepare
from jaxmark.pose import Pose
from jaxmark.schemes import get_scheme

Row = dict[str, Any]
LEVEL = -6  # log10 of the false-positive probability that counts in the controls
KEYS = 10  # that each of their suspects is read with

try:
    names = ("fast_simplification", "igl", "pymeshlab", "skimage.measure")
    fast_simplification, igl, pymeshlab, measure = map(importlib.import_module, names)
except ImportError as error:
    sys.exit(f"{error}; install what this needs with: pip install 'jaxmark[all]'")


def plain(mesh: Mesh) -> Mesh:
    """Distinct points only, and of them those that faces use, as other programs want them."""
    points = welded_mesh(mesh, weld(mesh.vertices))
    used = used_vertices(points)
    return jm.make_mesh(np.asarray(points.vertices)[used], (np.cumsum(used) - 1)[points.faces])


def left(mesh: Mesh, percent: float) -> int:
    """How many faces are left when so many percent go."""
    return round(len(mesh.faces) * (1 - percent / 100))


def meshlab(name: str, mesh: Mesh, normals: np.ndarray | None = None, **options: Any) -> Mesh:
    """What a filter of MeshLab makes of a mesh, or of points with normals."""
    filters = pymeshlab.MeshSet()
    given = {"face_matrix": mesh.faces} if normals is None else {"v_normals_matrix": normals}
    filters.add_mesh(pymeshlab.Mesh(vertex_matrix=mesh.vertices, **given))
    filters.apply_filter(name, **options)
    return Mesh(filters.current_mesh().vertex_matrix(), filters.current_mesh().face_matrix())


def sqrt3(mesh: Mesh) -> Mesh:
    """Kobbelt's subdivision (SIGGRAPH 2000), which none of the programs has; boundaries stay."""
    v, f, size = np.asarray(mesh.vertices), np.asarray(mesh.faces), len(mesh.vertices)
    i, j = edges(f).T
    graph = sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (size, size)).tocsr()
    degree = graph.sum(axis=1)[:, None]
    weight = (4 - 2 * np.cos(2 * np.pi / degree)) / 9
    weight[boundary_vertices(f)] = 0
    # A side i → j of the face with centroid c, and the other way of the face with d, gives the face i, d, c.
    start, end, centre = f.T.ravel(), np.roll(f, -1, axis=1).T.ravel(), np.tile(size + np.arange(len(f)), 3)
    across = dict(zip(zip(end.tolist(), start.tolist(), strict=True), centre.tolist(), strict=True))
    other = [across.get(side, side[1]) for side in zip(start.tolist(), end.tolist(), strict=True)]
    moved = (1 - weight) * v + weight * (graph @ v) / degree
    return Mesh(np.r_[moved, v[f].mean(axis=1)], np.c_[start, other, centre])


def remeshed(mesh: Mesh, factor: float) -> Mesh:
    """Isotropic, edges of so many times the mean length."""
    i, j = edges(mesh.faces).T
    length = np.linalg.norm(np.asarray(mesh.vertices)[i] - np.asarray(mesh.vertices)[j], axis=1).mean()
    return meshlab("meshing_isotropic_explicit_remeshing", mesh, targetlen=pymeshlab.PureValue(factor * length))


def extracted(mesh: Mesh, cells: float) -> Mesh:
    """Marching cubes on the signed distance, so many cells along the longest side of the box."""

    def distance(points: np.ndarray) -> np.ndarray:
        # The winding number gives a sign where a hole leaves inside and outside open.
        sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        return igl.signed_distance(points, np.asarray(mesh.vertices), np.asarray(mesh.faces), sign)[0]

    low, extent = np.asarray(mesh.vertices).min(axis=0), np.ptp(mesh.vertices, axis=0)
    cell = extent.max() / cells
    coarse = np.ceil(extent / cell / 4).astype(int) + 3
    low = low - 4 * cell
    rough = distance(low + 4 * cell * np.argwhere(np.ones(coarse))).reshape(coarse)
    # Every fourth point of the grid tells where the surface may be: a distance changes no faster than the position.
    values = rough[np.ix_(*((np.arange(4 * count - 3) + 2) // 4 for count in coarse))]
    near = np.argwhere(np.abs(values) < 6 * cell)
    values[tuple(near.T)] = distance(low + cell * near)
    found = measure.marching_cubes(values, 0, gradient_direction="descent")
    return Mesh(low + cell * found[0].astype(float), found[1])


def poisson(mesh: Mesh, depth: float, seed: int) -> Mesh:
    """Screened Poisson reconstruction of 30 points for each vertex, with their faces' normals."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(surface, 30 * len(mesh.vertices), seed=seed)[:2]
    samples, normals = Mesh(np.asarray(points), mesh.faces), np.asarray(surface.face_normals)[face]
    name = "generate_surface_reconstruction_screened_poisson"
    return meshlab(name, samples, normals, depth=int(depth), threads=1)  # more of them add up in any order


def cropped(mesh: Mesh, percent: float, seed: int) -> Mesh:
    """Without so many of the vertices, on one side of a plane, and the faces that use them."""
    side = mesh.vertices @ np.random.default_rng(seed).normal(size=3)
    kept = side <= np.quantile(side, 1 - percent / 100)
    return Mesh(mesh.vertices, np.asarray(mesh.faces)[kept[mesh.faces].all(axis=1)])


def scene(mesh: Mesh, seed: int) -> Mesh:
    """Between a ring and a box of about its size."""
    size, rng = diagonal(mesh), np.random.default_rng(seed)
    others = [trimesh.creation.torus(0.3, 0.1), trimesh.creation.box((0.6, 0.4, 0.5)).subdivide_to_size(0.1)]
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for other, side in zip(others, (-1.2, 1.2), strict=True):
        place = np.asarray(mesh.vertices).mean(axis=0) + size * np.array([side, *rng.uniform(-0.2, 0.2, 2)])
        faces = np.r_[faces, other.faces + len(vertices)]
        vertices = np.r_[vertices, place + size * rng.uniform(0.8, 1.2) * other.vertices]
    return Mesh(vertices, faces)


# Mesh, strength, seed → mesh. The strength is: percent of the faces that go, in fast-simplification, MeshLab or libigl;
# edge length over the mean; cells a side; depth of the octree; percent of the vertices that go.
KINDS: dict[str, Callable[[Mesh, float, int], Mesh]] = {
    "none": lambda mesh, *_: mesh,
    "simplification": lambda mesh, percent, _: Mesh(
        *fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=left(mesh, percent))
    ),
    "collapse": lambda mesh, percent, _: meshlab(
        "meshing_decimation_quadric_edge_collapse", mesh, targetfacenum=left(mesh, percent)
    ),
    "qslim": lambda mesh, percent, _: Mesh(
        *igl.qslim(*(np.asfortranarray(array) for array in mesh), left(mesh, percent))[:2]
    ),
    "midpoint": lambda mesh, *_: Mesh(*trimesh.remesh.subdivide(*mesh)[:2]),  # pyright: ignore
    "loop": lambda mesh, *_: meshlab(
        "meshing_surface_subdivision_loop", mesh, iterations=1, threshold=pymeshlab.PercentageValue(0)
    ),
    "sqrt3": lambda mesh, *_: sqrt3(mesh),
    "isotropic": lambda mesh, factor, _: remeshed(mesh, factor),
    "iso-surface": lambda mesh, cells, _: extracted(mesh, cells),
    "poisson": poisson,
    "crop": cropped,
    "scene": lambda mesh, _, seed: scene(mesh, seed),
}
# Other kinds are those of `jaxmark attack`.
ATTACKS = """none; simplification 50; simplification 70; simplification 90; simplification 95; simplification 97.5;
collapse 90; qslim 90; midpoint; loop; sqrt3; isotropic 1; isotropic 0.5; isotropic 2; iso-surface 100; iso-surface 200;
poisson 8; crop 10; crop 30; crop 50; crop 80; simplification 70 + noise 0.001; crop 30 + quantisation 9;
simplification 50 + smoothing 50; scene"""


def attacked(mesh: Mesh, steps: str, seed: int) -> Mesh:
    """A mesh after attacks one by one."""
    mesh = plain(mesh)
    for kind, *strength in (step.split() for step in steps.split(" + ")):
        size = float(*strength)
        mesh = plain(KINDS[kind](mesh, size, seed)) if kind in KINDS else jm.attack(mesh, kind, size, seed=seed)
    return mesh


def found_again(mesh: Mesh, rng: Generator) -> tuple[Mesh, Pose]:
    """A mesh in any pose and scale, vertices and faces in any order; and the pose."""
    scale = 10 ** rng.uniform(-2, 2)
    pose = Pose(scale * Rotation.random(rng=rng).as_matrix(), scale * diagonal(mesh) * rng.normal(size=3))
    order = rng.permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces]
    return Mesh(pose(np.asarray(mesh.vertices))[order], rng.permutation(faces)), pose


def pose_error(original: Mesh, true: Pose, found: Pose) -> float:
    """RMS distance of the original's vertices from where the two poses, there and back, bring them; in diagonals."""
    points = np.asarray(original.vertices)[used_vertices(original)]
    return float(jm.distortion.rms(found(true(points)) - points)) / diagonal(original)


def read(marker: jm.Marker, suspect: Mesh, source: Path, suffix: str, claim: bytes | None = None) -> Row:
    """What a process of `jaxmark detect` says of a suspect's file, with a claimed message or without."""
    with tempfile.TemporaryDirectory() as folder:
        file, key = Path(folder) / f"suspect{suffix}", Path(folder) / "owner.key"
        jm.save_mesh(suspect, file)
        jm.save_key(marker.key, key)
        options = f"-m jaxmark detect --bits {marker.bits} --scheme {marker.scheme.name} --json".split()
        options += ["--message", claim.hex()] if claim else []
        command, start = [sys.executable, *options, file, "--original", source, "--key", key], time.perf_counter()
        run = subprocess.run(command, capture_output=True, text=True)
    row: Row = {"seconds": time.perf_counter() - start}
    if run.returncode in (0, 1) and run.stdout:  # a process that cannot start ends with 1, too
        return row | json.loads(run.stdout)
    said = " ".join(run.stderr.split()[-60:]).replace(f"{folder}/", "").removeprefix("jaxmark: ")
    return row | {"note": ("refused: " if run.returncode == 2 else f"exit status {run.returncode}: ") + said}


def failed(error: Exception) -> Row:
    """A row for whatever another program raised."""
    return {"note": f"attack failed: {type(error).__name__}: {' '.join(str(error).split())}"}


def tried(marker: jm.Marker, marked: Mesh, message: bytes, source: Path, steps: str, seed: int) -> Row:
    """One suspect, made and read."""
    rng = np.random.default_rng([zlib.crc32(steps.encode()), seed])
    try:
        suspect, true = found_again(attacked(marked, steps, seed), rng)
    except Exception as error:
        return failed(error)
    suffix = str(rng.choice([".ply", ".obj"]))
    answer = read(marker, suspect, source, suffix)
    alignment = answer.get("alignment") or {}
    row = {"vertices": len(suspect.vertices), "faces": len(suspect.faces), "file": suffix}
    row |= {name: answer.get(name) for name in ("log10_p", "coverage", "seconds", "note")}
    row |= {name: alignment.get(name) for name in ("method", "residual", "pose")}
    if row["pose"]:
        found = Pose(*(np.array(row["pose"][name]) for name in Pose._fields))
        row["pose_error"] = pose_error(marker.original.mesh, true, found)
    if "message" in answer:
        right = answer["message"] == message.hex()
        row["message"] = "yes" if right else "WRONG" if answer["message"] else "no"
        if not right:
            # What a claim proves of the true message, exp(-SNR/2), is also a bound on what such a suspect could carry:
            # the capacity of a Gaussian channel is at most SNR/2 nats, in however many dimensions.
            claimed = read(marker, suspect, source, suffix, message).get("log10_p")
            row["most_bits"] = None if claimed is None else float(np.floor(-claimed * np.log2(10)))
    return row


def measured(source: Path, scheme: str, bits: int, budget: float, options: argparse.Namespace) -> Iterator[Row]:
    """All rows of one mesh and case."""
    for seed in range(options.seeds):
        row: Row = {"seed": seed, "attack": "all"}
        try:
            made = mark(jm.load_mesh(source), get_scheme(scheme), bits, budget, options.noise, seed)
        except jm.JaxmarkError as error:
            yield row | {"note": f"not marked: {error}"}
            continue
        for steps in options.attacks:
            yield row | {"attack": steps, "declared_noise": made[3]} | tried(*made[:3], source, steps, seed)


def controls(
    sources: list[Path], scheme: str, bits: int, budget: float, options: argparse.Namespace, trial: int
) -> Iterator[Row]:
    """One suspect, aligned once, that knows nothing of the keys it is read with."""
    rng = np.random.default_rng([trial, 1])
    source = sources[trial % len(sources)]
    kind = ("unmarked", "other key", "other object")[trial // len(sources) % 3]
    original, steps = jm.load_mesh(source), str(rng.choice(options.attacks))
    row = {"mesh": source.name, "kind": kind, "attack": steps}
    suspect = original
    try:
        if kind == "other key":
            suspect = mark(original, get_scheme(scheme), bits, budget, options.noise, trial)[1]
        elif kind == "other object":
            ball = trimesh.creation.icosphere(subdivisions=4)
            rough = Mesh(ball.vertices * (1 + 0.05 * rng.normal(size=(len(ball.vertices), 1))), ball.faces)
            others = [other for other in sources if other != source]
            suspect = jm.load_mesh(others[rng.integers(len(others))]) if others else rough
        suspect = found_again(attacked(suspect, steps, trial), rng)[0]
    except Exception as error:
        yield row | failed(error)
        return
    try:
        aligned = align(prepare(original), suspect)
    except jm.JaxmarkError as error:
        yield row | {"note": f"refused: {error}"}
        return
    for _ in range(KEYS):
        found = jm.make_marker(original, rng.bytes(32), bits=bits, scheme=scheme).detect(aligned)
        yield row | {"log10_p": found.log10_p, "coverage": found.coverage}


def summary(rows: list[Row]) -> str:
    """How many of the controls count as detected, and how many would at most in the long run."""
    text = [
        "## Controls",
        "",
        f"| suspects | readings | log10 p ≤ {LEVEL} | rate at most (95 %) | no answer |",
        "|---" * 5 + "|",
    ]
    for kind in (*dict.fromkeys(row["kind"] for row in rows), "all"):
        mine = [row for row in rows if kind in (row["kind"], "all")]
        values = [row["log10_p"] for row in mine if "log10_p" in row]
        hits = sum(value <= LEVEL for value in values)
        # Clopper and Pearson, Biometrika 26, 1934; one-sided.
        most = stats.beta.ppf(0.95, hits + 1, len(values) - hits) if hits < len(values) else 1.0
        text += [f"| {kind} | {len(values)} | {hits} | {most:.2g} | {len(mine) - len(values)} |"]
    notes = Counter(row["note"] for row in rows if "note" in row)
    return "\n".join([*text, "", *(f"- {count} × {note}" for note, count in notes.most_common())])


def tables(rows: list[Row]) -> str:
    """A Markdown table for each case."""

    def cell(value: Any) -> str:
        text = "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
        return text.replace("|", "\\|")

    columns = ["mesh", "attack", "seed", "vertices", "message", "log10_p", "most_bits", "coverage", "method"]
    columns += ["pose_error", "residual", "seconds", "note"]
    text = []
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        text += [f"## {case}", "", f"| {' | '.join(columns).replace('_', ' ')} |", "|---" * len(columns) + "|"]
        text += [f"| {' | '.join(cell(row.get(column)) for column in columns)} |" for row in mine]
        reads = Counter(row.get("message") for row in mine)
        text += ["", f"Of {len(mine)} rows, {reads['yes']} read exactly and {reads['WRONG']} wrongly.", ""]
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="+", type=Path)
    parser.add_argument("--case", nargs="+", metavar="BITS:BUDGET", default=["64:8e-4", "64:2e-4"])
    parser.add_argument("--schemes", nargs="+", default=["keyed"], choices=["keyed", "host", "eigen"])
    parser.add_argument("--attacks", nargs="+", default=[""], metavar="NAME", help="only those whose names have it")
    parser.add_argument("--seeds", type=int, default=1, help="keys, messages, poses and random seeds")
    parser.add_argument("--noise", type=float, default=0.0, help=f"what to declare where {NOISE:g} is refused")
    parser.add_argument(
        "--controls", type=int, default=0, help="how many other suspects, of the first case, each with 10 keys"
    )
    parser.add_argument("--output", type=Path, help="for foreign.md and .json, rewritten after each mesh and case")
    options = parser.parse_args()
    known = " ".join(ATTACKS.split()).split("; ")
    options.attacks = [steps for steps in known if any(name in steps for name in options.attacks)]
    if not options.attacks:
        parser.error(f"No attack is named so; there are {', '.join(known)}.")
    cases = [(scheme, *case.split(":")) for scheme, case in product(options.schemes, options.case)]
    rows: list[Row] = []
    trials: list[Row] = []

    def report() -> str:
        text = tables(rows) + (f"\n{summary(trials)}\n" if trials else "")
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            (options.output / "foreign.md").write_text(text)
            (options.output / "foreign.json").write_text(json.dumps({"rows": rows, "controls": trials}, indent=1))
        return text

    with tempfile.TemporaryDirectory() as cache:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = cache  # for the processes to come
        for source, (scheme, bits, budget) in product(options.mesh, cases):
            for row in measured(source, scheme, int(bits), float(budget), options):
                rows.append({"mesh": source.name, "case": f"{scheme}, {bits} bits at {budget}"} | row)
                print(*rows[-1].values(), sep=", ", file=sys.stderr, flush=True)
            report()
    scheme, bits, budget = cases[0]
    for trial in range(options.controls):
        for row in controls(options.mesh, scheme, int(bits), float(budget), options, trial):
            trials.append(row)
            print(*row.values(), sep=", ", file=sys.stderr, flush=True)
    print(report())


if __name__ == "__main__":
    main()
