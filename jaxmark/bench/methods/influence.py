"""Praun, Hoppe, Finkelstein, "Robust mesh watermarking", SIGGRAPH 1999, 69-76.

A vector of normal random numbers is added to the shape, each along one direction and under a basis function of its own
on a sphere of influence of the surface: few large ones and many small ones. The reader registers a suspect to the
original, resamples it at the original's vertices, fits the vector by least squares, and correlates it with the key's.
As the key's numbers are normal and independent of the suspect, the p-value of a correlation is exact.

Chosen here, where the publication leaves it open or needs what is not here. Centres and radii of the spheres are those
of farthest points along the edges, each as far from all before it as its radius, instead of the vertex splits of a
progressive mesh. Basis functions are the publication's hat, a raised cosine, along the normal at the centre, all
equally high. Registration and resampling are the library's; an affine map, which they may have fitted to the mark
itself, is fitted together with the vector. The publication shows presence; a message divides the vector into a part
for each bit, which turns its sign, and the squares of the parts' correlations, a sum of independent squares of normal
numbers where there is no mark, give the p-value.
"""

import math

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse, stats
from scipy.sparse import csgraph

from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import displace, make_original
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import choices, normal
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, edges, vertex_normals

SOURCE = "Praun, Hoppe, Finkelstein, SIGGRAPH 1999"
_MIN_SPHERES, _SPHERES_PER_BIT = 128, 4
_RIDGE = 1e-9  # on the diagonal of the normal equations, over its mean

Basis = sparse.csr_array  # `[3 · points, spheres]`, the coordinates of each point together


def influence(bits: int) -> Method:
    """Spheres of influence; strengths are the standard deviation of a basis function's height, over the diagonal.

    Args:
        bits: of a message, or 0 to show presence alone, as published.
    """
    count, parts = max(_MIN_SPHERES, _SPHERES_PER_BIT * bits), max(bits, 1)

    def vector(key: bytes) -> tuple[Float64[np.ndarray, " spheres"], Int64[np.ndarray, " spheres"]]:
        """The key's numbers, and the bit that each belongs to."""
        part = choices(key, "influence").permutation("parts", count) % parts
        return normal(key, "influence", "vector", count), part

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        prepared = make_original(mesh)
        drawn, part = vector(key)
        if bits:
            drawn = np.where(np.asarray(message, bool)[part], drawn, -drawn)
        shift = np.zeros((len(prepared.used), 3))
        shift[prepared.used] = (basis(compact(prepared.points), count) @ (strength * drawn)).reshape(-1, 3)
        return displace(prepared, shift)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        if original is None:
            raise JaxmarkError("The method influence reads beside the original; give it.")
        prepared = make_original(original)
        try:
            found = align(prepared, suspect)
        except JaxmarkError:  # the suspect shows nothing of the original
            return Reading(None, 0.0, 0.0)
        used = prepared.used
        affine = np.column_stack([prepared.positions[used], np.ones(used.sum())])  # displacements by affine maps
        columns = [basis(compact(prepared.points), count), sparse.kron(sparse.csr_array(affine), np.eye(3))]
        known = None if found.normals is None else found.normals[used]
        drawn, part = vector(key)
        bumps = sparse.csr_array(sparse.hstack(columns))
        fitted = _fit(bumps, found.displacement[used], found.weights[used], known)[:count]
        length = np.sqrt(np.bincount(part, fitted**2, parts))
        correlation = np.bincount(part, fitted * drawn, parts) / np.where(length > 0, length, 1)
        if not bits:
            return Reading(None, float(correlation[0]), float(stats.norm.logsf(correlation[0])) / math.log(10))
        total = float((correlation**2).sum())
        return Reading(correlation > 0, total, float(stats.chi2.logsf(total, np.count_nonzero(length))) / math.log(10))

    return Method("influence", embed, read, False, bits, (1e-6, 0.1), SOURCE)


def basis(mesh: Mesh, count: int) -> Basis:
    """Compute the displacements by basis functions of height 1 on spheres of influence; refuse a mesh of fewer points.

    The first centre is the farthest point from the first vertex; no part of the mesh is left without one.
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
    known: Float64[np.ndarray, "points 3"] | None,
) -> Float64[np.ndarray, " spheres"]:
    """Fit the vector to displacements by weighted least squares; only along the known directions, if given."""
    if known is not None:
        place = np.arange(known.size)
        along = sparse.csr_array((known.ravel(), (place // 3, place)))
        bumps, residual = sparse.csr_array(along @ bumps), (known * residual).sum(axis=1, keepdims=True)
    weights = np.repeat(weight, residual.shape[1])
    matrix = sparse.csr_array(bumps.T @ sparse.diags_array(weights) @ bumps).toarray()
    matrix += _RIDGE * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    return np.linalg.solve(matrix, bumps.T @ (weights * residual.ravel()))
