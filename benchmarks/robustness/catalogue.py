"""Measure how often a catalogue of thousands of originals finds the right one, how long it takes, and whom it names.

The originals are variants of the given meshes, so that near duplicates exist: bent, twisted, stretched, with a joint
turned, noisy, and as coarse as others. They are written to a folder and added to a catalogue there; the next run reuses
both.

    python benchmarks/robustness/catalogue.py MESH... --folder shop
    python benchmarks/robustness/catalogue.py MESH... --folder shop --count 500 --suspects 40 --halves 10 --answers 5

Suspects are made of originals by ten attacks, in any pose and scale. Half crops lose half of their vertices beyond a
plane; `--anew` of them are also remeshed, so that no landmark is left. Suspects that are only ranked are not marked,
because landmarks and descriptors do not respond to a mark. `--answers` suspects are marked, attacked and searched
completely. `--strangers` are made of files of other meshes, each deformed many times.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

import jaxmark as jm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.variants import deformed, load_models, rotation, simplified, variants
from jaxmark.catalogue import Finder, descriptors
from jaxmark.catalogue.retrieval import Near
from jaxmark.confidence import clopper_pearson
from jaxmark.geometry.mesh import Mesh, compact

ATTACKS = (
    ("noise", 0.005),
    ("smoothing", 30),
    ("taubin", 20),
    ("quantisation", 8),
    ("simplification", 0.95),
    ("isotropic", 1.0),
    ("midpoint", 1),
    ("iso-surface", 100),
    ("holes", 0.1),
    ("mirror", 0),
)
HALF = (("cropping", 0.5),)
HALF_ANEW = (("meshed anew", 0.5),)
BUDGET, MESSAGE = 8e-4, b"cataloge"
PLACES = (1, 3, 10)
WITHOUT, ALONE = "all, without landmarks", "all, by descriptors alone"


def parse() -> argparse.Namespace:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--folder", type=Path, required=True, help="for originals and catalogue")
    parser.add_argument("--count", type=int, default=10_000, help="originals")
    parser.add_argument("--most", type=int, default=3_000, help="vertices of an original, at most")
    parser.add_argument("--suspects", type=int, default=200, help="whole ones, ranked")
    parser.add_argument("--halves", type=int, default=50, help="half crops, ranked")
    parser.add_argument("--anew", type=int, default=20, help="half crops that are meshed anew, ranked")
    parser.add_argument("--answers", type=int, default=20, help="whole ones, marked and sought to the end")
    parser.add_argument("--half-answers", type=int, default=0, help="half crops, marked and sought to the end")
    parser.add_argument("--others", type=Path, nargs="*", default=[], metavar="MESH", help="files of strangers' meshes")
    parser.add_argument("--strangers", type=int, default=1_000, help="of these, deformed")
    parser.add_argument("--through", type=int, default=40, help="strangers that go through to the end, the nearest")
    parser.add_argument("--depth", type=int, default=3, help="originals that each is compared with, each way")
    return parser.parse_args()


def fill(folder: Path, models: dict[str, Mesh], count: int, most: int) -> None:
    """Make the originals that are not there, and add them."""
    originals = folder / "originals"
    originals.mkdir(parents=True, exist_ok=True)
    if len(list(originals.iterdir())) < count:
        for name, mesh in variants(models, count, most):
            if not (file := originals / f"{name}.ply").exists():
                jm.save_mesh(mesh, file)
    start, fresh = time.perf_counter(), 0
    with jm.Catalogue(folder / "shop.db") as catalogue:
        there = {entry.path for entry in catalogue.originals()}
        for file in sorted(originals.iterdir()):
            if str(file.resolve()) not in there:
                fresh += catalogue.add(file).status == "added"
        held = len(catalogue.originals())
    seconds = time.perf_counter() - start
    if fresh:
        print(f"added {fresh} in {seconds:.0f} s, {fresh / seconds:.1f} a second", flush=True)
    print(
        f"{held} originals of {len(models)} models in {(folder / 'shop.db').stat().st_size / 2**20:.0f} MiB", flush=True
    )


def attacked(mesh: Mesh, kind: str, strength: float, seed: int) -> Mesh:
    """A suspect, in any pose and scale."""
    random = np.random.default_rng(seed)
    if kind == "mirror":
        found = Mesh(np.asarray(mesh.vertices) * [-1, 1, 1], np.asarray(mesh.faces)[:, ::-1])
    elif kind == "meshed anew":
        found = jm.attack(compact(jm.attack(mesh, "cropping", strength, seed=seed)), "isotropic", 1.0, seed=seed)
    else:
        found = jm.attack(mesh, kind, strength, seed=seed)
    vertices = np.asarray(found.vertices) @ rotation(random).T * random.uniform(0.5, 2)
    return compact(jm.make_mesh(vertices, np.asarray(found.faces)))


def suspects(
    finder: Finder, kinds: tuple[tuple[str, float], ...], count: int, seed: int, marked: jm.Key | None = None
) -> Iterator[tuple[int, str, Mesh]]:
    """Suspects of random originals: the original's number, the attack, and the suspect."""
    random = np.random.default_rng(seed)
    shapes = finder.index.shapes[random.permutation(len(finder.index.shapes))]
    made = 0
    for shape in map(int, shapes):
        if made == count:
            return
        kind, strength = kinds[made % len(kinds)]
        mesh = finder.catalogue.load(shape)
        try:
            if marked is not None:
                mesh = jm.embed(mesh, MESSAGE, marked, budget=BUDGET)[0]
            suspect = attacked(mesh, kind, strength, made)
        except jm.JaxmarkError:  # too small for the message, or for the attack
            continue
        made += 1
        yield shape, kind, suspect


