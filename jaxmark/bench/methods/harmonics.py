"""An informed mark in 20 harmonics of the surface: what a public tool does (Forensic 3D Watermarking Suite, archtecgr).

A keyed pattern in the lowest eigenvectors of the cotangent Laplacian, as displacement along normals. The reader brings
the original onto the suspect by principal axes and closest vertices, and confirms the mark where the coefficients of
what lies between nearest vertices correlate with the pattern by 0.15 or more. Written anew here as a carrier and a
detector of jaxmark, to stand beside the others; there is no message.
"""

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
from jaxmark.extras import require
from jaxmark.geometry.mesh import Mesh, vertex_normals, weld, weld_mesh
from jaxmark.spectral.precision import einsum, matmul
from jaxmark.watermark.carriers import ModulatedCarrier
from jaxmark.watermark.perception.budget import Bounds, displace_within
from jaxmark.watermark.reading.detectors import correlate

HARMONICS = 20
THRESHOLD = 0.15  # of the correlation
_LONG = 0.7  # ratio of variances along principal axes up to which they are evened out
_FAR = 0.05  # mean distance of nearest vertices beyond which the suspect is another shape
_LEAST = 0.1  # share of the mark's displacement that must be there
_ROUNDS, _STILL = 100, 1e-6  # of closest points

Points = Float64[np.ndarray, "points 3"]


class Harmonics(NamedTuple):
    """Eigenvectors along normals, as components of a carrier; D is 1."""

    vectors: Float[Array, "vertices bands"]
    normals: Float[Array, "vertices 3"]

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """See `jaxmark.watermark.carriers.modulated.Components`."""
        return einsum("vj,vc,vk->cjk", self.vectors, self.normals**2, self.vectors)

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`."""
        return self.normals * matmul(self.vectors, amplitudes)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`."""
        return matmul(self.vectors.T, self.normals * residual)


def harmonics(mesh: Mesh, count: int = HARMONICS) -> Float64[np.ndarray, "points bands"]:
    """The lowest eigenvectors of the cotangent matrix, the constant left out."""
    matrix = -sparse.csc_array(require("igl", "align").cotmatrix(*mesh))
    start = np.cos(np.arange(len(mesh.vertices), dtype=float))
    values, vectors = linalg.eigsh(matrix, count + 1, sigma=-1e-8, v0=start)
    return vectors[:, np.argsort(values)[1:]]


def carrier(vectors: Float[np.ndarray, "points bands"], mesh: Mesh) -> ModulatedCarrier:
    """Each "bit" is the amplitude of one eigenvector."""
    components = Harmonics(jnp.asarray(vectors), jnp.asarray(vertex_normals(mesh), vectors.dtype))
    return ModulatedCarrier(components, np.eye(vectors.shape[1], dtype=np.int8)[:, :, None])


@dataclass(frozen=True, eq=False)
class HarmonicMark:
    """A pattern in the harmonics of an original."""

    original: Original
    points: Mesh  # the original's, in its units
    vectors: Float64[np.ndarray, "points bands"]
    pattern: Float64[np.ndarray, " bands"]  # at length 1

    def embed(self, bounds: Bounds) -> Mesh:
        """As strong as bounds allow; the tool itself takes a 200th of the mean edge length at most."""
        made = carrier(self.vectors.astype(np.float32), self.points)
        shift = made.displacement(jnp.asarray(self.pattern, jnp.float32))
        return displace_within(self.original, np.asarray(shift, np.float64), bounds).mesh

    def correlation(self, suspect: Mesh, expected: float) -> float:
        """Of what the suspect shows with the pattern; 0 where the reader says beforehand that it is another shape.

        Args:
            suspect: any mesh.
            expected: the mark's largest displacement, over the original's diagonal.
        """
        there = normalised(np.asarray(weld_mesh(suspect, weld(suspect.vertices)).vertices))
        mine, off = brought(normalised(np.asarray(self.points.vertices)), there)
        if off > _FAR:
            return 0.0
        # Nearest vertices, as the tool compares them, not nearest points of the surface.
        difference = there[KDTree(there).query(mine)[1]] - mine
        aligned = Mesh(mine, self.points.faces)
        along = np.sum(difference * vertex_normals(aligned), axis=1)
        if np.sqrt(np.mean(along**2)) < _LEAST * expected * self.original.diagonal / _radius(
            np.asarray(self.points.vertices)
        ):
            return 0.0
        found = _read(carrier(self.vectors.astype(np.float32), aligned), difference)
        return float(np.corrcoef(found, self.pattern)[0, 1])


def make_mark(mesh: Mesh, seed: list[int]) -> HarmonicMark:
    """A random pattern on an original."""
    original = make_original(mesh)
    points = weld_mesh(mesh, original.weld)
    pattern = np.random.default_rng(seed).normal(size=HARMONICS)
    return HarmonicMark(original, points, harmonics(points), pattern / np.linalg.norm(pattern))


def normalised(points: Points) -> Points:
    """Centred at unit RMS, principal axes evened out before if they differ much."""
    centred = points - points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(centred.T))
    if variance[0] <= _LONG * variance[2]:
        centred = centred @ axes / np.sqrt(np.maximum(variance, 1e-12)) @ axes.T
    return centred / _radius(centred)


def brought(points: Points, onto: Points) -> tuple[Points, float]:
    """Turned and shifted by closest vertices, from where they are; and the mean distance that is left."""
    tree, before = KDTree(onto), np.inf
    for _ in range(_ROUNDS):
        distance, nearest = tree.query(points)
        target = onto[nearest]
        turn = Rotation.align_vectors(target - target.mean(axis=0), points - points.mean(axis=0))[0]
        points = turn.apply(points - points.mean(axis=0)) + target.mean(axis=0)
        if abs(before - distance.mean()) < _STILL:
            break
        before = distance.mean()
    return points, float(before)


def _read(made: ModulatedCarrier, difference: Points) -> np.ndarray:
    return np.asarray(correlate(made.reader(), observe(jnp.asarray(difference, jnp.float32))), np.float64)


def _radius(points: Points) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
