"""How cleanly each family of bands separates a mesh: python benchmarks/families.py MESH [--bands 64].

One row per family: largest overshoot of a response, median leakage of the bands that hold energy, and coherence of the
unit components of x, y and z (the paper's Condition 3 wants it near 0).
"""

import argparse
from typing import Literal

import numpy as np

from jaxmark import load_mesh
from jaxmark.bands import report, scaling
from jaxmark.laplacian import centre, make_laplacian
from jaxmark.mesh import weld, welded_mesh

FAMILIES: list[tuple[Literal["halved", "printed"], Literal["none", "jackson", "lanczos"]]] = [
    ("printed", "none"),
    ("halved", "none"),
    ("halved", "lanczos"),
    ("halved", "jackson"),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh")
    parser.add_argument("--bands", type=int, default=64)
    arguments = parser.parse_args()
    mesh = load_mesh(arguments.mesh)
    points = welded_mesh(mesh, weld(np.asarray(mesh.vertices)))
    operator = make_laplacian(points)
    x = centre(operator, np.asarray(points.vertices))
    print(f"{arguments.mesh}: {len(x)} points, {arguments.bands} bands")
    print("| kernel | damping | overshoot | median leakage | median coherence x, y, z | largest |")
    print("|---|---|---|---|---|---|")
    for kernel, damping in FAMILIES:
        family = scaling(arguments.bands, kernel=kernel, damping=damping)
        found = [report(operator, family, column) for column in x.T]
        leakage = np.concatenate([one.leakage for one in found])
        print(
            f"| {kernel} | {damping} | {found[0].overshoot.max():.3f} | {np.median(leakage[leakage < 1]):.3f}"
            f" | {', '.join(f'{one.coherence_median:.3f}' for one in found)}"
            f" | {max(one.coherence_max for one in found):.3f} |"
        )


if __name__ == "__main__":
    main()
