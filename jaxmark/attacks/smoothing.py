"""Smoothing: steps of the graph Laplacian, an implicit step of the cotangent Laplacian, and the bilateral filter.

All of it is differentiable with respect to vertices. Numbers of steps are whole, from 0 to 100,000, and static.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.attacks.support import Positions, Strength, centred, displace, inner_vertices, whole_number
from jaxmark.distortion.norms import root
from jaxmark.geometry.mesh import Mesh, edges
from jaxmark.seeds import Seed
from jaxmark.spectral import rational
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, graph_laplacian
from jaxmark.spectral.weights import cotangent_weights

_STEP_SIZE = 0.1  # of the SMI 2010 benchmark
_TAUBIN_STEP_SIZES = (0.5, -0.53)  # Taubin's λ and μ: frequencies up to 1/λ + 1/μ = 0.11 are passed, not damped
Indices = Int[Array | np.ndarray, "_ _"]  # of vertices: one row per face or edge


def laplacian_smoothing(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Move all vertices at once towards the means of their neighbours: v ← v + 0.1 (mean of neighbours - v).

    The strength is the number of steps. As in the SMI 2010 benchmark (Wang et al.), boundary vertices stay.
    """
    return _smooth_by_steps(mesh, np.full(_step_count(strength), _STEP_SIZE))


def taubin_smoothing(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Smooth without shrinking: each step of 0.5 towards the mean of the neighbours is followed by one of -0.53.

    Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995. A pair is the filter
    (1 - 0.5 λ)(1 + 0.53 λ): frequencies below λ = 0.11 are kept, or raised by up to 0.09 % per pair, and higher ones
    damped. The strength is the number of pairs. Boundary vertices stay.
    """
    return _smooth_by_steps(mesh, np.tile(_TAUBIN_STEP_SIZES, _step_count(strength)))


def cotangent_smoothing(mesh: Mesh, strength: Strength, seed: Seed | None = None) -> Mesh:
    """Smooth by one implicit diffusion step with cotangent weights: v' solves (I + t Δ) v' = v.

    Desbrun et al., "Implicit fairing of irregular meshes using diffusion and curvature flow", SIGGRAPH 1999. Δ is the
    Laplacian of `from_mesh(mesh, "cotangent")`, whose weights are clipped to be positive. Boundary vertices move
    as all others do. The weighted mean position of each component stays. A mesh without a positive weight stays.

    The strength is the diffusion time t, which multiplies a component of frequency λ in [0, 2] by 1/(1 + tλ). Gradients
    include those through the weights, and the one with respect to the strength.
    """
    start = centred(mesh)
    pairs, size = edges(np.asarray(mesh.faces)), len(mesh.vertices)
    # Unlike `from_mesh`, this accepts a mesh without a positive weight; it has no edges.
    weights = cotangent_weights(jnp.asarray(mesh.vertices), mesh.faces)
    operator = graph_laplacian(pairs, size, np.ones(len(pairs))).with_weights(weights)
    return displace(mesh, _diffuse(operator, start, jnp.asarray(strength).astype(start.dtype)) - start)


def bilateral_smoothing(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Move each vertex along its normal by a weighted mean of its neighbours' offsets in that direction.

    Fleishman, Drori, Cohen-Or, "Bilateral mesh denoising", SIGGRAPH 2003. With n the normal at v, h = n · (q - v) the
    offset of a neighbour q and r = |q - v|, v moves by n Σ w h / Σ w with w = exp(-r²/2σ_c²) exp(-h²/2σ_s²). Neighbours
    are joined by an edge. σ_c is the mean edge length and σ_s the root mean square of the offsets, both of the given
    mesh; normals are weighted by area and computed again in each iteration. The strength is the number of iterations.
    Boundary vertices stay.
    """
    faces = np.asarray(mesh.faces)
    pairs = edges(faces)
    vertices, directed = jnp.asarray(mesh.vertices), np.concatenate([pairs, pairs[:, ::-1]])
    moved = _smooth_bilaterally(vertices, faces, directed, inner_vertices(mesh), _step_count(strength))
    return Mesh(moved, mesh.faces)


def _step_count(strength: float) -> int:
    return whole_number(strength, 0, 100_000, "Smoothing takes a whole number of steps from 0 to 100000")


def _smooth_by_steps(mesh: Mesh, factors: Float[np.ndarray, " steps"]) -> Mesh:
    """Smooth a mesh by one explicit step of the graph Laplacian for each factor; boundary vertices stay."""
    vertices = jnp.asarray(mesh.vertices)
    return Mesh(_smooth(from_mesh(mesh), inner_vertices(mesh), vertices, factors.astype(vertices.dtype)), mesh.faces)


@jax.jit
def _smooth(operator: Laplacian, moving: Array, vertices: Positions, factors: Float[Array, " steps"]) -> Positions:
    def step(v: Array, factor: Array) -> tuple[Array, None]:
        return v - jnp.where(moving, factor * operator.apply(v), 0), None

    return jax.lax.scan(step, vertices, factors)[0]


@jax.jit
def _diffuse(operator: Laplacian, x: Positions, time: Float[Array, ""]) -> Positions:
    one, nothing = jnp.ones_like(time), jnp.zeros_like(time)
    return rational.filter_rational(operator, jnp.stack([one, nothing, nothing, one, time, nothing])[None], x)


@partial(jax.jit, static_argnums=4)
def _smooth_bilaterally(
    vertices: Positions, faces: Indices, pairs: Indices, moving: Array | np.ndarray, steps: int
) -> Positions:
    tail, head = pairs[:, 0], pairs[:, 1]

    def offsets(v: Array) -> tuple[Array, Array, Array]:
        """Return vertex normals, squared lengths of the pairs, and offsets of the pairs."""
        normal, side = _vertex_normals(v, faces), v[head] - v[tail]
        return normal, jnp.sum(side**2, axis=1), jnp.sum(normal[tail] * side, axis=1)

    _, square, offset = offsets(vertices)
    spatial, spread = 2 * jnp.mean(root(square)) ** 2, 2 * jnp.mean(offset**2)
    flat = spread <= 0  # all offsets are zero, so nothing moves

    def step(v: Array, _: None) -> tuple[Array, None]:
        normal, square, offset = offsets(v)
        weight = jnp.exp(-square / spatial - offset**2 / jnp.where(flat, 1, spread))
        above, below = (jax.ops.segment_sum(x, tail, len(v)) for x in (weight * offset, weight))
        shift = above / jnp.where(below > 0, below, 1)
        return v + jnp.where(moving, shift[:, None] * normal, 0), None

    return jax.lax.scan(step, vertices, None, length=steps)[0]


def _vertex_normals(v: Positions, faces: Indices) -> Positions:
    """Return unit normals weighted by area, as `jaxmark.geometry.mesh.vertex_normals`, but traceable."""
    a, b, c = (v[faces[:, corner]] for corner in range(3))
    total = jax.ops.segment_sum(jnp.repeat(jnp.cross(b - a, c - a), 3, axis=0), faces.ravel(), len(v))
    length = root(jnp.sum(total**2, axis=1, keepdims=True))
    return total / jnp.where(length > 0, length, 1)