def tell(name: str, ranks: list[int], seconds: list[float]) -> None:
    """The shares of suspects whose original is among the first, with intervals."""
    if not ranks:
        return
    shares = []
    for place in PLACES:
        hits = sum(rank <= place for rank in ranks)
        low, high = clopper_pearson(hits, len(ranks))
        shares.append(f"{100 * hits / len(ranks):.1f} % [{100 * low:.0f}, {100 * high:.0f}]")
    took = f"{np.median(seconds):.2f} s, at most {max(seconds):.2f} s"
    print(f"| {name} | {len(ranks)} | {' | '.join(shares)} | {took} |", flush=True)


def say(finder: Finder, shape: int, kind: str, ranks: str) -> None:
    """The ranks of one suspect's original, on standard error."""
    print(f"{Path(path_of(finder, shape)).stem}, {kind}: {ranks}", file=sys.stderr, flush=True)


def path_of(finder: Finder, shape: int) -> str:
    query = "SELECT path FROM originals o JOIN shapes s ON s.original = o.id WHERE s.id = ?"
    return finder.catalogue.database.rows(query, shape)[0]["path"]


def by_descriptors(finder: Finder, suspect: Mesh) -> list[Near]:
    seen = descriptors.spread(suspect)
    assert seen is not None
    return finder.index.by_whole(descriptors.whole(seen), len(finder.index.shapes))


def place(near: list[Near], shape: int, last: int) -> int:
    """The place of an original, from 1; the last if it is not there."""
    order = list(dict.fromkeys(one.shape for one in near))
    return 1 + order.index(shape) if shape in order else last


def rank_wholes(finder: Finder, count: int) -> None:
    """Whole suspects, in the order in which they are compared: by landmarks, then by shape."""
    last = len(finder.index.shapes)
    ranks: dict[str, list[int]] = {}
    seconds: dict[str, list[float]] = {}
    for shape, kind, suspect in suspects(finder, ATTACKS, count, seed=1):
        start = time.perf_counter()
        meshed = finder.meshed_alike(suspect, last)
        middle = time.perf_counter()
        wholes = finder.wholes(suspect, last)
        end = time.perf_counter()
        described = by_descriptors(finder, suspect)
        for how, near, took in (
            (kind, [*meshed, *wholes], end - start),
            (WITHOUT, wholes, end - middle),
            (ALONE, described, time.perf_counter() - end),
        ):
            ranks.setdefault(how, []).append(place(near, shape, last))
            seconds.setdefault(how, []).append(took)
        say(finder, shape, kind, f"{ranks[kind][-1]}, {ranks[WITHOUT][-1]} without landmarks")
    for kind, found in ranks.items():
        tell(kind, found, seconds[kind])
    kinds = [kind for kind, _ in ATTACKS if kind in ranks]
    every = list(chain.from_iterable(ranks[kind] for kind in kinds))
    tell("all wholes", every, list(chain.from_iterable(seconds[kind] for kind in kinds)))


def rank_halves(finder: Finder, count: int) -> None:
    """Half crops, in the order in which they are compared; by shape where no landmark is known."""
    ranks, seconds = [], []
    for shape, _, suspect in suspects(finder, HALF, count, seed=2):
        start = time.perf_counter()
        near = finder.meshed_alike(suspect, len(finder.index.shapes))
        near = near or finder.parts(suspect, len(finder.index.shapes))
        seconds.append(time.perf_counter() - start)
        ranks.append(place(near, shape, len(finder.index.shapes)))
        say(finder, shape, "half", f"{ranks[-1]} of {len(near)} compared")
    tell("halves", ranks, seconds)


