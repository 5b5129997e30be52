"""Attacks by an adversary who may query a detector with arbitrary meshes, for its score or only for its decision.

The adversary knows the algorithm, but neither key nor original. Search directions are random displacements with the
spectrum of marks, because a detector hardly reacts to other displacements.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.adversaries.by_name import through_bands
from jaxmark.attacks.attack import Attack
from jaxmark.distortion.norms import rms
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, diagonal, host_mesh, used_vertices
from jaxmark.seeds import Randomness, generator
from jaxmark.spectral.graphs import from_mesh
from jaxmark.watermark.coding.keys import Choices, Key
from jaxmark.watermark.coding.message import check_size
from jaxmark.watermark.evidence.detection import check_alpha
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.reading.detectors import claims

_UNIT = "RMS over the diagonal"
_STRENGTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
_GRADIENT_ROUNDS = 4  # with more rounds, each gradient has fewer directions and so misses more
_SCORE_PROBE_RATIO = 0.3  # length of a probe of the score over that of the displacement
_DECISION_PROBE_RATIO = 0.05  # the same for a decision: short, because the boundary is curved
_MIN_START_RMS, _MAX_START_RMS = 1e-4, 0.2  # of the jamming that is tried for a start, in diagonals
_QUERY_COUNTS = (100, 300, 1000)
_BISECTION_TOLERANCE = 0.01  # over the whole way
_FIRST_NORMAL_DIRECTIONS = 30  # for the first estimate of the boundary's normal
_DIRECTIONS_PER_BATCH = 32  # filtered together

Score = Callable[[Mesh], float]  # the evidence √(-2 ln p) of a claim
Decision = Callable[[Mesh], bool]  # whether the claim is proven
_Shift = Float64[np.ndarray, "vertices 3"]
Answer = TypeVar("Answer", bool, float)


@dataclass
class Counted(Generic[Answer]):
    """An oracle that counts how often it is queried."""

    oracle: Callable[[Mesh], Answer]
    queries: int = 0

    def __call__(self, mesh: Mesh) -> Answer:
        """Query the oracle."""
        self.queries += 1
        return self.oracle(mesh)


def score_oracle(marker: NonBlindMarker, message: bytes) -> Score:
    """Make an oracle for the evidence √(-2 ln p) of a claim, with no floor on p; 0 for a suspect that is refused.

    The evidence is S/‖a‖ if the detector tries one way of weighting the suspect, and a little less if it takes the
    better of two (`detectors.claims`). The second readings of suspects with few vertices or non-rigid deformations are
    left out.

    Raises:
        JaxmarkError: if message and payload differ in size.
    """
    check_size(message, marker.bits)
    reader, dtype = marker.reader, marker.original.signal.dtype
    codeword = jnp.asarray(marker.codeword(message), dtype)

    def score(mesh: Mesh) -> float:
        try:
            received = marker.receive(marker.register(mesh))
        except JaxmarkError:
            return 0.0
        scores, norms = (np.asarray(one, np.float64) for one in claims(reader, received, codeword))
        best = np.max(np.divide(scores, norms, out=np.zeros_like(scores), where=norms > 0))
        return math.sqrt(max(float(best) * abs(float(best)) - 2 * math.log(len(scores)), 0.0))

    return score


def decision_oracle(marker: NonBlindMarker, message: bytes, alpha: float = 1e-6) -> Decision:
    """Make an oracle for the decision whether a claim is proven, with a false-positive probability of at most alpha.

    A suspect that is refused is not detected.

    Raises:
        JaxmarkError: if message and payload differ in size, or `alpha` is out of range.
    """
    check_size(message, marker.bits)
    least = _log10(alpha)

    def decide(mesh: Mesh) -> bool:
        try:
            return marker.detect(mesh, message).log10_p <= least
        except JaxmarkError:
            return False

    return decide


def decide_by_score(oracle: Score, alpha: float = 1e-6) -> Decision:
    """Make a decision oracle from a score oracle; with `randomise_scores`, its threshold cannot be predicted.

    Raises:
        JaxmarkError: if `alpha`, as in `decision_oracle`, is out of range.
    """
    least = math.sqrt(-2 * math.log(10) * _log10(alpha))
    return lambda mesh: bool(oracle(mesh) >= least)


def quantise_scores(oracle: Score, step: float) -> Score:
    """Round scores to multiples of a step, which hides small changes of a mesh.

    Raises:
        JaxmarkError: if the step is not positive.
    """
    if not step > 0:
        raise JaxmarkError(f"The step to which scores are rounded must be positive, got {step:g}.")
    return lambda mesh: step * round(oracle(mesh) / step)


def randomise_scores(oracle: Score, spread: float, key: bytes) -> Score:
    """Add normal noise to scores; repeated queries of a mesh get the same noise, so that they cannot average it out.

    The key of the detector, 32 bytes, determines the noise for each mesh; `spread` is its standard deviation.
    """

    def score(mesh: Mesh) -> float:
        seed = int.from_bytes(Choices(Key(key), geometry_hash(mesh)).derive("oracle/noise", 16), "little")
        return oracle(mesh) + spread * float(np.random.default_rng(seed).normal())

    return score


def estimated_gradient(oracle: Score, *, queries: int = 300) -> Attack:
    """Lower a score by gradients that are estimated from the scores of antithetic pairs of meshes.

    The attack starts from a jammed mesh, because at an unattacked mark scores are nearly at their largest and reveal
    little, and moves in four rounds on the sphere of displacements of one size. The gradient of a round is the one of
    least norm that explains the score differences of its pairs. Nesterov and Spokoiny, Foundations of Computational
    Mathematics 17, 2017, draw such pairs and average; least squares make up for directions that are not orthogonal. The
    attack follows the mean of all gradients so far. It takes at most `queries` queries for one mesh. Its strength is
    the RMS displacement over the diagonal.

    Raises:
        JaxmarkError: if `queries` is below 2.
    """
    if queries < 2:
        raise JaxmarkError(f"A gradient takes at least 2 queries, got {queries}.")
    rounds = min(_GRADIENT_ROUNDS, queries // 2)

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        space, random = _Space(mesh), generator(seed)
        here, total = space.rescale(space.draw(1, random)[0], strength), np.zeros_like(mesh.vertices, float)
        for _ in range(rounds if strength > 0 else 0):
            ways = space.draw(queries // rounds // 2, random)
            probes = [
                [space.rescale(here + sign * _SCORE_PROBE_RATIO * strength * way, strength) for sign in (1, -1)]
                for way in ways
            ]
            rises = [oracle(space.mesh(one)) - oracle(space.mesh(other)) for one, other in probes]
            slope = np.linalg.lstsq(ways.reshape(len(ways), -1), np.array(rises), rcond=0.1)[0].reshape(here.shape)
            total += space.rescale(slope, 1.0)
            here = space.rescale(here - space.rescale(total, 2 * strength), strength)
        return space.mesh(here)

    return Attack(apply, _UNIT, _STRENGTHS, host=True)


def random_search(oracle: Score, *, queries: int = 300) -> Attack:
    """Lower a score by random moves of the displacement, each kept if the score falls; no gradient is estimated.

    Moves grow by a half when one is kept and shrink when it is not, so that about a fifth of them is kept (Rechenberg,
    Evolutionsstrategie, 1973). The attack has the queries and strength of `estimated_gradient`.

    Raises:
        JaxmarkError: if `queries` is below 1.
    """
    if queries < 1:
        raise JaxmarkError(f"A search takes at least 1 query, got {queries}.")

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        space, random = _Space(mesh), generator(seed)
        here, step = space.rescale(space.draw(1, random)[0], strength), strength / 2
        lowest = oracle(space.mesh(here))
        for _ in range(queries - 1):
            there = space.rescale(here + step * space.draw(1, random)[0], strength)
            found = oracle(space.mesh(there))
            if found < lowest:
                here, lowest = there, found
            step *= 1.5 if found <= lowest else 1.5**-0.25
        return space.mesh(here)

    return Attack(apply, _UNIT, _STRENGTHS, host=True)


def boundary(oracle: Decision) -> Attack:
    """Search for the smallest displacement that is not detected, by decisions alone.

    The search follows HopSkipJump (Chen, Jordan, Wainwright, IEEE Symposium on Security and Privacy 2020): a mesh that
    is jammed until it is not detected moves back towards the marked one as far as it can. There the normal of the
    decision boundary is estimated from decisions nearby; the mesh moves along it, with the step halved until it is not
    detected, and back again. The oracle must give the same answer whenever it is asked about the same mesh.
    The strength of the attack is the number of queries, which is never exceeded. It returns the mesh unchanged if these
    do not suffice to find a displacement that is not detected.
    """

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        space, random, asked = _Space(mesh), generator(seed), Counted(oracle)

        def left() -> int:
            return int(strength) - asked.queries

        def passes(shift: _Shift) -> bool:
            return left() > 0 and not asked(space.mesh(shift))

        def nearest(shift: _Shift) -> _Shift:
            """Scale down a shift that passes, by bisection, as far as it still passes."""
            low, high = 0.0, 1.0
            while high - low > _BISECTION_TOLERANCE and left() > 0:
                middle = (low + high) / 2
                low, high = (low, middle) if passes(middle * shift) else (middle, high)
            return high * shift

        size = _MIN_START_RMS
        while not passes(start := size * space.draw(1, random)[0]):
            size *= 2
            if size > _MAX_START_RMS or left() <= 0:
                return mesh
        here = best = nearest(start)
        turn = 0
        while left() > 0:
            turn += 1
            length = space.size(here)
            ways = space.draw(min(round(_FIRST_NORMAL_DIRECTIONS * math.sqrt(turn)), left()), random)
            answers = np.array([passes(here + _DECISION_PROBE_RATIO * length * way) for way in ways], float)
            normal = space.rescale(np.tensordot(answers - answers.mean(), ways, 1), 1.0)
            step = length / math.sqrt(turn)
            while left() > 0 and step > _BISECTION_TOLERANCE * length:
                if passes(here + step * normal):
                    here = nearest(here + step * normal)
                    break
                step /= 2
            best = min(best, here, key=space.size)
        return space.mesh(best)

    return Attack(apply, "queries", _QUERY_COUNTS, host=True)


class _Space:
    """Displacements of the vertices that faces use, in diagonals of the mesh."""

    def __init__(self, mesh: Mesh) -> None:
        self.start = host_mesh(mesh)  # the marked mesh, not displaced
        self.operator, self.used, self.length = from_mesh(mesh), used_vertices(mesh), diagonal(mesh)

    def draw(self, count: int, random: np.random.Generator) -> Float64[np.ndarray, "count vertices 3"]:
        """Draw `count` directions that look like marks, each of RMS 1."""
        batch = min(count, _DIRECTIONS_PER_BATCH)  # batches of one shape are compiled once
        batches = [random.normal(size=(len(self.used), 3 * batch)) for _ in range(-(-count // batch))]
        noise = [np.asarray(through_bands(self.operator, jnp.asarray(one, np.float32))) for one in batches]
        found = np.concatenate(noise, axis=1)[:, : 3 * count].reshape(len(self.used), count, 3).astype(np.float64)
        ways = np.where(self.used[:, None], np.moveaxis(found, 1, 0), 0)
        return ways / np.sqrt(np.sum(ways**2, axis=(1, 2), keepdims=True) / self.used.sum())

    def size(self, shift: _Shift) -> float:
        return float(rms(shift[self.used]))

    def rescale(self, shift: _Shift, size: float) -> _Shift:
        """Rescale to RMS `size`; zero stays zero."""
        return shift * (size / max(self.size(shift), 1e-300))

    def mesh(self, shift: _Shift) -> Mesh:
        return Mesh(self.start.vertices + self.length * shift, self.start.faces)


def _log10(alpha: float) -> float:
    """Return log10 of a probability; refuse one that is not in (0, 1)."""
    check_alpha(alpha)
    return math.log10(alpha)
