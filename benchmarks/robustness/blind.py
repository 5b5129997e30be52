"""Read blind marks after attacks: python benchmarks/robustness/blind.py MESH...

With each of --keys keys, 64 bits are written by --scheme within --limits: either set of the protocol of SMI 2010 (a
track of `jaxmark bench`), or hidden, as by default. Each suspect is read with the key alone; with --record, also with
the record, whose hint finds the pose of parts (scheme `field`). The table of a mesh has a line for each attack, written
as soon as it is known:

read        number of copies from which the exact message was read
log10 p     of the false-positive probability, the worst and the best of the copies; [...] without its floor at -77;
            with --record, of the claimed message where none was read
agreement   mean cosine of the anchors' phases, the least of the copies
seconds     of the slowest reading
predicted   nρ² after the attack, from the unmarked mesh: n anchors are found, and ρ is the mean cosine that is left;
            not with --record, nor for `rooted`, whose anchors are only found on marked meshes

For the prediction, the unmarked mesh is attacked, and its anchors' values, after the best small change of pose, are
compared with the values before. With the root mean square σ of the changes, and the share α of the way to the lattice
that the mark goes, ρ = sinc(1 - α) exp(-2 (πσ/step)²), times the share of the suspect's anchors that existed before.
The best view of the suspect counts, as for the reader. Above the table is the nρ² that 64 bits and their tag need, by
the capacity of many weak anchors; a few good anchors need less. Below the table are controls: the unmarked mesh,
attacked or not, and the marked meshes with other keys.
"""

import argparse
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, weld
from jaxmark.watermark.blind.prediction import compare
from jaxmark.watermark.blind.reading import TAG_BITS, context
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.coding.keys import commitment
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.marks import MESSAGE
from common.tables import evidence, head, line

LIMITS: dict[str, dict[str, float] | None] = {
    "perceptual": {"msdm": 0.20, "mrms": 8e-4},
    "geometric": {"msdm": 0.30, "mrms": 2e-4},
    "hidden": None,
}
ATTACKS = """none; noise 0.001; noise 0.003; noise 0.005; smoothing 10; smoothing 30; smoothing 50; quantisation 9;
quantisation 8; quantisation 7; midpoint 1; sqrt3 1; loop 1; simplification 0.9; simplification 0.95;
simplification 0.975; isotropic 1; isotropic 2; iso-surface 100; similarity 3; bending 5;
cropping 0.1; cropping 0.5; cropping 0.7; region-cropping 0.5; region-cropping 0.7"""
CONTROLS = ("none", "noise 0.005")  # what the unmarked mesh goes through
NAMES = ("read", "log10 p", "agreement", "seconds")
NEEDED = math.log(2) * (8 * len(MESSAGE) + TAG_BITS)  # of nρ², by the capacity where ρ is small: nρ² nats


class Copy(NamedTuple):
    """A mesh that was marked with a key, and how."""

    key: bytes
    marked: Mesh
    info: EmbedInfo
    scheme: BlindScheme


class Cell(NamedTuple):
    """What one reading gave."""

    read: bool
    log10_p: float
    log10_p_unfloored: float
    agreement: float
    seconds: float


def read(suspect: Mesh, key: bytes, one: Copy, by_record: bool) -> Cell:
    """Read by a key and the suspect, and by the record if so asked."""
    start = time.perf_counter()
    try:
        if by_record:
            found = jm.detect(suspect, key=key, record=one.info.record)
            if found.message != MESSAGE and one.info.record.message_commitment:
                claimed = jm.detect(suspect, key=key, record=one.info.record, message=MESSAGE)
                found = claimed._replace(message=found.message)
        else:
            found = jm.detect(suspect, key=key, scheme=one.scheme)
    except jm.JaxmarkError:
        return Cell(False, 0.0, 0.0, 0.0, time.perf_counter() - start)
    seconds = time.perf_counter() - start
    evidence = found.evidence
    agreement = found.registration.agreement
    return Cell(found.message == MESSAGE, evidence.log10_p, evidence.log10_p_unfloored, agreement, seconds)


def predict(mesh: Mesh, steps: str, one: Copy) -> float:
    """Predicted nρ² of a mark after an attack, by what the attack does to the unmarked mesh."""
    step, choices = one.info.record.parameters["step"], context(one.key, 8 * len(MESSAGE), one.scheme.name)
    scheme = one.scheme.fixed(one.info.record.parameters["width"], step)
    before = next(scheme.views(mesh, choices))[0]
    looks = chain.from_iterable(scheme.views(attacked(mesh, steps, 0), choices))
    ways = [way for after in looks for way in compare(before, after)]
    return max((way.shown * way.cosine(step, one.info.record.beta) ** 2 for way in ways), default=0.0)


