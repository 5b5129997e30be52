"""Count the accused if several recipients combine their copies: by averaging, per-vertex mixing, median or minimum.

For coalitions of 1 to 10 recipients, the table has the number of members accused at 1e-6, the number of innocents
accused, the best log10 p (which covers all recipients tried), and the time to rank them.

    python benchmarks/security/collusion.py MESH [--recipients 100000] [--noise 0.002] [--budget 0.0008]
"""

import sys
from pathlib import Path

import numpy as np

import jaxmark as jm
from jaxmark.adversaries import combine
from jaxmark.adversaries.collusion import Rule
from jaxmark.geometry.mesh import weld

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.marks import BUDGET
from common.tables import head, line
from common.timing import timed

COALITIONS = (1, 2, 3, 5, 8, 10)
WAYS: dict[str, Rule] = {"average": "mean", "mixing vertices": "mixing", "median": "median", "minimum": "minimum"}
ALONE: dict[str, Rule] = {"itself": "mean"}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--recipients", type=int, default=100_000)
    parser.add_argument("--noise", type=float, default=0.002, help="of the mean radius, added by the colluders")
    parser.add_argument("--budget", type=float, default=BUDGET)
    arguments = parser.parse_args()
    mesh = load(parser, arguments.mesh)
    tracer = jm.watermark.make_tracer(mesh, jm.Key(bytes(32)))
    names = [f"recipient {i}" for i in range(arguments.recipients)]
    guilty = names[: max(COALITIONS)]
    copies = [tracer.fingerprint(name, arguments.budget)[0] for name in guilty]
    print(f"{len(weld(mesh.vertices).first)} points, {tracer.mark.code_bits} slots, {len(names)} recipients")
    print(head("colluders", "by", "members accused", "innocents accused", "best log10 p", "seconds"))
    random = np.random.default_rng(0)
    for count in COALITIONS:
        for way, rule in (WAYS if count > 1 else ALONE).items():
            suspect = combine(copies[:count], rule, random)
            suspect = jm.attack(suspect, "noise", arguments.noise, seed=count)
            found, seconds = timed(tracer.identify, suspect, names, top=2 * max(COALITIONS))
            accused = [one.recipient for one in found if one.log10_p <= -6]
            members = sum(name in names[:count] for name in accused)
            proof = f"{found[0].log10_p:.1f}"
            print(line(count, way, members, len(accused) - members, proof, f"{seconds:.1f}"), flush=True)


if __name__ == "__main__":
    main()
