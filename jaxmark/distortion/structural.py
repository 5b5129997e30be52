"""MSDM and MSDM2, the mesh structural distortion measures, and the curvature tensors that they compare.

References: Lavoué, Gelasca, Dupont, Baskurt, Ebrahimi, "Perceptually driven 3D distance metrics with application to
watermarking", SPIE 6312, 2006; Lavoué, "A multiscale metric for 3D mesh visual quality assessment", Computer Graphics
Forum 30(5), 2011, with the constants of its implementation in MEPP2. Tensors: Cohen-Steiner, Morvan, "Restricted
Delaunay triangulations and normal cycle", SoCG 2003.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion.dihedral import Hinges, dihedral_sine_cosine, make_hinges
from jaxmark.distortion.neighbourhoods import Neighbourhoods, filled, make_neighbourhoods, share_inside
from jaxmark.distortion.norms import (
    PerVertex,
    Positions,
    Scalar,
    cube_root,
    cubic_mean,
    inverse_root,
    ratio,
    root,
    with_dtype,
)
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.surfaces import Surface, barycentric
from jaxmark.spectral.precision import einsum

Originals = Float[Array, "originals 3"]
Tensors = Float[Array, "vertices 3 3"]

# Lengths are in units of the longest side of the distorted mesh's bounding box.
_MSDM_BALL, _MSDM_WINDOW, _MSDM_SIGMA = 0.005, 0.015, 0.008  # radius of balls and windows, width of the Gaussian
_MSDM2_BALLS = (0.002, 0.003, 0.004)  # radius of the balls at each scale
_MSDM2_WINDOW_BALLS, _MSDM2_SIGMA_BALLS = 5.0, 2.5  # radius of windows, width of the Gaussian, in radii of the ball
_MSDM2_OFFSET = 1.0  # added to the denominators of the contributions
_MAX_WINDOWS = 20_000  # in larger meshes, windows are around this number of random vertices


@jax.jit
def curvature_tensor(x: Positions, hinges: Hinges, balls: Neighbourhoods) -> Tensors:
    """Compute the tensor T = 1/(πr²) Σ β_e/|e| e eᵀ over the pieces e of edges in the ball around each vertex.

    β_e is the dihedral angle. As in MEPP2, whose values are published, it is computed by the inverse sine, and so at
    most π/2 however sharp the edge is, and edges across the direction of the search from the centre do not count. The
    balls, of radius r, are the edges that `make_neighbourhoods` returns.
    """
    sine, cosine = dihedral_sine_cosine(x, hinges)
    angle = jnp.arctan2(sine, jnp.abs(cosine))
    along = share_inside(x, balls)[:, None] * (x[balls.head] - x[balls.tail])
    weight = angle[balls.edge] * inverse_root(jnp.sum(along**2, axis=1))
    products = weight[:, None, None] * along[:, :, None] * along[:, None, :]
    total = jax.ops.segment_sum(products, balls.centre, len(x), indices_are_sorted=True)
    return total / (np.pi * jnp.asarray(balls.radius).astype(x.dtype) ** 2)


@jax.jit
def curvature(tensor: Tensors) -> PerVertex:
    """(|K_max| + |K_min|)/2, the mean size of the two largest eigenvalues of the tensor by size."""
    sizes = jnp.sort(jnp.abs(_eigenvalues(tensor)), axis=1)
    return (sizes[:, 1] + sizes[:, 2]) / 2


def _eigenvalues(matrix: Tensors) -> Positions:
    """Compute the eigenvalues of symmetric matrices, in closed form (Smith, Communications of the ACM 4, 1961).

    LAPACK is avoided, for the determinant, too: on processors, several of its batched calls at once can deadlock.
    """
    mean = jnp.trace(matrix, axis1=1, axis2=2) / 3
    rest = matrix - mean[:, None, None] * jnp.eye(3, dtype=matrix.dtype)
    square = jnp.sum(rest**2, axis=(1, 2)) / 6
    round_ = square <= 0
    size = jnp.sqrt(jnp.where(round_, 1, square))
    first, second, third = jnp.moveaxis(rest / size[:, None, None], 1, 0)
    half = jnp.where(round_, 0, jnp.sum(first * jnp.cross(second, third), axis=1) / 2)
    # The arc cosine's slope at ±1, where two eigenvalues meet, is infinite: stop just before it.
    limit = 1 - 4 * jnp.finfo(matrix.dtype).eps
    angle = jnp.arccos(jnp.clip(half, -limit, limit)) / 3
    turns = angle[:, None] + 2 * np.pi / 3 * jnp.arange(3, dtype=matrix.dtype)
    return mean[:, None] + jnp.where(round_, 0, 2 * size)[:, None] * jnp.cos(turns).astype(matrix.dtype)


@jax.jit
def tensor_distance(original: Tensors, distorted: Tensors) -> Scalar:
    """Compute the change of curvature, 0 to 1: the cubic mean of ‖T - T'‖/(‖T‖ + ‖T'‖ + ε) over vertices.

    This follows TPDM (Torkhani, Wang, Chassery, "A curvature-tensor-based perceptual quality metric for 3D triangular
    meshes", Machine Graphics & Vision 2014) in comparing tensors relative to their size, but has none of its visibility
    weights. ε is 5 % of the mean of the original's ‖T‖.
    """

    def norm(tensor: Array) -> Array:
        return root(jnp.sum(tensor**2, axis=(1, 2)))

    before, after = norm(original), norm(distorted)
    return cubic_mean(ratio(norm(distorted - original), before + after + 0.05 * before.mean()))


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

    The meshes must be welded, as `compare` and `measure` weld them: vertices at one position have neighbourhoods that
    differ from each other.

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

    def stack(vertices: np.ndarray, scales: list[Neighbourhoods]) -> Neighbourhoods:
        """Pad the neighbourhoods of all scales to the largest, so that one compiled program serves all."""
        most = max(len(one.centre) for one in scales)
        return jax.tree.map(lambda *rows: np.stack(rows), *(filled(one, most, len(vertices)) for one in scales))

    balls = [stack(mesh[0], [make_neighbourhoods(*mesh, unit * ball)[0] for ball, _, _ in sizes]) for mesh in meshes]
    windows = [make_neighbourhoods(*meshes[1], unit * window, centres)[1] for _, window, _ in sizes]
    sigmas = np.array([unit * sigma for _, _, sigma in sizes])
    before, after = (make_hinges(faces) for _, faces in meshes)
    scales = Scale(*balls, windows=stack(meshes[1][0], windows), sigma=sigmas)
    return Views((before, after), corners, share, scales, centres, unit)


@jax.jit
def local_msdm2(original: Originals, distorted: Positions, views: Views) -> Float[Array, " centres"]:
    """Compute the distortion at each centre of the views, from 0 to 1: (L + C + S/2)/2.5, averaged over scales.

    L, C and S are the differences of curvature, contrast and structure; arguments are those of `msdm2`.
    """
    curved, contrast, structure = _compared(original, distorted, views, _MSDM2_OFFSET)
    return jnp.mean((curved + contrast + structure / 2) / 2.5, axis=0)


@jax.jit
def msdm2(original: Originals, distorted: Positions, views: Views) -> Scalar:
    """Compute the multiscale structural distortion of a mesh, from 0 to 1; not symmetric. Connectivities may differ.

    The views are those that `msdm2_views` prepares, for these positions or others near them.
    """
    return cubic_mean(local_msdm2(original, distorted, views))


@jax.jit
def msdm(original: Positions, distorted: Positions, views: Views) -> Scalar:
    """Compute the structural distortion of a mesh at one scale, from 0 to 1; connectivities must be the same.

    By the paper's equations, the local distortion is ((L³ + C³ + S³/2)/2.5)^(1/3), from the differences of curvature L,
    contrast C and structure S, and the global one the cubic mean of local ones. The views are those that `msdm_views`
    prepares, for these positions or others near them.
    """
    curved, contrast, structure = (values[0] for values in _compared(original, distorted, views, 0.0))
    return cubic_mean(cube_root((curved**3 + contrast**3 + structure**3 / 2) / 2.5))


def _compared(original: Array, distorted: Array, views: Views, offset: float) -> tuple[Array, Array, Array]:
    """Compute the contributions of curvature, contrast and structure, `[scales, centres]` each."""
    share = jnp.asarray(views.share).astype(distorted.dtype)
    closest = einsum("vk,vkc->vc", share, original[views.corners])

    def at_scale(scale: Scale) -> tuple[Array, ...]:
        first = curvature(curvature_tensor(original, views.hinges[0], scale.original)) * views.unit
        second = curvature(curvature_tensor(distorted, views.hinges[1], scale.distorted)) * views.unit
        matched = einsum("vk,vk->v", share, first[jnp.asarray(views.corners)])
        found = _contributions((matched, second), (closest, distorted), scale.windows, scale.sigma, offset)
        return tuple(values[jnp.asarray(views.centres)] for values in found)

    # Scales are computed one after the other, because balls have many pieces.
    return jax.lax.map(at_scale, with_dtype(views.scales, distorted.dtype))


def _contributions(
    curvatures: tuple[PerVertex, PerVertex],
    positions: tuple[Positions, Positions],
    windows: Neighbourhoods,
    sigma: float | np.ndarray | Scalar,
    offset: float,
) -> tuple[PerVertex, ...]:
    """Compute the differences of curvature, contrast and structure in the window of each vertex, as in SSIM.

    Each is relative to its size plus an offset. Curvatures and positions are those of both meshes at the distorted
    mesh's vertices; points are weighted by a Gaussian of width `sigma` of their distance from the centre.
    """
    share = share_inside(positions[1], windows)

    def at_points(values: Array) -> Array:
        part = share if values.ndim == 1 else share[:, None]
        return (1 - part) * values[windows.tail] + part * values[windows.head]

    def total(values: Array) -> Array:
        return jax.ops.segment_sum(values, windows.centre, len(curvatures[0]), indices_are_sorted=True)

    def relative(difference: Array, size: Array) -> Array:
        return ratio(jnp.abs(difference), size + offset)

    values = [at_points(curvature) for curvature in curvatures]
    weights = [jnp.exp(-jnp.sum((at_points(x) - x[windows.centre]) ** 2, axis=1) / (2 * sigma**2)) for x in positions]
    sums = [jnp.where(whole > 0, whole, 1) for whole in map(total, weights)]
    m1, m2 = means = [total(w * v) / s for w, v, s in zip(weights, values, sums, strict=True)]
    off = [v - m[windows.centre] for v, m in zip(values, means, strict=True)]
    s1, s2 = (root(total(w * d**2) / s) for w, d, s in zip(weights, off, sums, strict=True))
    # As in MEPP, the original's weights are divided by the sum of the distorted mesh's.
    covariance = total(weights[0] * off[0] * off[1]) / sums[1]
    curved, contrast = relative(m1 - m2, jnp.maximum(m1, m2)), relative(s1 - s2, jnp.maximum(s1, s2))
    return curved, contrast, relative(s1 * s2 - covariance, s1 * s2)
