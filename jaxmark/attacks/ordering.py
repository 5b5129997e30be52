"""Reordering of vertices and faces."""

import numpy as np
from jaxtyping import Int64

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.seeds import Randomness, generator


@on_host
def reordering(mesh: Mesh, strength: float, key: Randomness) -> Mesh:
    """Permute random vertices among themselves, and random faces among themselves; on the host.

    Each of these faces also starts at a random corner; its orientation stays.

    Args:
        mesh: any mesh, concrete.
        strength: share of the vertices and of the faces that change places, in [0, 1]; 1 for all of them.
        key: a JAX random key or a NumPy generator.

    Returns:
        The same surface. A vertex that no face uses keeps its place.

    Raises:
        JaxmarkError: if the share is outside [0, 1].
    """
    if not 0 <= strength <= 1:
        raise JaxmarkError(f"A share of vertices and faces to reorder is in [0, 1], got {strength:g}.")
    random, faces = generator(key), np.asarray(mesh.faces, np.int64)
    here, there = _cycle(np.flatnonzero(used_vertices(mesh)), strength, random)
    vertices, place = np.array(mesh.vertices), np.arange(len(mesh.vertices))
    vertices[there], place[here] = vertices[here], there
    faces = place[faces]
    here, there = _cycle(np.arange(len(faces)), strength, random)
    corner = (random.integers(3, size=(len(here), 1)) + np.arange(3)) % 3
    faces[there] = np.take_along_axis(faces[here], corner, axis=1)
    return Mesh(vertices, faces)


def _cycle(
    indices: Int64[np.ndarray, " indices"], share: float, random: np.random.Generator
) -> tuple[Int64[np.ndarray, " chosen"], Int64[np.ndarray, " chosen"]]:
    """A random share of some indices, and for each the index that it moves to: a cyclic permutation."""
    chosen = random.permutation(indices)[: round(share * len(indices))]
    return chosen, np.roll(chosen, 1)
