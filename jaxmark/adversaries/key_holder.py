"""Attacks by the key holder, with original and message: the least displacement that defeats a claim of the message.

These attacks estimate the least distortion that any attack needs. Compared with attackers who know less, they show
whether those fail because they lack knowledge, or because their method is weak. Pose and correspondence are computed on
the host; given them, the claim is a differentiable function of the displacement. Strengths are RMS displacements of the
vertices that faces use, relative to the diagonal of the original's bounding box. The attacked mesh must have the
original's connectivity, and a mark with the payload and the scheme of the marker.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.adversaries.expected import strongest_evidence
from jaxmark.alignment.attempts import align
from jaxmark.alignment.observation import Observation
from jaxmark.attacks.attack import Attack
from jaxmark.distortion.norms import rms
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, weld
from jaxmark.seeds import Randomness
from jaxmark.watermark.coding.message import check_size
from jaxmark.watermark.interfaces import Reader
from jaxmark.watermark.markers import NonBlindMarker

_STRENGTHS = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3)

_Way = Float64[np.ndarray, "points 3"]
Rise = tuple[
    Float[Array, ""], Float[Array, "vertices 3"]
]  # evidence S/‖a‖ of a claim, and a displacement that raises it
Slope = Callable[[Reader, Observation, Float[Array, " code"]], Rise]


def erasure(marker: NonBlindMarker, message: bytes) -> Attack:
    """Make an attack with the displacement that lowers the score of a claim most, in closed form.

    With weights, gains and powers as the receiver finds them in the marked mesh, the score is linear in the
    displacement, S + ⟨c, d⟩, and d = -ρ c/‖c‖ is the best displacement of its size: ρ = S/‖c‖ removes the whole score.
    If subtracting the mark itself leaves less evidence, the attack does that instead: as far as its size allows, and
    beyond that it reverses the mark.

    Raises:
        JaxmarkError: if the message is of another size than the payload.
    """
    return _attack(marker, message, _linear_slope, 1)


def erasure_by_descent(marker: NonBlindMarker, message: bytes, *, steps: int = 20) -> Attack:
    """Make the attack of `erasure` stronger by optimisation through the whole receiver, including its weights.

    It starts from the closed form. Each step moves towards the displacement of the same size that lies against the
    gradient of S/‖a‖, by a share of 2/(k + 2) in step k (Frank, Wolfe, Naval Research Logistics Quarterly 3, 1956); the
    suspect is aligned again in each step. The best displacement of as many as `steps` is returned.

    Raises:
        JaxmarkError: see `erasure`; or if `steps` is below 1.
    """
    if steps < 1:
        raise JaxmarkError(f"An attack by descent needs at least one step, got {steps}.")
    return _attack(marker, message, _slope, steps)


def _attack(marker: NonBlindMarker, message: bytes, slopes: Slope, steps: int) -> Attack:
    """Make an attack that goes against a slope of the evidence, with `steps` gradients."""
    original, reader = marker.original, marker.reader
    check_size(message, marker.bits)
    copies = weld(original.mesh.vertices)
    codeword = jnp.asarray(marker.codeword(message), original.signal.dtype)

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        if len(mesh.vertices) != len(copies.first):
            raise JaxmarkError(
                f"The mesh has {len(mesh.vertices)} points, the original {len(copies.first)}; only marks in the"
                " original's own connectivity are erased so."
            )
        if strength == 0:
            return mesh
        # An attack gets each point only once, but a suspect has all vertices at the point.
        start = np.asarray(mesh.vertices, np.float64)[copies.point]
        faces = original.mesh.faces
        given = align(original, Mesh(start, faces), "same")
        observation, back = marker.observe(given), np.linalg.inv(given.pose.matrix)

        def evaluate(observation: Observation) -> tuple[float, _Way]:
            evidence, slope = slopes(reader, observation, codeword)
            return float(evidence), -original.to_host(slope)

        def resize(way: _Way) -> _Way:
            return way * strength / max(float(rms(way[original.used])), 1e-300)

        def displace(way: _Way) -> Mesh:
            return Mesh(start + (original.diagonal * resize(way) @ back.T)[original.weld.point], faces)

        def attempt(way: _Way) -> tuple[float, _Way, _Way]:
            return (*evaluate(marker.observe(align(original, displace(way), "same"))), way)

        # Two displacements in closed form: the one that lowers the score most, and the mark subtracted. The better of
        # them is the start of the descent.
        homewards = -original.to_host(observation.residual)
        trials = [attempt(resize(way)) for way in (evaluate(observation)[1], homewards)]
        _, against, way = min(trials, key=lambda one: one[0])
        for step in range(steps - 1):
            trials.append(attempt(way + (2 / (step + 3)) * (resize(against) - way)))
            _, against, way = trials[-1]
        # A step may raise the evidence, so the best of all displacements of this size is returned.
        return mesh._replace(vertices=displace(min(trials, key=lambda one: one[0])[2]).vertices[copies.first])

    return Attack(apply, "RMS over the diagonal", _STRENGTHS, host=True)


@jax.jit
def _linear_slope(reader: Reader, observation: Observation, codeword: Float[Array, " code"]) -> Rise:
    """Return the evidence of a claim, and the slope of its score if all that the receiver learns is held fixed."""
    received = reader.receive(observation)
    slope = jax.grad(lambda residual: reader.linear_score(received, residual, codeword))(observation.residual)
    return strongest_evidence(reader, received, codeword), slope


@jax.jit
def _slope(reader: Reader, observation: Observation, codeword: Float[Array, " code"]) -> Rise:
    """Return the evidence of a claim, and its slope through all that the receiver does."""

    def evidence(residual: Array) -> Array:
        return strongest_evidence(reader, reader.receive(observation._replace(residual=residual)), codeword)

    return jax.value_and_grad(evidence)(observation.residual)
