"""Measure the distance from the limits of white noise: python benchmarks/theory/limit.py MESH [--trials 1000].

The result is the message error rate of the whole chain against Eb/N0. Messages are written by `Mark.write`, white
Gaussian noise is added to every coordinate, and the suspects are read by the functions that `jaxmark.detect` calls:
`attempts.align`, `Mark.receive` (projection), `Mark.soft_decisions` (joint detector) and `Mark.decode` (list decoder,
keyed tag). A wrong message and no message are both errors. The code alone is measured first: the same decoder on code
bits in white Gaussian noise, where a word counts as read if it is on the list, because the tag selects it except with
probability 64 · 2^-28. `--code-only` stops there; without a MESH, codes have the longest useful length.

Eb/N0 = η |w|² / (2 k σ²): w is the mark as written, η the share of such marks that survives the projection (`energy` of
a reader's free dimensions, from one probe), k the payload without the tag, σ the noise of a coordinate. The limits are
Shannon's, the least energy of any code (the converse of Polyanskiy, Poor, Verdú 2011), and a matched filter for each
bit, uncoded.

Intervals are Clopper-Pearson's, 95 %; a point ends early after 100 errors. Eb/N0 at error 1e-3 is interpolated on the
logarithm of the rate. Without an error, the upper end of the interval is used as the rate, and the result is "at most".
"""

import math
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import stats

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import displace, shift_of
from jaxmark.confidence import clopper_pearson
from jaxmark.watermark.coding import message, polar
from jaxmark.watermark.markers import NonBlindMarker, make_marker
from jaxmark.watermark.perception.capacity import least_energy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.marks import BUDGET, free_dimensions, write

TARGET = 1e-3
ENOUGH = 100  # errors
SPREAD = 12  # of the keyed scheme
KEYS = 4  # keys and messages that take turns
Count = Callable[[float, int], int]  # how many of so many trials fail at an Eb/N0


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--payloads", type=int, nargs="+", default=[16, 64, 256, 1024])
    parser.add_argument("--trials", type=int, default=1000, help="of the whole chain, each point")
    parser.add_argument("--code-trials", type=int, default=10000, help="of the code alone, each point")
    parser.add_argument("--code-only", action="store_true")
    parser.add_argument("--gaps", type=float, nargs="+", default=[1.5, 2.0, 2.5, 3.0], help="dB above the converse")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if not (arguments.mesh or arguments.code_only):
        parser.error("a MESH is needed, but for --code-only")
    mesh = load(parser, arguments.mesh) if arguments.mesh else None
    for bits in arguments.payloads:
        random = np.random.default_rng([arguments.seed, bits])
        try:
            markers = [make_marker(mesh, jm.Key(random.bytes(32)), bits=bits) for _ in range(KEYS)] if mesh else []
        except jm.JaxmarkError as refusal:
            print(f"\n{bits} bits: {refusal}")
            continue
        length = markers[0].code_bits if markers else message.code_length(bits, 1 << 30, SPREAD)
        bare = float(stats.norm.isf(-math.expm1(math.log1p(-TARGET) / bits))) ** 2 / 2
        limits = {"Shannon": math.log(2), "converse": least_energy(bits, TARGET) / bits, "uncoded": bare}
        print(f"\n{bits} bits and a tag of {message.TAG_BITS} in {length} code bits, {message.CANDIDATES} candidates")
        print(f"Eb/N0 in dB at error {TARGET:g}:", *(f"{name} {decibel(x):.2f}" for name, x in limits.items()))
        code = partial(code_alone, bits, length, random)
        measure("code alone", bits, arguments.gaps, arguments.code_trials, code)
        if markers and not arguments.code_only:
            chains = [prepare(marker, random.bytes(bits // 8), random) for marker in markers]
            measure("whole chain", bits, arguments.gaps, arguments.trials, partial(in_turn, chains))


def measure(name: str, bits: int, gaps: list[float], trials: int, count: Count) -> None:
    """Count the errors at each gap to the converse, in dB, and print them."""
    print(f"{name:<11}  Eb/N0  - converse   errors / trials     rate  95 % interval        uncoded  seconds")
    converse = decibel(least_energy(bits, TARGET) / bits)
    points = []
    for gap in gaps:
        level = 10 ** ((converse + gap) / 10)
        errors, done, start = 0, 0, time.perf_counter()
        while done < trials and errors < ENOUGH:
            batch = min(128, trials - done)
            errors, done = errors + count(level, batch), done + batch
        low, high = clopper_pearson(errors, done)
        points.append((gap, errors / done if errors else high, "" if errors else "at most "))
        bare = -math.expm1(bits * stats.norm.logcdf(math.sqrt(2 * level)))
        left = f"{converse + gap:18.2f}  {gap:10.2f}  {errors:7d} / {done:<6d}  {errors / done:7.1e}"
        print(f"{left}  {low:.1e} ... {high:.1e}  {bare:7.1e}  {time.perf_counter() - start:7.0f}", flush=True)
    for (left, above, _), (right, below, most) in pairwise(points):
        if above > TARGET >= below:
            gap = left + (right - left) * math.log(above / TARGET) / math.log(above / below)
            print(f"  error {TARGET:g} at {most}{converse + gap:.2f} dB, {most}{gap:.2f} dB above the converse")
            return
    print(f"  error {TARGET:g} lies outside these points, or is not resolved by so many trials")


def code_alone(bits: int, length: int, random: np.random.Generator, level: float, trials: int) -> int:
    """Code bits ±1 in white Gaussian noise."""
    words = random.integers(0, 2, (trials, bits + message.TAG_BITS))
    soft = 1.0 - 2.0 * polar.encode(words, length)
    soft += math.sqrt(length / (2 * bits * level)) * random.normal(size=soft.shape)
    listed = polar.decode(soft, words.shape[1], message.CANDIDATES)
    return int(np.sum(~(listed == words[:, None]).all(axis=-1).any(axis=-1)))


def prepare(marker: NonBlindMarker, text: bytes, random: np.random.Generator) -> Callable[[float], bool]:
    """Write a mark; the result says whether one reading of it fails at an Eb/N0."""
    original = marker.original
    mark = shift_of(original, write(marker, text, BUDGET))
    left = free_dimensions(marker)
    assert left is not None
    energy = left.dimensions @ left.energy * np.sum(mark**2) / original.used.sum()

    def fails(level: float) -> bool:
        noise = math.sqrt(energy / (2 * marker.bits * level)) * random.normal(size=mark.shape)
        aligned = align(original, displace(original, mark + noise))
        found = marker.decode(marker.soft_decisions(marker.receive(aligned)))
        return found is None or found.message != text

    return fails


def in_turn(chains: list[Callable[[float], bool]], level: float, trials: int) -> int:
    return sum(chains[i % len(chains)](level) for i in range(trials))


def decibel(x: float) -> float:
    return 10 * math.log10(x)


if __name__ == "__main__":
    main()
