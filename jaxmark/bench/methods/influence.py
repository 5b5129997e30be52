"""Praun, Hoppe, Finkelstein, "Robust mesh watermarking", SIGGRAPH 1999, 69-76.

A vector of normal random numbers is added to the shape, each along one direction and under a bump of its own: spheres
of influence on the surface, few large ones and many small ones. The reader registers a suspect to the original,
resamples it at the original's vertices, finds by least squares the vector that explains what is left, and correlates
it with the key's. As the key's numbers are normal and know nothing of the suspect, what a correlation proves is exact.

Chosen here, where the publication leaves it open or needs what is not here. The centres and radii of the spheres are
those of farthest points along the edges, each as far from all before it as its radius, instead of the vertex splits of
a progressive mesh. A bump is the publication's hat, a raised cosine, along the normal at its centre; all are equally
high. Registration and resampling are the library's; an affine map, which it may have fitted to the mark itself, is
found together with the vector. The publication shows that a
mark is there; a message divides the vector into a part for each bit, which turns its sign, and then the squares of the
parts' correlations, a sum of independent squares of normal numbers where there is no mark, prove the same.
"""

import math

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse, stats
from scipy.sparse import csgraph

from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import displace, make_original
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.draws import choices, normal
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, compact, edges, vertex_normals

SOURCE = "Praun, Hoppe, Finkelstein, SIGGRAPH 1999"
_FEWEST, _PER_BIT = 128, 4  # spheres
_RIDGE = 1e-9  # on the diagonal of the normal equations, over its mean

Basis = sparse.csr_array  # `[3 · points, spheres]`, the coordinates of each point together


def influence(bits: int) -> Method:
    """Spheres of influence; strengths are the standard deviation of a bump's height, over the diagonal.

    Args:
        bits: of a message, or 0 to show presence alone, as published.
    """
    count = max(_FEWEST, _PER_BIT * bits)

    def vector(key: bytes) -> tuple[Float64[np.ndarray, " spheres"], Int64[np.ndarray, " spheres"]]:
        """The key's numbers, and the bit that each belongs to."""
        part = choices(key, "influence").permutation("parts", count) % max(bits, 1)
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
        except JaxmarkError:  # nothing of the original is there
            return Reading(None, 0.0, 0.0)
        used = prepared.used
        bumps = basis(compact(prepared.points), count)
        bumps = sparse.csr_array(sparse.hstack([bumps, _affine(prepared.positions[used])]))
        known = None if found.normals is None else found.normals[used]
        drawn, part = vector(key)
        shown = _explain(bumps, found.displacement[used], found.weights[used], known)[:count]
        length = np.sqrt(np.bincount(part, shown**2, max(bits, 1)))
        surety = np.bincount(part, shown * drawn, max(bits, 1)) / np.where(length > 0, length, 1)
        if not bits:
            return Reading(None, float(surety[0]), float(stats.norm.logsf(surety[0])) / math.log(10))
        total = float((surety**2).sum())
        log10_p = float(stats.chi2.logsf(total, np.count_nonzero(length))) / math.log(10)
        return Reading(surety > 0, total, log10_p)

    return Method("influence", embed, read, False, bits, (1e-6, 0.1), SOURCE)


def basis(mesh: Mesh, count: int) -> Basis:
    """The displacements that bumps of height 1 on the spheres of influence of a surface are.

    The first centre is the farthest point from the first vertex; no part of the mesh is left without one.

    Raises:
        JaxmarkError: if there are fewer points than spheres.
    """
    points, pairs = np.asarray(mesh.vertices), edges(mesh.faces)
    if len(points) < count:
        raise JaxmarkError(f"There are {len(points)} points for {count} spheres of influence; write fewer bits.")
    length = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    graph = sparse.csr_array((length, (pairs[:, 0], pairs[:, 1])), (len(points),) * 2)
    graph = (graph + graph.T).tocsr()
    normals = vertex_normals(mesh)
    nearest = np.full(len(points), np.inf)
    centre = int(np.argmax(_finite(csgraph.dijkstra(graph, indices=0))))
    rows, columns, values = [], [], []
    for number in range(count):
        reach = nearest[centre]
        distance = csgraph.dijkstra(graph, indices=centre, limit=reach)
        radius = reach if np.isfinite(reach) else _finite(distance).max()
        inside = np.flatnonzero(distance < max(radius, 1e-300))
        bump = (1 + np.cos(np.pi * distance[inside] / max(radius, 1e-300))) / 2
        rows.append((3 * inside[:, None] + np.arange(3)).ravel())
        columns.append(np.full(3 * len(inside), number))
        values.append((bump[:, None] * normals[centre]).ravel())
        nearest = np.minimum(nearest, distance)
        centre = int(np.argmax(nearest))
    data = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(data, (3 * len(points), count))


def _affine(points: Float64[np.ndarray, "points 3"]) -> Basis:
    """The displacements that affine maps are, coordinate by coordinate."""
    each = np.column_stack([points, np.ones(len(points))])
    return sparse.csr_array(sparse.kron(sparse.csr_array(each), np.eye(3)))


def _explain(
    bumps: Basis,
    residual: Float64[np.ndarray, "points 3"],
    weight: Float64[np.ndarray, " points"],
    known: Float64[np.ndarray, "points 3"] | None,
) -> Float64[np.ndarray, " spheres"]:
    """The vector that explains displacements best, by least squares; along some directions, if only these are known."""
    if known is not None:
        place = np.arange(len(residual))
        along = sparse.csr_array((known.ravel(), (np.repeat(place, 3), np.arange(3 * len(place)))))
        bumps, residual = sparse.csr_array(along @ bumps), (known * residual).sum(axis=1, keepdims=True)
    weights = np.repeat(weight, residual.shape[1])
    matrix = sparse.csr_array(bumps.T @ sparse.diags_array(weights) @ bumps).toarray()
    matrix += _RIDGE * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    return np.linalg.solve(matrix, bumps.T @ (weights * residual.ravel()))


def _finite(distance: Float64[np.ndarray, " points"]) -> Float64[np.ndarray, " points"]:
    return np.where(np.isfinite(distance), distance, 0)
