"""Who is accused when several recipients make one copy of theirs: by averaging, per-vertex mixing, median, minimum.

For coalitions of 1 to 10 it prints how many of their members are accused at 1e-6, how many innocents, the best
log10 p (which covers all recipients tried), and the time to rank them.

    python benchmarks/collusion.py MESH [--recipients 100000] [--noise 0.002] [--budget 0.0008]
"""

import argparse
import time

import numpy as np

import jaxmark as jm
from jaxmark.attacks.adversarial import combined
from jaxmark.attacks.adversarial.collusion import Rule
from jaxmark.mesh import weld

COALITIONS = (1, 2, 3, 5, 8, 10)
WAYS: dict[str, Rule] = {"average": "mean", "mixing vertices": "mixing", "median": "median", "minimum": "minimum"}
ALONE: dict[str, Rule] = {"itself": "mean"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh")
    parser.add_argument("--recipients", type=int, default=100_000)
    parser.add_argument("--noise", type=float, default=0.002, help="of the mean radius, added by the colluders")
    parser.add_argument("--budget", type=float, default=8e-4)
    arguments = parser.parse_args()
    mesh = jm.load_mesh(arguments.mesh)
    tracer = jm.make_tracer(mesh, jm.Key(bytes(32)))
    names = [f"recipient {i}" for i in range(arguments.recipients)]
    guilty = names[: max(COALITIONS)]
    copies = [tracer.fingerprint(name, arguments.budget)[0] for name in guilty]
    print(f"{len(weld(mesh.vertices).first)} points, {tracer.marker.code} slots, {len(names)} recipients")
    print(
        "| colluders | by | members accused | innocents accused | best log10 p | seconds |\n|---|---|---|---|---|---|"
    )
    random = np.random.default_rng(0)
    for count in COALITIONS:
        for way, rule in (WAYS if count > 1 else ALONE).items():
            suspect = combined(copies[:count], rule, random)
            suspect = jm.attack(suspect, "noise", arguments.noise, seed=count)
            start = time.perf_counter()
            found = tracer.identify(suspect, names, top=2 * max(COALITIONS))
            seconds = time.perf_counter() - start
            accused = [one.recipient for one in found if one.log10_p <= -6]
            members = sum(name in names[:count] for name in accused)
            print(
                f"| {count} | {way} | {members} | {len(accused) - members} | {found[0].log10_p:.1f} | {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
