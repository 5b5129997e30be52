"""Read marks after other programs remeshed them: python benchmarks/robustness/foreign.py MESH... [--case 64:8e-4 ...].

Each suspect is a marked mesh after ATTACKS, rotated, shifted, scaled by 0.01 to 100 and shuffled, written to a file and
read by a process, `jaxmark detect`. The table says whether the message is exact, what its reading proves or, if it
cannot be read, how many bits with their tag such a suspect can carry at most, and the distance of the estimated pose
from the true one. With --controls, it also has the rate of detection in suspects without this mark.

For each suspect of at most 5,000 vertices, the table has a bound on what the vertices can carry, from original and
suspect. It is a bound by a model; `common/bounds.py` describes the model and its omissions. For a chain of attacks, it
is that of the step with the fewest vertices, as later steps add nothing of the mark. The columns:

    claim      log10 p of a claim of the true message, without its floor; it compares attacks, and proves nothing
    bound      the least log10 p of a claim by the model
    gap dB     distance of the claim's S²/‖a‖² below the bound; where it is negative, the claim exceeds the model
    matched    log10 p by the model's own best receiver, with the true pose and the errors of the same attack
    bits bound number of bits, with their tag, that the vertices carry at most by the model
"""

import argparse
import json
import math
import statistics
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.random import Generator
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import make_original
from jaxmark.attacks import Attack
from jaxmark.attacks.remeshing import apply_filter
from jaxmark.confidence import clopper_pearson
from jaxmark.errors import require
from jaxmark.geometry.mesh import Mesh, compact, diagonal, used_vertices, weld, weld_mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.schemes.registry import get_nonblind

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.attacks import parse
from common.bounds import OTHERS, make_bound
from common.detection import compilation_cache, detect
from common.marks import Case, Subject, add_schemes, mark, parse_case
from common.tables import Row, head, line, save, say

LEVEL = -6  # log10 of the false-positive probability that counts in the controls
KEYS = 10  # that each of their suspects is read with
NEEDED = ("igl", "fast_simplification", "pymeshlab", "skimage")


def plain(mesh: Mesh) -> Mesh:
    """Distinct points only, and of them those that faces use, as other programs want them."""
    return compact(jm.make_mesh(*weld_mesh(mesh, weld(mesh.vertices))))


def left(mesh: Mesh, share: float) -> int:
    """How many faces are left when such a share of the edges goes."""
    return round(len(mesh.faces) * (1 - share))


def collapse(mesh: Mesh, share: float, _: Any) -> Mesh:
    return plain(apply_filter("meshing_decimation_quadric_edge_collapse", mesh, targetfacenum=left(mesh, share)))


def qslim(mesh: Mesh, share: float, _: Any) -> Mesh:
    arrays = (np.asfortranarray(array) for array in mesh)
    return plain(Mesh(*require("igl", "attacks").qslim(*arrays, left(mesh, share))[:2]))


def filtered(name: str) -> Callable[[Mesh, float, Any], Mesh]:
    """A filter of MeshLab, some times one after the other."""

    def run(mesh: Mesh, times: float, _: Any) -> Mesh:
        for _time in range(round(times)):
            mesh = apply_filter(name, mesh)
        return plain(mesh)

    return run


# Simplifiers of MeshLab and libigl, and smoothing by MeshLab, beside the library's.
KINDS = {
    "none": Attack(lambda mesh, *_: mesh, "none", (0,), host=True),
    "collapse": Attack(collapse, "share of the edges", (0.9,), host=True),
    "qslim": Attack(qslim, "share of the edges", (0.9,), host=True),
    "hc": Attack(filtered("apply_coord_hc_laplacian_smoothing"), "times", (1, 10), host=True),
    "two-step": Attack(filtered("apply_coord_two_steps_smoothing"), "times", (1, 10), host=True),
}
# Those, and attacks of `jaxmark attack`, with their strengths.
ATTACKS = """none; simplification 0.5; simplification 0.7; simplification 0.9; simplification 0.95;
simplification 0.975; collapse 0.9; qslim 0.9; midpoint 1; loop 1; sqrt3 1; isotropic 1; isotropic 0.5; isotropic 2;
iso-surface 100; iso-surface 200; poisson 8; cropping 0.1; cropping 0.3; cropping 0.5; cropping 0.8;
simplification 0.7 + noise 0.001; cropping 0.3 + quantisation 9; simplification 0.5 + smoothing 50;
isotropic 1.5 + smoothing 50 + isotropic 1; simplification 0.96 + loop 2; hc 5; two-step 5;
added-geometry 1"""


def attacked(mesh: Mesh, steps: str, seed: int) -> Mesh:
    """A mesh after attacks one by one."""
    return jm.adversaries.chain(plain(mesh), [(KINDS.get(kind, kind), size) for kind, size in parse(steps)], seed=seed)


def narrowest(mesh: Mesh, steps: str, seed: int) -> tuple[Mesh, str]:
    """A mesh after the first steps of a chain, those up to where the fewest vertices are left; and these steps."""
    names = steps.split(" + ")
    firsts = [" + ".join(names[: count + 1]) for count in range(len(names))]
    meshes = [attacked(mesh, first, seed) for first in firsts]
    return min(zip(meshes, firsts, strict=True), key=lambda pair: len(pair[0].vertices))


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


