"""An informed mark in the 20 lowest harmonics of a surface, as a public tool has it (Forensic 3D Watermarking Suite).

A keyed pattern in the lowest eigenvectors of the cotangent Laplacian is added as displacement along normals. The reader
registers the original to the suspect by principal axes and closest vertices, and confirms the mark where the
coefficients of the differences between nearest vertices correlate with the pattern by 0.15 or more. Reimplemented
as a carrier and a detector of jaxmark; there is no message. The tool is by archtecgr.
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
THRESHOLD = 0.15  # of the correlation
_MAX_VARIANCE_RATIO = 0.7  # of the extreme principal axes, up to which they are evened out
_MAX_DISTANCE = 0.05  # mean distance of nearest vertices beyond which the suspect is another shape
_MIN_SHARE = 0.1  # of the mark's displacement that must be there
_MAX_ROUNDS, _TOLERANCE = 100, 1e-6  # of closest points

Points = Float64[np.ndarray, "points 3"]


class Harmonics(NamedTuple):
    """Eigenvectors along normals as `jaxmark.watermark.carriers.components.Components`, with D = 1."""

    vectors: Float[Array, "vertices bands"]
    normals: Float[Array, "vertices 3"]

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """The inner products of bands, by coordinate."""
        return einsum("vj,vc,vk->cjk", self.vectors, self.normals**2, self.vectors)

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """The displacement of amplitudes."""
        return self.normals * matmul(self.vectors, amplitudes)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """The adjoint of `synthesise`."""
        return matmul(self.vectors.T, self.normals * residual)


def harmonics(mesh: Mesh, count: int = HARMONICS) -> Float64[np.ndarray, "points bands"]:
    """Compute the lowest eigenvectors of the cotangent matrix, without the constant."""
    matrix = -sparse.csc_array(require("igl", "align").cotmatrix(*mesh))
    start = np.cos(np.arange(len(mesh.vertices), dtype=float))
    values, vectors = linalg.eigsh(matrix, count + 1, sigma=-1e-8, v0=start)
    return vectors[:, np.argsort(values)[1:]]


def carrier(vectors: Float[np.ndarray, "points bands"], mesh: Mesh) -> ModulatedCarrier:
    """Make a carrier whose "bits" are amplitudes of eigenvectors."""
    components = Harmonics(jnp.asarray(vectors), jnp.asarray(vertex_normals(mesh), vectors.dtype))
    return ModulatedCarrier(components, np.eye(vectors.shape[1], dtype=np.int8)[:, :, None])


@dataclass(frozen=True, eq=False)
class HarmonicMark:
    """A pattern in the harmonics of an original."""

    original: Original
    points: Mesh  # the original's, in its units
    vectors: Float64[np.ndarray, "points bands"]
    pattern: Float64[np.ndarray, " bands"]  # of length 1

    def embed(self, bounds: Bounds) -> Mesh:
        """Embed as strongly as bounds allow; the tool itself takes a 200th of the mean edge length at most."""
        shift = self._carrier(self.points).displacement(jnp.asarray(self.pattern, jnp.float32))
        return displace_within(self.original, np.asarray(shift, np.float64), bounds).mesh

    def correlation(self, suspect: Mesh, expected: float) -> float:
        """Correlate the differences of a suspect with the pattern; 0 where it is another shape.

        Args:
            suspect: any mesh.
            expected: the mark's largest displacement, over the original's diagonal.
        """
        target = normalised(np.asarray(weld_mesh(suspect, weld(suspect.vertices)).vertices))
        points, distance = register(normalised(np.asarray(self.points.vertices)), target)
        if distance > _MAX_DISTANCE:
            return 0.0
        # Nearest vertices, as the tool compares them, not nearest points of the surface.
        difference = target[KDTree(target).query(points)[1]] - points
        aligned = Mesh(points, self.points.faces)
        along = np.sum(difference * vertex_normals(aligned), axis=1)
        scale = self.original.diagonal / _rms_radius(np.asarray(self.points.vertices))
        if np.sqrt(np.mean(along**2)) < _MIN_SHARE * expected * scale:
            return 0.0
        found = correlate(self._carrier(aligned).reader(), observe(jnp.asarray(difference, jnp.float32)))
        return float(np.corrcoef(np.asarray(found, np.float64), self.pattern)[0, 1])

    def _carrier(self, points: Mesh) -> ModulatedCarrier:
        return carrier(self.vectors.astype(np.float32), points)


def make_mark(mesh: Mesh, key: Iterable[int]) -> HarmonicMark:
    """Draw a random pattern for an original; the bytes of the key seed NumPy's generator."""
    original = make_original(mesh)
    points = weld_mesh(mesh, original.weld)
    pattern = np.random.default_rng(list(key)).normal(size=HARMONICS)
    return HarmonicMark(original, points, harmonics(points), pattern / np.linalg.norm(pattern))


def normalised(points: Points) -> Points:
    """Centre points and scale them to unit RMS radius; even out principal axes that differ much."""
    centred = points - points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(centred.T))
    if variance[0] <= _MAX_VARIANCE_RATIO * variance[2]:
        centred = centred @ axes / np.sqrt(np.maximum(variance, 1e-12)) @ axes.T
    return centred / _rms_radius(centred)


def register(points: Points, target: Points) -> tuple[Points, float]:
    """Turn and shift points by iterative closest vertices, and return them with their mean distance."""
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
