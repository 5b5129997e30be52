"""MSDM and MSDM2, mesh structural distortion measures.

Lavoué, Gelasca, Dupont, Baskurt, Ebrahimi, "Perceptually driven 3D distance metrics with application to watermarking",
SPIE 6312, 2006; Lavoué, "A multiscale metric for 3D mesh visual quality assessment", Computer Graphics Forum 30(5),
2011, with the constants of its implementation in MEPP2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion.curvature import curvature, curvature_tensor
from jaxmark.distortion.dihedral import Hinges, make_hinges
from jaxmark.distortion.neighbourhoods import Neighbourhoods, filled, make_neighbourhoods
from jaxmark.distortion.structure import contributions, cubic_mean, window_statistics
from jaxmark.mesh import Mesh
from jaxmark.precision import einsum
from jaxmark.surfaces import Surface, barycentric

# In longest sides of the distorted mesh's box.
_BALL, _WINDOW, _SIGMA = 0.005, 0.015, 0.008
_BALLS, _WINDOW_BALLS, _SIGMA_BALLS = (0.002, 0.003, 0.004), 5.0, 2.5
_OFFSET = 1.0  # of MSDM2
_CENTRES = 20_000  # most windows; of larger meshes, as many vertices chosen at random


class Scale(NamedTuple):
    """What one scale looks at; of several scales, their stack."""

    original: Neighbourhoods  # over which the curvature of each mesh is averaged
    distorted: Neighbourhoods
    windows: Neighbourhoods  # points of the distorted mesh whose curvatures are compared
    sigma: float | np.ndarray | Float[Array, "*scales"]


class Views(NamedTuple):
    """Everything about a pair of meshes that MSDM or MSDM2 fixes on the host; positions may move a little."""

    hinges: tuple[Hinges, Hinges]  # of the original and the distorted mesh
    corners: Int[np.ndarray, "vertices 3"]  # of the original's face that is closest to each of the distorted's vertices
    share: Float[np.ndarray, "vertices 3"]  # of the corners in the closest point
    scales: Scale
    centres: Int[np.ndarray, " centres"]  # the distorted mesh's vertices in whose windows the meshes are compared
    unit: float | Float[Array, ""]  # longest side of the distorted mesh's box


def msdm_views(original: Mesh, distorted: Mesh) -> Views:
    """For `msdm`: one scale, vertex by vertex."""
    corners = np.tile(np.arange(len(original.vertices))[:, None], 3)
    share = np.broadcast_to([1.0, 0.0, 0.0], corners.shape)
    return _views(original, distorted, corners, share, [(_BALL, _WINDOW, _SIGMA)])


def msdm2_views(original: Mesh, distorted: Mesh) -> Views:
    """For `msdm2`: three scales, and the points of the original's surface closest to the distorted mesh's vertices.

    Raises:
        JaxmarkError: if libigl is missing.
    """
    closest, face = Surface(original).closest(np.asarray(distorted.vertices, np.float64))
    share = barycentric(original, face, closest)
    scales = [(ball, _WINDOW_BALLS * ball, _SIGMA_BALLS * ball) for ball in _BALLS]
    return _views(original, distorted, np.asarray(original.faces)[face], share, scales)


def _views(
    original: Mesh,
    distorted: Mesh,
    corners: Int[np.ndarray, "vertices 3"],
    share: Float[np.ndarray, "vertices 3"],
    sizes: list[tuple[float, float, float]],
) -> Views:
    meshes = [(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)) for mesh in (original, distorted)]
    unit, count = float(np.ptp(meshes[1][0], axis=0).max()), len(meshes[1][0])
    centres = np.sort(np.random.default_rng(0).permutation(count)[:_CENTRES])
    balls = [[make_neighbourhoods(*mesh, unit * ball)[0] for ball, _, _ in sizes] for mesh in meshes]
    windows = [make_neighbourhoods(*meshes[1], unit * window, centres)[1] for _, window, _ in sizes]
    counts = [len(vertices) for vertices, _ in meshes]
    first, second, third = map(_stacked, (*balls, windows), (*counts, counts[1]))
    scales = Scale(first, second, third, np.array([unit * sigma for _, _, sigma in sizes]))
    before, after = (make_hinges(faces) for _, faces in meshes)
    return Views((before, after), corners, share, scales, centres, unit)


def _stacked(scales: list[Neighbourhoods], count: int) -> Neighbourhoods:
    """Filled up to the largest, so that one program serves all."""
    most = max(len(balls.centre) for balls in scales)
    return Neighbourhoods(*map(np.stack, zip(*(filled(balls, most, count) for balls in scales), strict=True)))


@jax.jit
def local_msdm2(
    original: Float[Array, "originals 3"], distorted: Float[Array, "vertices 3"], views: Views
) -> Float[Array, " centres"]:
    """Distortion at the centres of the views, from 0 to 1: (L + C + S/2)/2.5, averaged over scales."""
    curved, contrast, structure = _compared(original, distorted, views, _OFFSET)
    return jnp.mean((curved + contrast + structure / 2) / 2.5, axis=0)


@jax.jit
def msdm2(
    original: Float[Array, "originals 3"], distorted: Float[Array, "vertices 3"], views: Views
) -> Float[Array, ""]:
    """Multiscale structural distortion of a mesh, from 0 to 1, not symmetric; connectivities may differ.

    Args:
        original: positions.
        distorted: positions.
        views: from `msdm2_views`, of these positions or others near them.
    """
    return cubic_mean(local_msdm2(original, distorted, views))


@jax.jit
def msdm(original: Float[Array, "vertices 3"], distorted: Float[Array, "vertices 3"], views: Views) -> Float[Array, ""]:
    """Structural distortion of a mesh, from 0 to 1, between meshes of the same connectivity, at one scale.

    The paper's equations: local ((L³ + C³ + S³/2)/2.5)^(1/3), over all the mean of cubes.

    Args:
        original: positions.
        distorted: positions of the same vertices.
        views: from `msdm_views`, of these positions or others near them.
    """
    curved, contrast, structure = (values[0] for values in _compared(original, distorted, views, 0.0))
    return cubic_mean(_cubic_root((curved**3 + contrast**3 + structure**3 / 2) / 2.5))


def _compared(original: Array, distorted: Array, views: Views, offset: float) -> tuple[Array, Array, Array]:
    """Contributions of curvature, contrast and structure, `[scales, centres]` each."""
    share = jnp.asarray(views.share).astype(distorted.dtype)
    there = einsum("vk,vkc->vc", share, original[views.corners])

    def one(scale: Scale) -> tuple[Array, Array, Array]:
        first = curvature(curvature_tensor(original, views.hinges[0], scale.original)) * views.unit
        second = curvature(curvature_tensor(distorted, views.hinges[1], scale.distorted)) * views.unit
        matched = einsum("vk,vk->v", share, first[jnp.asarray(views.corners)])
        found = window_statistics((matched, second), (there, distorted), scale.windows, scale.sigma)
        return contributions(jax.tree.map(lambda value: value[jnp.asarray(views.centres)], found), offset)

    # One after the other: the balls' pieces are many.
    def real(leaf: Array | np.ndarray) -> Array:
        return jnp.asarray(leaf, distorted.dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else None)

    return jax.lax.map(one, jax.tree.map(real, views.scales))


def _cubic_root(values: Array) -> Array:
    return jnp.where(values > 0, jnp.cbrt(jnp.where(values > 0, values, 1)), 0)