def rank_halves_anew(finder: Finder, count: int) -> None:
    by_balls, by_fit, sought, fitted = [], [], [], []
    for shape, _, suspect in suspects(finder, HALF_ANEW, count, seed=6):
        start = time.perf_counter()
        local = descriptors.local(suspect)
        assert local is not None
        near = finder.index.by_parts(local, len(finder.index.shapes))
        sought.append(time.perf_counter() - start)
        by_balls.append(place(near, shape, len(near)))
        start = time.perf_counter()
        best = finder.fitting(suspect, near)
        fitted.append(time.perf_counter() - start)
        by_fit.append(place(best, shape, len(near)))
        say(finder, shape, "half meshed anew", f"{by_balls[-1]} by balls, {by_fit[-1]} by fit")
    tell("halves meshed anew, by balls", by_balls, sought)
    tell("halves meshed anew, by fit", by_fit, fitted)


def answer(finder: Finder, name: str, kinds: tuple[tuple[str, float], ...], count: int, seed: int, key: jm.Key) -> None:
    """Seek marked suspects to the end."""
    right = wrong = 0
    seconds = []
    for shape, kind, suspect in suspects(finder, kinds, count, seed, marked=key):
        start = time.perf_counter()
        verdict = finder.find(suspect)
        seconds.append(time.perf_counter() - start)
        hits = [match.original == path_of(finder, shape) for match in verdict.named]
        right += any(hits)
        wrong += not all(hits)
        told = f"{verdict.matches[0].log10_p:.1f}" if verdict.matches else "nothing was compared"
        print(f"{name}, {kind}: {hits or 'nobody'}, {told}, {seconds[-1]:.1f} s", file=sys.stderr, flush=True)
    if seconds:
        took = f"{np.median(seconds):.1f} s, at most {max(seconds):.1f} s"
        print(f"{name}: {right} of {len(seconds)} named rightly, {wrong} named wrongly; {took}", flush=True)


def strangers(finder: Finder, paths: list[Path], count: int, through: int, most: int) -> None:
    """Compare other meshes with all originals, and seek the nearest to the end."""
    models = {}
    for path in paths:
        try:
            meshes = jm.files.load_scene(path).meshes
        except jm.JaxmarkError:
            continue
        for name, mesh in meshes.items():
            if len(mesh.vertices) >= 300 and len(mesh.faces):
                models[f"{path.stem}/{name}"] = simplified(compact(mesh), most)
    if not models:
        return
    random, found = np.random.default_rng(3), []
    for number in range(count):
        mesh = models[list(models)[number % len(models)]]
        mesh = deformed(mesh, random) if number >= len(models) else mesh
        seen = descriptors.spread(mesh)
        if seen is not None:
            found.append((finder.index.by_whole(descriptors.whole(seen), 1)[0].distance, number, mesh))
    found.sort(key=lambda one: one[:2])
    nearest, middle = found[0][0], found[len(found) // 2][0]
    print(f"{len(found)} strangers of {len(models)} meshes; nearest {nearest:.2f}, median {middle:.2f}", flush=True)
    named, seconds, least = 0, [], 0.0
    for distance, _, mesh in found[:through]:
        start = time.perf_counter()
        verdict = finder.find(mesh)
        seconds.append(time.perf_counter() - start)
        named += bool(verdict.named)
        least = min([least, *(match.log10_p for match in verdict.matches)])
        print(
            f"stranger at {distance:.2f}: {len(verdict.named)} named, {seconds[-1]:.1f} s", file=sys.stderr, flush=True
        )
    if seconds:
        print(f"{named} of {len(seconds)} strangers that went through are named; least log10 p {least:.1f}", flush=True)


def main() -> None:
    given = parse()
    models = load_models(given.meshes)
    fill(given.folder, models, given.count, given.most)
    key = jm.Key(bytes(range(32)))
    with jm.Catalogue(given.folder / "shop.db", read_only=True) as catalogue:
        finder = Finder(catalogue, [key], depth=given.depth)
        start = time.perf_counter()
        finder.prepare()
        print(f"descriptors read in {time.perf_counter() - start:.1f} s\n")
        print(
            "| suspects | number | first | among 3 | among 10 | seconds each |\n|---|---|---|---|---|---|", flush=True
        )
        rank_wholes(finder, given.suspects)
        rank_halves(finder, given.halves)
        rank_halves_anew(finder, given.anew)
        answer(finder, "wholes", ATTACKS, given.answers, 4, key)
        answer(finder, "halves", HALF, given.half_answers, 5, key)
        strangers(finder, given.others, given.strangers, given.through, given.most)


if __name__ == "__main__":
    main()