def read(marker: jm.watermark.NonBlindMarker, suspect: Mesh, source: Path, suffix: str) -> Row:
    """What a process of `jaxmark detect` says of a suspect's file."""
    run, seconds = detect(marker, suspect, source, suffix)
    row: Row = {"seconds": seconds}
    if run.returncode in (0, 1) and run.stdout:  # a process that cannot start ends with 1, too
        return row | json.loads(run.stdout)
    said = " ".join(run.stderr.split()[-60:]).removeprefix("jaxmark: ")
    return row | {"note": ("refused: " if run.returncode == 2 else f"exit status {run.returncode}: ") + said}


def failed(error: Exception) -> Row:
    """A row for whatever another program raised."""
    return {"note": f"attack failed: {type(error).__name__}: {' '.join(str(error).split())}"}


def log10_p(square: float) -> float:
    """log10 of Hoeffding's bound for S²/‖a‖²."""
    return -square / 2 / math.log(10)


def bounded(subject: Subject, steps: str, seed: int, others: int) -> Row:
    """What the vertices of a suspect can carry by the model; nothing where the model says nothing."""
    marker, marked = subject.marker, subject.marked
    try:
        suspect, first = narrowest(marked, steps, seed)
        found = make_bound(
            marker, marked, suspect, lambda other: attacked(other, first, seed), others=others, seed=seed
        )
    except Exception as error:  # of another program, on another mark
        return {"bound_note": failed(error)["note"]}
    if found is None:
        return {}
    return {
        "bound": log10_p(found.square),
        "matched": log10_p(found.matched),
        "bits_bound": found.bits,
        "bounded_step": first,
    }


def claimed(subject: Subject, suspect: Mesh) -> float | None:
    """log10 p of a claim of the true message, without floor; None for a suspect that is refused."""
    try:
        return subject.marker.detect(suspect, subject.message).evidence.log10_p_unfloored
    except jm.JaxmarkError:
        return None


def tried(subject: Subject, source: Path, steps: str, seed: int, others: int) -> Row:
    """One suspect, made and read."""
    rng = np.random.default_rng([zlib.crc32(steps.encode()), seed])
    marker, message = subject.marker, subject.message
    try:
        suspect, true = found_again(attacked(subject.marked, steps, seed), rng)
    except Exception as error:
        return failed(error)
    suffix = str(rng.choice([".ply", ".obj"]))
    answer = read(marker, suspect, source, suffix)
    registration = answer.get("registration") or {}
    row = {"vertices": len(suspect.vertices), "faces": len(suspect.faces), "file": suffix}
    row |= {name: answer.get(name) for name in ("log10_p", "coverage", "seconds", "note")}
    row |= {name: registration.get(name) for name in ("method", "residual", "pose")}
    if row["pose"]:
        found = Pose(*(np.array(row["pose"][name]) for name in Pose._fields))
        row["pose_error"] = pose_error(marker.original.mesh, true, found)
    row |= {"claim": claimed(subject, suspect)} | bounded(subject, steps, seed, others)
    if "bound" in row:
        row["gap_dB"] = 10 * math.log10(row["bound"] / row["claim"]) if row["claim"] else math.inf
    if "message" in answer:
        right = answer["message"] == message.hex()
        row["message"] = "yes" if right else "WRONG" if answer["message"] else "no"
        if not right:
            # What a claim proves of the true message, exp(-SNR/2), is also a bound on what such a suspect could carry:
            # the capacity of a Gaussian channel is at most SNR/2 nats, in however many dimensions.
            row["most_bits"] = None if row["claim"] is None else math.floor(-row["claim"] * math.log2(10))
    return row


def measured(source: Path, scheme: str, wanted: Case, options: argparse.Namespace) -> Iterator[Row]:
    """All rows of one mesh and case."""
    for seed in range(options.seeds):
        row: Row = {"seed": seed, "attack": "all"}
        try:
            made = mark(jm.load_mesh(source), get_nonblind(scheme), wanted.bits, wanted.budget, options.noise, seed)
        except jm.JaxmarkError as error:
            yield row | {"note": f"not marked: {error}"}
            continue
        for steps in options.attacks:
            yield (
                row | {"attack": steps, "declared_noise": made.noise} | tried(made, source, steps, seed, options.others)
            )