def row(name: str, cells: list[Cell], *more: object) -> str:
    """A line of the table: of an attack and its strength, or a control."""
    p = [
        evidence(worst(one.log10_p for one in cells), worst(one.log10_p_unfloored for one in cells))
        for worst in (max, min)
    ]
    return line(
        name,
        f"{sum(cell.read for cell in cells)}/{len(cells)}",
        " … ".join(dict.fromkeys(p)),
        f"{min(cell.agreement for cell in cells):.2f}",
        f"{max(cell.seconds for cell in cells):.0f}",
        *more,
    )


def copies(
    mesh: Mesh, scheme: BlindScheme, together: tuple[str, ...], limits: dict[str, float] | None, count: int
) -> Iterator[Copy]:
    """Mark a mesh with several keys, with a scheme or several together, and say how."""
    for seed in range(count):
        key, start = np.random.default_rng([seed, 64]).bytes(32), time.perf_counter()
        marked, info = jm.embed(mesh, MESSAGE, key, budget=limits, scheme=together or scheme)
        seconds, found = time.perf_counter() - start, jm.compare(mesh, marked, ("mrms", "msdm"))
        how = "" if together else ", width {width}, step {step:.2e}".format(**info.record.parameters)
        print(
            f"Key {seed}: RMS {info.rms:.2e}, MRMS {found.mrms:.2e}, MSDM {found.msdm:.3f}{how}, α"
            f" {info.record.beta:.2f}, predicted to survive noise {info.survives.whole:.4f}, {seconds:.0f} s.",
            flush=True,
        )
        yield Copy(key, marked, info, scheme)


def measure(mesh: Mesh, marked: list[Copy], attacks: list[str], by_record: bool) -> None:
    """Attack what was marked, read it, and print a table."""
    print(f"\n{head('attack', *NAMES, 'predicted')}", flush=True)
    for steps in attacks:
        try:
            suspects = [attacked(one.marked, steps, seed) for seed, one in enumerate(marked)]
            cells = [read(suspect, one.key, one, by_record) for suspect, one in zip(suspects, marked, strict=True)]
            is_predicted = not (by_record or marked[0].scheme.by_key) and "width" in marked[0].info.record.parameters
            predicted = f"{predict(mesh, steps, marked[0]):.0f}" if is_predicted else ""
        except jm.JaxmarkError as refusal:
            print(line(steps, f"failed: {refusal}"), flush=True)
            continue
        print(row(steps, cells, predicted), flush=True)


def replace_key(one: Copy, key: bytes) -> Copy:
    """Return a copy whose record is of another key; without that, it would be refused."""
    record = replace(one.info.record, key=commitment(key), message_commitment="", code="").sealed(key)
    return one._replace(info=one.info._replace(record=record))


def control(mesh: Mesh, marked: list[Copy], by_record: bool) -> None:
    """Read what nobody should find a mark in, and print a table."""
    print(f"\n{head('control', *NAMES)}")
    for steps in CONTROLS:
        cells = [read(attacked(mesh, steps, seed), one.key, one, by_record) for seed, one in enumerate(marked)]
        print(row(f"unmarked, {steps}", cells), flush=True)
    others = [(one, bytes(reversed(one.key))) for one in marked]
    resealed = [(replace_key(one, key), key) for one, key in others]
    cells = [read(one.marked, key, one, by_record) for one, key in resealed]
    print(row("another key", cells), flush=True)


def main() -> None:
    """Mark, attack, read, and print the tables."""
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--keys", type=int, default=2, help="keys, each with attacks of its own; %(default)s")
    parser.add_argument("--limits", choices=LIMITS, default="perceptual", help="%(default)s")
    parser.add_argument("--scheme", choices=BLIND_SCHEMES, default="field", help="%(default)s")
    parser.add_argument("--together", nargs="+", default=[], help="mark with these schemes, and read the blind ones")
    parser.add_argument("--attacks", default=ATTACKS, help="kinds and strengths; %(default)s")
    parser.add_argument("--record", action="store_true", help="read with the record, too")
    parser.add_argument("--controls", action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    scheme, steps = BLIND_SCHEMES[options.scheme], " ".join(options.attacks.split()).split("; ")
    for path in options.meshes:
        mesh = load(parser, path)
        points = len(weld(mesh.vertices).first)
        print(f"\n## {path.name}, {points:,} points, {options.limits} limits\n")
        print(f"{8 * len(MESSAGE)} bits and their tag need nρ² of about {NEEDED:.0f}.\n", flush=True)
        try:
            marked = list(copies(mesh, scheme, tuple(options.together), LIMITS[options.limits], options.keys))
        except jm.JaxmarkError as refusal:
            print(f"Not marked: {refusal}", flush=True)
            continue
        for name in options.together[1:] or [options.scheme]:
            print(f"\nRead by `{name}`:")
            measure(mesh, [one._replace(scheme=BLIND_SCHEMES[name]) for one in marked], steps, options.record)
            if options.controls:
                control(mesh, marked, options.record)


if __name__ == "__main__":
    main()
