"""Measure the evidence of blind marks, and the cost of erasing and copying them.

The output is tables in Markdown, by part; `--only` selects parts:

  bound      simulated pairs of suspect and key, without a mesh: the number that state at most a given probability, and
             the largest number expected; for a pose chosen independently of the key, for one at which all offsets fit
             exactly, and for the best of many, with a Bonferroni correction; by the squares of the cosines, as
             `jaxmark.detect` computes it, and by the number of anchors, which a search defeats
  unmarked   the smallest log10 p read from unmarked meshes, and the smallest expected by chance
  erasure    a keyless attacker moves the values of all anchors by shares of a step
  rewatermarking  a second mark with another key and the same limits
  copying    a keyless attacker writes the phases of one marked work into another shape
  averaging  the lattice of values is estimated from several works of one key with different messages, and another work
             is moved to halfway between its values
  answers    values are moved according to a detector's answers: a number of scores, or of decisions at 1e-6; answers
             are those of the right pose, and the last reading is of the mesh
  mixing     if each value were a keyed mixture of several neighbouring ones: the displacement by which a keyless
             attacker erases the mark, by formulas, and the number of mixtures that keep all of their values
  salts      seconds and evidence that trying several lattices of one key costs a reader
  codes      if the lattice depended on the shape around each anchor, on its normal and on the sign of its curvature at
             some scales: the number of anchors with a clear code, and the number that keep it, in attacked works and in
             another shape to which the mark is copied

RMS is that of the attack over that of the mark, MSDM that of the attack alone. Figures are of one seed.

    python benchmarks/security/blind_marks.py MESH [MESH ...] [--only PART ...] [--pairs N] [--keys N] [--works N ...]
"""

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.special import jn_zeros

import jaxmark as jm
from jaxmark import distortion
from jaxmark.alignment.original import Original, displace, make_original
from jaxmark.geometry.mesh import Mesh, compact, diagonal, weld, weld_mesh
from jaxmark.watermark.blind import reading
from jaxmark.watermark.blind.anchors import place, see
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.field import TURNS, FieldScheme
from jaxmark.watermark.blind.scheme import AnchoredHost
from jaxmark.watermark.blind.writing import Writer
from jaxmark.watermark.evidence import bounds, ledger
from jaxmark.watermark.evidence.ledger import figure
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.markers import make_blind_marker
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.marks import KEY, MESSAGE
from common.tables import Row, say, table

PARTS = (
    "bound",
    "unmarked",
    "erasure",
    "rewatermarking",
    "copying",
    "averaging",
    "answers",
    "mixing",
    "salts",
    "codes",
)
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
QUERIES = (0, 100, 300, 1000)  # that a detector answers
PROBE = 0.05  # of a step, by which values are moved to see scores change
THRESHOLD = -6.0  # log10 p from which a decision is "detected"
SALTS = 16
MIXED = (2, 4, 8)  # values in a mixture
LOST = (0.01, 0.05, 0.1)  # shares of anchors
CODED = ("noise 0.005", "smoothing 50", "quantisation 7", "simplification 0.95", "isotropic 1")
SCALES = (2.0, 4.0, 8.0)  # of the curvature in a code, in widths
GUARDS = (0.0, 0.2)  # of the usual size of what a sign is taken of, up to which a code is not clear
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
    return np.array([bounds.log10_p_score(score, norm) for score, norm in zip(scores[near], norms[near], strict=True)])


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
        claimed, read, suspect = [], [], reading.register(mesh)
        for number in range(keys):
            claimed.append(reading.read(suspect, key_of(number), 8 * len(MESSAGE), scheme, MESSAGE).log10_p)
            read.append(reading.read(suspect, key_of(number), 8 * len(MESSAGE), scheme))
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
    marked, info = jm.embed(mesh, MESSAGE, KEY, budget=LIMITS, scheme=SCHEME)
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
    say(f"log10 p {found.log10_p:.1f}, agreement {found.registration.agreement:.2f}")
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


def rewatermarking(work: Marked) -> Iterator[Row]:
    """Mark a marked work again under another key."""
    second = MESSAGE[::-1]
    again, _ = jm.embed(work.marked, second, OTHER, budget=LIMITS, scheme=SCHEME)
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
        marked, info = marker.embed(message, work.info.rms, read_back="never")
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


