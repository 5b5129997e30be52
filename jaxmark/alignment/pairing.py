"""Pairing of meshes in files of several meshes: each mesh of the original with the most similar one of the suspect."""

import hashlib
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from jaxmark.geometry.mesh import Mesh

_Numbers = Float64[np.ndarray, " numbers"]

_SHAPES_ALIKE = 0.1  # largest distance between the moments of two meshes that may show the same shape
_PROFILE = 500  # number of vertices by which meshes with the same connectivity are distinguished


def pair(originals: Mapping[str, Mesh], suspects: Mapping[str, Mesh]) -> dict[str, str]:
    """Pair each mesh of an original with the most similar mesh of a suspect.

    Meshes of the same connectivity are paired first, then meshes of a similar shape, measured by moments, or of the
    same name. Among several candidates, the most similar shape is chosen; equal names decide if shapes hardly differ.
    If the suspect has one mesh, it is paired with all meshes of the original. The pairs do not depend on a key.

    Returns:
        The name in the suspect for each name in the original that has a partner.
    """
    if len(suspects) == 1:
        return dict.fromkeys(originals, next(iter(suspects)))
    pairs: dict[str, str] = {}
    ours, theirs = _by_connectivity(originals), _by_connectivity(suspects)
    for connectivity, names in ours.items():
        others = theirs.get(connectivity, [])
        profiles = (
            {name: _profile(originals[name]) for name in names},
            {name: _profile(suspects[name]) for name in others},
        )
        pairs |= _nearest(*profiles, most=math.inf)
    left = {name: _shape(mesh) for name, mesh in originals.items() if name not in pairs}
    free = {name: _shape(mesh) for name, mesh in suspects.items() if name not in pairs.values()}
    return pairs | _nearest(left, free, most=_SHAPES_ALIKE)


def _by_connectivity(meshes: Mapping[str, Mesh]) -> dict[tuple[int, bytes], list[str]]:
    """Group the names of meshes that have the same faces and the same number of vertices."""
    groups: dict[tuple[int, bytes], list[str]] = {}
    for name, mesh in meshes.items():
        faces = np.ascontiguousarray(mesh.faces, np.int64)
        groups.setdefault((len(mesh.vertices), hashlib.sha256(faces.tobytes()).digest()), []).append(name)
    return groups


def _nearest(ours: Mapping[str, _Numbers], theirs: Mapping[str, _Numbers], most: float) -> dict[str, str]:
    """Pair the most similar numbers, which differ by at most `most` unless the names are equal."""
    if not ours or not theirs:
        return {}
    names, others = list(ours), list(theirs)
    distance = cdist(np.stack(list(ours.values())), np.stack(list(theirs.values())), "chebyshev")
    same = np.array(names)[:, None] == np.array(others)[None, :]
    cost = np.where(same | (distance <= most), np.where(same, 0.5, 1.0) * distance, np.inf)
    pairs: dict[str, str] = {}
    partners: set[str] = set()
    for place in np.argsort(cost, axis=None, kind="stable"):
        row, column = divmod(int(place), len(others))
        if not np.isfinite(cost[row, column]) or len(pairs) == len(names):
            break
        if names[row] not in pairs and others[column] not in partners:
            pairs[names[row]] = others[column]
            partners.add(others[column])
    return pairs


def _profile(mesh: Mesh) -> _Numbers:
    """Compute the distances of some vertices to the centroid, which do not depend on pose and scale."""
    points = np.asarray(mesh.vertices, np.float64)
    radii = np.linalg.norm(points - points.mean(axis=0), axis=1)
    size = np.sqrt(np.mean(radii**2))
    some = np.linspace(0, len(radii) - 1, min(len(radii), _PROFILE)).astype(np.int64)
    return radii[some] / size if 0 < size < math.inf else np.zeros(len(some))


def _shape(mesh: Mesh) -> _Numbers:
    """Compute moments that describe a surface in any pose and scale: relative principal extents, and relative area."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    total = areas.sum()
    if not 0 < total < math.inf:
        return np.zeros(4)
    centres = corners.mean(axis=1)
    centres = centres - areas @ centres / total
    values = np.linalg.eigvalsh(centres.T @ (areas[:, None] * centres) / total)
    size = max(values.sum(), np.finfo(float).tiny)
    return np.append(np.sqrt(np.maximum(values, 0) / size), math.sqrt(total / size) / 10)
