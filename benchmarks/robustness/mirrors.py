"""Compare reflected suspects with the same ones unreflected: python benchmarks/robustness/mirrors.py MESH...

Each mesh is marked by default with a random key, attacked, rotated and scaled at random, and reflected in two ways:
with faces reversed so that normals still point outwards ("mirrored"), and by negated coordinates alone ("inside out").
The output has log10 p of the claimed message, "*" if the message can also be decoded, and the seconds of alignment;
then the number of reflected suspects whose evidence is within a tenth of that of the unreflected ones.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.geometry.pose import Pose

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, load, make_parser
from common.attacks import attacked
from common.tables import head, line

ATTACKS = (
    "none",
    "reordering 1",
    "midpoint 1",
    "simplification 0.1",
    "isotropic 1",
    "edge-flips 0.01",
    "cropping 0.3",
    "midpoint 1 + cropping 0.3",
)
HANDS = {"as it was": (1, 1), "mirrored": (-1, -1), "inside out": (-1, 1)}  # of a coordinate, of the order of corners


def found_again(mesh: Mesh, hand: str, seed: int) -> Mesh:
    """A mesh of one hand or the other, in any pose and scale."""
    rng, (sign, step) = np.random.default_rng(seed), HANDS[hand]
    scale = 10 ** rng.uniform(-2, 2)
    turn = scale * Rotation.random(rng=rng).as_matrix() * [sign, 1, 1]
    pose = Pose(turn, scale * diagonal(mesh) * rng.normal(size=3))
    return jm.make_mesh(pose(np.asarray(mesh.vertices)), np.asarray(mesh.faces)[:, ::step])


def read(marker: jm.watermark.NonBlindMarker, suspect: Mesh, message: bytes) -> tuple[float, str]:
    """Evidence of the claimed message, 0 if the suspect is refused; and what to print."""
    try:
        found = marker.detect(suspect, message)
    except jm.JaxmarkError:
        return 0.0, "refused"
    seconds = f"{found.registration.method}, {found.registration.seconds:.1f} s"
    return found.log10_p, f"{found.log10_p:.1f}{'*' * (found.message == message)} ({seconds})"


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--attacks", nargs="+", default=ATTACKS, help='such as "isotropic 1 + cropping 0.3"')
    parser.add_argument("--budget", type=float, help="RMS displacement over the diagonal; by default as `embed` has it")
    parser.add_argument("--seed", type=int, default=0, help="of key, message, attacks and poses")
    options = parser.parse_args()
    print(head("mesh", "attack", *HANDS))
    alike, rows = dict.fromkeys(HANDS, 0), 0
    for path in options.meshes:
        rng = np.random.default_rng(options.seed)
        marker = jm.make_marker(load(parser, path), rng.bytes(32))
        message = rng.bytes(marker.bits // 8)
        try:
            marked, _ = marker.embed(message, options.budget)
        except jm.JaxmarkError as refusal:
            print(line(path.name, "not marked", refusal, *[""] * (len(HANDS) - 1)), flush=True)
            continue
        for steps in options.attacks:
            try:
                plain = attacked(marked, steps, options.seed)
            except jm.JaxmarkError as refusal:
                print(line(path.name, steps, f"attack refused: {refusal}", *[""] * (len(HANDS) - 1)), flush=True)
                continue
            found = {hand: read(marker, found_again(plain, hand, options.seed), message) for hand in HANDS}
            print(line(path.name, steps, *(text for _, text in found.values())), flush=True)
            rows += 1
            for hand, (evidence, _) in found.items():
                alike[hand] += evidence <= 0.9 * found["as it was"][0]
    print()
    for hand in list(HANDS)[1:]:
        print(f"{hand}: {alike[hand]} of {rows} within a tenth of the evidence.")


if __name__ == "__main__":
    main()