class Detector:
    """Answers for one work whose values are moved, seen in the right pose; counts its answers."""

    def __init__(self, seen: Seen) -> None:
        choices = seen.writer.choices
        word = reading.codeword(MESSAGE, choices)
        dither = make_dither(choices, SCHEME.name, seen.cells[seen.good], len(word))
        self.phases = seen.phases[seen.good] - dither.offset
        self.signs = dither.sign * word[dither.slot]
        looks = len(SCHEME.widths) * SCHEME.looks * len(SCHEME.steps) * 2
        self.charges = [ledger.LOOKS.charge("each", looks)]
        self.asked = 0

    def score(self, change: Float64[np.ndarray, " anchors"]) -> float:
        """Mean cosine of the phases."""
        self.asked += 1
        return float(np.mean(self.signs * np.cos(2 * np.pi * (self.phases + change))))

    def detects(self, change: Float64[np.ndarray, " anchors"]) -> bool:
        """Whether the claimed message is proven."""
        self.asked += 1
        cosines = np.cos(2 * np.pi * (self.phases + change))
        log10_p = bounds.log10_p_score(self.signs @ cosines, np.linalg.norm(cosines))
        return figure(log10_p, self.charges) <= THRESHOLD

    def least(self, way: Float64[np.ndarray, " anchors"], most: float, rounds: int) -> float:
        """How far values must go a way until no mark is detected, by halving; `most` if it is not detected there."""
        low, high = 0.0, most
        for _ in range(rounds):
            middle = (low + high) / 2
            low, high = (middle, high) if self.detects(middle * way) else (low, middle)
        return high


def by_scores(detector: Detector, queries: int, rng: np.random.Generator) -> Float64[np.ndarray, " anchors"]:
    """Estimate which way each value's part of the score falls, by pairs of random moves; go there as far as needed."""
    size = len(detector.phases)
    slope = np.zeros(size)
    while detector.asked + 2 <= queries:
        probe = rng.choice([-PROBE, PROBE], size)
        slope += (detector.score(probe) - detector.score(-probe)) * probe
    way = -np.sign(slope) if queries else rng.choice([-1.0, 1.0], size)
    return detector.least(way, 0.5, 8 if queries else 0) * way if queries else way / 4


def by_decisions(detector: Detector, queries: int, rng: np.random.Generator) -> Float64[np.ndarray, " anchors"]:
    """Erase, and turn the moves of random groups of values as long as no mark is detected; then move less."""
    size = len(detector.phases)
    way, far = rng.choice([-1.0, 1.0], size), 1 / 4
    while detector.asked + 8 <= queries:
        far = detector.least(way, far, 3)
        other = np.where(rng.random(size) < 2 / math.sqrt(size), -way, way)
        # A little nearer, so that what is turned must have helped.
        way = way if detector.detects(0.98 * far * other) else other
    return far * way


def answers(work: Marked) -> Iterator[Row]:
    """Move values as answers tell."""
    seen = look(work.marked, work.width, work.step)
    for (name, way), queries in product({"scores": by_scores, "decisions": by_decisions}.items(), QUERIES):
        change = np.zeros(len(seen.good))
        change[seen.good] = way(Detector(seen), queries, np.random.default_rng(0))
        row: Row = {"mesh": work.name, "answers": name, "asked": queries, "moved, steps": float(np.abs(change).max())}
        erased = moved(seen, change)
        yield row | cost(work.marked, erased, work.info.rms) | read(erased)


