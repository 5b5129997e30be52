"""A picture of how a suspect was aligned. Needs the extra `plot`."""

from pathlib import Path

import numpy as np

from jaxmark.alignment.alignment import Alignment
from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot import View, save_views


def save_report(folder: Path, original: Original, suspect: Mesh, alignment: Alignment) -> Path:
    """Draw the original, the suspect in its pose, which points of it are seen, and how far they are off.

    Args:
        folder: folder of the picture `alignment.png`, which is made if it does not exist.
        original: what was aligned to.
        suspect: the mesh that was aligned.
        alignment: alignment of the suspect to the original.

    Returns:
        The picture's path.

    Raises:
        JaxmarkError: if matplotlib is missing, or the picture cannot be written.
    """
    mesh, point = original.mesh, original.weld.point
    off = np.linalg.norm(alignment.displacement, axis=1)
    if alignment.normals is not None:
        off = np.abs(np.sum(alignment.normals * alignment.displacement, axis=1))
    posed = suspect._replace(vertices=alignment.pose(np.asarray(suspect.vertices, np.float64)))
    views = [
        View("Original", mesh),
        View(f"Suspect, aligned by {alignment.method}", posed),
        View("Weight", mesh, alignment.weights[point], "1 seen, 0 masked"),
        View("Residual", mesh, 100 * off[point], "% of the diagonal"),
    ]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"{folder} cannot be made a folder: {error.strerror}.") from None
    save_views(views, folder / "alignment.png")
    return folder / "alignment.png"
