"""Read marks in bent and posed suspects: python benchmarks/robustness/poses.py MESH... [--bits 64] [--budget 8e-4].

GLB and glTF files with a skin are posed: every joint rotates by some degrees about a random axis, together with all
joints attached to it, and skins blend linearly. Joints that share vertices are attached to each other. Other meshes are
bent, twisted, and dragged as rigidly as possible. Vertices keep their order, as in a modelling tool. The output has the
RMS displacement of the vertices in the best common pose, in diagonals; and whether the message is read, and log10 p of
a claim of it without its floor, by three registrations: a single map, a map of each point's neighbourhood, and the
skeleton (`jaxmark.geometry.unpose`), for files with a skin.
"""

import sys
import time
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.files import load_skin
from jaxmark.files.programs import release_programs
from jaxmark.geometry import Skinning, unpose
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.geometry.pose import Pose, similarity
from jaxmark.watermark.schemes.keyed import KeyedScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.marks import BUDGET, mark
from common.tables import Row, save_json, say, table

DEGREES = (10.0, 25.0, 40.0)
BENDS = (("bending", 45.0), ("bending", 120.0), ("twisting", 45.0), ("twisting", 120.0), ("arap", 0.2), ("arap", 0.4))


def posed(mesh: Mesh, skin: Skinning, degrees: float, random: Generator) -> Mesh:
    """Turn every joint about the vertices that it shares with the one that it hangs on."""
    joints, place = np.unique(skin.joints, return_inverse=True)
    weights = np.zeros((len(skin.joints), len(joints)))
    np.add.at(weights, (np.arange(len(weights))[:, None], place.reshape(skin.joints.shape)), skin.weights)
    vertices, shared = np.asarray(mesh.vertices, np.float64), weights.T @ weights
    tree = csgraph.minimum_spanning_tree(sparse.csr_array(np.where(shared > 1e-9, 1 / np.maximum(shared, 1e-9), 0)))
    found = np.zeros_like(vertices)
    poses: dict[int, Pose] = {}
    for root in range(len(joints)):
        if root in poses:
            continue
        order, before = csgraph.breadth_first_order(tree, root, directed=False)
        for joint in order.tolist():
            if joint == root:
                poses[joint] = Pose(np.eye(3), np.zeros(3))
                continue
            both = weights[:, joint] * weights[:, before[joint]]
            pivot, axis = both @ vertices / both.sum(), random.normal(size=3)
            turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
            poses[joint] = Pose(turn, pivot - turn @ pivot).then(poses[int(before[joint])])
    for joint, pose in poses.items():
        found += weights[:, joint, None] * pose(vertices)
    return Mesh(found, mesh.faces)


def skin_of(path: Path) -> Skinning | None:
    try:
        return load_skin(path)
    except jm.JaxmarkError:
        return None


def rows_of(path: Path, mesh: Mesh, bits: int, budget: float) -> list[Row]:
    skin, subject, rows = skin_of(path), mark(mesh, KeyedScheme(), bits, budget, 0.0), []
    marker, random = subject.marker, np.random.default_rng(0)
    kinds = [("pose", degrees) for degrees in DEGREES] if skin is not None else BENDS
    for kind, strength in kinds:
        if skin is not None:
            suspect = posed(subject.marked, skin, strength, random)
        else:
            suspect = jm.attack(subject.marked, kind, strength, seed=0)
        aligned, start = align(marker.original, suspect), time.perf_counter()
        read = marker.read(aligned).message == subject.message
        seconds = time.perf_counter() - start
        places, before = np.asarray(suspect.vertices, np.float64), np.asarray(mesh.vertices, np.float64)
        off = np.linalg.norm(similarity(places, before)(places) - before, axis=1)
        moved = float(np.sqrt(np.mean(off**2))) / diagonal(mesh)
        ways = {"one map": aligned._replace(deformed=None)}
        if aligned.deformed is not None:
            ways["own maps"] = aligned.undeformed(marker.original, aligned.deformed)
        if skin is not None:
            ways["skeleton"] = align(marker.original, unpose(mesh, skin, suspect))
        claims = {name: marker.read(way, subject.message).evidence.log10_p_unfloored for name, way in ways.items()}
        rows.append({"mesh": path.name, "points": int(marker.original.used.sum()), "attack": f"{kind} {strength:g}"})
        rows[-1] |= {"moved": moved, "read": "yes" if read else "no", **{k: round(v, 1) for k, v in claims.items()}}
        rows[-1]["seconds"] = round(seconds, 1)
        say(*rows[-1].values())
    return rows


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--bits", type=int, default=64)
    parser.add_argument("--budget", type=float, default=BUDGET)
    parser.add_argument("--output", type=Path, help="JSON file")
    arguments = parser.parse_args()
    rows: list[Row] = []
    for path in arguments.meshes:
        release_programs()
        try:
            rows += rows_of(path, load(parser, path), arguments.bits, arguments.budget)
        except jm.JaxmarkError as refusal:
            rows.append({"mesh": path.name, "attack": f"refused: {refusal}"})
    print(table(rows))
    if arguments.output:
        save_json(arguments.output, rows)


if __name__ == "__main__":
    main()
