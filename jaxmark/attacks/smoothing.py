"""Linear smoothing: explicit steps of the graph Laplacian, and an implicit step of the cotangent Laplacian."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.attacks.extent import displace, surface
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, boundary_vertices, edges, used_vertices
from jaxmark.spectral import rational
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, graph_laplacian
from jaxmark.spectral.weights import cotangent_weights

_STEP_SIZE = 0.1  # of the SMI 2010 benchmark
_TAUBIN_STEP_SIZES = (0.5, -0.53)  # Taubin's λ and μ: frequencies up to 1/λ + 1/μ = 0.11 are passed, not damped
_MAX_STEPS = 100_000


def laplacian_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Move all vertices at once towards the means of their neighbours: v ← v + 0.1 (mean of neighbours - v).

    As in the SMI 2010 benchmark (Wang et al.), boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of steps, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of steps is not a whole number from 0 to 100,000.
    """
    return _smooth_by_steps(mesh, np.full(whole_steps(strength), _STEP_SIZE))


def taubin_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Smooth without shrinking: each step of 0.5 towards the mean of the neighbours is followed by one of -0.53.

    Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995. A pair is the filter
    (1 - 0.5 λ)(1 + 0.53 λ): frequencies below λ = 0.11 are kept, or raised by up to 0.09 % per pair, and higher ones
    damped. Boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of pairs of steps, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of pairs is not a whole number from 0 to 100,000.
    """
    return _smooth_by_steps(mesh, np.tile(_TAUBIN_STEP_SIZES, whole_steps(strength)))


def cotangent_smoothing(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray | None = None) -> Mesh:
    """Smooth by one implicit diffusion step with cotangent weights: v' solves (I + t Δ) v' = v.

    Desbrun et al., "Implicit fairing of irregular meshes using diffusion and curvature flow", SIGGRAPH 1999. Δ is the
    Laplacian of `from_mesh(mesh, "cotangent")`, whose weights are clipped to be positive. Boundary vertices move
    as all others do. The weighted mean position of each component stays. A mesh without a positive weight stays.

    Args:
        mesh: any mesh, its faces concrete.
        strength: diffusion time t, which multiplies a component of frequency λ in [0, 2] by 1/(1 + tλ).
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices, on which the weights depend, and strength.
    """
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    # Positions are filtered relative to their mean, so that a distant mesh loses no digits.
    start = jnp.where(used[:, None], vertices - surface(mesh).mean(axis=0), 0)
    return displace(mesh, _diffuse(_cotangent(mesh), start, jnp.asarray(strength).astype(vertices.dtype)) - start)


def whole_steps(strength: float) -> int:
    """The number of steps that a strength asks for.

    Raises:
        JaxmarkError: if it is not a whole number from 0 to 100,000.
    """
    if not 0 <= strength <= _MAX_STEPS or strength != int(strength):
        raise JaxmarkError(f"Smoothing takes a whole number of steps from 0 to {_MAX_STEPS}, got {strength:g}.")
    return int(strength)


def inner_vertices(mesh: Mesh) -> Bool[np.ndarray, "vertices 1"]:
    """Mask of the vertices that are on no boundary."""
    inner = np.ones((len(mesh.vertices), 1), bool)
    inner[boundary_vertices(np.asarray(mesh.faces))] = False
    return inner


def _smooth_by_steps(mesh: Mesh, factors: Float[np.ndarray, " steps"]) -> Mesh:
    """Smooth a mesh by one explicit step of the graph Laplacian for each factor; boundary vertices stay."""
    vertices = jnp.asarray(mesh.vertices)
    moved = _smooth(from_mesh(mesh), inner_vertices(mesh), vertices, factors.astype(vertices.dtype))
    return Mesh(moved, mesh.faces)


@jax.jit
def _smooth(
    operator: Laplacian, moving: Array, vertices: Float[Array, "vertices 3"], factors: Float[Array, " steps"]
) -> Float[Array, "vertices 3"]:
    def step(v: Array, factor: Array) -> tuple[Array, None]:
        return v - jnp.where(moving, factor * operator.apply(v), 0), None

    return jax.lax.scan(step, vertices, factors)[0]


@jax.jit
def _diffuse(operator: Laplacian, x: Float[Array, "vertices 3"], time: Float[Array, ""]) -> Float[Array, "vertices 3"]:
    one, nothing = jnp.ones_like(time), jnp.zeros_like(time)
    return rational.filter_rational(operator, jnp.stack([one, nothing, nothing, one, time, nothing])[None], x)


def _cotangent(mesh: Mesh) -> Laplacian:
    """The Laplacian of `from_mesh(mesh, "cotangent")`, in which a mesh without a positive weight has no edges."""
    pairs, size = edges(np.asarray(mesh.faces)), len(mesh.vertices)
    weighted = graph_laplacian(pairs, size, np.ones(len(pairs)))
    return weighted.with_weights(cotangent_weights(jnp.asarray(mesh.vertices), mesh.faces))
