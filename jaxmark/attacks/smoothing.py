"""Smoothing that is linear in the positions."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark import rational
from jaxmark.attacks.extent import displaced, surface
from jaxmark.distortion.roots import root
from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import Laplacian, make_laplacian
from jaxmark.mesh import Mesh, boundary_vertices, edges, sides, used_vertices

# The step of the SMI 2010 benchmark.
_STEP = 0.1
_PAIR = (0.5, -0.53)  # Taubin's λ and μ: λ up to 1/λ + 1/μ = 0.11 is passed, and not damped
_MOST_STEPS = 100_000
_LEAST = 1e-6  # cotangent weight, over the largest


def laplacian_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Move each vertex towards the mean of its neighbours, all at once: v ← v + 0.1 (mean of neighbours - v).

    As in the SMI 2010 benchmark (Wang et al.), boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many steps, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not whole, negative or too large.
    """
    return _stepwise(mesh, np.full(whole_steps(strength), _STEP))


def taubin_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Smooth without shrinking: each step of 0.5 towards the mean of the neighbours is followed by one of -0.53.

    Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995. A pair is the filter
    (1 - 0.5 λ)(1 + 0.53 λ): what lies below λ = 0.11 is kept, or raised by up to 0.09 % a pair, and the rest damped.
    Boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: how many pairs of steps, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of pairs is not whole, negative or too large.
    """
    return _stepwise(mesh, np.tile(_PAIR, whole_steps(strength)))


def cotangent_smoothing(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Smooth by one implicit step of cotangent weights: the solution v' of (I + t Δ) v' = v.

    Desbrun et al., "Implicit fairing of irregular meshes using diffusion and curvature flow", SIGGRAPH 1999. Δ is that
    of `make_laplacian(mesh, "cotangent")`, whose weights are clipped to be positive. Boundary vertices move as all
    others do. The mean position of each component, by the weights, stays. A mesh without a positive weight stays.

    Args:
        mesh: any mesh, its faces concrete.
        strength: the time t of diffusion, in which a part of frequency λ in [0, 2] falls to 1/(1 + tλ).
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices, on which the weights depend, and strength.
    """
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    # Only the difference from the middle is filtered: the position does not eat its digits.
    start = jnp.where(used[:, None], vertices - surface(mesh).mean(axis=0), 0)
    return displaced(mesh, _diffused(_cotangent(mesh), start, jnp.asarray(strength).astype(vertices.dtype)) - start)


def whole_steps(strength: float) -> int:
    """How many steps a strength asks for.

    Raises:
        JaxmarkError: if it is not whole, negative or too large.
    """
    if not 0 <= strength <= _MOST_STEPS or strength != int(strength):
        raise JaxmarkError(f"Smoothing takes a whole number of steps from 0 to {_MOST_STEPS}, got {strength:g}.")
    return int(strength)


def inner_vertices(mesh: Mesh) -> Bool[np.ndarray, "vertices 1"]:
    """The vertices that are on no boundary."""
    inner = np.ones((len(mesh.vertices), 1), bool)
    inner[boundary_vertices(np.asarray(mesh.faces))] = False
    return inner


def _stepwise(mesh: Mesh, factors: Float[np.ndarray, " steps"]) -> Mesh:
    vertices = jnp.asarray(mesh.vertices)
    moved = _smooth(make_laplacian(mesh), inner_vertices(mesh), vertices, factors.astype(vertices.dtype))
    return Mesh(moved, mesh.faces)


@jax.jit
def _smooth(
    operator: Laplacian, moving: Array, vertices: Float[Array, "vertices 3"], factors: Float[Array, " steps"]
) -> Float[Array, "vertices 3"]:
    def step(v: Array, factor: Array) -> tuple[Array, None]:
        return v - jnp.where(moving, factor * operator.apply(v), 0), None

    return jax.lax.scan(step, vertices, factors)[0]


@jax.jit
def _diffused(operator: Laplacian, x: Float[Array, "vertices 3"], time: Float[Array, ""]) -> Float[Array, "vertices 3"]:
    one, nothing = jnp.ones_like(time), jnp.zeros_like(time)
    return rational.filter(operator, jnp.stack([one, nothing, nothing, one, time, nothing])[None], x)


def _cotangent(mesh: Mesh) -> Laplacian:
    """As `make_laplacian(mesh, "cotangent")`, of positions that may be traced."""
    v, faces = jnp.asarray(mesh.vertices), np.asarray(mesh.faces)
    pairs, (ends, apex), base = edges(faces), sides(faces), np.array([len(v), 1])
    first, second = v[ends[:, 0]] - v[apex], v[ends[:, 1]] - v[apex]
    area = root(jnp.sum(jnp.cross(first, second) ** 2, axis=1))
    sound = area > 0  # a degenerate face has no angles
    cotangent = jnp.where(sound, jnp.sum(first * second, axis=1) / jnp.where(sound, area, 1), 0)
    which = np.searchsorted(pairs @ base, np.sort(ends, axis=1) @ base)
    weights = jax.ops.segment_sum(cotangent / 2, which, len(pairs))
    weights = jnp.maximum(weights, _LEAST * jnp.max(weights, initial=0))
    degree = jax.ops.segment_sum(jnp.repeat(weights, 2), pairs.ravel(), len(v))
    return make_laplacian(mesh, np.ones(len(pairs)))._replace(weights=weights, degree=degree)
