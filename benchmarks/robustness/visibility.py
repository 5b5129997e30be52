"""Measure the visibility of marks, point by point: python benchmarks/robustness/visibility.py MESH ...

There is a line for each given mesh, and for each built-in shape, marked with 64 bits at the default strength or within
--limit. Columns:

rms        displacement over the diagonal
dame       mean masked change of dihedral angles, in radians
stretch    change of length that 1 % of the edges exceed
turn       of face normals, in degrees, that half / 5 % of the area exceed
shading    visible turn of normals, in just noticeable differences, that half / 5 % / 1 % of the area exceed
on planes  turn of the normals of planes, in degrees, that 5 % of their area exceeds; their edges turn by less than 0.1°
least      the turn of normals that is just noticed, in degrees, where the original masks least (5 % of the area, the
           most sensitive band)
flip, ssim differences of pictures that 1 % of their pixels exceed, with --pictures
seconds    to prepare the original / to measure / to take the gradient, once compiled
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark.bench.parametric import SHAPES
from jaxmark.distortion import RENDERED, make_masking, shading
from jaxmark.geometry.mesh import Mesh, compact, diagonal, host_mesh, weld, weld_mesh
from jaxmark.watermark.perception.budget import Budget

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.marks import KEY, MESSAGE, write
from common.tables import Row, say, table
from common.timing import timed
from common.turns import planes, turns


def again(function: Callable[[], Any]) -> tuple[Any, float]:
    """The result, and the seconds of a second run."""
    jax.block_until_ready(function())
    return timed(lambda: jax.block_until_ready(function()))


def row(name: str, mesh: Mesh, budget: Budget, pictures: bool) -> Row:
    """A line of the table."""
    mesh = host_mesh(compact(weld_mesh(mesh, weld(mesh.vertices))))
    marked = write(jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE)), MESSAGE, budget)
    metrics = ("rms", "dame", "stretch", *(RENDERED if pictures else ()))
    found = jm.distortion.measure(mesh, marked, metrics)
    points = [np.asarray(one.vertices, np.float64) / diagonal(mesh) for one in (mesh, marked)]
    points = [one - points[0].mean(axis=0) for one in points]
    masking, prepare = again(lambda: make_masking(points[0], mesh.faces))
    x, y = (jnp.asarray(one, jnp.float32) for one in points)
    seen = [float(shading(x, y, masking, share)) for share in (0.5, 0.95, 0.99)]
    _, measure = again(lambda: shading(x, y, masking))
    slope = jax.jit(jax.grad(shading, argnums=1))
    _, differentiate = again(lambda: slope(x, y, masking))
    least = np.degrees(np.quantile(masking.threshold, 0.05, axis=1).min())
    return {
        "mesh": name,
        "points": len(x),
        **{metric: found[metric] for metric in metrics[:3]},
        "turn": " / ".join(f"{value:.2f}" for value in turns(mesh, marked, (0.5, 0.95))),
        "on planes": f"{turns(mesh, marked, (0.95,), planes(mesh))[0]:.2f}",
        "shading": " / ".join(f"{value:.2f}" for value in seen),
        "least": f"{least:.2f}",
        **{metric: found[metric] for metric in metrics[3:]},
        "seconds": " / ".join(f"{value:.2f}" for value in (prepare, measure, differentiate)),
    }


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*")
    parser.add_argument("--shapes", nargs="*", default=[], choices=[*SHAPES], metavar="SHAPE", help=", ".join(SHAPES))
    parser.add_argument("--points", type=int, default=10_000, help="of each shape, about; %(default)s")
    parser.add_argument("--limit", action="append", metavar="NAME=VALUE", help="instead of the default")
    parser.add_argument("--pictures", action="store_true", help="compare pictures, too")
    arguments = parser.parse_args()
    limits = dict(limit.split("=") for limit in arguments.limit or [])
    budget = jm.Budget(limits={name: float(value) for name, value in limits.items()} or None)
    rows = []
    for name, mesh in [
        *((path.stem, load(parser, path)) for path in arguments.meshes),
        *((name, SHAPES[name](arguments.points)) for name in arguments.shapes),
    ]:
        say(name)
        rows.append(row(name, mesh, budget, arguments.pictures))
    print(table(rows))


if __name__ == "__main__":
    main()