def controls(sources: list[Path], scheme: str, wanted: Case, options: argparse.Namespace, trial: int) -> Iterator[Row]:
    """One suspect, aligned once, that knows nothing of the keys it is read with."""
    rng = np.random.default_rng([trial, 1])
    source = sources[trial % len(sources)]
    kind = ("unmarked", "other key", "other object")[trial // len(sources) % 3]
    original, steps = jm.load_mesh(source), str(rng.choice(options.attacks))
    row = {"mesh": source.name, "kind": kind, "attack": steps}
    suspect = original
    try:
        if kind == "other key":
            suspect = mark(original, get_nonblind(scheme), wanted.bits, wanted.budget, options.noise, trial).marked
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
        aligned = align(make_original(original), suspect)
    except jm.JaxmarkError as error:
        yield row | {"note": f"refused: {error}"}
        return
    for _ in range(KEYS):
        found = jm.make_marker(original, rng.bytes(32), bits=wanted.bits, scheme=scheme).read(aligned)
        yield row | {"log10_p": found.log10_p, "coverage": found.coverage}


def summary(rows: list[Row]) -> str:
    """How many of the controls count as detected, and how many would at most in the long run."""
    text = [
        "## Controls",
        "",
        head("suspects", "readings", f"log10 p ≤ {LEVEL}", "rate at most (95 %)", "no answer"),
    ]
    for kind in (*dict.fromkeys(row["kind"] for row in rows), "all"):
        mine = [row for row in rows if kind in (row["kind"], "all")]
        values = [row["log10_p"] for row in mine if "log10_p" in row]
        hits = sum(value <= LEVEL for value in values)
        most = clopper_pearson(hits, len(values), 0.9).high if values else 1.0
        text += [line(kind, len(values), hits, f"{most:.2g}", len(mine) - len(values))]
    notes = Counter(row["note"] for row in rows if "note" in row)
    return "\n".join([*text, "", *(f"- {count} × {note}" for note, count in notes.most_common())])


def tables(rows: list[Row]) -> str:
    """A Markdown table for each case."""

    def cell(value: Any) -> str:
        text = "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
        return text.replace("|", "\\|")

    columns = ["mesh", "attack", "seed", "vertices", "message", "log10_p", "most_bits"]
    columns += ["claim", "bound", "gap_dB", "matched", "bits_bound", "coverage", "method"]
    columns += ["pose_error", "residual", "seconds", "note"]
    text = []
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        text += [f"## {case}", "", head(*(column.replace("_", " ") for column in columns))]
        text += [line(*(cell(row.get(column)) for column in columns)) for row in mine]
        reads = Counter(row.get("message") for row in mine)
        text += [
            "",
            f"Of {len(mine)} rows, {reads['yes']} read exactly and {reads['WRONG']} wrongly.",
            "",
            *outcomes(mine),
            "",
        ]
    return "\n".join(text)


def outcomes(rows: list[Row]) -> Iterator[str]:
    """For each attack, how many messages read, how many claims are proven, and how far the model's bound is."""
    yield head("attack", "suspects", "read", f"claims of log10 p ≤ {LEVEL}", "bounds", "gap, dB: median", "worst")
    for attack in dict.fromkeys(row["attack"] for row in rows):
        mine = [row for row in rows if row["attack"] == attack]
        reads = sum(row.get("message") == "yes" for row in mine)
        proven = sum((row.get("claim") or 0) <= LEVEL for row in mine)
        gaps = [row["gap_dB"] for row in mine if "gap_dB" in row]
        shown = (f"{statistics.median(gaps):.1f}", f"{max(gaps):.1f}") if gaps else ("-", "-")
        yield line(attack, len(mine), reads, proven, sum("bound" in row for row in mine), *shown)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument(
        "--case",
        nargs="+",
        type=parse_case,
        metavar="BITS:BUDGET",
        default=[parse_case("64:8e-4"), parse_case("64:2e-4")],
    )
    add_schemes(parser, noise=0.0)
    parser.add_argument("--attacks", nargs="+", default=[""], metavar="NAME", help="only those whose names have it")
    parser.add_argument("--seeds", type=int, default=1, help="keys, messages, poses and random seeds")
    parser.add_argument(
        "--controls", type=int, default=0, help="how many other suspects, of the first case, each with 10 keys"
    )
    parser.add_argument("--others", type=int, default=OTHERS, help="how many other marks tell the model's errors")
    parser.add_argument("--output", type=Path, help="for foreign.md and .json, rewritten after each mesh and case")
    options = parser.parse_args()
    known = " ".join(ATTACKS.split()).split("; ")
    options.attacks = [steps for steps in known if any(name in steps for name in options.attacks)]
    if not options.attacks:
        parser.error(f"No attack is named so; there are {', '.join(known)}.")
    try:
        for package in NEEDED:
            require(package, "all")
    except jm.JaxmarkError as missing:
        sys.exit(str(missing))
    cases = list(product(options.schemes, options.case))
    rows: list[Row] = []
    trials: list[Row] = []

    def report() -> str:
        text = tables(rows) + (f"\n{summary(trials)}\n" if trials else "")
        if options.output:
            save(options.output, "foreign", text, {"rows": rows, "controls": trials})
        return text

    with compilation_cache():
        for source, (scheme, wanted) in product(options.meshes, cases):
            for row in measured(source, scheme, wanted, options):
                rows.append({"mesh": source.name, "case": f"{scheme}, {wanted.name}"} | row)
                say(*rows[-1].values(), sep=", ")
            report()
    for trial in range(options.controls):
        for row in controls(options.meshes, *cases[0], options, trial):
            trials.append(row)
            say(*row.values(), sep=", ")
    print(report())


if __name__ == "__main__":
    main()
