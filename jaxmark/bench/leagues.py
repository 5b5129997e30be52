"""What marks have to stand: leagues of attacks, and the limits that every method keeps.

`smi2010` is the field's protocol as it was: Wang, Lavoué, Denis, Baskurt, He, "A benchmark for 3D mesh watermarking",
SMI 2010. `2026` has what it lacks: other meshings, other forms, other machines, and attackers who choose.
"""

from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmark.adversaries.by_name import attack
from jaxmark.attacks import Attack
from jaxmark.bench import compositions as made
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.perception.budget import visibility_of

CROPS = 3  # of one mesh, whose readings are averaged
OVERWRITTEN = "overwritten"  # by a second mark of the same method, with another key, as strong as the limits
_FARTHEST = 0.02  # diagonals that a hidden mark moves any vertex: single ones may move far unseen by means
_EXTRAS = {"pymeshlab": "attacks", "fast_simplification": "attacks", "skimage": "attacks", "igl": "align"}
_EXTRAS |= {"DracoPy": "files"}


class Line(NamedTuple):
    """One attack of a league; of the protocol also the bit error rates published for it, under both sets of limits."""

    kind: str | Attack
    strength: float
    cho: tuple[float, float] | None = None  # Cho, Prost, Jung 2007, on Venus, blind
    wang: tuple[float, float] | None = None  # Wang, Lavoué, Denis, Baskurt 2011 (volume moments), on Venus, blind
    copies: int = 1  # suspects that are made, each by another seed
    in_place: bool = True  # whether what it costs the shape can be measured: it leaves the pose and the whole
    needs: tuple[str, ...] = ()  # packages that are optional
    family: str = ""  # of an attacker with one budget, who takes the best for each mark

    def suspects(self, mesh: Mesh, seed: int) -> list[Mesh]:
        """What the attack makes of a mesh, unless it is `OVERWRITTEN`, which only the method itself can do.

        Raises:
            JaxmarkError: if it is not possible on this mesh.
        """
        return [attack(mesh, self.kind, self.strength, seed=self.copies * seed + copy) for copy in range(self.copies)]

    def missing(self) -> str:
        """A sentence that names what is not installed; empty if nothing."""
        gone = [name for name in self.needs if find_spec(name) is None]
        return f"{gone[0]} is missing: pip install 'jaxmark[{_EXTRAS[gone[0]]}]'" if gone else ""


class League(NamedTuple):
    """Attacks, and sets of limits on what a mark may do to the mesh."""

    limits: Mapping[str, Mapping[str, float]]  # by metric; an empty one is what is hidden on this mesh
    lines: Mapping[str, Line]

    def bounds(self, limits: str, mesh: Mesh) -> Mapping[str, float]:
        """The limits of one name for a mesh."""
        return self.limits[limits] or {**visibility_of(mesh)["hidden"], "max": _FARTHEST}


