"""Compare evidence with and without masking at equal visibility: python benchmarks/robustness/hiding.py MESH ...

There is a line for each mesh and each built-in shape, marked with 64 bits within the limits; values without masking,
all points alike in all directions, are left of the arrow, and values with masking right of it. Columns of attacks,
which are those of `jaxmark attack`, have the evidence for a claim of the message after the attack, in nats of the bound
exp(-S²/2‖a‖²). Other columns:

rms        displacement, 1e-3 of the diagonal
shading    visible turn of normals that 5 % / 1 % of the area exceed, in just noticeable differences
dame       mean masked change of dihedral angles
stretch    change of length that 1 % of the edges exceed
plane      turn of normals that 5 % of the area of planes exceeds, in degrees; planes are faces all of whose edges turn
           by less than 0.1°
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark.bench.parametric import SHAPES
from jaxmark.distortion import shading
from jaxmark.geometry.mesh import Mesh, compact, diagonal, host_mesh, weld, weld_mesh
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.reading.detectors import claims
from jaxmark.watermark.schemes.keyed import KeyedScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.marks import KEY, MESSAGE, write
from common.tables import Row, say, table
from common.turns import planes, turns

ATTACKS = """noise 0.005; smoothing 50; quantisation 8; quantisation 7; simplification 0.9; isotropic 1"""


def nats(marker: jm.watermark.NonBlindMarker, suspect: Mesh) -> float:
    """The best of a claim's exponents."""
    received = marker.receive(marker.register(suspect))
    word = jnp.asarray(marker.codeword(MESSAGE), received.observed.residual.dtype)
    return max(
        float(max(score / norm, 0) ** 2 / 2) for score, norm in zip(*claims(marker.reader, received, word), strict=True)
    )


def row(name: str, mesh: Mesh, budget: Budget, attacks: list[str]) -> Row:
    """A line of the table."""
    mesh = host_mesh(compact(weld_mesh(mesh, weld(mesh.vertices))))
    reference = jm.distortion.Reference(mesh)
    cells: dict[str, list[str]] = {}
    for masking in (False, True):
        marker = jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE), scheme=KeyedScheme(hiding=masking))
        marked = write(marker, MESSAGE, budget)
        found = reference.measure(marked, ("rms", "dame", "stretch"))
        x, y = (
            jnp.asarray((np.asarray(one.vertices) - reference.centre) / diagonal(mesh), jnp.float32)
            for one in (mesh, marked)
        )
        seen = [float(shading(x, y, reference.masking, share)) for share in (0.95, 0.99)]
        told = {
            "rms": f"{1e3 * (found['rms'] or 0):.2f}",
            "shading": " / ".join(f"{value:.2f}" for value in seen),
            "dame": f"{found['dame']:.4f}",
            "stretch": f"{found['stretch']:.3f}",
            "plane": f"{turns(mesh, marked, (0.95,), planes(mesh))[0]:.2f}",
        }
        told |= {attack: f"{nats(marker, attacked(marked, attack, 1)):.0f}" for attack in attacks}
        for column, value in told.items():
            cells.setdefault(column, []).append(value)
    return {"mesh": name, "points": len(mesh.vertices), **{column: " → ".join(pair) for column, pair in cells.items()}}


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*")
    parser.add_argument("--shapes", nargs="*", default=[], choices=[*SHAPES], metavar="SHAPE", help=", ".join(SHAPES))
    parser.add_argument("--points", type=int, default=10_000, help="of each shape, about; %(default)s")
    parser.add_argument("--limit", action="append", metavar="NAME=VALUE", help="instead of the default")
    parser.add_argument("--attacks", default=ATTACKS, help="kinds and strengths; %(default)s")
    arguments = parser.parse_args()
    limits = {name: float(value) for name, value in (limit.split("=") for limit in arguments.limit or [])}
    rms = limits.pop("rms", None)
    budget = jm.Budget(rms=rms, limits=limits or None)
    rows = []
    for name, mesh in [
        *((path.stem, load(parser, path)) for path in arguments.meshes),
        *((name, SHAPES[name](arguments.points)) for name in arguments.shapes),
    ]:
        say(name)
        rows.append(row(name, mesh, budget, [one.strip() for one in arguments.attacks.split(";")]))
    print(table(rows))


if __name__ == "__main__":
    main()
