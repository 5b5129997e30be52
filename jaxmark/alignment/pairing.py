"""Which mesh of a suspect looks like which mesh of the original; without the key."""

import hashlib
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from jaxmark.geometry.mesh import Mesh

_Numbers = Float64[np.ndarray, " numbers"]

_SHAPES_ALIKE = 0.1  # distance of moments below which a mesh may be another one in another pose
_PROFILE = 500  # vertices by which meshes of one connectivity are told apart


def pair(originals: Mapping[str, Mesh], suspects: Mapping[str, Mesh]) -> dict[str, str]:
    """Find which mesh of a suspect looks like each original mesh.

    First those of the same connectivity, then of a similar shape by its moments, or of the same name. Of several, the
    most similar shape is taken; a name counts where shapes hardly differ. A suspect's only mesh is compared with all.
    Neither key nor marks decide.

    Returns:
        Names in the suspect by names in the original, where there is one.
    """
    if len(suspects) == 1:
        return dict.fromkeys(originals, next(iter(suspects)))
    found: dict[str, str] = {}
    ours, theirs = _by_connectivity(originals), _by_connectivity(suspects)
    for connectivity, names in ours.items():
        others = theirs.get(connectivity, [])
        profiles = (
            {name: _profile(originals[name]) for name in names},
            {name: _profile(suspects[name]) for name in others},
        )
        found |= _nearest(*profiles, most=math.inf)
    left = {name: _shape(mesh) for name, mesh in originals.items() if name not in found}
    free = {name: _shape(mesh) for name, mesh in suspects.items() if name not in found.values()}
    return found | _nearest(left, free, most=_SHAPES_ALIKE)


def _by_connectivity(meshes: Mapping[str, Mesh]) -> dict[tuple[int, bytes], list[str]]:
    """The names of meshes that have the same faces on the same number of vertices."""
    groups: dict[tuple[int, bytes], list[str]] = {}
    for name, mesh in meshes.items():
        faces = np.ascontiguousarray(mesh.faces, np.int64)
        groups.setdefault((len(mesh.vertices), hashlib.sha256(faces.tobytes()).digest()), []).append(name)
    return groups


def _nearest(ours: Mapping[str, _Numbers], theirs: Mapping[str, _Numbers], most: float) -> dict[str, str]:
    """Pair what has the most similar numbers, which differ by no more than `most` unless names are equal."""
    if not ours or not theirs:
        return {}
    names, others = list(ours), list(theirs)
    off = cdist(np.stack(list(ours.values())), np.stack(list(theirs.values())), "chebyshev")
    same = np.array(names)[:, None] == np.array(others)[None, :]
    cost = np.where(same | (off <= most), np.where(same, 0.5, 1.0) * off, np.inf)
    found: dict[str, str] = {}
    taken: set[str] = set()
    for place in np.argsort(cost, axis=None, kind="stable"):
        row, column = divmod(int(place), len(others))
        if not np.isfinite(cost[row, column]) or len(found) == len(names):
            break
        if names[row] not in found and others[column] not in taken:
            found[names[row]] = others[column]
            taken.add(others[column])
    return found


def _profile(mesh: Mesh) -> _Numbers:
    """Distances of some vertices to the centre of all, in any pose and scale."""
    points = np.asarray(mesh.vertices, np.float64)
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    size = np.sqrt(np.mean(away**2))
    some = np.linspace(0, len(away) - 1, min(len(away), _PROFILE)).astype(np.int64)
    return away[some] / size if 0 < size < math.inf else np.zeros(len(some))


def _shape(mesh: Mesh) -> _Numbers:
    """Numbers that describe a surface in any pose and scale: the extents of its area, and how much area they hold."""
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