def posed(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """The protocol's similarity: shifts of up to 5 mean radii along each axis, any turn, scales from 0.1 to 10."""
    vertices = np.asarray(mesh.vertices)
    radius = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()
    axis = random.normal(size=3)
    turn = Rotation.from_rotvec(random.uniform(0, 2 * np.pi) * axis / np.linalg.norm(axis))
    moved = turn.apply(random.uniform(0.1, 10) * vertices) + radius * random.uniform(-5, 5, 3)
    return Mesh(moved, mesh.faces)


def _lines(kind: str, strengths: Iterable[float], *published: str) -> dict[str, Line]:
    """Lines of one kind; rates published for a method are lists of numbers, perceptual / geometric."""
    columns = [[[float(x) for x in part.split()] for part in one.split("/")] for one in published]
    return {
        f"{kind} {strength:g}": Line(
            kind,
            strength,
            *((one[0][place], one[1][place]) for one in columns),
            copies=CROPS if kind == "cropping" else 1,
            in_place=kind != "cropping",
            needs=("fast_simplification",) if kind == "simplification" else (),
        )
        for place, strength in enumerate(strengths)
    }


# Published rates: the protocol's result page, for the model Venus.
PROTOCOL: Mapping[str, Line] = {
    "none": Line("noise", 0),
    "file": Line("reordering", 1),
    "similarity": Line(Attack(posed, "none", (1,), host=True), 1, in_place=False),
    **_lines(
        "noise",
        (0.0005, 0.001, 0.003, 0.005),
        ".01 .03 .13 .28 / 0 .01 .10 .24",
        "0 .01 .08 .16 / .02 .15 .29 .40",
    ),
    **_lines("smoothing", (5, 10, 30, 50), ".10 .23 .38 .45 / .06 .16 .34 .42", "0 .01 .07 .14 / .06 .18 .39 .51"),
    **_lines(
        "quantisation",
        (11, 10, 9, 8, 7),
        "0 .04 .14 .26 .46 / 0 .02 .06 .18 .41",
        "0 .01 .01 .05 .17 / .01 .17 .27 .39 .53",
    ),
    **_lines("midpoint", (1,), ".04 / .02", "0 / 0"),
    **_lines("sqrt3", (1,), ".14 / .09", "0 / .01"),
    **_lines("loop", (1,), ".16 / .09", "0 / .01"),
    **_lines("simplification", (0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.975)),
    **_lines("cropping", (0.1, 0.3, 0.5)),
}

_MESHLAB, _ISO, _EDGES = ("pymeshlab",), ("skimage", "igl"), ("fast_simplification",)

LINES_2026: Mapping[str, Line] = {
    "none": Line("noise", 0),
    **{f"iso-surface {cells}": Line("iso-surface", cells, needs=_ISO) for cells in (150, 70)},
    **{f"isotropic {length:g}": Line("isotropic", length, needs=_MESHLAB) for length in (0.7, 1, 1.4)},
    **{f"poisson {depth}": Line("poisson", depth, needs=_MESHLAB) for depth in (7, 6)},
    **{f"warp {size:g}": Line("warp", size) for size in (0.005, 0.02)},
    "bending 10": Line("bending", 10),
    "twisting 10": Line("twisting", 10),
    "arap 0.1": Line("arap", 0.1, needs=("igl",)),
    "remesh-smooth-remesh": Line(made.REMESH_SMOOTH_REMESH, 10, needs=_MESHLAB),
    "mirror": Line(made.MIRROR, 0, in_place=False),
    "mirror, retriangulated": Line(made.MIRROR, 0.3, in_place=False),
    "mirror, remeshed": Line(made.MIRROR_REMESHED, 1, in_place=False, needs=_MESHLAB),
    "decimated to 4 %, 2 Loop": Line(made.DECIMATE_LOOP, 0.96, needs=_EDGES),
    "decimated to 20 %, 1 Loop": Line(made.DECIMATE_LOOP, 0.8, needs=_EDGES),
    "print and scan 0.1 mm": Line(made.PRINT_SCAN, 0.1, in_place=False, needs=(*_ISO, *_MESHLAB)),
    "slicer": Line(made.SLICER, 5, in_place=False),
    "Draco 14": Line(made.DRACO, 14, needs=("DracoPy",)),
    "Draco 11": Line(made.DRACO, 11, needs=("DracoPy",)),
    "glTF quantised 16": Line(made.GLTF, 16),
    "glTF quantised 12": Line(made.GLTF, 12),
    "grafted 0.5": Line(made.GRAFT, 0.5, copies=CROPS, in_place=False),
    "mosaic 0.1": Line("mosaic", 0.1, in_place=False),
    OVERWRITTEN: Line(OVERWRITTEN, 1),
    **{
        f"attacker, MSDM2 {budget:g}: {kind}": Line(
            made.to_budget(kind), budget, needs=("igl",), family=f"attacker, MSDM2 {budget:g}"
        )
        for budget in (0.3, 0.5)
        for kind in made.CHOICES
    },
}

#: The leagues by their names.
LEAGUES: Mapping[str, League] = {
    "smi2010": League(
        {"perceptual": {"mrms": 8e-4, "msdm": 0.20}, "geometric": {"mrms": 2e-4, "msdm": 0.30}}, PROTOCOL
    ),
    "2026": League({"hidden": {}}, LINES_2026),
}


def get_league(name: str) -> League:
    """A league by its name.

    Raises:
        JaxmarkError: if there is none of that name.
    """
    if name not in LEAGUES:
        raise JaxmarkError(f"There is no league {name!r}; there are {', '.join(LEAGUES)}.")
    return LEAGUES[name]
