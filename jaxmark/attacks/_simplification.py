"""Simplification by edge collapses."""

from jaxmark.attacks.host import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, simplify
from jaxmark.seeds import Randomness


@on_host
def simplification(mesh: Mesh, strength: float, key: Randomness | None = None) -> Mesh:
    """Collapse edges, those of least quadric error first, until only a share of the faces is left; on the host.

    The program is fast-simplification (`jaxmark.geometry.mesh.simplify`). The protocol of SMI 2010 (Wang et al.) has
    the same strengths, but uses the simplifier of CGAL, that of Lindstrom and Turk, "Fast and memory efficient
    polygonal simplification", 1998.

    Args:
        mesh: any mesh, concrete.
        strength: share of the edges to collapse, in [0, 1). The same share of the faces goes with them, rounded to a
            whole number of faces.
        key: not used; attacks share one signature.

    Returns:
        A mesh with about the number of faces that was asked for.

    Raises:
        JaxmarkError: if the share is outside [0, 1), no face would be left, all vertices are at one point, or
            fast-simplification is missing.
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of edges to collapse is at least 0 and below 1, got {strength:g}.")
    count = len(mesh.faces)
    left = round((1 - strength) * count)
    if left == 0:
        raise JaxmarkError(f"Of {count} faces none would be left; ask for a share of at most {1 - 1 / count:g}.")
    return simplify(mesh, left)
