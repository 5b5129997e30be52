"""How far a texture drifts over a surface whose vertices move along it."""

import numpy as np
from jaxtyping import Float

from jaxmark.geometry.mesh import Mesh

SHARE = 0.99  # share of the corners at which it drifts less
TEXELS = 2048  # on each side of a texture


def texture_drift(
    original: Mesh, distorted: Mesh, texture: Float[np.ndarray, "faces 3 2"], size: float = TEXELS
) -> float | None:
    """The drift of a texture that 1 % of the faces' corners exceed, in texels of a texture of 2,048 x 2,048.

    A corner that moves along the surface takes its place in the texture along, past what was there before.

    Args:
        original: any mesh.
        distorted: a mesh of the same connectivity.
        texture: texture coordinates of each face's corners, from 0 to 1, NaN where there are none.
        size: texels on each side of the texture.

    Returns:
        The drift; None if no face with an area has texture coordinates.
    """
    corners, moved = (np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)] for mesh in (original, distorted))
    sides, pairs = corners[:, 1:] - corners[:, :1], texture[:, 1:] - texture[:, :1]
    metric = sides @ sides.transpose(0, 2, 1)
    determinant = metric[:, 0, 0] * metric[:, 1, 1] - metric[:, 0, 1] ** 2
    sound = np.isfinite(pairs).all(axis=(1, 2)) & (determinant > 1e-12 * metric[:, 0, 0] * metric[:, 1, 1])
    if not sound.any():
        return None
    # What each displacement is as a sum of the two sides, times what these are in the texture.
    along = (moved - corners)[sound] @ sides[sound].transpose(0, 2, 1) @ np.linalg.inv(metric[sound]) @ pairs[sound]
    return float(np.quantile(size * np.linalg.norm(along, axis=-1), SHARE))
