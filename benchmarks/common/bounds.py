"""An upper bound on the evidence and the bits that the vertices of a simplified suspect can carry, by a model.

Each of a suspect's M vertices q_i that lies near the original is d_i = n_i · (q_i - foot_i) above the original's
surface. The foot is the point of that surface that is closest to q_i, and n_i is the original's normal there. The model
is

    d = A w + B c + e.

A interpolates the mark's displacement w at the feet (barycentric) and projects it on the normals. B does the same to
affine maps with any coefficients c, because the pose of a suspect is never known exactly. The errors e_i are
independent and Gaussian; their means and variances are those of simplifications of the original with other marks. A
keyed mark is w = T r with random signs r, so its covariance is T Tᵀ. Divide each height by the standard deviation of
its error, project B off, and let s_i be the eigenvalues of the covariance of A w after that. Each score S = r · a with
an a that is linear in d has

    (E S)² / E‖a‖² ≤ Σ s_i / (1 + s_i) ≤ M,

and `matched` reaches this bound. By Hoeffding's bound, exp(-S² / 2‖a‖²), a claim proves half of it in nats. A message
and its tag can have at most ½ Σ log₂(1 + s_i) bits, the capacity of parallel Gaussian channels.

The bound holds for the model only. Receivers can exceed it by using what the model omits: the positions of vertices
along the surface, the faces that join them, and correlations of errors. They can fall short of it, because the model
assumes too much: that the mark has its full strength, although smoothing weakens it; that errors do not depend on the
mark, and are Gaussian; and that their means are known, although only a reader who knows the attack knows them. A
variance estimated from 16 values makes 1/σ² larger by 15/13 in the mean, and so the bound by up to 0.6 dB. The bound
grows with the number of other marks, because more of them have vertices near those of a suspect and estimate its errors
better; it does not converge. With few other marks, claims exceed the bound.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.linalg import eigvalsh

from jaxmark.alignment.heights import Numbers, Unknowns, VertexHeights, measure_heights
from jaxmark.alignment.original import Original, displace, shift_of
from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.surfaces import Surface
from jaxmark.watermark.carriers.chips import KeyedCarrier
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.reading.coarse import model_errors, orthonormal

MOST_VERTICES = 5_000  # of a suspect, for matrices of M x M are dense
OTHERS = 64  # other marks, of random signs
COLUMNS = 32  # rows of A that are filtered at a time

Matrix = Float64[np.ndarray, "vertices vertices"]


class Bound(NamedTuple):
    """The model's bound for one suspect."""

    vertices: int  # M, those near the original
    square: float  # S² / ‖a‖² of a claim, at most
    bits: float  # of message and tag, at most
    matched: float  # S² / ‖a‖² of the true claim by the receiver that is best by the model; 0 if its score is negative


class Channel(NamedTuple):
    """The model of one suspect, after each height was divided by its standard deviation, without B."""

    deviation: Numbers  # of each error, in diagonals
    nuisance: Unknowns  # orthonormal basis of what was projected off
    covariance: Matrix  # of A w

    def white(self, height: Numbers) -> Numbers:
        """Heights in units of their deviation, without the nuisance."""
        return self.cleaned(height / self.deviation)

    def cleaned(self, white: Numbers) -> Numbers:
        """What is left when the nuisance is projected off."""
        return white - self.nuisance @ (self.nuisance.T @ white)

    def signal_to_noise(self) -> Numbers:
        """The eigenvalues s."""
        return np.maximum(eigvalsh(self.covariance), 0)

    def matched(self, height: Numbers, mark: Numbers) -> float:
        """S² / ‖a‖² of a claim by the best receiver, whose a is Tᵀ Aᵀ (1 + C)⁻¹ d with the covariance C of A w.

        Args:
            height: d, without the means of its errors.
            mark: A w of the mark that is claimed.
        """
        weights = np.linalg.solve(self.covariance + np.eye(len(height)), self.white(height))
        score, square = float(self.white(mark) @ weights), float(weights @ self.covariance @ weights)
        return score**2 / square if score > 0 and square > 0 else 0.0


