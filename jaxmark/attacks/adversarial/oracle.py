"""Attacks by somebody who may ask a detector about meshes of his own making: for its score, or only for its decision.

He knows the algorithm, and neither key nor original. Directions are drawn as marks are, by the public filter: along
others there is little to learn.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, PRNGKeyArray

from jaxmark.attacks.jamming import through_bands
from jaxmark.attacks.random import generator
from jaxmark.attacks.registry import Attack
from jaxmark.detectors import claims
from jaxmark.distortion import rms
from jaxmark.errors import JaxmarkError
from jaxmark.keys import derive, geometry_hash
from jaxmark.laplacian import Laplacian, make_laplacian
from jaxmark.marking import Marker
from jaxmark.mesh import Mesh, diagonal, host_mesh, used_vertices
from jaxmark.message import encode

_UNIT = "RMS over the diagonal"
_STRENGTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
_ROUNDS = 4  # of gradients: more are each of fewer directions, and see less of them
_PROBE = 0.3  # over the displacement, where scores tell
_NEAR = 0.05  # over the displacement, where decisions tell: the boundary bends
_FIRST, _LAST = 1e-4, 0.2  # of jamming that is tried for a start
_QUERIES = (100, 300, 1000)
_TOLERANCE = 0.01  # of bisection, over the whole way
_BATCH = 30  # directions for the first normal
_AT_ONCE = 32  # directions that are filtered together

Score = Callable[[Mesh], float]
Decision = Callable[[Mesh], bool]
_Shift = Float64[np.ndarray, "vertices 3"]
Answer = TypeVar("Answer", bool, float)


@dataclass
class Counted(Generic[Answer]):
    """An oracle that counts how often it was asked."""

    oracle: Callable[[Mesh], Answer]
    queries: int = 0

    def __call__(self, mesh: Mesh) -> Answer:
        """Ask."""
        self.queries += 1
        return self.oracle(mesh)


def score_oracle(marker: Marker, message: bytes) -> Score:
    """A detector that tells the evidence √(-2 ln p) of a claim, without a floor; 0 for a suspect that it refuses.

    That is S/‖a‖ where one way of weighing is tried, and a little less where the better of two is (`detectors.claims`).

    Args:
        marker: what reads: original, key, payload and scheme.
        message: what was written.

    Raises:
        JaxmarkError: if the message is of another size than the payload.
    """
    marker.check_size(message)
    original, reader = marker.original, marker.reader
    codeword = jnp.asarray(encode(message, marker.key, original.geometry, marker.code), original.signal.dtype)

    def score(mesh: Mesh) -> float:
        try:
            seen = marker.observe(mesh)
        except JaxmarkError:
            return 0.0
        scores, norms = (np.asarray(one, np.float64) for one in claims(reader, seen, codeword))
        best = np.max(np.divide(scores, norms, out=np.zeros_like(scores), where=norms > 0))
        return math.sqrt(max(float(best) * abs(float(best)) - 2 * math.log(len(scores)), 0.0))

    return score


def decision_oracle(marker: Marker, message: bytes, alpha: float = 1e-6) -> Decision:
    """A detector that tells whether a claim is proven; a suspect that it refuses is not detected.

    Args:
        marker: see `score_oracle`.
        message: see `score_oracle`.
        alpha: false-positive probability at which it detects, in (0, 1).

    Raises:
        JaxmarkError: if the message is of another size than the payload, or `alpha` out of range.
    """
    marker.check_size(message)
    least = _log10(alpha)

    def decide(mesh: Mesh) -> bool:
        try:
            return marker.detect(mesh, message).log10_p <= least
        except JaxmarkError:
            return False

    return decide


def decided(oracle: Score, alpha: float = 1e-6) -> Decision:
    """The decision by a score: with `randomised`, by a threshold that nobody can tell beforehand.

    Args:
        oracle: of √(-2 ln p), see `score_oracle`.
        alpha: see `decision_oracle`.

    Raises:
        JaxmarkError: if `alpha` is out of range.
    """
    least = math.sqrt(-2 * math.log(10) * _log10(alpha))
    return lambda mesh: bool(oracle(mesh) >= least)


def quantised(oracle: Score, step: float) -> Score:
    """Scores rounded to multiples of a step, so that small changes of a mesh are not seen.

    Args:
        oracle: of scores.
        step: positive.

    Raises:
        JaxmarkError: if the step is not positive.
    """
    if not step > 0:
        raise JaxmarkError(f"Scores are rounded to multiples of a positive step, not {step:g}.")
    return lambda mesh: step * round(oracle(mesh) / step)


def randomised(oracle: Score, spread: float, key: bytes) -> Score:
    """Scores with normal noise, which a key determines for each mesh: asking twice gives nothing to average.

    Args:
        oracle: of scores.
        spread: standard deviation of the noise.
        key: 32 bytes, of the detector's.
    """

    def score(mesh: Mesh) -> float:
        seed = int.from_bytes(derive(key, geometry_hash(mesh), "oracle/noise", 16), "little")
        return oracle(mesh) + spread * float(np.random.default_rng(seed).normal())

    return score


def estimated_gradient(oracle: Score, *, queries: int = 300) -> Attack:
    """Lower a score by gradients that are estimated from answers to antithetic pairs of meshes.

    From a jammed mesh, for at an unattacked mark scores are nearly at their largest and tell little, it goes in four
    rounds over the sphere of displacements of one size. A gradient is the least one that explains the differences of a
    round's pairs (Nesterov, Spokoiny, Foundations of Computational Mathematics 17, 2017, draw and average so; least
    squares make up for directions that are not orthogonal); the mean of all gradients leads.

    Args:
        oracle: of scores.
        queries: how often it may be asked for one mesh, at least 2.

    Returns:
        An attack; its strength is the RMS displacement over the diagonal of the mesh.

    Raises:
        JaxmarkError: if fewer than 2 queries are allowed.
    """
    if queries < 2:
        raise JaxmarkError(f"A gradient takes at least 2 queries, got {queries}.")
    rounds = min(_ROUNDS, queries // 2)

    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        space, random = _space(mesh), generator(key)
        here, total = space.resized(space.draw(1, random)[0], strength), np.zeros_like(mesh.vertices, float)
        for _ in range(rounds if strength > 0 else 0):
            ways = space.draw(queries // rounds // 2, random)
            probes = [
                [space.resized(here + sign * _PROBE * strength * way, strength) for sign in (1, -1)] for way in ways
            ]
            rises = [oracle(space.mesh(one)) - oracle(space.mesh(other)) for one, other in probes]
            slope = np.linalg.lstsq(ways.reshape(len(ways), -1), np.array(rises), rcond=0.1)[0].reshape(here.shape)
            total += space.resized(slope, 1.0)
            here = space.resized(here - space.resized(total, 2 * strength), strength)
        return space.mesh(here)

    return Attack(apply, _UNIT, _STRENGTHS, host=True)


def random_search(oracle: Score, *, queries: int = 300) -> Attack:
    """Lower a score by random moves of the displacement, each kept if the score falls; no gradient is estimated.

    Moves grow by a half where they are kept and shrink where they are not, so that a fifth is kept (Rechenberg,
    Evolutionsstrategie, 1973).

    Args:
        oracle: of scores.
        queries: how often it may be asked for one mesh, at least 1.

    Returns:
        See `estimated_gradient`.

    Raises:
        JaxmarkError: if not even one query is allowed.
    """
    if queries < 1:
        raise JaxmarkError(f"A search takes at least 1 query, got {queries}.")

    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        space, random = _space(mesh), generator(key)
        here, step = space.resized(space.draw(1, random)[0], strength), strength / 2
        lowest = oracle(space.mesh(here))
        for _ in range(queries - 1):
            there = space.resized(here + step * space.draw(1, random)[0], strength)
            found = oracle(space.mesh(there))
            if found < lowest:
                here, lowest = there, found
            step *= 1.5 if found <= lowest else 1.5**-0.25
        return space.mesh(here)

    return Attack(apply, _UNIT, _STRENGTHS, host=True)


def boundary(oracle: Decision) -> Attack:
    """The least displacement found that is not detected, by decisions alone.

    It follows HopSkipJump (Chen, Jordan, Wainwright, IEEE Symposium on Security and Privacy 2020): a mesh that is
    jammed until it is not detected goes back towards the marked one as far as it may; there the boundary's normal is
    estimated from decisions nearby, the mesh goes along it, halving the step until it is not detected, and back again.

    Args:
        oracle: of decisions; one that answers always alike for a mesh.

    Returns:
        An attack; its strength is the number of queries, which are not exceeded. It gives the mesh back as it was where
        they do not suffice to find any that is not detected.
    """

    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        space, random, asked = _space(mesh), generator(key), Counted(oracle)

        def left() -> int:
            return int(strength) - asked.queries

        def passes(shift: _Shift) -> bool:
            return left() > 0 and not asked(space.mesh(shift))

        def nearest(shift: _Shift) -> _Shift:
            """The last that passes on the way from a shift that does to none."""
            low, high = 0.0, 1.0
            while high - low > _TOLERANCE and left() > 0:
                middle = (low + high) / 2
                low, high = (low, middle) if passes(middle * shift) else (middle, high)
            return high * shift

        size = _FIRST
        while not passes(start := size * space.draw(1, random)[0]):
            size *= 2
            if size > _LAST or left() <= 0:
                return mesh
        here = best = nearest(start)
        turn = 0
        while left() > 0:
            turn += 1
            length = space.size(here)
            ways = space.draw(min(round(_BATCH * math.sqrt(turn)), left()), random)
            answers = np.array([passes(here + _NEAR * length * way) for way in ways], float)
            normal = space.resized(np.tensordot(answers - answers.mean(), ways, 1), 1.0)
            step = length / math.sqrt(turn)
            while left() > 0 and step > _TOLERANCE * length:
                if passes(here + step * normal):
                    here = nearest(here + step * normal)
                    break
                step /= 2
            best = min(best, here, key=space.size)
        return space.mesh(best)

    return Attack(apply, "queries", _QUERIES, host=True)


@dataclass(frozen=True)
class _Space:
    """Displacements of a mesh, in its diagonals, of the vertices that faces use."""

    start: Mesh
    operator: Laplacian
    used: Bool[np.ndarray, " vertices"]
    length: float

    def draw(self, count: int, random: np.random.Generator) -> Float64[np.ndarray, "count vertices 3"]:
        """So many that look like marks, each of RMS 1."""
        batch = min(count, _AT_ONCE)  # all batches of one shape are compiled once
        batches = [random.normal(size=(len(self.used), 3 * batch)) for _ in range(-(-count // batch))]
        noise = [np.asarray(through_bands(self.operator, jnp.asarray(one, np.float32))) for one in batches]
        found = np.concatenate(noise, axis=1)[:, : 3 * count].reshape(len(self.used), count, 3).astype(np.float64)
        ways = np.where(self.used[:, None], np.moveaxis(found, 1, 0), 0)
        return ways / np.sqrt(np.sum(ways**2, axis=(1, 2), keepdims=True) / self.used.sum())

    def size(self, shift: _Shift) -> float:
        return float(rms(shift[self.used]))

    def resized(self, shift: _Shift, size: float) -> _Shift:
        """Of another RMS; nothing stays nothing."""
        return shift * (size / max(self.size(shift), 1e-300))

    def mesh(self, shift: _Shift) -> Mesh:
        return Mesh(self.start.vertices + self.length * shift, self.start.faces)


def _space(mesh: Mesh) -> _Space:
    mesh = host_mesh(mesh)
    return _Space(mesh, make_laplacian(mesh), used_vertices(mesh), diagonal(mesh))


def _log10(alpha: float) -> float:
    if not 0 < alpha < 1:
        raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
    return math.log10(alpha)
