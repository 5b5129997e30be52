"""MSDM and MSDM2, the mesh structural distortion measures.

References: Lavoué, Gelasca, Dupont, Baskurt, Ebrahimi, "Perceptually driven 3D distance metrics with application to
watermarking", SPIE 6312, 2006; Lavoué, "A multiscale metric for 3D mesh visual quality assessment", Computer Graphics
Forum 30(5), 2011, with the constants of its implementation in MEPP2.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion._curvature import curvature, curvature_tensor
from jaxmark.distortion.dihedral import Hinges, make_hinges
from jaxmark.distortion.neighbourhoods import Neighbourhoods, filled, make_neighbourhoods
from jaxmark.distortion.structure import contributions, cubic_mean, window_statistics
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.surfaces import Surface, barycentric
from jaxmark.spectral.precision import einsum

# Lengths are in units of the longest side of the distorted mesh's bounding box.
_MSDM_BALL, _MSDM_WINDOW, _MSDM_SIGMA = 0.005, 0.015, 0.008  # radius of balls and windows, width of the Gaussian
_MSDM2_BALLS = (0.002, 0.003, 0.004)  # radius of the balls at each scale
_MSDM2_WINDOW_BALLS, _MSDM2_SIGMA_BALLS = 5.0, 2.5  # radius of windows, width of the Gaussian, in radii of the ball
_MSDM2_OFFSET = 1.0  # added to the denominators of the contributions
_MAX_WINDOWS = 20_000  # in larger meshes, windows are around this number of random vertices


class Scale(NamedTuple):
    """The neighbourhoods of one scale, or of several scales stacked along a leading axis."""

    original: Neighbourhoods  # balls over which the original's curvature is averaged
    distorted: Neighbourhoods  # balls over which the distorted mesh's curvature is averaged
    windows: Neighbourhoods  # points of the distorted mesh at which curvatures are compared
    sigma: float | np.ndarray | Float[Array, "*scales"]  # width of the Gaussian that weighs the points of a window


class Views(NamedTuple):
    """Data for MSDM or MSDM2, prepared on the host for a pair of meshes; it also serves positions nearby."""

    hinges: tuple[Hinges, Hinges]  # hinges of the original and of the distorted mesh
    corners: Int[np.ndarray, "vertices 3"]  # corners of the original's face that is closest to each distorted vertex
    share: Float[np.ndarray, "vertices 3"]  # barycentric coordinates of the closest point on this face
    scales: Scale
    centres: Int[np.ndarray, " centres"]  # vertices of the distorted mesh in whose windows the meshes are compared
    unit: float | Float[Array, ""]  # longest side of the distorted mesh's bounding box


def msdm_views(original: Mesh, distorted: Mesh) -> Views:
    """Prepare a pair of meshes for `msdm`: one scale, and vertices compared by their indices."""
    corners = np.tile(np.arange(len(original.vertices))[:, None], 3)
    share = np.broadcast_to([1.0, 0.0, 0.0], corners.shape)
    return _views(original, distorted, corners, share, [(_MSDM_BALL, _MSDM_WINDOW, _MSDM_SIGMA)])


def msdm2_views(original: Mesh, distorted: Mesh) -> Views:
    """Prepare a pair of meshes for `msdm2`: three scales, and vertices compared with closest points of the original.

    Raises:
        JaxmarkError: if libigl is missing.
    """
    closest, face = Surface(original).closest(np.asarray(distorted.vertices, np.float64))
    share = barycentric(original, face, closest)
    scales = [(ball, _MSDM2_WINDOW_BALLS * ball, _MSDM2_SIGMA_BALLS * ball) for ball in _MSDM2_BALLS]
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
    centres = np.sort(np.random.default_rng(0).permutation(count)[:_MAX_WINDOWS])
    balls = [[make_neighbourhoods(*mesh, unit * ball)[0] for ball, _, _ in sizes] for mesh in meshes]
    windows = [make_neighbourhoods(*meshes[1], unit * window, centres)[1] for _, window, _ in sizes]
    counts = [len(vertices) for vertices, _ in meshes]
    first, second, third = map(_stacked, (*balls, windows), (*counts, counts[1]))
    scales = Scale(first, second, third, np.array([unit * sigma for _, _, sigma in sizes]))
    before, after = (make_hinges(faces) for _, faces in meshes)
    return Views((before, after), corners, share, scales, centres, unit)


def _stacked(scales: list[Neighbourhoods], count: int) -> Neighbourhoods:
    """Stack the neighbourhoods of several scales, padded to the largest, so that one compiled program serves all."""
    most = max(len(balls.centre) for balls in scales)
    return Neighbourhoods(*map(np.stack, zip(*(filled(balls, most, count) for balls in scales), strict=True)))


@jax.jit
def local_msdm2(
    original: Float[Array, "originals 3"], distorted: Float[Array, "vertices 3"], views: Views
) -> Float[Array, " centres"]:
    """Distortion at each centre of the views, from 0 to 1: (L + C + S/2)/2.5, averaged over scales.

    L, C and S are the differences of curvature, contrast and structure; arguments are those of `msdm2`.
    """
    curved, contrast, structure = _compared(original, distorted, views, _MSDM2_OFFSET)
    return jnp.mean((curved + contrast + structure / 2) / 2.5, axis=0)


@jax.jit
def msdm2(
    original: Float[Array, "originals 3"], distorted: Float[Array, "vertices 3"], views: Views
) -> Float[Array, ""]:
    """Multiscale structural distortion of a mesh, from 0 to 1; not symmetric. Connectivities may differ.

    Args:
        original: positions.
        distorted: positions.
        views: from `msdm2_views`, for these positions or others near them.
    """
    return cubic_mean(local_msdm2(original, distorted, views))


@jax.jit
def msdm(original: Float[Array, "vertices 3"], distorted: Float[Array, "vertices 3"], views: Views) -> Float[Array, ""]:
    """Structural distortion of a mesh at one scale, from 0 to 1; connectivities must be the same.

    By the paper's equations, the local distortion is ((L³ + C³ + S³/2)/2.5)^(1/3), from the differences of curvature L,
    contrast C and structure S, and the global one the cubic mean of local ones.

    Args:
        original: positions.
        distorted: positions of the same vertices.
        views: from `msdm_views`, for these positions or others near them.
    """
    curved, contrast, structure = (values[0] for values in _compared(original, distorted, views, 0.0))
    return cubic_mean(_cubic_root((curved**3 + contrast**3 + structure**3 / 2) / 2.5))


def _compared(original: Array, distorted: Array, views: Views, offset: float) -> tuple[Array, Array, Array]:
    """Contributions of curvature, contrast and structure, `[scales, centres]` each."""
    share = jnp.asarray(views.share).astype(distorted.dtype)
    closest = einsum("vk,vkc->vc", share, original[views.corners])

    def at_scale(scale: Scale) -> tuple[Array, Array, Array]:
        first = curvature(curvature_tensor(original, views.hinges[0], scale.original)) * views.unit
        second = curvature(curvature_tensor(distorted, views.hinges[1], scale.distorted)) * views.unit
        matched = einsum("vk,vk->v", share, first[jnp.asarray(views.corners)])
        found = window_statistics((matched, second), (closest, distorted), scale.windows, scale.sigma)
        return contributions(jax.tree.map(lambda value: value[jnp.asarray(views.centres)], found), offset)

    def cast(leaf: Array | np.ndarray) -> Array:
        return jnp.asarray(leaf, distorted.dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else None)

    # Scales are computed one after the other, because balls have many pieces.
    return jax.lax.map(at_scale, jax.tree.map(cast, views.scales))


def _cubic_root(values: Array) -> Array:
    return jnp.where(values > 0, jnp.cbrt(jnp.where(values > 0, values, 1)), 0)