def make_bound(
    marker: NonBlindMarker,
    marked: Mesh,
    suspect: Mesh,
    attack: Callable[[Mesh], Mesh],
    *,
    others: int = OTHERS,
    seed: int,
) -> Bound | None:
    """Bound what a suspect can carry, as the module says.

    Args:
        marker: what the mark was made by.
        marked: the mesh with the mark that is claimed.
        suspect: what the attack made of it, where the original lies.
        attack: makes suspects of the original with other marks.
        others: number of those marks.
        seed: of those marks.

    Returns:
        The bound; None for marks that are not keyed, and for suspects of more vertices than `MOST_VERTICES`, or of so
        few that an affine map may explain all their heights.
    """
    carrier, original = marker.carrier, marker.original
    if not isinstance(carrier, KeyedCarrier) or len(suspect.vertices) > MOST_VERTICES:
        return None
    mark = shift_of(original, marked)
    size = float(rms(mark[original.used]))
    ones = jnp.ones(carrier.code_bits, original.signal.dtype)
    keys = jax.random.split(jax.random.key(seed), others)
    units = [original.to_host(carrier.redraw(key).displacement(ones)) for key in keys]
    sizes = [float(rms(shift[original.used])) for shift in units]
    shifts = [size / one * shift for one, shift in zip(sizes, units, strict=True)]
    measured = measurer(original)
    there = measured(suspect)
    elsewhere = [measured(attack(displace(original, shift))) for shift in shifts]
    errors = model_errors(carrier, original, there, elsewhere, shifts)
    if errors is None:
        return None
    covariance = size**2 / np.mean(np.square(sizes)) * carried(carrier, there)
    channel = make_channel(covariance, errors.deviation, errors.nuisance)
    s = channel.signal_to_noise()
    matched = channel.matched(there.height - errors.mean, there.along(mark))
    return Bound(len(s), float(np.sum(s / (1 + s))), float(np.sum(np.log2(1 + s)) / 2), matched)


def measurer(original: Original) -> Callable[[Mesh], VertexHeights]:
    """What measures the heights of a mesh's vertices where the original lies in its file."""
    surface = Surface(Mesh(original.positions, original.points.faces))
    centre = np.asarray(original.points.vertices)[original.used].mean(axis=0)

    def measured(mesh: Mesh) -> VertexHeights:
        places = (np.asarray(mesh.vertices) - centre) / original.diagonal
        return measure_heights(surface, mesh._replace(vertices=places))

    return measured


def carried(carrier: KeyedCarrier, there: VertexHeights) -> Matrix:
    """The covariance of A w for a mark of unit strength, A T Tᵀ Aᵀ."""
    coefficients = carrier.coefficients(1.0)
    moving = jnp.abs(jnp.asarray(carrier.chips.signs, carrier.host.signal.dtype))

    @jax.jit
    def pull(block: jax.Array) -> jax.Array:
        """Tᵀ of displacements, `[rows, 3, columns]`, up to the signs of chips."""
        return moving[:, :, None] * jax.vmap(lambda one: carrier.match_chips(one, coefficients), 2, 2)(block)

    parts = []
    for start in range(0, len(there.height), COLUMNS):
        some = there.share[start : start + COLUMNS].toarray().T
        block = np.zeros((len(moving), 3, COLUMNS), carrier.host.signal.dtype)
        block[: len(some), :, : some.shape[1]] = some[:, None] * there.normals[start : start + COLUMNS].T
        parts.append(np.asarray(pull(jnp.asarray(block))).reshape(-1, COLUMNS)[:, : some.shape[1]])
    pulled = np.concatenate(parts, axis=1)
    return np.asarray(pulled.T @ pulled, np.float64)


def make_channel(covariance: Matrix, deviation: Numbers, nuisance: Unknowns) -> Channel:
    """Make the model of a suspect from the covariance of A w, the deviation of each error, and B."""
    basis = orthonormal(nuisance / deviation[:, None])
    white = covariance / deviation[:, None] / deviation
    white = white - basis @ (basis.T @ white)
    return Channel(deviation, basis, white - (white @ basis) @ basis.T)
