"""What happens to objects outside of a modelling tool, composed of the library's attacks; host side."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.adversaries.by_name import attack, chain
from jaxmark.attacks import Attack
from jaxmark.attacks.remeshing import apply_filter
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, compact, diagonal, face_normals

_SIZE = 100.0  # mm, the longest side of an object that is printed
_SCAN_NOISE, _SCAN_LENGTH = 0.05, 2.0  # mm: its standard deviation, and how far it is correlated
_SCAN_COVERAGE, _SCAN_POINTS, _SCAN_DEPTH = 0.8, 200_000, 8
_SCAN_REACH = 1.5  # mm from a scanned point up to which a surface is believed
_WAVES = 256  # of which correlated noise is the sum

Points = Float64[np.ndarray, "points 3"]


def _seed(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


def _remesh_smooth_remesh(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    return chain(mesh, [("isotropic", 1), ("taubin", strength), ("isotropic", 1)], seed=_seed(random))


def _mirror(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """The mirror image in any pose, with a share of its edges flipped."""
    vertices = Rotation.random(rng=random).apply(np.asarray(mesh.vertices) * [-1, 1, 1])
    mirrored = Mesh(vertices, np.asarray(mesh.faces)[:, ::-1].copy())
    return attack(mirrored, "edge-flips", strength, seed=_seed(random)) if strength else mirrored


def _mirror_remeshed(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    return attack(_mirror(mesh, 0, random), "isotropic", strength, seed=_seed(random))


def _decimate_loop(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Simplified, and subdivided until there are nearly as many vertices again."""
    steps = max(round(-np.log(1 - strength) / np.log(4)), 1)
    return chain(mesh, [("simplification", strength), ("loop", steps)], seed=_seed(random))


