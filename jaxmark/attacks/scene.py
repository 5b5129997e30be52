"""Scenes: a mesh beside other objects."""

import numpy as np

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal, used_vertices
from jaxmark.seeds import Randomness, generator

_GAP_DIAGONALS = 0.1  # between the bounding spheres of the mesh and of each object, in diagonals of the mesh


@on_host
def adding_geometry(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Add a ring on one side of the mesh and a box on the other, in a random direction and poses; on the host.

    Args:
        mesh: any mesh, concrete.
        strength: bounding-box diagonal of each object before it is rotated, relative to that of the mesh; positive.
        key: a JAX random key or a NumPy generator.

    Returns:
        The mesh, unchanged and first, then the ring of 1,024 vertices and the box of 386. None of them touch.

    Raises:
        JaxmarkError: if the size is not positive, or all vertices of the mesh are at one point.
    """
    import trimesh  # takes long to import

    if not strength > 0:
        raise JaxmarkError(f"What is put beside a mesh needs a positive size, got {strength:g}.")
    random, size = generator(key), diagonal(mesh)
    surface = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    step = random.normal(size=3)
    step *= size * ((1 + strength) / 2 + _GAP_DIAGONALS) / np.linalg.norm(step)
    box = trimesh.creation.box((6, 5, 4)).subdivide().subdivide().subdivide()
    vertices, faces = [np.asarray(mesh.vertices, np.float64)], [np.asarray(mesh.faces, np.int64)]
    count = len(vertices[0])
    for thing, place in ((trimesh.creation.torus(3, 1), middle + step), (box, middle - step)):
        turn = trimesh.transformations.random_rotation_matrix(random.random(3))[:3, :3]
        scale = strength * size / np.linalg.norm(np.ptp(thing.vertices, axis=0))
        vertices.append(place + scale * (thing.vertices @ turn.T))
        faces.append(count + np.asarray(thing.faces, np.int64))
        count += len(thing.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces))
