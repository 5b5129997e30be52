"""Draw the pictures of docs/results/visibility.md: python benchmarks/pictures/looks.py MESH ... [--output FOLDER].

For each mesh, and for each built-in shape, it draws a strip of six pictures: the original, the mesh with a mark of 64
bits at the default strength, and ten times the displacement, each shaded flat and with the reflection of stripes, which
shows changes of normals. For meshes named by --levels, another strip has the original and each name of visibility.
"""

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import jaxmark as jm
from jaxmark.bench.parametric import SHAPES
from jaxmark.geometry.mesh import Mesh, compact, host_mesh, weld, weld_mesh
from jaxmark.geometry.raster import Frame
from jaxmark.plot import Rendering, exaggerate, render
from jaxmark.watermark.perception.budget import VISIBILITY, Budget

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.drawn import keep
from common.marks import KEY, MESSAGE, write
from common.tables import say

SIZE = 270  # pixels
SIDE = (20.0, 30.0)  # elevation and azimuth of the eye
CLOSE = 0.85  # of the frame in which meshes are seen whole from everywhere
GRAYS = 48
FACETED = 300  # points of shapes with large facets


def strip(meshes: list[Mesh], frame: Frame) -> np.ndarray:
    """Meshes shaded flat, and then with stripes, side by side; all are seen through the frame of the first."""
    return np.hstack(
        [
            # Twice as large and halved, so that edges are smooth.
            render(Rendering("", mesh, style, SIDE, frame), 2 * SIZE).reshape(SIZE, 2, SIZE, 2).mean(axis=(1, 3))
            for style in ("flat", "zebra")
            for mesh in meshes
        ]
    )


def save(gray: np.ndarray, path: Path) -> None:
    """Write a picture as PNG, in few grays."""
    levels = np.round(np.round(gray * (GRAYS - 1)) * 255 / (GRAYS - 1)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(levels).quantize(GRAYS).save(buffer, format="PNG", optimize=True)
    keep(path, buffer.getvalue())


def marked(mesh: Mesh, budget: Budget) -> Mesh:
    """With 64 bits."""
    return write(jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE)), MESSAGE, budget)


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*")
    parser.add_argument("--points", type=int, default=10_000, help="of each shape, about; %(default)s")
    parser.add_argument("--output", type=Path, default=Path("docs/pictures"), metavar="FOLDER", help="%(default)s")
    parser.add_argument("--levels", nargs="*", default=[], metavar="NAME", help="of meshes and shapes above")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    meshes = {path.stem: load(parser, path) for path in arguments.meshes}
    meshes |= {name: make(arguments.points) for name, make in SHAPES.items()}
    meshes |= {f"faceted_{name}": SHAPES[name](FACETED) for name in ("torus", "sphere")}
    for name, given in meshes.items():
        say(name)
        mesh = host_mesh(compact(weld_mesh(given, weld(given.vertices))))
        frame = Frame.of(mesh)
        frame, result = frame._replace(width=CLOSE * frame.width), marked(mesh, jm.Budget())
        more = exaggerate(jm.make_marker(mesh, KEY).original, result).mesh
        save(strip([mesh, result, more], frame), arguments.output / f"visibility_{name}.png")
        if name in arguments.levels:
            levels = [marked(mesh, jm.Budget(visibility=level)) for level in VISIBILITY]
            save(strip([mesh, *levels], frame), arguments.output / f"visibility_levels_{name}.png")


if __name__ == "__main__":
    main()
