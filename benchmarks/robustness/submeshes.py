"""Compare marks of sub-meshes with one mark of as many bits: python benchmarks/robustness/submeshes.py MESH ...

There is a line for each number of parts, which grow from vertices far from each other, and one for the whole mesh with
the same payload and budget. Columns:

bits       payload: --bits for each part
carries    result of `jaxmark.capacity` at the budget, in the same noise: of the part that carries least, and of all
           parts together
prepare, embed, detect
           seconds, of the first seed / of the last, for which nothing is compiled; detection is of the mark without
           attack, aligned by its order
others     number of parts that are read, over all seeds: keys, messages, noise and planes. "crop" keeps one side of a
           plane with half of the vertices on each side
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxmark as jm
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.perception.capacity import NOISE

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.marks import BUDGET
from common.submeshes import make_part_marker
from common.tables import head, line
from common.timing import timed

ATTACKS = ("none", "noise 0.005", "smoothing 30", "quantisation 8", "crop 0.5")


class Way(NamedTuple):
    """How to mark a mesh with a total payload, and to read it part by part."""

    name: str
    parts: int
    prepare: Callable[[jm.Key], Any]
    embed: Callable[[Any, list[bytes]], Mesh]
    detect: Callable[[Any, Mesh], list[jm.watermark.Detection]]


def ways(mesh: Mesh, parts: int, bits: int, budget: float) -> tuple[Way, Way]:
    """In parts, and as a whole."""
    return (
        Way(
            f"{parts} parts",
            parts,
            lambda key: make_part_marker(mesh, key, parts, bits=bits),
            lambda marker, messages: marker.embed(messages, budget)[0],
            lambda marker, suspect: marker.detect(suspect),
        ),
        Way(
            "whole",
            1,
            lambda key: jm.make_marker(mesh, key, bits=bits * parts),
            lambda marker, messages: marker.embed(b"".join(messages), budget)[0],
            lambda marker, suspect: [marker.detect(suspect)],
        ),
    )


def crop(mesh: Mesh, share: float, random: np.random.Generator) -> Mesh:
    """Such a share of the vertices, on one side of a plane; the others stay, without faces."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    along = vertices @ random.normal(size=3)
    return mesh._replace(faces=faces[(along <= np.quantile(along, share))[faces].all(axis=1)])


def capacities(mesh: Mesh, parts: int, budget: float) -> list[int]:
    """Of each part, at the whole's budget and in the whole's noise: relative to a part's own size, both are larger."""
    marker = make_part_marker(mesh, jm.Key(bytes(32)), parts, bits=16)
    whole, found = marker.original, []
    for own in (one.original for one in marker.markers):
        scale = whole.diagonal / own.diagonal
        noise = NOISE * scale * radius(whole) / radius(own)
        found.append(jm.capacity(own.mesh, jm.Budget(rms=budget * scale, noise=noise)))
    return found


def radius(original: Original) -> float:
    """Mean distance of the points to their centre, in diagonals."""
    return float(np.linalg.norm(original.positions[original.used], axis=1).mean())


def measure(way: Way, parts: int, bits: int, seeds: int) -> list[str]:
    """Cells of times and of readings, or why it was refused."""
    seconds, reads = [], dict.fromkeys(ATTACKS, 0)
    for seed in range(seeds):
        random = np.random.default_rng([parts, seed])
        messages = [random.bytes(bits // 8) for _ in range(parts)]
        marker, preparing = timed(way.prepare, jm.Key(random.bytes(32)))
        try:
            marked, embedding = timed(way.embed, marker, messages)
        except jm.JaxmarkError as error:
            return [f"refused: {error}"]
        _, detecting = timed(way.detect, marker, marked)
        seconds.append((preparing, embedding, detecting))
        wanted = messages if way.parts > 1 else [b"".join(messages)]
        for attack in ATTACKS:
            found = way.detect(marker, attacked(marked, attack, seed, {"crop": crop}))
            reads[attack] += sum(one.message == message for one, message in zip(found, wanted, strict=True))
    times = [f"{first:.1f} / {last:.1f}" for first, last in zip(seconds[0], seconds[-1], strict=True)]
    return [*times, *(f"{count}/{way.parts * seeds}" for count in reads.values())]


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--parts", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--bits", type=int, default=16, help="of each part")
    parser.add_argument("--budget", type=float, default=BUDGET, help="RMS displacement over the whole's diagonal")
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    print(head("mesh", "marked", "bits", "carries", "prepare", "embed", "detect", *ATTACKS))
    for path in options.meshes:
        mesh = load(parser, path)
        whole = jm.capacity(mesh, options.budget)
        for parts in options.parts:
            bits = capacities(mesh, parts, options.budget) if parts > 1 else [whole]
            for way in ways(mesh, parts, options.bits, options.budget)[parts == 1 :]:
                carried = f"{min(bits)}, {sum(bits)}" if way.parts > 1 else f"{whole}"
                found = measure(way, parts, options.bits, options.seeds)
                print(line(path.name, way.name, parts * options.bits, carried, *found), flush=True)


if __name__ == "__main__":
    main()
