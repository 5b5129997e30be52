"""The tracks of the benchmark: sets of attacks, and of distortion limits for the marks of all methods.

`smi2010` is the established protocol: Wang, Lavoué, Denis, Baskurt, He, "A benchmark for 3D mesh watermarking", SMI
2010. `2026` adds remeshing, deformation, file formats, and attackers who choose among several attacks.
"""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmark.adversaries.by_name import attack
from jaxmark.attacks import Attack
from jaxmark.bench import composed_attacks as composed
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.perception.budget import visibility_of

CROPS = 3  # number of crops of one mesh, whose readings are averaged
OVERWRITTEN = "overwritten"  # re-watermarking by the same method with another key, as strongly as the limits allow
_MAX_DISPLACEMENT = 0.02  # largest displacement of a vertex by a hidden mark, over the diagonal; other limits are means
_EXTRAS = {"igl": "align", "DracoPy": "files"}  # extras that install packages; `attacks` installs all others


class Line(NamedTuple):
    """One attack of a track, with the bit error rates that were published for it under both sets of limits."""

    kind: str | Attack
    strength: float
    cho: tuple[float, float] | None = None  # Cho, Prost, Jung 2007, on Venus, blind
    wang: tuple[float, float] | None = None  # Wang, Lavoué, Denis, Baskurt 2011 (volume moments), on Venus, blind
    copies: int = 1  # number of suspects, each with its own seed
    in_place: bool = True  # whether distortion can be measured: the attack changes no pose and removes no parts
    needs: tuple[str, ...] = ()  # optional packages that the attack needs
    family: str = ""  # the attacker with a distortion budget, who chooses the best attack of this family for each mark

    def suspects(self, mesh: Mesh, seed: int) -> list[Mesh]:
        """Attack a mesh, or refuse it; `OVERWRITTEN` needs the method itself and is not made here."""
        return [attack(mesh, self.kind, self.strength, seed=self.copies * seed + copy) for copy in range(self.copies)]

    def missing(self) -> str:
        """Return a message that names a missing package; it is empty if all packages are installed."""
        absent = [name for name in self.needs if find_spec(name) is None]
        return f"{absent[0]} is missing: pip install 'jaxmark[{_EXTRAS.get(absent[0], 'attacks')}]'" if absent else ""


class Track(NamedTuple):
    """A set of attacks, and sets of limits on the distortion by a mark."""

    limits: Mapping[str, Mapping[str, float]]  # limits by metric; an empty set means the limits of hidden marks
    lines: Mapping[str, Line]

    def bounds(self, limits: str, mesh: Mesh) -> Mapping[str, float]:
        """Return a set of limits for a mesh, by its name."""
        return self.limits[limits] or {**visibility_of(mesh)["hidden"], "max": _MAX_DISPLACEMENT}


def posed(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Apply the protocol's similarity: a shift of up to 5 mean radii per axis, any rotation, a scale from 0.1 to 10."""
    vertices = np.asarray(mesh.vertices)
    radius = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()
    axis = random.normal(size=3)
    turn = Rotation.from_rotvec(random.uniform(0, 2 * np.pi) * axis / np.linalg.norm(axis))
    return Mesh(turn.apply(random.uniform(0.1, 10) * vertices) + radius * random.uniform(-5, 5, 3), mesh.faces)


def _lines(kind: str, strengths: Sequence[float], *published: str, **options: Any) -> dict[str, Line]:
    """Make lines of one kind; published rates of a method are lists of numbers: perceptual / geometric."""
    columns = [
        [tuple(map(float, pair)) for pair in zip(*map(str.split, text.split("/")), strict=True)] for text in published
    ]
    rates = zip(*columns, strict=True) if columns else [()] * len(strengths)
    return {
        f"{kind} {strength:g}": Line(kind, strength, *pairs, **options)
        for strength, pairs in zip(strengths, rates, strict=True)
    }


_MESHLAB, _ISO, _EDGES = ("pymeshlab",), ("skimage", "igl"), ("fast_simplification",)

# The published rates are from the result page of the protocol, for the model Venus.
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
    **_lines("simplification", (0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.975), needs=_EDGES),
    **_lines("cropping", (0.1, 0.3, 0.5), copies=CROPS, in_place=False),
}

LINES_2026: Mapping[str, Line] = {
    "none": Line("noise", 0),
    **_lines("iso-surface", (150, 70), needs=_ISO),
    **_lines("isotropic", (0.7, 1, 1.4), needs=_MESHLAB),
    **_lines("poisson", (7, 6), needs=_MESHLAB),
    **_lines("warp", (0.005, 0.02)),
    **_lines("bending", (10,)),
    **_lines("twisting", (10,)),
    **_lines("arap", (0.1,), needs=("igl",)),
    "remesh-smooth-remesh": Line(composed.REMESH_SMOOTH_REMESH, 10, needs=_MESHLAB),
    "mirror": Line(composed.MIRROR, 0, in_place=False),
    "mirror, retriangulated": Line(composed.MIRROR, 0.3, in_place=False),
    "mirror, remeshed": Line(composed.MIRROR_REMESHED, 1, in_place=False, needs=_MESHLAB),
    "decimated to 4 %, 2 Loop": Line(composed.DECIMATE_LOOP, 0.96, needs=_EDGES),
    "decimated to 20 %, 1 Loop": Line(composed.DECIMATE_LOOP, 0.8, needs=_EDGES),
    "print and scan 0.1 mm": Line(composed.PRINT_SCAN, 0.1, in_place=False, needs=(*_ISO, *_MESHLAB)),
    "slicer": Line(composed.SLICER, 5, in_place=False),
    "Draco 14": Line(composed.DRACO, 14, needs=("DracoPy",)),
    "Draco 11": Line(composed.DRACO, 11, needs=("DracoPy",)),
    "glTF quantised 16": Line(composed.GLTF, 16),
    "glTF quantised 12": Line(composed.GLTF, 12),
    "grafted 0.5": Line(composed.GRAFT, 0.5, copies=CROPS, in_place=False),
    **_lines("mosaic", (0.1,), in_place=False),
    OVERWRITTEN: Line(OVERWRITTEN, 1),
    **{
        f"attacker, MSDM2 {budget:g}: {kind}": Line(
            composed.to_budget(kind), budget, needs=("igl",), family=f"attacker, MSDM2 {budget:g}"
        )
        for budget in (0.3, 0.5)
        for kind in composed.CHOICES
    },
}

#: The tracks by their names.
TRACKS: Mapping[str, Track] = {
    "smi2010": Track({"perceptual": {"mrms": 8e-4, "msdm": 0.20}, "geometric": {"mrms": 2e-4, "msdm": 0.30}}, PROTOCOL),
    "2026": Track({"hidden": {}}, LINES_2026),
}


def get_track(name: str) -> Track:
    """Return a track by its name, or raise `JaxmarkError`."""
    if name not in TRACKS:
        raise JaxmarkError(f"There is no track {name!r}; there are {', '.join(TRACKS)}.")
    return TRACKS[name]
