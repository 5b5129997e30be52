"""Sub-meshes, each marked on its own, beside one mark of as many bits: python benchmarks/submeshes.py MESH ...

A line for each number of parts, grown from vertices far from each other, and one for the mesh as a whole with the same
payload and budget. Columns:

bits       payload: --bits for each part
carries    what `jaxmark.capacity` says at the budget, in the same noise: of the part that carries least, and of all
           together
prepare, embed, detect
           seconds, of the first seed / of the last, for which nothing has to be compiled; detection is of the mark
           that nobody attacked, aligned by its order
others     how many parts read, over all seeds: keys, messages, noise and planes. "crop" keeps one side of a plane that
           has half of the vertices on it
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import jaxmark as jm
from jaxmark.marking import NOISE
from jaxmark.mesh import Mesh
from jaxmark.original import Original
from jaxmark.submeshes import make_part_marker

ATTACKS = (("none", 0.0), ("noise", 0.005), ("smoothing", 30), ("quantisation", 8), ("crop", 0.5))


class Way(NamedTuple):
    """How to mark a mesh with a total payload, and to read it part by part."""

    name: str
    parts: int
    prepare: Callable[[jm.Key], Any]
    embed: Callable[[Any, list[bytes]], Mesh]
    detect: Callable[[Any, Mesh], list[jm.Detection]]


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


def attacked(mesh: Mesh, kind: str, strength: float, seed: int) -> Mesh:
    match kind:
        case "none":
            return mesh
        case "crop":
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            along = vertices @ np.random.default_rng(seed).normal(size=3)
            return mesh._replace(faces=faces[(along <= np.quantile(along, strength))[faces].all(axis=1)])
    return jm.attack(mesh, kind, strength, seed=seed)


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    return call(*arguments), time.perf_counter() - start


def capacities(mesh: Mesh, parts: int, budget: float) -> list[int]:
    """Of each part, at the whole's budget and in the whole's noise: relative to a part's own size, both are larger."""
    marker = make_part_marker(mesh, jm.Key(bytes(32)), parts, bits=16)
    whole, found = marker.original, []
    for own in (one.original for one in marker.markers):
        scale = whole.diagonal / own.diagonal
        noise = NOISE * scale * radius(whole) / radius(own)
        found.append(jm.capacity(own.mesh, budget * scale, noise=noise))
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
            found = way.detect(marker, attacked(marked, *attack, seed))
            reads[attack] += sum(one.message == message for one, message in zip(found, wanted, strict=True))
    times = [f"{first:.1f} / {last:.1f}" for first, last in zip(seconds[0], seconds[-1], strict=True)]
    return [*times, *(f"{count}/{way.parts * seeds}" for count in reads.values())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", metavar="MESH")
    parser.add_argument("--parts", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--bits", type=int, default=16, help="of each part")
    parser.add_argument("--budget", type=float, default=8e-4, help="RMS displacement over the whole's diagonal")
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    heads = ["mesh", "marked", "bits", "carries", "prepare", "embed", "detect"]
    heads += [kind if kind == "none" else f"{kind} {strength:g}" for kind, strength in ATTACKS]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for path in options.meshes:
        mesh = jm.load_mesh(path)
        whole = jm.capacity(mesh, options.budget)
        for parts in options.parts:
            rooms = capacities(mesh, parts, options.budget) if parts > 1 else [whole]
            for way in ways(mesh, parts, options.bits, options.budget)[parts == 1 :]:
                carried = f"{min(rooms)}, {sum(rooms)}" if way.parts > 1 else f"{whole}"
                cells = [path.rsplit("/", 1)[-1], way.name, f"{parts * options.bits}", carried]
                print(f"| {' | '.join(cells + measure(way, parts, options.bits, options.seeds))} |", flush=True)


if __name__ == "__main__":
    main()
