"""Angles by which the normals of faces turn, and the faces that form planes."""

import jax.numpy as jnp
import numpy as np

from jaxmark.distortion import dihedral_angles, make_hinges
from jaxmark.geometry.mesh import Mesh, face_normals

PLANE = 0.1  # degrees by which faces of a plane turn, at most, at each of their edges


def planes(mesh: Mesh) -> np.ndarray:
    """Which faces are of a plane."""
    faces, size = np.asarray(mesh.faces), len(mesh.vertices)
    hinges = make_hinges(faces)
    deformed = np.abs(np.degrees(dihedral_angles(jnp.asarray(mesh.vertices, jnp.float32), hinges))) > PLANE
    pairs = np.sort(np.asarray(hinges.edges)[deformed], axis=1) @ [size, 1]
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1) @ [size, 1]
    return np.asarray(np.all(~np.isin(sides, pairs), axis=1))


def turns(original: Mesh, marked: Mesh, shares: tuple[float, ...], where: np.ndarray | None = None) -> list[float]:
    """Turn of face normals, in degrees, that is not exceeded on shares of the area, of some faces or of all."""
    chosen = np.full(len(original.faces), True) if where is None else where
    if not chosen.any():
        return [float("nan")] * len(shares)
    one, other = face_normals(original)[chosen], face_normals(marked)[chosen]
    turn = np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1)))
    a, b, c = (np.asarray(original.vertices)[np.asarray(original.faces)[chosen, corner]] for corner in range(3))
    order = np.argsort(turn)
    share = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1)[order])
    return [float(turn[order][np.searchsorted(share, least * share[-1])]) for least in shares]
