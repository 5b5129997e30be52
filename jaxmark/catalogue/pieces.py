"""The pieces of a suspect: each may be a copy of an original of its own."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxmark.geometry.canonical import exact
from jaxmark.geometry.mesh import Mesh, area, compact, components, weld, weld_mesh
from jaxmark.geometry.pose import Pose

MOST_PIECES = 32  # of a suspect, the largest ones
_MOST_COMPONENTS = 8  # of a mesh
_LEAST_SHARE = 0.02  # of a mesh's area, below which a component is no piece of its own
_LEAST_FACES = 50
_NEAR = 0.01  # distance from an original, over its size, up to which a piece is explained by it


class Piece(NamedTuple):
    """A mesh that may be a copy, or a part of one."""

    name: str  # of the mesh in the suspect's file, and the number of its component
    mesh: Mesh
    within: str  # the name of the piece that it is a component of; empty if it is a whole mesh


def split(meshes: Mapping[str, Mesh]) -> list[Piece]:
    """Each mesh, then the components of those that have several large ones; of equal meshes, the first."""
    found: list[Piece] = []
    known: set[bytes] = set()
    for name, mesh in meshes.items():
        shape = exact(mesh).hash
        if shape not in known:
            known.add(shape)
            found.append(Piece(name, mesh, ""))
    found.sort(key=lambda piece: -len(piece.mesh.faces))
    found = found[:MOST_PIECES]
    for piece in list(found):
        parts = _components(piece.mesh)
        if len(parts) > 1:
            found += [
                Piece(f"{piece.name}#{number}".lstrip(), part, piece.name) for number, part in enumerate(parts, 1)
            ]
    return found[:MOST_PIECES]


def _components(mesh: Mesh) -> list[Mesh]:
    """The largest components of a surface, without what is small."""
    if not len(mesh.faces):
        return []
    welded = weld_mesh(mesh, weld(mesh.vertices))
    parts = components(welded)[:_MOST_COMPONENTS]
    least = _LEAST_SHARE * area(welded)
    return [compact(part) for part in parts if len(part.faces) >= _LEAST_FACES and area(part) >= least]


def is_explained(piece: Mesh, pose: Pose, original: Mesh) -> bool:
    """Whether a piece lies on an original that the suspect was aligned with.

    Args:
        piece: a mesh.
        pose: the map from the suspect's coordinates to the original's.
        original: the original.
    """
    points = np.asarray(original.vertices, np.float64)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    spacing = float(np.median(KDTree(points).query(points[:: max(1, len(points) // 1000)], k=2)[0][:, 1]))
    posed = pose(np.asarray(piece.vertices, np.float64))
    off = KDTree(points).query(posed[:: max(1, len(posed) // 1000)])[0]
    return float(np.median(off)) <= max(_NEAR * size, spacing)
