"""The benchmark's corpus: meshes by formula, and meshes from other packages, verified by hashes."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmark.adversaries.by_name import attack
from jaxmark.bench import parametric as shapes
from jaxmark.bench.parametric import SHAPES
from jaxmark.errors import JaxmarkError
from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry import asteroid
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, make_mesh

_DIGITS = 6  # decimals of coordinates; rounding removes the differences between processors


class Member(NamedTuple):
    """A mesh of the corpus."""

    kind: str  # scan, CAD, organic, symmetric, noisy or components
    vertices: int  # approximate number of vertices
    make: Callable[[], Mesh]


def _by_formula() -> Iterator[tuple[str, Member]]:
    def member(name: str, kind: str, make: Callable[..., Mesh], size: int, *options: float) -> tuple[str, Member]:
        return name, Member(kind, size, partial(make, size, *options))

    def attacked(make: Callable[[], Mesh], *how: Any, seed: int) -> Callable[[], Mesh]:
        return lambda: attack(make(), *how, seed=seed)

    for name, size in zip(SHAPES, (1_000, 3_000, 5_000, 10_000, 8_000, 6_000, 20_000), strict=True):
        yield member(name.replace("_", "-"), "CAD", SHAPES[name], size)
    for size in (1_000, 3_000, 10_000, 30_000, 100_000):
        yield f"asteroid-{size // 1000}k", Member("scan", size, partial(asteroid, size, seed=size % 97))
    for seed, size in ((1, 2_000), (2, 6_000), (3, 15_000), (4, 40_000)):
        yield member(f"creature-{seed}", "organic", shapes.creature, size, seed)
    for power, size in ((0.8, 5_000), (1.5, 3_000), (6.0, 8_000)):
        yield member(f"superquadric-{power:g}", "symmetric", shapes.superquadric, size, power)
    for fold, sharp, size in ((3, 4.0, 5_000), (5, 2.5, 9_000), (8, 1.5, 12_000)):
        yield member(f"supershape-{fold}", "symmetric", shapes.supershape, size, fold, sharp)
    yield member("trefoil", "organic", shapes.knot, 6_000, 2, 3)
    yield member("knot-5-2", "organic", shapes.knot, 20_000, 5, 2)
    yield member("seashell", "organic", shapes.seashell, 10_000)
    yield member("spring", "CAD", shapes.spring, 7_000)
    yield member("gear-20", "CAD", shapes.gear, 9_600, 20)
    yield member("gem", "CAD", shapes.gem, 2_500, 5)
    yield member("vase", "symmetric", shapes.vase, 6_400)
    yield member("terrain", "scan", shapes.terrain, 25_000, 7)
    scan, rock, box = partial(asteroid, 16_000, seed=11), partial(asteroid, 8_000, seed=21), shapes.rounded_box
    yield "scan-with-holes", Member("scan", 14_000, attacked(scan, "holes", 0.1, seed=3))
    yield "noisy-asteroid", Member("noisy", 8_000, attacked(rock, "gaussian-noise", 0.004, seed=1))
    yield "noisy-box", Member("noisy", 6_000, attacked(partial(box, 6_000), "gaussian-noise", 0.003, seed=2))
    yield member("chain-12", "components", shapes.chain, 12_000, 12)
    yield member("rubble-18", "components", shapes.rubble, 18_000, 18)
    yield member("torus-1m", "symmetric", shapes.torus, 1_000_000)


#: Files in the package pymeshlab, which the extra `attacks` installs.
_SHIPPED = {
    "cow": ("organic", 2_900, "cow.obj"),
    "airplane": ("CAD", 7_000, "airplane.obj"),
    "bone": ("scan", 1_900, "bone.ply"),
    "bunny-10k": ("scan", 5_000, "bunny10k_textured.obj"),
    "bunny": ("scan", 28_000, "bunny.obj"),
}


def corpus() -> dict[str, Member]:
    """Return the meshes of the corpus by their names: all by formula, and those of installed packages."""
    members, spec = dict(_by_formula()), find_spec("pymeshlab")
    if spec is not None and spec.origin is not None:
        for name, (kind, size, file) in _SHIPPED.items():
            path = Path(spec.origin).parent / "tests" / "sample_meshes" / file
            if path.is_file():
                members[name] = Member(kind, size, partial(load_mesh, path))
    return members


def make_member(member: Member) -> Mesh:
    """Make a mesh of the corpus, with rounded coordinates and faces in a canonical order: equal on every machine."""
    mesh = member.make()
    faces = np.asarray(mesh.faces, np.int64)
    least = np.argmin(faces, axis=1)  # each face begins with its vertex of least index
    faces = np.take_along_axis(faces, (least[:, None] + np.arange(3)) % 3, axis=1)
    vertices = np.round(np.asarray(mesh.vertices, np.float64), _DIGITS) + 0.0
    return make_mesh(vertices, faces[np.lexsort(faces.T[::-1])])


def known_hashes() -> Mapping[str, str]:
    """Return the hash of each mesh as this version makes it, see `jaxmark.geometry.canonical.geometry_hash`."""
    return json.loads(resources.files("jaxmark.bench").joinpath("corpus.json").read_text())


def make_corpus(
    folder: str | os.PathLike[str],
    *,
    most_vertices: int = 1_000_000,
    log: Callable[[str], None] = lambda line: None,
) -> dict[str, str]:
    """Write the meshes of the corpus as PLY files, and their hashes as `hashes.json`.

    Args:
        folder: folder for the files, which is created if it does not exist.
        most_vertices: meshes with more vertices are left out.
        log: callback, called with a line for each mesh.

    Returns:
        The hash of each mesh's geometry, by its name.

    Raises:
        JaxmarkError: if the folder cannot be written.
    """
    target, expected, hashes = Path(folder), known_hashes(), {}
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"The folder {target} cannot be created: {error.strerror}.") from None
    for name, member in corpus().items():
        if member.vertices > most_vertices:
            continue
        mesh = make_member(member)
        save_mesh(mesh, target / f"{name}.ply")
        hashes[name] = geometry_hash(mesh).hex()
        if expected.get(name) == hashes[name]:
            check = "expected hash"
        else:
            check = "UNEXPECTED HASH" if name in expected else "new"
        log(f"{name}: {len(mesh.vertices)} vertices, {member.kind}, {check}")
    (target / "hashes.json").write_text(json.dumps(hashes, indent=1) + "\n")
    return hashes
