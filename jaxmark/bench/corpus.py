"""The corpus: meshes by formula, and some that other packages ship; made by one command, and known by their hashes."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmark.adversaries.by_name import attack
from jaxmark.bench import forms
from jaxmark.bench.shapes import SHAPES, torus
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry import asteroid
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, make_mesh

_DIGITS = 6  # after the point, of coordinates: what processors compute differently is cut off


class Member(NamedTuple):
    """A mesh of the corpus."""

    kind: str  # scan, CAD, organic, symmetric, noisy or components
    vertices: int  # about how many
    make: Callable[[], Mesh]


def _by_formula() -> Iterator[tuple[str, Member]]:
    for name, size in zip(SHAPES, (1_000, 3_000, 5_000, 10_000, 8_000, 6_000, 20_000), strict=True):
        yield name.replace("_", "-"), Member("CAD", size, partial(SHAPES[name], size))
    for name, size in (("1k", 1_000), ("3k", 3_000), ("10k", 10_000), ("30k", 30_000), ("100k", 100_000)):
        yield f"asteroid-{name}", Member("scan", size, partial(asteroid, size, seed=size % 97))
    for seed, size in ((1, 2_000), (2, 6_000), (3, 15_000), (4, 40_000)):
        yield f"creature-{seed}", Member("organic", size, partial(forms.creature, size, seed))
    for power, size in ((0.8, 5_000), (1.5, 3_000), (6.0, 8_000)):
        yield f"superquadric-{power:g}", Member("symmetric", size, partial(forms.superquadric, size, power))
    for fold, sharp, size in ((3, 4.0, 5_000), (5, 2.5, 9_000), (8, 1.5, 12_000)):
        yield f"supershape-{fold}", Member("symmetric", size, partial(forms.supershape, size, fold, sharp))
    yield "trefoil", Member("organic", 6_000, partial(forms.knot, 6_000, 2, 3))
    yield "knot-5-2", Member("organic", 20_000, partial(forms.knot, 20_000, 5, 2))
    yield "seashell", Member("organic", 10_000, partial(forms.seashell, 10_000))
    yield "spring", Member("CAD", 7_000, partial(forms.spring, 7_000))
    yield "gear-20", Member("CAD", 9_600, partial(forms.gear, 9_600, 20))
    yield "gem", Member("CAD", 2_500, partial(forms.gem, 2_500, 5))
    yield "vase", Member("symmetric", 6_400, partial(forms.vase, 6_400))
    yield "terrain", Member("scan", 25_000, partial(forms.terrain, 25_000, 7))
    yield "scan-with-holes", Member("scan", 14_000, _scan_with_holes)
    yield "noisy-asteroid", Member("noisy", 8_000, lambda: forms.noisy(asteroid(8_000, seed=21), 0.004, 1))
    yield "noisy-box", Member("noisy", 6_000, lambda: forms.noisy(SHAPES["rounded_box"](6_000), 0.003, 2))
    yield "chain-12", Member("components", 12_000, partial(forms.chain, 12_000, 12))
    yield "rubble-18", Member("components", 18_000, partial(forms.rubble, 18_000, 18))
    yield "torus-1m", Member("symmetric", 1_000_000, partial(torus, 1_000_000))


def _scan_with_holes() -> Mesh:
    return attack(asteroid(16_000, seed=11), "holes", 0.1, seed=3)


#: Files in the wheel of pymeshlab, of the extra `attacks`.
_SHIPPED = {
    "cow": ("organic", 2_900, "cow.obj"),
    "airplane": ("CAD", 7_000, "airplane.obj"),
    "bone": ("scan", 1_900, "bone.ply"),
    "bunny-10k": ("scan", 5_000, "bunny10k_textured.obj"),
    "bunny": ("scan", 28_000, "bunny.obj"),
}


def _shipped() -> Iterator[tuple[str, Member]]:
    spec = find_spec("pymeshlab")
    if spec is None or spec.origin is None:
        return
    folder = Path(spec.origin).parent / "tests" / "sample_meshes"
    for name, (kind, size, file) in _SHIPPED.items():
        if (folder / file).is_file():
            yield name, Member(kind, size, partial(load_mesh, folder / file))


def corpus() -> dict[str, Member]:
    """The meshes of the corpus by their names: those by formula, and those whose packages are installed."""
    return {**dict(_by_formula()), **dict(_shipped())}


def make_member(member: Member) -> Mesh:
    """Make a mesh of the corpus, the same on every machine but for the last digit."""
    mesh = member.make()
    return make_mesh(np.round(np.asarray(mesh.vertices, np.float64), _DIGITS) + 0.0, forms.sorted_faces(mesh))


def known_hashes() -> Mapping[str, str]:
    """The hash of each mesh as it was made for this version, see `jaxmark.geometry.canonical.geometry_hash`."""
    return json.loads(resources.files("jaxmark.bench").joinpath("corpus.json").read_text())


def make_corpus(
    folder: str | os.PathLike[str],
    *,
    most_vertices: int = 1_000_000,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, str]:
    """Write the meshes of the corpus as PLY files, with `hashes.json`.

    Args:
        folder: where to; it is made if it does not exist.
        most_vertices: larger meshes are left out.
        say: function that is called with a line for each mesh.

    Returns:
        The hash of each mesh's geometry, by its name.

    Raises:
        JaxmarkError: if the folder cannot be written.
    """
    target, known, found = Path(folder), known_hashes(), {}
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"The folder {target} cannot be made: {error.strerror}.") from None
    for name, member in corpus().items():
        if member.vertices > most_vertices:
            continue
        mesh = make_member(member)
        save_mesh(mesh, target / f"{name}.ply")
        found[name] = geometry_hash(mesh).hex()
        same = "as known" if known.get(name) == found[name] else "ANOTHER HASH THAN KNOWN" if name in known else "new"
        say(f"{name}: {len(mesh.vertices)} vertices, {member.kind}, {same}")
    (target / "hashes.json").write_text(json.dumps(found, indent=1) + "\n")
    return found
