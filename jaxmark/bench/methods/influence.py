"""Praun, Hoppe, Finkelstein, "Robust mesh watermarking", SIGGRAPH 1999, 69-76.

The mark is a vector of normal random numbers. Each number is the height of a basis function, which displaces a sphere
of influence of the surface along one direction; few spheres are large, and many are small. The reader registers a
suspect to the original, resamples it at the original's vertices, fits the vector by least squares, and correlates it
with the vector of the key. The p-value of the correlation is exact, because the key's numbers are normal and
independent of the suspect.

This implementation differs from the publication, or fills gaps of it, as follows.

- The centres of the spheres are farthest points along edges, instead of the vertex splits of a progressive mesh. The
  radius of a sphere is the distance of its centre from all centres before it.
- The basis functions are the publication's hat, a raised cosine, along the normal at the centre, all of equal height.
- Registration and resampling are those of this library. Because registration may have fitted an affine map to the mark
  itself, an affine map is fitted together with the vector.
- The publication's mark shows presence only. Here a message divides the vector into one part per bit, and the bit is
  the sign of its part. The p-value is that of the sum of the parts' squared correlations, which without a mark are
  squares of independent normal numbers.
"""

import math

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse, stats
from scipy.sparse import csgraph

from jaxmark.alignment.original import displace
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import choices, normal
from jaxmark.bench.methods.shared import aligned, once, prepared
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, edges, vertex_normals

SOURCE = "Praun, Hoppe, Finkelstein, SIGGRAPH 1999"
_MIN_SPHERES, _SPHERES_PER_BIT = 128, 4
_RIDGE = 1e-9  # ridge of the normal equations, as a fraction of the mean of their diagonal

Basis = sparse.csr_array  # `[3 · points, spheres]`; the three coordinates of a point are adjacent


def influence(bits: int) -> Method:
    """Make the method; its strength is the standard deviation of a basis function's height, over the diagonal.

    Args:
        bits: payload in bits; 0 shows presence only, as in the publication.
    """
    count, parts = max(_MIN_SPHERES, _SPHERES_PER_BIT * bits), max(bits, 1)

    def vector(key: bytes) -> tuple[Float64[np.ndarray, " spheres"], Int64[np.ndarray, " spheres"]]:
        """Return the key's numbers, and the bit that each number belongs to."""
        part = choices(key, "influence").permutation("parts", count) % parts
        return normal(key, "influence", "vector", count), part

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        host = prepared(mesh)
        drawn, part = vector(key)
        if bits:
            drawn = np.where(np.asarray(message, bool)[part], drawn, -drawn)
        shift = np.zeros((len(host.used), 3))
        shift[host.used] = (once(_bumps, mesh, count) @ (strength * drawn)).reshape(-1, 3)
        return displace(host, shift)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        if original is None:
            raise JaxmarkError("The method influence is not blind; give the original.")
        host = prepared(original)
        try:
            alignment = aligned(original, suspect)
        except JaxmarkError:  # the suspect cannot be registered to the original
            return Reading(None, 0.0, 0.0)
        used = host.used
        affine = np.column_stack([host.positions[used], np.ones(used.sum())])  # displacements by affine maps
        columns = [once(_bumps, original, count), sparse.kron(sparse.csr_array(affine), np.eye(3))]
        directions = None if alignment.normals is None else alignment.normals[used]
        drawn, part = vector(key)
        bumps = sparse.csr_array(sparse.hstack(columns))
        fitted = _fit(bumps, alignment.displacement[used], alignment.weights[used], directions)[:count]
        length = np.sqrt(np.bincount(part, fitted**2, parts))
        correlation = np.bincount(part, fitted * drawn, parts) / np.where(length > 0, length, 1)
        if not bits:
            return Reading(None, float(correlation[0]), float(stats.norm.logsf(correlation[0])) / math.log(10))
        total = float((correlation**2).sum())
        return Reading(correlation > 0, total, float(stats.chi2.logsf(total, np.count_nonzero(length))) / math.log(10))

    return Method("influence", embed, read, False, bits, (1e-6, 0.1), SOURCE)


def _bumps(original: Mesh, count: int) -> Basis:
    return basis(compact(prepared(original).points), count)


def basis(mesh: Mesh, count: int) -> Basis:
    """Compute the displacements by basis functions of height 1; refuse a mesh with fewer points than spheres.

    The first centre is the farthest point from the first vertex. Every component of the mesh gets a centre.
    """
    points, pairs = np.asarray(mesh.vertices), edges(mesh.faces)
    if len(points) < count:
        raise JaxmarkError(f"There are {len(points)} points for {count} spheres of influence; write fewer bits.")
    length = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    graph = sparse.csr_array((length, (pairs[:, 0], pairs[:, 1])), (len(points),) * 2)
    graph = (graph + graph.T).tocsr()
    normals = vertex_normals(mesh)
    nearest = np.full(len(points), np.inf)
    centre = int(np.argmax(np.nan_to_num(csgraph.dijkstra(graph, indices=0), posinf=0)))
    rows, columns, values = [], [], []
    for number in range(count):
        reach = nearest[centre]
        distance = csgraph.dijkstra(graph, indices=centre, limit=reach)
        radius = max(reach if np.isfinite(reach) else np.nan_to_num(distance, posinf=0).max(), 1e-300)
        inside = np.flatnonzero(distance < radius)
        bump = (1 + np.cos(np.pi * distance[inside] / radius)) / 2
        rows.append((3 * inside[:, None] + np.arange(3)).ravel())
        columns.append(np.full(3 * len(inside), number))
        values.append((bump[:, None] * normals[centre]).ravel())
        nearest = np.minimum(nearest, distance)
        centre = int(np.argmax(nearest))
    data = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(data, (3 * len(points), count))


def _fit(
    bumps: Basis,
    residual: Float64[np.ndarray, "points 3"],
    weight: Float64[np.ndarray, " points"],
    directions: Float64[np.ndarray, "points 3"] | None,
) -> Float64[np.ndarray, " spheres"]:
    """Fit the vector to displacements by weighted least squares; with directions, only to components along them."""
    if directions is not None:
        place = np.arange(directions.size)
        along = sparse.csr_array((directions.ravel(), (place // 3, place)))
        bumps, residual = sparse.csr_array(along @ bumps), (directions * residual).sum(axis=1, keepdims=True)
    weights = np.repeat(weight, residual.shape[1])
    matrix = sparse.csr_array(bumps.T @ sparse.diags_array(weights) @ bumps).toarray()
    matrix += _RIDGE * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    return np.linalg.solve(matrix, bumps.T @ (weights * residual.ravel()))
