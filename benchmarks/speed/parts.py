"""Cut a mesh into parts with equal numbers of faces: python benchmarks/speed/parts.py MESH PARTS.glb [--parts 10].

A model that is too large for the memory can be marked as a file of several meshes, one after the other. The parts are
slabs across the longest side; points on a cut are in both of its parts. `/usr/bin/time -v jaxmark embed PARTS.glb ...`
and `detect` measure time and memory.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

import jaxmark as jm
from jaxmark.files.atomic import write_atomically
from jaxmark.geometry.mesh import compact

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.tables import say


def cut(mesh: jm.Mesh, count: int) -> list[jm.Mesh]:
    """Slabs of as many faces each, across the longest side of the bounding box."""
    along = int(np.argmax(np.ptp(mesh.vertices, axis=0)))
    order = np.argsort(np.asarray(mesh.vertices)[mesh.faces, along].mean(axis=1), kind="stable")
    return [compact(jm.Mesh(mesh.vertices, mesh.faces[np.sort(some)])) for some in np.array_split(order, count)]


def main() -> None:
    """Write the parts as meshes of one file."""
    parser = make_parser(__doc__)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("output", type=Path, metavar="PARTS.glb")
    parser.add_argument("--parts", type=int, default=10)
    options = parser.parse_args()
    if options.output.suffix != ".glb" or not options.output.parent.is_dir():
        parser.error(f"{options.output} cannot be written: it must end in .glb, in a folder that exists")
    mesh, scene = load(parser, options.mesh), trimesh.Scene()
    if not 1 <= options.parts <= len(mesh.faces):
        parser.error(f"{options.mesh} has {len(mesh.faces)} faces, of which --parts {options.parts} cannot be made")
    for number, part in enumerate(cut(mesh, options.parts)):
        say(f"part {number}: {len(part.vertices):,} vertices")
        scene.add_geometry(trimesh.Trimesh(*part, process=False), geom_name=f"part {number}")
    written = scene.export(file_type="glb")
    assert isinstance(written, bytes)
    write_atomically(options.output, written)


if __name__ == "__main__":
    main()
