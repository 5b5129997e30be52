"""Sub-meshes, each with a mark of its own, so that the loss of one part leaves the messages of the others intact.

Parts grow from feature vertices by breadth-first search (Sohn et al.), all at once: a point belongs to the feature that
is the fewest edges away. Every point is in one part, and a part has the faces whose corners are all in it. Faces along
the seams belong to no part, so a mesh that is put together again has its original faces and no gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int64
from scipy.sparse import csgraph

from jaxmark.alignment import attempts
from jaxmark.alignment.original import Original, make_original
from jaxmark.alignment.result import Align, Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces, edges, host_mesh, used_vertices, weld, weld_mesh
from jaxmark.spectral.laplacian import adjacency
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.markers import NonBlindMarker, make_marker
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME


@dataclass(frozen=True, eq=False)
class PartMarker:
    """A marker for each part of an original. Make one with `make_part_marker`."""

    original: Original  # the whole
    label: Int64[np.ndarray, " vertices"]  # index of the part that each vertex is in; -1 if it is in none
    markers: Sequence[NonBlindMarker]  # one for each part

    def embed(self, messages: Sequence[bytes], budget: float) -> tuple[Mesh, list[EmbedInfo]]:
        """Embed a message in each part.

        Args:
            messages: one for each part, of the size of its marker's payload.
            budget: RMS displacement of each part's points, relative to the diagonal of the *whole* original.

        Returns:
            The marked mesh (float64 vertices, same faces), and how each part was marked, in the part's own diagonals.

        Raises:
            JaxmarkError: if there is not one message for each part, or a part cannot carry its message; see `embed`.
        """
        if len(messages) != len(self.markers):
            raise JaxmarkError(f"{len(self.markers)} parts need as many messages, got {len(messages)}.")
        vertices, infos = np.array(self.original.mesh.vertices, np.float64), []
        for part, (marker, message) in enumerate(zip(self.markers, messages, strict=True)):
            try:
                marked, info = marker.embed(message, budget * self.original.diagonal / marker.original.diagonal)
            except JaxmarkError as error:
                raise JaxmarkError(f"Part {part} of {len(self.markers)}: {error}") from None
            vertices[self.label == part] = marked.vertices
            infos.append(info)
        return Mesh(vertices, self.original.mesh.faces), infos

    def detect(self, suspect: Mesh, align: Align = "auto") -> list[Detection]:
        """Read all parts of a suspect, which is aligned as a whole and only once.

        The false-positive probability of each detection is that of its own part alone.

        Raises:
            JaxmarkError: see `jaxmark.alignment.attempts.align`.
        """
        whole = attempts.align(self.original, suspect, align)
        return [marker.read(self._restrict(whole, part)) for part, marker in enumerate(self.markers)]

    def _restrict(self, whole: Alignment, part: int) -> Alignment:
        """Restrict an alignment to what the suspect shows of a part, in the part's diagonals."""
        own = self.markers[part].original
        points = self.original.weld.point[np.flatnonzero(self.label == part)[own.weld.first]]
        scale = self.original.diagonal / own.diagonal
        return whole._replace(
            displacement=scale * whole.displacement[points],
            weights=whole.weights[points] * own.used,
            normals=None if whole.normals is None else whole.normals[points],
            nuisance=None if whole.nuisance is None else whole.nuisance[points],
            residual=scale * whole.residual,
        )


def make_part_marker(
    original: Mesh,
    key: bytes,
    features: int | Int[np.ndarray, " parts"],
    *,
    bits: int,
    scheme: str | Scheme = DEFAULT_SCHEME,
) -> PartMarker:
    """Cut an original into parts and prepare each for marking.

    Args:
        original: the unmarked mesh.
        key: 32 bytes, from `new_key`; parts share nothing that is derived from it, for their geometry differs.
        features: the vertices that the parts grow from; or their number, for vertices that are far from each other.
        bits: size of each part's payload in bits.
        scheme: a name or a scheme, see `make_marker`.

    Raises:
        JaxmarkError: if a feature is not a vertex that faces use, or is given twice; or see `make_marker`.
    """
    check_faces("Marking part by part", original)
    ready = make_original(original)
    chosen = farthest_vertices(ready.mesh, features) if isinstance(features, int) else np.asarray(features)
    label, markers = parts(ready.mesh, chosen), []
    for part in range(len(chosen)):
        inside = np.flatnonzero(label == part)
        place = np.full(len(label), -1)
        place[inside] = np.arange(len(inside))
        faces = place[np.asarray(ready.mesh.faces)]
        faces = faces[(faces >= 0).all(axis=1)]
        if not len(faces):
            raise JaxmarkError(f"Part {part}, from vertex {chosen[part]}, has no face; use fewer or other features.")
        markers.append(make_marker(Mesh(np.asarray(ready.mesh.vertices)[inside], faces), key, bits=bits, scheme=scheme))
    return PartMarker(ready, label, markers)


def parts(mesh: Mesh, features: Int[np.ndarray, " parts"]) -> Int64[np.ndarray, " vertices"]:
    """Find the part of each vertex: its nearest feature by the number of edges between welded points.

    Args:
        mesh: any mesh.
        features: a vertex of each part.

    Returns:
        The index of each vertex's part; -1 if no feature is connected with it.

    Raises:
        JaxmarkError: if a feature is not a vertex that faces use, or two features are the same point.
    """
    mesh, features = host_mesh(mesh), np.asarray(features)
    used = used_vertices(mesh)
    if len(features) == 0 or not ((features >= 0) & (features < len(used))).all() or not used[features].all():
        raise JaxmarkError(f"Features are vertices that faces use, at least one, got {features.tolist()}.")
    welded = weld(mesh.vertices)
    points = welded.point[features]
    if len(np.unique(points)) < len(points):
        raise JaxmarkError(f"Features must be different points, got {features.tolist()}.")
    graph = adjacency(edges(weld_mesh(mesh, welded).faces), len(welded.first))
    _, _, nearest = csgraph.dijkstra(graph, indices=points, unweighted=True, min_only=True, return_predecessors=True)
    part = np.full(len(welded.first) + 1, -1)  # the last entry is for points that no feature is connected with
    part[points] = np.arange(len(points))
    return part[np.maximum(nearest, -1)][welded.point]


def farthest_vertices(mesh: Mesh, count: int) -> Int64[np.ndarray, " parts"]:
    """Choose vertices that are far from each other.

    The first is the vertex farthest from the centre; each next one is the most edges away from all before it.

    Args:
        mesh: any mesh; connected components without a chosen vertex come first.
        count: number of vertices, at least 1.

    Raises:
        JaxmarkError: if the mesh does not have so many points.
    """
    mesh = host_mesh(mesh)
    welded = weld(mesh.vertices)
    points = weld_mesh(mesh, welded)
    used = used_vertices(points)
    if not 1 <= count <= used.sum():
        raise JaxmarkError(f"This mesh has 1 to {int(used.sum())} feature vertices, not {count}.")
    graph, position = adjacency(edges(points.faces), len(used)), np.asarray(points.vertices)
    off = np.where(used, np.linalg.norm(position - position[used].mean(axis=0), axis=1), -1)
    chosen, hops = [int(np.argmax(off))], np.where(used, np.inf, -1)
    while len(chosen) < count:
        hops = np.minimum(hops, csgraph.dijkstra(graph, indices=chosen[-1], unweighted=True))
        chosen.append(int(np.argmax(hops)))
    return welded.first[chosen]
