"""Hash the geometry of a mesh, independently of the file that holds it; and integers, quickly."""

import hashlib

import numpy as np
from jaxtyping import UInt64

from jaxmark.geometry.mesh import Mesh, weld, weld_mesh


def geometry_hash(mesh: Mesh) -> bytes:
    """SHA-256 of a mesh's canonical geometry, the same for every file that stores it exactly.

    The canonical geometry is the welded points in order of first occurrence, as little-endian float64 with -0.0 as
    0.0, and the triangles that refer to them, as little-endian int64.
    """
    return points_hash(weld_mesh(mesh, weld(mesh.vertices)))


def points_hash(points: Mesh) -> bytes:
    """`geometry_hash` of a mesh that is welded already."""
    vertices = np.asarray(points.vertices, np.float64) + 0.0  # turns -0.0 into 0.0
    faces = np.asarray(points.faces)
    state = hashlib.sha256(b"jaxmark/1/geometry")
    state.update(np.array([len(vertices), len(faces)], "<i8").tobytes())
    state.update(vertices.astype("<f8").tobytes())
    state.update(faces.astype("<i8").tobytes())
    return state.digest()


def mix(values: UInt64[np.ndarray, "*values"]) -> UInt64[np.ndarray, "*values"]:
    """Hash integers by a 64-bit finaliser (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).

    It is no cryptographic hash: who wants two integers of one hash finds them.
    """
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
