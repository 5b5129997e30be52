"""A non-blind mark in the 20 lowest harmonics of a surface, after a public tool (Forensic 3D Watermarking Suite).

The mark is a displacement along normals by a keyed pattern in the lowest eigenvectors of the cotangent Laplacian. The
reader registers the original to the suspect by principal axes and closest vertices. It analyses the differences between
nearest vertices, and confirms the mark if their coefficients have a correlation of at least 0.15 with the pattern.
There is no message. The tool is by archtecgr; it is reimplemented here as a carrier and a detector of jaxmark.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy import sparse
from scipy.sparse import linalg
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.alignment.observation import observe
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import require
from jaxmark.geometry.mesh import Mesh, vertex_normals, weld, weld_mesh
from jaxmark.spectral.precision import einsum, matmul
from jaxmark.watermark.carriers import ModulatedCarrier
from jaxmark.watermark.perception.budget import Bounds, displace_within
from jaxmark.watermark.reading.detectors import correlate

HARMONICS = 20
THRESHOLD = 0.15  # least correlation of a detected mark
_MAX_VARIANCE_RATIO = 0.7  # largest ratio of the extreme principal variances at which all variances are equalised
_MAX_DISTANCE = 0.05  # largest mean distance of nearest vertices; other suspects are assumed to be another shape
_MIN_SHARE = 0.1  # least RMS difference of a suspect, as a fraction of the mark's largest displacement
_MAX_ROUNDS, _TOLERANCE = 100, 1e-6  # rounds of closest points, and change of their mean distance at which they end

Points = Float64[np.ndarray, "points 3"]


class Harmonics(NamedTuple):
    """Displacements along normals by eigenvectors: `jaxmark.watermark.carriers.components.Components` with D = 1."""

    vectors: Float[Array, "vertices bands"]
    normals: Float[Array, "vertices 3"]

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """The inner products of bands, for each coordinate."""
        return einsum("vj,vc,vk->cjk", self.vectors, self.normals**2, self.vectors)

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """Compute the displacement for amplitudes."""
        return self.normals * matmul(self.vectors, amplitudes)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """Apply the adjoint of `synthesise`."""
        return matmul(self.vectors.T, self.normals * residual)


def harmonics(mesh: Mesh, count: int = HARMONICS) -> Float64[np.ndarray, "points bands"]:
    """Compute the lowest eigenvectors of the cotangent matrix, except the constant one."""
    matrix = -sparse.csc_array(require("igl", "align").cotmatrix(*mesh))
    start = np.cos(np.arange(len(mesh.vertices), dtype=float))
    values, vectors = linalg.eigsh(matrix, count + 1, sigma=-1e-8, v0=start)
    return vectors[:, np.argsort(values)[1:]]


def carrier(vectors: Float[np.ndarray, "points bands"], mesh: Mesh) -> ModulatedCarrier:
    """Make a carrier whose code bits are amplitudes of eigenvectors."""
    components = Harmonics(jnp.asarray(vectors), jnp.asarray(vertex_normals(mesh), vectors.dtype))
    return ModulatedCarrier(components, np.eye(vectors.shape[1], dtype=np.int8)[:, :, None])


@dataclass(frozen=True, eq=False)
class HarmonicMark:
    """A pattern in the harmonics of an original."""

    original: Original
    points: Mesh  # the original's welded points, in its units
    vectors: Float64[np.ndarray, "points bands"]
    pattern: Float64[np.ndarray, " bands"]  # unit vector

    def embed(self, bounds: Bounds) -> Mesh:
        """Embed as strongly as bounds allow; the tool itself embeds with at most 1/200 of the mean edge length."""
        shift = self._carrier(self.points).displacement(jnp.asarray(self.pattern, jnp.float32))
        return displace_within(self.original, np.asarray(shift, np.float64), bounds).mesh

    def correlation(self, suspect: Mesh, expected: float) -> float:
        """Correlate the differences of a suspect with the pattern; returns 0 if the suspect is another shape.

        Args:
            suspect: any mesh.
            expected: the mark's largest displacement, as a fraction of the original's diagonal.
        """
        target = normalised(np.asarray(weld_mesh(suspect, weld(suspect.vertices)).vertices))
        points, distance = register(normalised(np.asarray(self.points.vertices)), target)
        if distance > _MAX_DISTANCE:
            return 0.0
        # The tool compares nearest vertices, not nearest points of the surface.
        difference = target[KDTree(target).query(points)[1]] - points
        aligned = Mesh(points, self.points.faces)
        along = np.sum(difference * vertex_normals(aligned), axis=1)
        scale = self.original.diagonal / _rms_radius(np.asarray(self.points.vertices))
        if np.sqrt(np.mean(along**2)) < _MIN_SHARE * expected * scale:
            return 0.0
        amplitudes = correlate(self._carrier(aligned).reader(), observe(jnp.asarray(difference, jnp.float32)))
        return float(np.corrcoef(np.asarray(amplitudes, np.float64), self.pattern)[0, 1])

    def _carrier(self, points: Mesh) -> ModulatedCarrier:
        return carrier(self.vectors.astype(np.float32), points)


def make_mark(mesh: Mesh, key: Iterable[int]) -> HarmonicMark:
    """Draw a random pattern for an original; the bytes of the key are the seed of NumPy's generator."""
    original = make_original(mesh)
    points = weld_mesh(mesh, original.weld)
    pattern = np.random.default_rng(list(key)).normal(size=HARMONICS)
    return HarmonicMark(original, points, harmonics(points), pattern / np.linalg.norm(pattern))


def normalised(points: Points) -> Points:
    """Centre points and scale them to unit RMS radius; if principal variances differ much, make them equal."""
    centred = points - points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(centred.T))
    if variance[0] <= _MAX_VARIANCE_RATIO * variance[2]:
        centred = centred @ axes / np.sqrt(np.maximum(variance, 1e-12)) @ axes.T
    return centred / _rms_radius(centred)


def register(points: Points, target: Points) -> tuple[Points, float]:
    """Rotate and shift points by iterative closest vertices; returns the points and their mean distance."""
    tree, before = KDTree(target), np.inf
    for _ in range(_MAX_ROUNDS):
        distance, nearest = tree.query(points)
        closest = target[nearest]
        turn = Rotation.align_vectors(closest - closest.mean(axis=0), points - points.mean(axis=0))[0]
        points = turn.apply(points - points.mean(axis=0)) + closest.mean(axis=0)
        if abs(before - distance.mean()) < _TOLERANCE:
            break
        before = distance.mean()
    return points, float(before)


def _rms_radius(points: Points) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
