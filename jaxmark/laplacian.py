"""The graph Laplacian of a mesh as edge arrays: what every filter is a polynomial of.

Δ = I - D⁻¹W with symmetric non-negative edge weights W and D the diagonal of their row sums (Sohn et al., eq. 4-5;
the paper prints D = diag(1/d), but its Lemma 3.1 holds for D = diag(d)). The spectrum is real and lies in [0, 2], and Δ
is self-adjoint in the inner product ⟨x, y⟩_D = xᵀDy.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int, Num
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, edges

Weighting = Literal["valence", "inverse-length", "cotangent"]


class Laplacian(NamedTuple):
    """Δ = I - D⁻¹W of a graph with N vertices and E undirected edges, as a pytree of arrays.

    A vertex without edges is an eigenvector of its own with eigenvalue 0 and has no weight in the inner product.
    """

    edges: Int[Array | np.ndarray, "edges 2"]  # each undirected edge once, no vertex joined to itself
    weights: Float[Array | np.ndarray, " edges"]  # W, symmetric by construction, non-negative
    degree: Float[Array | np.ndarray, " vertices"]  # D: the weights' row sums, 0 where isolated

    @jax.jit
    def apply(self, x: Float[Array, " vertices *columns"]) -> Float[Array, " vertices *columns"]:
        """Δx for one signal `[N]` or several `[N, C]`: two segment-sums over the edges, in the dtype of `x`.

        Raises:
            JaxmarkError: if `x` is not floating.
        """
        if not jnp.issubdtype(x.dtype, jnp.floating):
            raise JaxmarkError(f"Laplacian.apply needs a floating-point signal, got {x.dtype}.")
        tail, head = self.edges[:, 0], self.edges[:, 1]
        weights = per_row(self.weights, x)
        size = self.degree.shape[0]
        total = jax.ops.segment_sum(weights * x[head], tail, size) + jax.ops.segment_sum(weights * x[tail], head, size)
        degree = per_row(self.degree, x)
        # Select before dividing, so that isolated vertices keep finite gradients.
        linked = degree > 0
        return jnp.where(linked, x - total / jnp.where(linked, degree, 1), 0)

    @jax.jit
    def inner(
        self, x: Float[Array, " vertices *columns"], y: Float[Array, " vertices *columns"]
    ) -> Float[Array, " *columns"]:
        """⟨x, y⟩_D = Σ_v D_v x_v y_v, column by column: a scalar for `[N]`, `[C]` for `[N, C]`.

        Raises:
            JaxmarkError: if the shapes differ.
        """
        if x.shape != y.shape:
            raise JaxmarkError(f"Laplacian.inner needs two signals of one shape, got {x.shape} and {y.shape}.")
        return jnp.sum(per_row(self.degree, x) * x * y, axis=0)


def make_laplacian(mesh: Mesh, weights: Weighting | ArrayLike = "valence") -> Laplacian:
    """Build the operator of a mesh's edges on the host.

    Vertices at the same position are *not* merged; see `jaxmark.mesh.weld`.

    Args:
        mesh: any mesh; edges on a boundary, shared by three faces or more, and several components are well defined.
        weights: `"valence"`, each edge 1, so that w_ij = 1/d(v_i) as in the paper; `"inverse-length"`, 1 over the
            edge's length; `"cotangent"`, half the sum of the cotangents of the angles opposite the edge, clipped below
            at 1e-6 of the largest; or an array `[E]` of non-negative weights in the order of `jaxmark.mesh.edges`.

    Returns:
        A `Laplacian` of NumPy arrays in float64; it computes in the dtype of the signal it is applied to.

    Raises:
        JaxmarkError: if the weighting is unknown or not finite and non-negative, `[E]`, or a length is zero.
    """
    pairs = edges(np.asarray(mesh.faces))
    if isinstance(weights, str):
        match weights:
            case "valence":  # needs no positions: they may be traced
                values = np.ones(len(pairs))
            case "inverse-length":
                values = _inverse_lengths(np.asarray(mesh.vertices, np.float64), pairs)
            case "cotangent":
                values = _cotangents(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), pairs)
            case _:
                raise JaxmarkError(
                    f"weights must be 'valence', 'inverse-length', 'cotangent' or an array, got {weights!r}."
                )
    else:
        values = np.asarray(weights, np.float64)
        if values.shape != (len(pairs),):
            raise JaxmarkError(f"weights must have one value for each of the {len(pairs)} edges, got {values.shape}.")
        if not (np.isfinite(values) & (values >= 0)).all():
            raise JaxmarkError("weights must be finite and not negative; otherwise the spectrum leaves [0, 2].")
    degree = np.bincount(pairs.ravel(), np.repeat(values, 2), minlength=len(mesh.vertices))
    return Laplacian(pairs.astype(np.int32), values, degree)


def per_row(values: Num[Array | np.ndarray, " rows"], x: Array | np.ndarray) -> Array:
    """Values per row, such as D, in the dtype of `x` and shaped to broadcast against its columns."""
    return jnp.asarray(values).astype(x.dtype).reshape(-1, *[1] * (x.ndim - 1))


def centre(
    operator: Laplacian, x: Float[Array | np.ndarray, "vertices columns"]
) -> Float64[np.ndarray, "vertices columns"]:
    """Subtract from each connected component its D-weighted mean, on the host in float64.

    What is left has no part in the null space of Δ: a filtered signal then does not depend on where the object, or any
    piece of it, stands. Do this before casting to float32, or large offsets eat the digits. An isolated vertex
    becomes 0.
    """
    x = np.asarray(x, np.float64)
    degree = np.asarray(operator.degree, np.float64)
    size = len(degree)
    # An edge of weight zero joins nothing.
    tail, head = np.asarray(operator.edges)[np.asarray(operator.weights) > 0].T
    graph = sparse.coo_array((np.ones(len(tail)), (tail, head)), shape=(size, size))
    count, component = csgraph.connected_components(graph, directed=False)
    mass = np.where(degree > 0, degree, 1.0)
    total = np.bincount(component, mass, count)
    means = np.stack([np.bincount(component, mass * column, count) for column in x.T], axis=1) / total[:, None]
    centred = x - means[component]
    # A second pass removes what the first left by cancellation at large offsets.
    rest = np.stack([np.bincount(component, mass * column, count) for column in centred.T], axis=1) / total[:, None]
    return centred - rest[component]


def sparse_matrices(operator: Laplacian) -> tuple[sparse.csr_array, sparse.dia_array]:
    """(D - W, D) as SciPy sparse matrices in float64, for host-side linear algebra; D⁻¹(D - W) is Δ."""
    degree = np.asarray(operator.degree, np.float64)
    tail, head = np.asarray(operator.edges).T
    weights = np.asarray(operator.weights, np.float64)
    adjacency = sparse.coo_array((weights, (tail, head)), shape=(len(degree), len(degree)))
    mass = sparse.diags_array(degree)
    stiffness = sparse.csr_array(mass - adjacency - adjacency.T)
    stiffness.eliminate_zeros()
    return stiffness, mass


def _inverse_lengths(vertices: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    if (lengths == 0).any():
        bad = pairs[int(np.argmin(lengths))]
        raise JaxmarkError(f"Edge {bad.tolist()} has length zero; weld its vertices or use valence weights.")
    return 1.0 / lengths


def _cotangents(vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Half the sum of the cotangents opposite each edge, clipped at 1e-6 of the largest to keep W non-negative."""
    values = np.zeros(len(pairs))
    base = len(vertices)
    codes = pairs[:, 0] * base + pairs[:, 1]
    for corner in range(3):
        apex, first, second = (faces[:, (corner + shift) % 3] for shift in range(3))
        u, v = vertices[first] - vertices[apex], vertices[second] - vertices[apex]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        sound = area > 0  # a degenerate face has no angles
        cotangent = np.einsum("ij,ij->i", u, v)[sound] / area[sound]
        edge = np.minimum(first, second)[sound] * base + np.maximum(first, second)[sound]
        values += np.bincount(np.searchsorted(codes, edge), 0.5 * cotangent, len(pairs))
    largest = values.max(initial=0.0)
    if largest <= 0:
        raise JaxmarkError("No edge has a positive cotangent weight; use valence weights.")
    return np.maximum(values, 1e-6 * largest)
