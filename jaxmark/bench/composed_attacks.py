"""Attacks of the track `2026` that are composed of several attacks of the library; on the host."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.adversaries.by_name import attack, chain
from jaxmark.attacks import Attack
from jaxmark.attacks.remeshing import apply_filter
from jaxmark.distortion import Reference
from jaxmark.errors import JaxmarkError, require
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, compact, diagonal, face_normals

_SIZE = 100.0  # longest side of a printed object, in mm
_SCAN_NOISE, _SCAN_LENGTH = 0.05, 2.0  # standard deviation and correlation length of the scan's noise, in mm
_SCAN_COVERAGE, _SCAN_POINTS, _SCAN_DEPTH = 0.8, 200_000, 8
_SCAN_REACH = 1.5  # largest distance of the reconstructed surface from a scanned point, in mm
_WAVES = 256  # number of waves that approximate correlated noise

Points = Float64[np.ndarray, "points 3"]


def _seed(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


def _remesh_smooth_remesh(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    return chain(mesh, [("isotropic", 1), ("taubin", strength), ("isotropic", 1)], seed=_seed(random))


def _mirror(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Reflect and rotate a mesh, and flip a fraction of its edges."""
    vertices = Rotation.random(rng=random).apply(np.asarray(mesh.vertices) * [-1, 1, 1])
    mirrored = Mesh(vertices, np.asarray(mesh.faces)[:, ::-1].copy())
    return attack(mirrored, "edge-flips", strength, seed=_seed(random)) if strength else mirrored


def _mirror_remeshed(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    return attack(_mirror(mesh, 0, random), "isotropic", strength, seed=_seed(random))


def _decimate_loop(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Simplify a mesh, and subdivide it until it has about as many vertices as before."""
    steps = max(round(-np.log(1 - strength) / np.log(4)), 1)
    return chain(mesh, [("simplification", strength), ("loop", steps)], seed=_seed(random))


def _print_scan(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Simulate a print of 10 cm with layers of `strength` mm, and a noisy scan that misses a fifth of the surface."""
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
    distance = np.linalg.norm(points - points[random.integers(len(points))], axis=1)
    covered = distance >= np.quantile(distance, 1 - _SCAN_COVERAGE)
    name = "generate_surface_reconstruction_screened_poisson"
    scanned = apply_filter(name, Mesh(points[covered], mesh.faces), normals[covered], depth=_SCAN_DEPTH, threads=1)
    near = KDTree(points[covered]).query(np.asarray(scanned.vertices))[0] <= _SCAN_REACH
    faces = np.asarray(scanned.faces)
    return compact(Mesh(np.asarray(scanned.vertices), faces[near[faces].all(axis=1)]))


def _correlated(points: Points, length: float, random: np.random.Generator) -> Float64[np.ndarray, " points"]:
    """Draw noise of unit variance at points, with the covariance exp(-d²/2 length²), as a sum of random waves."""
    waves, phases = random.normal(size=(3, _WAVES)) / length, random.uniform(0, 2 * np.pi, _WAVES)
    total = np.zeros(len(points))
    for wave, phase in zip(waves.T, phases, strict=True):
        total += np.cos(points @ wave + phase)
    return total * np.sqrt(2 / _WAVES)


def _slicer(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Simulate the export of a slicer: rotated, in mm, as STL, then as text with `strength` digits, and reordered."""
    vertices = Rotation.random(rng=random).apply(np.asarray(mesh.vertices, np.float64))
    vertices *= _SIZE / np.ptp(vertices, axis=0).max()
    placed = Mesh(vertices - [*vertices.mean(axis=0)[:2], vertices[:, 2].min()], mesh.faces)
    return chain(placed, [("soup", 1), ("digits", strength), ("reordering", 1)], seed=_seed(random))


def _draco(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    draco = require("DracoPy", "files")
    points, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
    decoded = draco.decode(draco.encode(points, faces, quantization_bits=int(strength)))
    vertices, corners = np.asarray(decoded.points, np.float64), np.asarray(decoded.faces, np.int64)
    return Mesh(vertices.reshape(-1, 3), corners.reshape(-1, 3))


def _gltf(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Quantise coordinates, convert them to single precision, and reorder, as tools for `KHR_mesh_quantization` do."""
    return chain(mesh, [("quantisation", strength), ("float-bits", 32), ("reordering", 1)], seed=_seed(random))


def _graft(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
    """Cut off a part of a mesh by a plane, and put another model in its place."""
    cropped = attack(mesh, "cropping", strength, seed=_seed(random))
    vertices, rest = np.asarray(mesh.vertices), np.asarray(cropped.vertices)
    removed_centre = (vertices.sum(axis=0) - rest.sum(axis=0)) / max(len(vertices) - len(rest), 1)
    other = asteroid(max(len(mesh.vertices) // 2, 500), seed=_seed(random))
    scale = 0.6 * diagonal(mesh) / diagonal(other)
    placed = removed_centre + scale * Rotation.random(rng=random).apply(np.asarray(other.vertices))
    return Mesh(np.concatenate([rest, placed]), np.concatenate([cropped.faces, len(rest) + np.asarray(other.faces)]))


#: The attacks of an attacker with a distortion budget, each with strengths of rising severity.
CHOICES: Mapping[str, Sequence[float]] = {
    "noise": tuple(np.geomspace(1e-5, 0.1, 64)),
    "smoothing": tuple(np.unique(np.geomspace(1, 1000, 48).astype(int))),
    "low-pass": tuple(np.linspace(0.02, 0.98, 49)),
    "jamming": tuple(np.geomspace(1e-6, 0.02, 64)),
    "quantisation": tuple(range(16, 3, -1)),
}


def last_within(count: int, within: Callable[[int], bool]) -> int:
    """Find the last of `count` places of rising severity that is within a limit, by bisection; -1 if none is."""
    low, high = -1, count
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if within(middle) else (low, middle)
    return low


def _host(apply: Callable[[Mesh, float, np.random.Generator], Mesh], unit: str, *strengths: float) -> Attack:
    return Attack(apply, unit, strengths, host=True, faces=True)


def to_budget(kind: str) -> Attack:
    """Make an attack whose strength is an MSDM2; bisection finds the strongest of `CHOICES` within this MSDM2."""

    def attacked(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
        reference, seed = Reference(mesh), _seed(random)

        def at(place: int) -> Mesh:
            return attack(mesh, kind, float(CHOICES[kind][place]), seed=seed)

        def within(place: int) -> bool:
            return (reference.measure(at(place), ["msdm2"])["msdm2"] or 0.0) <= strength

        if (last := last_within(len(CHOICES[kind]), within)) < 0:
            raise JaxmarkError(f"Even the weakest {kind} exceeds an MSDM2 of {strength:g} on this mesh.")
        return at(last)

    return _host(attacked, "MSDM2", 0.3, 0.5)


REMESH_SMOOTH_REMESH = _host(_remesh_smooth_remesh, "pairs of steps between two remeshings", 10)
MIRROR = _host(_mirror, "share of the edges", 0, 0.3)
MIRROR_REMESHED = _host(_mirror_remeshed, "edge length over the mean one", 1)
DECIMATE_LOOP = _host(_decimate_loop, "share of the edges, before subdivision", 0.8, 0.96)
PRINT_SCAN = _host(_print_scan, "mm of a layer at 10 cm", 0.1)
SLICER = _host(_slicer, "significant digits", 5)
DRACO = _host(_draco, "bits per coordinate", 14, 11)
GLTF = _host(_gltf, "bits per coordinate", 16, 12)
GRAFT = _host(_graft, "share of the vertices that another model replaces", 0.5)
