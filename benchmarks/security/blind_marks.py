"""What marks prove that are read without the original, and what it costs to erase and to copy them.

Tables in Markdown, by part; `--only` chooses some:

  bound      simulated pairs of suspect and key, without a mesh: how many state a probability at most so small, beside
             the most that are expected; for a pose chosen blindly, for one at which all offsets fit exactly, and for
             the best of many, paid for; by the squares of the cosines, as `jaxmark.detect` states it, and by the number
             of anchors, which a search breaks
  unmarked   the smallest log10 p that is read from unmarked meshes, and expected by chance
  erasure    values of all anchors moved by shares of a step, without the key
  remarking  a second mark by another key, of the same limits
  copying    the phases of one marked work written in another shape, without the key
  averaging  the lattice of values estimated from several works of one key with different messages, and another work
             moved to halfway between

RMS is that of the attack over that of the mark, MSDM that of the attack alone. Figures are of one seed.

    python benchmarks/security/blind_marks.py MESH [MESH ...] [--only PART ...] [--pairs N] [--keys N] [--works N ...]
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

import jaxmark as jm
from jaxmark import distortion
from jaxmark.alignment.original import Original, displace, make_original
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.watermark import evidence
from jaxmark.watermark.blind import reading
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.marker import make_blind_marker
from jaxmark.watermark.blind.scheme import AnchoredHost
from jaxmark.watermark.blind.writing import Writer
from jaxmark.watermark.everyday import BLIND_SCHEMES
from jaxmark.watermark.marking import EmbedInfo

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.marks import KEY, MESSAGE
from common.tables import Row, say, table

PARTS = ("bound", "unmarked", "erasure", "remarking", "copying", "averaging")
LIMITS = {"msdm": 0.2, "mrms": 8e-4}
LEVELS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
ANCHORS = 200  # of a simulated suspect
BATCH = 5_000  # pairs that are simulated at once
CANDIDATES = 64  # poses of which the best is taken
NEAR = 2.0  # score over norm from which a probability may be as small as the first level
SHARES = (1 / 8, 3 / 16, 1 / 4)  # of a step, by which values are moved
ROUNDS = 2  # of Gauss and Newton, as the library writes
WAVES, WAVE_LENGTH, WAVE_SIZE = 4, 0.4, 2e-3  # of the warps that tell versions of a shape apart, in diagonals
SCHEME = FieldScheme()  # that is attacked
OTHER = jm.Key(bytes(reversed(range(32))))


class Scores(NamedTuple):
    """Scores of simulated readings, and what two bounds divide by."""

    score: Float64[np.ndarray, " pairs"]
    norm: Float64[np.ndarray, " pairs"]  # root of Σ c²
    blind: Float64[np.ndarray, " pairs"]  # root of half the number of anchors: what Σ c² is on average


def simulate(way: str, pairs: int, rng: np.random.Generator) -> Scores:
    """Scores of suspects that know nothing of the signs.

    Args:
        way: "none": phases know nothing of the offsets; "extreme": each is at the offset or half a step beside it, by
            chance; "best": the best of `CANDIDATES` of the first kind.
        pairs: of suspect and key.
        rng: the source of all chance.
    """
    tried = CANDIDATES if way == "best" else 1
    shape = (pairs, tried, ANCHORS)
    offset = rng.random((pairs, 1, ANCHORS), np.float32) / 2
    sign = 1 - 2 * rng.integers(0, 2, (pairs, 1, ANCHORS), np.int8).astype(np.float32)
    if way == "extreme":
        phase = offset + rng.integers(0, 2, shape, np.int8).astype(np.float32) / 2
    else:
        phase = rng.random(shape, np.float32)
    cosine = np.cos(np.float32(2 * np.pi) * (phase - offset))
    score = np.asarray(np.sum(sign * cosine, axis=2), np.float64)
    norm = np.sqrt(np.asarray(np.sum(cosine**2, axis=2), np.float64))
    best = np.argmax(score / norm, axis=1)
    rows = np.arange(pairs)
    return Scores(score[rows, best], norm[rows, best], np.full(pairs, math.sqrt(ANCHORS / 2)))


def stated(scores: Float64[np.ndarray, " pairs"], norms: Float64[np.ndarray, " pairs"]) -> Float64[np.ndarray, " some"]:
    """log10 p of each pair that may state one as small as the first level."""
    near = np.flatnonzero(scores > NEAR * norms)
    return np.array(
        [evidence.log10_p_claimed(score, norm) for score, norm in zip(scores[near], norms[near], strict=True)]
    )


def bound(pairs: int) -> Iterator[Row]:
    """How many pairs state a probability at most as small as each level."""
    names = {"none": "no search", "extreme": "all offsets fit", "best": f"best of {CANDIDATES}"}
    for seed, (way, name) in enumerate(names.items()):
        tried = CANDIDATES if way == "best" else 1
        count, rng = pairs // tried, np.random.default_rng(seed)
        found: dict[str, list[np.ndarray]] = {"Σ c²": [], "n": []}
        for start in range(0, count, BATCH // tried):
            scores = simulate(way, min(BATCH // tried, count - start), rng)
            found["Σ c²"].append(stated(scores.score, scores.norm))
            found["n"].append(stated(scores.score, scores.blind))
        say(name, "simulated")
        expected = {f"{p:.0e}": f"{p * count:,g}" for p in LEVELS}
        yield {"search": name, "pairs": count, "bound by": "(expected)"} | expected
        for by, parts in found.items():
            values = np.concatenate(parts) + math.log10(tried)
            hits = {f"{p:.0e}": int(np.sum(values <= math.log10(p))) for p in LEVELS}
            yield {"search": name, "pairs": count, "bound by": by} | hits


def key_of(number: int) -> jm.Key:
    return jm.Key(b"blind marks, key" + number.to_bytes(16, "big"))


def unmarked(meshes: Mapping[str, Mesh], keys: int) -> Iterator[Row]:
    """The smallest probability that is read from meshes without a mark, by each scheme."""
    for (name, mesh), scheme in product(meshes.items(), BLIND_SCHEMES.values()):
        claimed, read = [], []
        for number in range(keys):
            claimed.append(reading.detect(mesh, key_of(number), 8 * len(MESSAGE), scheme, MESSAGE).log10_p)
            read.append(reading.detect(mesh, key_of(number), 8 * len(MESSAGE), scheme))
            say(name, number, claimed[-1], read[-1].log10_p)
        yield {
            "mesh": name,
            "scheme": scheme.name,
            "keys": keys,
            "claimed": min(claimed),
            "read": min(one.log10_p for one in read),
            "messages": sum(one.message is not None for one in read),
            "by chance": -math.log10(keys),
        }


class Marked(NamedTuple):
    """A work with its mark."""

    name: str
    mesh: Mesh
    marked: Mesh
    info: EmbedInfo

    @property
    def width(self) -> float:
        """Of the averages, in the unit of its own pose."""
        return self.info.record.parameters["width"]

    @property
    def step(self) -> float:
        """Of the lattice of values, in the same unit."""
        return self.info.record.parameters["step"]


def mark(name: str, mesh: Mesh) -> Marked:
    """Mark within the limits."""
    marked, info = jm.embed(mesh, MESSAGE, KEY, scheme=SCHEME, limits=LIMITS)
    found = Marked(name, mesh, marked, info)
    say(f"{name}: RMS {info.rms:.2e}, width {found.width:g}, step {found.step:.2e}, alpha {info.record.beta:.2f}")
    return found


class Seen(NamedTuple):
    """A mesh as anybody sees it who knows width and step, which are on short public ladders."""

    mesh: Mesh
    original: Original
    writer: Writer
    host: AnchoredHost
    step: float

    @property
    def good(self) -> Bool[np.ndarray, " anchors"]:
        """Whether an anchor is one that is written."""
        return self.host.good > 0

    @property
    def cells(self) -> Int64[np.ndarray, "anchors 3"]:
        """Indices of the anchors in the lattice of points."""
        return self.host.names

    @property
    def phases(self) -> Float64[np.ndarray, " anchors"]:
        """Values in steps."""
        return self.host.values / self.step


def look(mesh: Mesh, width: float, step: float) -> Seen:
    """Look at a mesh by its anchors, without a key."""
    original = make_original(mesh)
    writer = Writer(original, SCHEME.fixed(width, step), reading.context(KEY, 8 * len(MESSAGE), SCHEME.name))
    return Seen(mesh, original, writer, writer.hosts[width], step)


def moved(
    seen: Seen, change: Float64[np.ndarray, " anchors"], counted: Bool[np.ndarray, " anchors"] | None = None
) -> Mesh:
    """Move values by the least displacement.

    Args:
        seen: the mesh.
        change: of each value, in steps.
        counted: the anchors whose values matter; all that are good, if None.
    """
    host = seen.host if counted is None else seen.host._replace(good=counted.astype(np.float64))
    return displace(seen.original, seen.writer.shift(host, host.values + seen.step * change, ROUNDS))


def cost(before: Mesh, after: Mesh, mark: float) -> Row:
    """What an attack did to a mesh, beside what a mark did."""
    found = distortion.measure(before, after, ("rms", "msdm"))
    return {"RMS": (found["rms"] or 0.0) / mark, "MSDM": found["msdm"]}


def read(suspect: Mesh, key: jm.Key = KEY, message: bytes = MESSAGE) -> Row:
    """What is proven of the mark's message, and whether it reads."""
    found = jm.detect(suspect, key=key, message=message)
    say(f"log10 p {found.log10_p:.1f}, agreement {found.agreement:.2f}")
    return {"log10 p": found.log10_p, "reads": "yes" if found.message == message else "no"}


