"""Small things that the file tests share; none of them uses the code under test except to load and save."""

from pathlib import Path

import numpy as np

from jaxmark.files import load_mesh, save_mesh
from jaxmark.geometry.mesh import Mesh


def written(folder: Path, name: str, data: bytes) -> Path:
    """A file with these bytes."""
    path = folder / name
    path.write_bytes(data)
    return path


def loaded(folder: Path, name: str, data: bytes) -> Mesh:
    return load_mesh(written(folder, name, data))


def shifted(mesh: Mesh, vertex: int, by: list[float]) -> Mesh:
    """The mesh with one vertex moved."""
    vertices = np.asarray(mesh.vertices).copy()
    vertices[vertex] += by
    return mesh._replace(vertices=vertices)


def noisy(mesh: Mesh, amount: float, seed: int = 0) -> Mesh:
    """The mesh with all vertices moved at random."""
    noise = np.random.default_rng(seed).normal(0, amount, np.shape(mesh.vertices))
    return mesh._replace(vertices=np.asarray(mesh.vertices) + noise)


def turned(mesh: Mesh) -> Mesh:
    """The mesh turned by a right angle about z: (x, y, z) becomes (-y, x, z)."""
    x, y, z = np.asarray(mesh.vertices).T
    return mesh._replace(vertices=np.stack([0 - y, x, z], axis=1))


def patched(source: Path, mesh: Mesh) -> bytes:
    """What saving the mesh like the source writes."""
    out = source.with_name("out" + source.suffix)
    save_mesh(mesh, out, like=source)
    return out.read_bytes()