def mixing() -> Iterator[Row]:
    """How far values must be moved until the mean cosine of keyed mixtures of several is zero, over a quarter step.

    Of a move d of m values, a unit vector by chance shows the part u·d, and the mean of cos(2π u·d) is
    Γ(m/2) J_(m/2-1)(x) (2/x)^(m/2-1) with x = 2π|d|: zero first at the first zero of that Bessel function.
    """
    yield {"mixed": 1, "least move": 1.0} | {f"whole at {share:g} lost": 1 - share for share in LOST}
    for mixed in MIXED:
        least = float(jn_zeros(mixed // 2 - 1, 1)[0]) / (2 * math.pi * math.sqrt(mixed)) / (1 / 4)
        yield {"mixed": mixed, "least move": least} | {
            f"whole at {share:g} lost": (1 - share) ** mixed for share in LOST
        }


def salts(name: str, mesh: Mesh) -> Iterator[Row]:
    """What it takes to try several lattices; the suspect is looked at once."""
    choices = reading.context(KEY, 8 * len(MESSAGE), SCHEME.name)
    for _ in SCHEME.views(mesh, choices):  # compiles
        break
    reading.read(reading.register(mesh), KEY, 8 * len(MESSAGE), SCHEME)
    start = time.perf_counter()
    looks = [look for group in SCHEME.views(mesh, choices) for look in group]
    looked = time.perf_counter() - start
    start = time.perf_counter()
    reading.read(reading.register(mesh), KEY, 8 * len(MESSAGE), SCHEME)
    once = time.perf_counter() - start
    for count in (1, SALTS):
        seconds = looked + count * (once - looked)
        yield {"mesh": name, "views": len(looks), "salts": count, "seconds": seconds, "log10 p": math.log10(count)}


class Codes(NamedTuple):
    """What the shape around the points of a lattice is like, roughly."""

    cells: Int64[np.ndarray, "cells 3"]
    normal: Float64[np.ndarray, "cells 3"]  # on average
    curvature: Float64[np.ndarray, "cells scales"]  # differences of two averages along it

    def of(self, guard: float) -> dict[tuple[int, ...], tuple[int, ...]]:
        """The code of each cell where it is clear: the axis nearest to the normal, and signs."""
        sizes = np.sort(np.abs(self.normal), axis=1)
        clear = sizes[:, 2] - sizes[:, 1] >= guard
        clear &= (np.abs(self.curvature) >= guard * np.sqrt(np.mean(self.curvature**2, axis=0))).all(axis=1)
        axis = np.argmax(np.abs(self.normal), axis=1)
        up = np.take_along_axis(self.normal, axis[:, None], axis=1) > 0
        codes = np.concatenate([axis[:, None], up, self.curvature > 0], axis=1).astype(int)
        return {tuple(self.cells[one].tolist()): tuple(codes[one].tolist()) for one in np.flatnonzero(clear)}

    def turned(self, turn: Int64[np.ndarray, " 3"]) -> "Codes":
        """As the shape looks the other way along some axes."""
        return Codes(self.cells * turn, self.normal * turn, self.curvature)


def codes_of(mesh: Mesh, width: float) -> Codes:
    """Look at what is around each anchor of a width, at wider scales."""
    placed = place(compact(weld_mesh(mesh, weld(mesh.vertices))))
    _, surface, anchors = see(placed.mesh, (width,), jnp.result_type(float))[width]
    there = np.asarray(surface.area) > 1e-12
    area, points = np.asarray(surface.area)[there], np.asarray(surface.points)[there]
    cells = anchors.cells[np.unique(anchors.anchor[anchors.anchor < len(anchors.cells)])]
    places, normals = anchors.places[: len(cells)], np.asarray(surface.normals)[there]
    square = np.sum((places[:, None] - points) ** 2, axis=2)

    def average(scale: float, of: Float64[np.ndarray, "pieces 3"]) -> Float64[np.ndarray, "cells 3"]:
        weights = np.exp(-square / 2 / (scale * width) ** 2)
        return weights @ of / (weights @ area)[:, None]

    normal = average(SCALES[0], normals)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    means = [average(scale, area[:, None] * points) for scale in (*SCALES, 2 * SCALES[-1])]
    steps = pairwise(means)
    return Codes(cells, normal, np.stack([np.sum((one - other) * normal, axis=1) for one, other in steps], axis=1))


def codes(work: Marked) -> Iterator[Row]:
    """How many anchors have a code, and keep it."""
    before = codes_of(work.marked, work.width)
    suspects = {steps: attacked(work.marked, steps, 0) for steps in CODED} | {"a version of it": version(work.mesh, 0)}
    for name, suspect in suspects.items():
        after, row = codes_of(suspect, work.width), {"mesh": work.name, "suspect": name}
        for guard in GUARDS:
            known = before.of(guard)
            seen = [after.turned(turn).of(guard) for turn in TURNS[:4]]
            same = max(sum(known.get(cell) == code for cell, code in one.items()) for one in seen)
            row |= {
                f"clear, guard {guard:g}": len(known) / len(before.cells),
                f"kept, guard {guard:g}": same / len(known),
            }
        say(name, row)
        yield row


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
    if "mixing" in parts:
        show("Mixtures of values", mixing())
    if "salts" in parts:
        show("Several lattices", (row for name, mesh in meshes.items() for row in salts(name, mesh)))
    if not parts - {"bound", "unmarked", "mixing", "salts"}:
        return
    works = [mark(name, mesh) for name, mesh in meshes.items()]
    if "erasure" in parts:
        show("Erasure without the key", (row for work in works for row in erasure(work)))
    if "rewatermarking" in parts:
        show("Another mark", (row for work in works for row in rewatermarking(work)))
    if "copying" in parts:
        rows = (row for work in works for row in copying(work, targets(work, meshes)))
        show("Copying without the key", rows)
    if "averaging" in parts:
        rows = (row for work in works for row in averaging(work, arguments.works))
        show("Erasure by works of one key", rows)
    if "answers" in parts:
        show("Erasure by answers", (row for work in works for row in answers(work)))
    if "codes" in parts:
        show("Codes of the shape around", (row for work in works for row in codes(work)))


def targets(work: Marked, meshes: Mapping[str, Mesh]) -> Mapping[str, Mesh]:
    """The shapes that a mark is copied to: a version of its own, and all others."""
    others = {name: mesh for name, mesh in meshes.items() if name != work.name}
    return {"a version of it": version(work.mesh, 0), **others}


if __name__ == "__main__":
    main()
