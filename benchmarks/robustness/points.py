"""Read marks in point clouds and splats after attacks: python benchmarks/robustness/points.py MESH ...

64 bits are written into clouds of --points points, with --budget or, by default, hidden: an RMS displacement of at most
0.02 % of the diagonal. Without meshes, the clouds are a bumpy sphere and an artificial laser scan of a street: rings of
points on ground, walls and cars, whose distance grows, with noise in range. Points of meshes are sampled from their
surfaces by area. The first table describes the mark of each cloud:

bits, usual     result of `jaxmark.capacity` for noise of half a percent of the cloud's size, with half of it lost
RMS             of the displacement, over the diagonal
spacing         mean distance of a point to the nearest other one, over the diagonal
point_to_plane  displacement across the surface that 5 % of the points exceed, over that spacing
embed           seconds

The second table has a line for each attack. For each cloud it has the number of --seeds messages that are read exactly,
the worst log10 of the false-positive probability for the claimed message, in square brackets without its floor at -77,
the coverage, and the seconds of the last detection. "turned" is any rotation, with a shift and another scale, in random
order.

With --splats, the clouds are also the centres of Gaussians, with the size of the points' spacing and colours of their
own. A third table has the PSNR in decibels of pictures before and after the mark from three sides, by an orthographic
renderer that composites projected Gaussians from front to back, and readings after pruning, which removes the least
opaque Gaussians from the file.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.geometry.clouds import planes, spacings
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.geometry.surfaces import sample

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import Own, attacked
from common.marks import MESSAGE
from common.tables import evidence, head, line, say

ATTACKS = """none; diagonal-noise 0.001; diagonal-noise 0.002; noise 0.005; quantisation 9; quantisation 8;
reordering 1; subsampling 0.5; subsampling 0.9; subsampling 0.5 + diagonal-noise 0.001; cropping 0.5;
outliers 0.1 + reordering 1; floaters 0.2; merging 0; merging 0.001; resampling 1; turned; subsampling 0.5 + turned;
cropping 0.5 + turned"""
SIDE = 512  # pixels of a picture

Points = Float64[np.ndarray, "points 3"]


class Splats(NamedTuple):
    """Gaussians, as splat files have them once scales and opacities are decoded."""

    centres: Points
    sizes: Float64[np.ndarray, "points 3"]  # standard deviations along the axes
    turns: Float64[np.ndarray, "points 4"]  # quaternions, w first
    opacities: Float64[np.ndarray, " points"]
    colours: Float64[np.ndarray, "points 3"]


def make_cloud(points: Points) -> Mesh:
    """Of points in any order."""
    return jm.make_mesh(points, np.zeros((0, 3), np.int64))


def bumpy_sphere(count: int) -> Mesh:
    """Points on a closed surface with bumps, at random."""
    random = np.random.default_rng(0)
    around = random.normal(size=(count, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    bumps = np.sin(around @ (2 * random.normal(size=(3, 6))) + random.uniform(0, 6, 6)).sum(axis=1)
    return make_cloud(around * (1 + 0.05 * bumps)[:, None] * [1, 0.8, 1.3])


def street(count: int) -> Mesh:
    """What a scanner at a height of 2 metres sees of rolling ground, two walls and some cars, with noise of 1 cm."""
    random, found = np.random.default_rng(1), []
    cars = np.column_stack([random.uniform(-30, 30, 12), random.choice([-4.0, 4.0], 12)])
    rings = np.radians(np.linspace(-35, 12, 64))
    for turn in np.radians(np.arange(0, 360, 0.2)):
        way = np.column_stack([np.cos(rings) * np.cos(turn), np.cos(rings) * np.sin(turn), np.sin(rings)])
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(way[:, 2] < 0, -2 / way[:, 2], np.inf)
            wall = (10 + np.sin(0.3 * turn)) / np.abs(way[:, 1])
        reach = np.minimum(ground, wall)
        for x, y in cars:
            low, high = ((np.array([x, y, -2]) + side * np.array([2.2, 0.9, 0])) for side in (-1, 1))
            high[2] = -0.5
            with np.errstate(divide="ignore", invalid="ignore"):
                near, far = low / way, high / way
            first = np.nan_to_num(np.minimum(near, far), nan=-np.inf).max(axis=1)
            last = np.nan_to_num(np.maximum(near, far), nan=np.inf).min(axis=1)
            reach = np.where((first > 0) & (first < last), np.minimum(reach, first), reach)
        seen = reach < 60
        points = way[seen] * (reach[seen] + 0.01 * random.normal(size=seen.sum()))[:, None]
        points[:, 2] += 0.3 * np.sin(0.2 * points[:, 0]) * (reach == ground)[seen]
        found.append(points)
    scanned = np.concatenate(found)
    return make_cloud(scanned[np.sort(random.permutation(len(scanned))[:count])])


def turned(mesh: Mesh, _: float, random: np.random.Generator) -> Mesh:
    """In any pose, size and order."""
    points = random.permutation(np.asarray(mesh.vertices))
    scale = 10 ** random.uniform(-1, 1)
    return make_cloud(scale * (points @ Rotation.random(rng=random).as_matrix().T) + scale * random.normal(size=3))


OWN: Own = {"turned": turned}


def reading(marker: jm.watermark.NonBlindMarker, suspects: Callable[[int], Mesh], seeds: int) -> str:
    """How many messages read, the worst evidence, what was seen, and how long it took."""
    reads, worst, unfloored, seen, seconds = 0, -np.inf, -np.inf, 1.0, 0.0
    for seed in range(seeds):
        start = time.perf_counter()
        try:
            aligned = marker.register(suspects(seed))
            found, claimed = marker.read(aligned), marker.read(aligned, MESSAGE).evidence
            reads, seen = reads + (found.message == MESSAGE), min(seen, found.coverage or 0.0)
            worst, unfloored = max(worst, claimed.log10_p), max(unfloored, claimed.log10_p_unfloored)
        except jm.JaxmarkError:
            worst, unfloored, seen = 0.0, 0.0, 0.0
        seconds = time.perf_counter() - start
    return f"{reads}/{seeds}, {evidence(worst, unfloored)}, {seen:.2f}, {seconds:.0f}"


def dress(mesh: Mesh) -> Splats:
    """Flat Gaussians on a cloud, about as wide as it is sparse, with a pattern of colours and some noise."""
    random, points = np.random.default_rng(2), np.asarray(mesh.vertices)
    apart = np.clip(spacings(points, 3), 0, 3 * np.median(spacings(points, 3)))
    sizes = apart[:, None] * [0.6, 0.6, 0.1] * random.uniform(0.7, 1.3, points.shape)
    normals = planes(KDTree(points), points).normals
    across = np.cross([0.0, 0, 1], normals)
    axis = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    angle = np.arccos(np.clip(normals[:, 2], -1, 1))
    turns = np.column_stack([np.cos(angle / 2), axis * np.sin(angle / 2)[:, None]])
    waves = np.sin(points / diagonal(mesh) @ (40 * random.normal(size=(3, 3))))
    colours = np.clip(0.5 + 0.3 * waves + 0.05 * random.normal(size=points.shape), 0, 1)
    return Splats(points, sizes, turns, random.uniform(0.3, 1, len(points)) ** 0.5, colours)


def write_splats(splats: Splats, path: Path) -> None:
    """As programs that train splats write them: colours as spherical harmonics, logarithms, and logits."""
    columns = {
        **dict(zip(("x", "y", "z"), splats.centres.T, strict=True)),
        **{name: np.zeros(len(splats.centres)) for name in ("nx", "ny", "nz")},
        **{f"f_dc_{k}": (splats.colours[:, k] - 0.5) / 0.28209479177387814 for k in range(3)},
        "opacity": np.log(splats.opacities / np.maximum(1 - splats.opacities, 1e-6)),
        **{f"scale_{k}": np.log(splats.sizes[:, k]) for k in range(3)},
        **{f"rot_{k}": splats.turns[:, k] for k in range(4)},
    }
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats.centres)}"]
    lines += [*(f"property float {name}" for name in columns), "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + np.column_stack(list(columns.values())).astype("<f4").tobytes())


def prune(path: Path, pruned: Path, share: float) -> None:
    """Leave the least opaque Gaussians out of a splat file."""
    top, body = path.read_bytes().split(b"end_header\n", 1)
    names = [row.split()[2] for row in top.decode().splitlines() if row.startswith("property")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    opacity = rows[:, names.index("opacity")]
    kept = rows[opacity >= np.quantile(opacity, share)]
    top = top.replace(f"vertex {len(rows)}".encode(), f"vertex {len(kept)}".encode())
    pruned.write_bytes(top + b"end_header\n" + kept.tobytes())


def picture(splats: Splats, side: int, length: float, centre: Points) -> Float64[np.ndarray, "pixels pixels 3"]:
    """Render along an axis without perspective: projected Gaussians, composited from front to back over black."""
    over, up = (side + 1) % 3, (side + 2) % 3
    scale = SIDE / length
    place = (splats.centres - centre)[:, [over, up]] * scale + SIDE / 2
    axes = Rotation.from_quat(splats.turns, scalar_first=True).as_matrix() * splats.sizes[:, None] * scale
    form = (axes @ axes.transpose(0, 2, 1))[:, [[over, over], [up, up]], [[over, up], [over, up]]]
    form = form + 0.3 * np.eye(2)  # pixels have a width, too
    inverse, reach = np.linalg.inv(form), 3 * np.sqrt(np.trace(form, axis1=1, axis2=2))
    image, clear = np.zeros((SIDE, SIDE, 3)), np.ones((SIDE, SIDE))
    low = np.clip(np.floor(place - reach[:, None]), 0, SIDE).astype(int)
    high = np.clip(np.ceil(place + reach[:, None]) + 1, 0, SIDE).astype(int)
    for one in np.argsort(-splats.centres[:, side], kind="stable"):
        patch = np.s_[low[one, 0] : high[one, 0], low[one, 1] : high[one, 1]]
        if not clear[patch].size:
            continue
        x = np.arange(low[one, 0], high[one, 0])[:, None] + 0.5 - place[one, 0]
        y = np.arange(low[one, 1], high[one, 1])[None] + 0.5 - place[one, 1]
        (a, b), (_, d) = inverse[one]
        alpha = np.minimum(0.99, splats.opacities[one] * np.exp(-0.5 * (a * x * x + 2 * b * x * y + d * y * y)))
        image[patch] += (clear[patch] * alpha)[:, :, None] * splats.colours[one]
        clear[patch] *= 1 - alpha
    return image


def psnr(first: Splats, second: Splats) -> float:
    """Of pictures from three sides together, in decibels."""
    low, high = first.centres.min(axis=0), first.centres.max(axis=0)
    frame = float((high - low).max()) * 1.05, (low + high) / 2
    errors = [np.mean((picture(first, side, *frame) - picture(second, side, *frame)) ** 2) for side in range(3)]
    return float(-10 * np.log10(np.mean(errors)))


def splat_row(name: str, mesh: Mesh, key: jm.Key, folder: Path) -> str:
    """PSNR of a mark in a splat file, and readings of the pruned file."""
    splats = dress(mesh)
    path, marked, pruned = (folder / f"{part}.ply" for part in ("splats", "marked", "pruned"))
    write_splats(splats, path)
    marker = jm.make_marker(jm.load_mesh(path), key, bits=8 * len(MESSAGE))
    jm.save_mesh(marker.embed(MESSAGE, jm.Budget(noise=0))[0], marked, like=path)
    moved = splats._replace(centres=np.asarray(jm.load_mesh(marked).vertices))
    cells = [f"{psnr(splats, moved):.1f}"]
    for share in (0.3, 0.5, 0.7):
        prune(marked, pruned, share)
        cells.append(reading(marker, lambda _: jm.load_mesh(pruned), 1))
    return line(name, *cells)


def main() -> None:
    """Mark, attack, read, and print the tables."""
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*")
    parser.add_argument("--points", type=int, default=50_000, help="points of each cloud; %(default)s")
    parser.add_argument("--budget", type=float, help="RMS displacement over the diagonal; by default, marks are hidden")
    parser.add_argument("--seeds", type=int, default=1, help="attacks of each kind; %(default)s")
    parser.add_argument("--attacks", default=ATTACKS, help="kinds and strengths; %(default)s")
    parser.add_argument("--splats", action="store_true", help="render splats, and prune them")
    arguments = parser.parse_args()
    key, clouds = jm.Key(bytes(range(32))), {}
    for path in arguments.meshes:
        mesh = load(parser, path)
        clouds[path.stem] = mesh if not len(mesh.faces) else make_cloud(sample(mesh, arguments.points).points)
    clouds = clouds or {"bumpy sphere": bumpy_sphere(arguments.points), "street": street(arguments.points)}
    print(head("cloud", "points", "bits, usual", "RMS", "spacing", "point_to_plane", "embed"))
    markers, marked = {}, {}
    for name, cloud in clouds.items():
        markers[name] = jm.make_marker(cloud, key, bits=8 * len(MESSAGE))
        start = time.perf_counter()
        marked[name], info = markers[name].embed(MESSAGE, jm.Budget(rms=arguments.budget, noise=0))
        took = time.perf_counter() - start
        across = jm.compare(cloud, marked[name]).point_to_plane
        apart = spacings(np.asarray(cloud.vertices)).mean() / diagonal(cloud)
        cells = jm.capacity(cloud), f"{info.rms:.2g}", f"{apart:.2g}", f"{across:.2g}", f"{took:.1f}"
        print(line(name, f"{len(cloud.vertices):,}", *cells), flush=True)
    print(f"\n{head('attack', *clouds)}")
    for steps in " ".join(arguments.attacks.split()).split("; "):
        say(steps)
        cells = [
            reading(
                markers[name],
                lambda seed, mesh=marked[name], steps=steps: attacked(mesh, steps, seed, OWN),
                arguments.seeds,
            )
            for name in clouds
        ]
        print(line(steps, *cells), flush=True)
    if arguments.splats:
        print(f"\n{head('splats', 'PSNR', 'pruned 30 %', 'pruned 50 %', 'pruned 70 %')}")
        with tempfile.TemporaryDirectory() as folder:
            for name, cloud in clouds.items():
                print(splat_row(name, cloud, key, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
