"""Attacks by somebody who holds original, key and message: the least that takes a claim of the message away.

They bound from below what any attacker must pay, and say whether weaker attackers are weak or just clumsy. Pose and
correspondence are found on the host; given them, the claim is a differentiable function of the displacement.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.alignment import align
from jaxmark.attacks.adversarial.expected import strongest
from jaxmark.attacks.registry import Attack
from jaxmark.carriers import KeyedCarrier
from jaxmark.distortion import rms
from jaxmark.errors import JaxmarkError
from jaxmark.marking import Marker
from jaxmark.mesh import Mesh
from jaxmark.message import encode
from jaxmark.observation import Observation
from jaxmark.precision import matmul
from jaxmark.reception import clean

_UNIT = "RMS over the diagonal"
_STRENGTHS = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3)

_Way = Float64[np.ndarray, "points 3"]
# The evidence S/‖a‖ of a claim, and a displacement along which it rises.
Slope = Callable[
    [KeyedCarrier, Observation, Float[Array, " code"]], tuple[Float[Array, ""], Float[Array, "vertices 3"]]
]


def erasure(marker: Marker, message: bytes) -> Attack:
    """The displacement that lowers the score of a claim most, in closed form.

    With weights, gains and powers as the receiver finds them in the marked mesh, the score is linear in the
    displacement, S + ⟨c, d⟩, and d = -ρ c/‖c‖ is the best of its size: ρ = S/‖c‖ takes all of it. Or, where that leaves
    less evidence, the mark itself taken off as far as the size goes, and turned beyond.

    Args:
        marker: a keyed one: original, key, payload and scheme.
        message: what was written.

    Returns:
        An attack on meshes of the original's connectivity; its strength is the RMS displacement of the vertices that
        faces use, relative to the diagonal of the original's bounding box.

    Raises:
        JaxmarkError: if the marker is of a scheme that is not keyed, or the message of another size than its payload.
    """
    return _attack(marker, message, _linear_slope, 1)


def erasure_by_descent(marker: Marker, message: bytes, *, steps: int = 20) -> Attack:
    """The same by optimisation through all that the receiver does, so that what weighs the evidence is attacked, too.

    From the closed form on, each step goes some of the way to the displacement of its size that lies against the
    gradient of S/‖a‖, 2/(k + 2) in step k (Frank, Wolfe, Naval Research Logistics Quarterly 3, 1956); the suspect is
    aligned anew at each.

    Args:
        marker: see `erasure`.
        message: see `erasure`.
        steps: how many gradients are taken; the best of as many displacements is returned.

    Returns:
        See `erasure`.

    Raises:
        JaxmarkError: see `erasure`; or if not even one step is asked for.
    """
    if steps < 1:
        raise JaxmarkError(f"An attack by descent needs at least one step, got {steps}.")
    return _attack(marker, message, _slope, steps)


def _attack(marker: Marker, message: bytes, slopes: Slope, steps: int) -> Attack:
    original, reader = marker.original, marker.reader
    if not isinstance(reader, KeyedCarrier):
        raise JaxmarkError(f"Only keyed marks are erased so, not those of the scheme {marker.scheme.name!r}.")
    marker.check_size(message)
    codeword = jnp.asarray(encode(message, marker.key, original.geometry, marker.code), original.signal.dtype)

    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        if len(mesh.vertices) != len(original.positions):
            raise JaxmarkError(
                f"The mesh has {len(mesh.vertices)} points, the original {len(original.positions)}; only marks in the"
                " original's own connectivity are erased so."
            )
        if strength == 0:
            return mesh
        # An attack is given each point once, but a suspect has its copies.
        start = np.asarray(mesh.vertices, np.float64)[original.weld.point]
        faces = original.mesh.faces
        given = align(original, Mesh(start, faces), "same")
        seen, back = marker.observe(given), np.linalg.inv(given.pose.matrix)

        def looked(seen: Observation) -> tuple[float, _Way]:
            evidence, slope = slopes(reader, seen, codeword)
            return float(evidence), -original.on_host(slope)

        def sized(way: _Way) -> _Way:
            return way * strength / max(float(rms(way[original.used])), 1e-300)

        def displaced(way: _Way) -> Mesh:
            return Mesh(start + (original.diagonal * sized(way) @ back.T)[original.weld.point], faces)

        def tried(way: _Way) -> tuple[float, _Way, _Way]:
            return (*looked(marker.observe(align(original, displaced(way), "same"))), way)

        # In closed form: what the score falls by most, and the mark itself; then on from the better of them.
        homewards = -original.on_host(seen.residual)
        trials = [tried(sized(way)) for way in (looked(seen)[1], homewards)]
        _, against, way = min(trials, key=lambda one: one[0])
        for step in range(steps - 1):
            trials.append(tried(way + (2 / (step + 3)) * (sized(against) - way)))
            _, against, way = trials[-1]
        # The way is not always down: the best of all displacements of this size counts.
        return mesh._replace(vertices=displaced(min(trials, key=lambda one: one[0])[2]).vertices[original.weld.first])

    return Attack(apply, _UNIT, _STRENGTHS, host=True)


@jax.jit
def _linear_slope(
    carrier: KeyedCarrier, seen: Observation, codeword: Float[Array, " code"]
) -> tuple[Float[Array, ""], Float[Array, "vertices 3"]]:
    """Of the score alone, with what the receiver learns held fixed; the evidence as it would be found."""
    received = carrier.received(seen)

    def score(residual: Array) -> Array:
        left = matmul(clean(received.host, received.seen, received.factor, residual), received.axes)
        shape = carrier.shape(1.0, received.gain / received.power)
        return jnp.sum(codeword * carrier.correlate(matmul(left, received.axes), shape))

    return strongest(carrier, received, codeword), jax.grad(score)(seen.residual)


@jax.jit
def _slope(
    carrier: KeyedCarrier, seen: Observation, codeword: Float[Array, " code"]
) -> tuple[Float[Array, ""], Float[Array, "vertices 3"]]:
    def evidence(residual: Array) -> Array:
        return strongest(carrier, seen._replace(residual=residual), codeword)

    return jax.value_and_grad(evidence)(seen.residual)