def either_way(seen: Seen) -> Float64[np.ndarray, " anchors"]:
    """A sign for each anchor, by chance."""
    return np.random.default_rng(0).choice([-1.0, 1.0], len(seen.good))


def erasure(work: Marked) -> Iterator[Row]:
    """Move all values by shares of a step, all the same way or each either way by chance."""
    yield {"mesh": work.name, "attack": "none"} | read(work.marked)
    seen = look(work.marked, work.width, work.step)
    for name, way in {"one way": np.ones(len(seen.good)), "either way": either_way(seen)}.items():
        for share in SHARES:
            erased = moved(seen, share * way)
            row: Row = {"mesh": work.name, "attack": f"{share:g} of a step, {name}"}
            yield row | cost(work.marked, erased, work.info.rms) | read(erased)


def remarking(work: Marked) -> Iterator[Row]:
    """Mark a marked work again under another key."""
    second = MESSAGE[::-1]
    again, _ = jm.embed(work.marked, second, OTHER, scheme=SCHEME, limits=LIMITS)
    both = cost(work.marked, again, work.info.rms)
    yield {"mesh": work.name, "mark": "first"} | both | read(again)
    yield {"mesh": work.name, "mark": "second"} | both | read(again, OTHER, second)


def places_in(
    cells: Int64[np.ndarray, "cells 3"], others: Int64[np.ndarray, "others 3"]
) -> tuple[Int64[np.ndarray, " shared"], Int64[np.ndarray, " shared"]]:
    """Where the cells that two lists share lie in each."""
    number = {tuple(cell): place for place, cell in enumerate(others.tolist())}
    shared = [(place, number[tuple(cell)]) for place, cell in enumerate(cells.tolist()) if tuple(cell) in number]
    pairs = np.array(shared, np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def copying(work: Marked, others: Mapping[str, Mesh]) -> Iterator[Row]:
    """Write the phases of a marked work at the anchors that another shape shares with it, and read that."""
    source = look(work.marked, work.width, work.step)
    for name, other in others.items():
        target = look(other, work.width, work.step)
        here, there = np.flatnonzero(target.good), np.flatnonzero(source.good)
        places, sources = places_in(target.cells[here], source.cells[there])
        change, counted = np.zeros(len(target.good)), np.zeros(len(target.good), bool)
        counted[here[places]] = True
        away = source.phases[there[sources]] - target.phases[here[places]]
        change[here[places]] = away - np.round(away)
        row: Row = {"from": work.name, "to": name, "anchors": len(here), "shared": len(places)}
        if not len(places):
            yield row
            continue
        copied = moved(target, change, counted)
        yield row | cost(other, copied, work.info.rms) | read(copied)


def version(mesh: Mesh, seed: int) -> Mesh:
    """A version of a shape that differs a little everywhere: smooth waves go through it."""
    rng, size, points = np.random.default_rng(seed), diagonal(mesh), np.asarray(mesh.vertices, np.float64)
    waves = rng.normal(size=(2, WAVES, 3))
    towards, sideways = waves / np.linalg.norm(waves, axis=2, keepdims=True)
    turns = points @ towards.T / (WAVE_LENGTH * size) + rng.random(WAVES)
    return mesh._replace(vertices=points + WAVE_SIZE * size * np.sin(2 * np.pi * turns) @ sideways)


def versions(work: Marked, count: int) -> Iterator[Seen]:
    """Versions of a work, marked as strongly as it is under its key, each with a message of its own."""
    for number in range(count):
        message = np.random.default_rng(number).bytes(len(MESSAGE))
        scheme = SCHEME.fixed(work.width, work.step)
        marker = make_blind_marker(version(work.mesh, number + 1), KEY, bits=8 * len(message), scheme=scheme)
        marked, info = marker.embed(message, work.info.rms, read_back=False)
        say(f"version {number}: alpha {info.record.beta:.2f}")
        yield look(marked, work.width, work.step)


def lattice_of(works: Sequence[Seen], cells: Int64[np.ndarray, "cells 3"]) -> Float64[np.ndarray, " cells"]:
    """The lattice's shift at each cell, in steps modulo a half, as marked works show it; NaN where none does.

    Messages move a value by half a step, so that works of all messages agree modulo a half.
    """
    total = np.zeros(len(cells), complex)
    for work in works:
        good = np.flatnonzero(work.good)
        here, there = places_in(cells, work.cells[good])
        total[here] += np.exp(4j * np.pi * work.phases[good[there]])
    return np.where(total == 0, np.nan, np.angle(total) / (4 * np.pi))


def from_half(phase: Float64[np.ndarray, " cells"]) -> Float64[np.ndarray, " cells"]:
    """How far phases are from the nearest multiple of a half, up to a quarter."""
    return phase - np.round(2 * phase) / 2


def averaging(work: Marked, counts: Sequence[int]) -> Iterator[Row]:
    """Move a work's values halfway between where other works of its key show the lattice."""
    seen = look(work.marked, work.width, work.step)
    cells, good = seen.cells, seen.good
    truth = make_dither(seen.writer.choices, SCHEME.name, cells, 1).offset
    works = list(versions(work, max(counts, default=0)))
    for count in (0, *counts):
        shift = lattice_of(works[:count], cells)
        known = good & np.isfinite(shift)
        off = from_half(seen.phases - np.where(known, shift, 0))
        change = np.where(known, np.where(off < 0, -1, 1) * (1 / 4 - np.abs(off)), either_way(seen) / 4)
        row: Row = {"mesh": work.name, "works": count, "anchors": int(good.sum()), "known": int(known.sum())}
        error = from_half((shift - truth)[known])
        row["error, steps"] = float(np.sqrt(np.mean(error**2))) if count else ""
        erased = moved(seen, change)
        yield row | cost(work.marked, erased, work.info.rms) | read(erased)


def show(title: str, rows: Iterator[Row]) -> None:
    """Print one part."""
    print(f"\n{title}\n\n{table(list(rows))}", flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--only", nargs="+", default=PARTS, choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--pairs", type=int, default=1_000_000, help="simulated; of the best of many, so many readings")
    parser.add_argument("--keys", type=int, default=3, help="that unmarked meshes are read with")
    parser.add_argument("--works", type=int, nargs="+", default=[1, 4, 16], help="that are averaged")
    arguments = parser.parse_args()
    meshes = {path.name: load(parser, path) for path in arguments.meshes}
    parts = set(arguments.only)
    if "bound" in parts:
        show("Pairs that state a probability at most so small", bound(arguments.pairs))
    if "unmarked" in parts:
        show("Unmarked meshes, smallest log10 p", unmarked(meshes, arguments.keys))
    if not parts - {"bound", "unmarked"}:
        return
    works = [mark(name, mesh) for name, mesh in meshes.items()]
    if "erasure" in parts:
        show("Erasure without the key", (row for work in works for row in erasure(work)))
    if "remarking" in parts:
        show("Another mark", (row for work in works for row in remarking(work)))
    if "copying" in parts:
        rows = (row for work in works for row in copying(work, targets(work, meshes)))
        show("Copying without the key", rows)
    if "averaging" in parts:
        rows = (row for work in works for row in averaging(work, arguments.works))
        show("Erasure by works of one key", rows)


def targets(work: Marked, meshes: Mapping[str, Mesh]) -> Mapping[str, Mesh]:
    """The shapes that a mark is copied to: a version of its own, and all others."""
    others = {name: mesh for name, mesh in meshes.items() if name != work.name}
    return {"a version of it": version(work.mesh, 0), **others}


if __name__ == "__main__":
    main()
