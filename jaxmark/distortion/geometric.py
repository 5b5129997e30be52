"""Metrics of positions: distances of surfaces, geometric Laplacian, lengths of edges, planes of points, textures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int
from scipy.spatial import KDTree

from jaxmark.distortion.norms import Positions, Scalar, check_alike, inverse_root, lengths, percentile, ratio, rms
from jaxmark.geometry.clouds import planes, spacings
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.geometry.surfaces import Surface, sample
from jaxmark.spectral.laplacian import take_rows

Edges = Int[Array | np.ndarray, "edges 2"]  # as by `jaxmark.geometry.mesh.edges`

HIGH_SHARE = 0.99  # share of the edges, or corners of faces, whose change is smaller than the returned one
_HIGH_SHARE_OF_POINTS = 0.95
_SAMPLED_POINTS = 100_000  # on each surface
_TEXELS = 2048  # on each side of a texture


class SurfaceDistance(NamedTuple):
    """Distances between two surfaces, in the units of the positions."""

    mrms: float  # the larger of the two one-sided root mean square distances
    hausdorff: float  # the largest distance of a point on either surface from the other


def surface_distance(first: Mesh, second: Mesh) -> SurfaceDistance:
    """Measure the distance between two surfaces, from the vertices and 100,000 sampled points of each to the other.

    Distances to the surfaces are exact. Root mean squares are over the points, which are sampled uniformly by area; the
    largest distance is over points and vertices. Reference: Cignoni, Rocchini, Scopigno, "Metro: measuring error on
    simplified surfaces", Computer Graphics Forum 17(2), 1998.

    Raises:
        JaxmarkError: if a surface has no area, or libigl is missing.
    """

    def one_sided(mesh: Mesh, other: Surface) -> tuple[float, float]:
        points = sample(mesh, _SAMPLED_POINTS).points, np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
        sampled, vertices = (np.linalg.norm(other.closest(some)[0] - some, axis=1) for some in points)
        return float(np.sqrt(np.mean(sampled**2))), float(max(sampled.max(), vertices.max()))

    sides = one_sided(first, Surface(second)), one_sided(second, Surface(first))
    return SurfaceDistance(*map(max, *sides))


@jax.jit
def geometric_laplacian(x: Positions, edges: Edges) -> Positions:
    """Compute the geometric Laplacian v - Σ_j v_j/l_j / Σ_j 1/l_j of each vertex, over neighbours at distances l_j.

    Edges of length 0 do not count; a vertex without other edges gets 0.
    """
    tail, head = edges[:, 0], edges[:, 1]
    weight = inverse_root(jnp.sum((x[tail] - x[head]) ** 2, axis=1))[:, None]
    total = jnp.zeros((len(x), 1), x.dtype).at[tail].add(weight).at[head].add(weight)
    near = jnp.zeros_like(x).at[tail].add(weight * x[head]).at[head].add(weight * x[tail])
    return jnp.where(total > 0, x - ratio(near, total), 0)


@jax.jit
def gl(original: Positions, distorted: Positions, edges: Edges) -> Scalar:
    """Compute the mean of two RMS changes, of positions and of the geometric Laplacian, in units of the positions.

    Reference: Karni, Gotsman, "Spectral compression of mesh geometry", SIGGRAPH 2000, section 5. The paper divides the
    roots of sums of squares by the number of vertices. Here they are root mean squares, so that meshes with different
    numbers of vertices are comparable.

    Raises:
        JaxmarkError: if the positions differ in shape.
    """
    check_alike("gl", original, distorted)
    change = geometric_laplacian(distorted, edges) - geometric_laplacian(original, edges)
    return jnp.asarray((rms(distorted - original) + rms(change)) / 2)


@jax.jit
def stretch(original: Positions, distorted: Positions, edges: Edges, share: float | Scalar = HIGH_SHARE) -> Scalar:
    """Compute the relative change of length that 1 % of the edges (1 - `share`) exceed.

    Displacements along the surface change lengths, and so textures, where shading hardly changes. Edges of length 0 do
    not count. The gradient is that of the edge at this percentile.

    Raises:
        JaxmarkError: if the positions differ in shape.
    """
    check_alike("stretch", original, distorted)
    before, after = (lengths(take_rows(x, edges[:, 0]) - take_rows(x, edges[:, 1])) for x in (original, distorted))
    return percentile(ratio(jnp.abs(after - before), before), (before > 0).astype(before.dtype), share)


class PointPlanes(NamedTuple):
    """The plane through the nearest points of each point of a cloud, and how far the points are apart."""

    normals: Float64[np.ndarray, "points 3"]  # of the planes
    spacing: float  # mean distance of a point to the nearest other one

    @classmethod
    def of(cls, points: Float64[np.ndarray, "points 3"]) -> "PointPlanes":
        """Fit the planes of a cloud."""
        return cls(planes(KDTree(points), points).normals, float(spacings(points).mean()))


def point_to_plane(displacement: Float64[np.ndarray, "points 3"], around: PointPlanes) -> float:
    """Measure the displacement across the surface that 5 % of the points exceed, over the distance of nearest points.

    A cloud is drawn as dots or small discs, which are about as large as the distance between points. Displacements by a
    small fraction of that distance neither roughen the surface nor open gaps. Displacements along the surface do not
    count. `around` has the planes of the points before they moved, in the units of the displacement.
    """
    across = np.abs(np.sum(displacement * around.normals, axis=1))
    return float(np.quantile(across, _HIGH_SHARE_OF_POINTS) / (around.spacing or 1.0))


def texture_drift(
    original: Mesh, distorted: Mesh, texture: Float[np.ndarray, "faces 3 2"], size: float = _TEXELS
) -> float | None:
    """Measure the drift of a texture that 1 % of the faces' corners exceed, in texels of a texture of 2,048 x 2,048.

    A corner that moves along the surface moves its part of the texture with it.

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
    # Each displacement is written as a sum of the two sides, whose images in the texture are known.
    along = (moved - corners)[sound] @ sides[sound].transpose(0, 2, 1) @ np.linalg.inv(metric[sound]) @ pairs[sound]
    return float(np.quantile(size * np.linalg.norm(along, axis=-1), HIGH_SHARE))