def _print_scan(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Printed in layers of so many mm at 10 cm, and scanned: noise, a fifth unseen, and a surface of the points."""
    import trimesh  # takes long to import

    mesh = compact(mesh)
    unit = float(np.ptp(mesh.vertices, axis=0).max()) / _SIZE
    vertices = Rotation.random(rng=random).apply(np.asarray(mesh.vertices, np.float64) / unit)
    surface = trimesh.Trimesh(vertices, np.asarray(mesh.faces), process=False)
    points, face = trimesh.sample.sample_surface(surface, _SCAN_POINTS, seed=random)[:2]
    normals = face_normals(Mesh(vertices, mesh.faces))[face]
    points = np.array(points)
    points[:, 2] = strength * np.round(points[:, 2] / strength)
    points += normals * _SCAN_NOISE * _correlated(points, _SCAN_LENGTH, random)[:, None]
    away = np.linalg.norm(points - points[random.integers(len(points))], axis=1)
    seen = away >= np.quantile(away, 1 - _SCAN_COVERAGE)
    name = "generate_surface_reconstruction_screened_poisson"
    scanned = apply_filter(name, Mesh(points[seen], mesh.faces), normals[seen], depth=_SCAN_DEPTH, threads=1)
    near = KDTree(points[seen]).query(np.asarray(scanned.vertices))[0] <= _SCAN_REACH
    faces = np.asarray(scanned.faces)
    return compact(Mesh(np.asarray(scanned.vertices), faces[near[faces].all(axis=1)]))


def _correlated(points: Points, length: float, random: np.random.Generator) -> Float64[np.ndarray, " points"]:
    """Noise of unit variance at points, of Gaussian covariance exp(-d²/2 length²): a sum of random waves."""
    waves, phases = random.normal(size=(3, _WAVES)) / length, random.uniform(0, 2 * np.pi, _WAVES)
    total = np.zeros(len(points))
    for wave, phase in zip(waves.T, phases, strict=True):
        total += np.cos(points @ wave + phase)
    return total * np.sqrt(2 / _WAVES)


def _slicer(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Through a slicer: turned, set down in mm, as STL, and out again as text with so many digits, in another order."""
    vertices = Rotation.random(rng=random).apply(np.asarray(mesh.vertices, np.float64))
    vertices *= _SIZE / np.ptp(vertices, axis=0).max()
    laid = Mesh(vertices - [*vertices.mean(axis=0)[:2], vertices[:, 2].min()], mesh.faces)
    return chain(laid, [("soup", 1), ("digits", strength), ("reordering", 1)], seed=_seed(random))


def _draco(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Through Draco, with so many bits for a coordinate."""
    draco = require("DracoPy", "files")
    points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    coded = draco.encode(points.astype(np.float32), faces.astype(np.uint32), quantization_bits=int(strength))
    found = draco.decode(coded)
    return Mesh(np.asarray(found.points, np.float64).reshape(-1, 3), np.asarray(found.faces, np.int64).reshape(-1, 3))


def _gltf(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """As `KHR_mesh_quantization` and its tools leave a mesh: whole numbers, single precision, another order."""
    return chain(mesh, [("quantisation", strength), ("float-bits", 32), ("reordering", 1)], seed=_seed(random))


def _graft(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """What is left beyond a plane, grown into another model that takes the place of what is lost."""
    kept = attack(mesh, "cropping", strength, seed=_seed(random))
    whole, left = np.asarray(mesh.vertices), np.asarray(kept.vertices)
    lost = (whole.sum(axis=0) - left.sum(axis=0)) / max(len(whole) - len(left), 1)
    other = asteroid(max(len(mesh.vertices) // 2, 500), seed=_seed(random))
    scale = 0.6 * diagonal(mesh) / diagonal(other)
    placed = lost + scale * Rotation.random(rng=random).apply(np.asarray(other.vertices))
    return Mesh(np.concatenate([left, placed]), np.concatenate([kept.faces, len(left) + np.asarray(other.faces)]))


#: What an attacker chooses from, each with strengths of rising severity.
CHOICES: Mapping[str, Sequence[float]] = {
    "noise": tuple(np.geomspace(1e-5, 0.1, 64)),
    "smoothing": tuple(np.unique(np.geomspace(1, 1000, 48).astype(int))),
    "low-pass": tuple(np.linspace(0.02, 0.98, 49)),
    "jamming": tuple(np.geomspace(1e-6, 0.02, 64)),
    "quantisation": tuple(range(16, 3, -1)),
}


def _attacked_to(kind: str, mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """As strongly as a difference of structure (MSDM2) allows, found by bisection of the strengths in `CHOICES`."""
    reference, seed, found = Reference(mesh), _seed(random), None
    held, broken = -1, len(CHOICES[kind])
    while broken - held > 1:
        middle = (held + broken) // 2
        tried = attack(mesh, kind, float(CHOICES[kind][middle]), seed=seed)
        if (reference.measure(tried, ["msdm2"])["msdm2"] or 0.0) <= strength:
            held, found = middle, tried
        else:
            broken = middle
    if found is None:
        raise JaxmarkError(f"Even the weakest {kind} exceeds an MSDM2 of {strength:g} on this mesh.")
    return found


def _host(apply: Callable[[Mesh, float, np.random.Generator], Mesh], unit: str, *strengths: float) -> Attack:
    return Attack(apply, unit, strengths, host=True, faces=True)


REMESH_SMOOTH_REMESH = _host(_remesh_smooth_remesh, "pairs of steps between two remeshings", 10)
MIRROR = _host(_mirror, "share of the edges", 0, 0.3)
MIRROR_REMESHED = _host(_mirror_remeshed, "edge length over the mean one", 1)
DECIMATE_LOOP = _host(_decimate_loop, "share of the edges, before subdivision", 0.8, 0.96)
PRINT_SCAN = _host(_print_scan, "mm of a layer at 10 cm", 0.1)
SLICER = _host(_slicer, "significant digits", 5)
DRACO = _host(_draco, "bits per coordinate", 14, 11)
GLTF = _host(_gltf, "bits per coordinate", 16, 12)
GRAFT = _host(_graft, "share of the vertices that another model replaces", 0.5)


def to_budget(kind: str) -> Attack:
    """An attack that is as strong as its own difference of structure allows."""

    def attacked(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
        return _attacked_to(kind, mesh, strength, random)

    return _host(attacked, "MSDM2", 0.3, 0.5)
