"""What a suspect may show, without the key: its values in a few ways of looking, and how they change with its pose.

A suspect that was smoothed is looked at as if some smoothing was undone; one that was meshed anew, as if some blur was
there already. The pose that it shows is nearly the one that was marked: the search for the rest is by the key's
offsets, which say nothing of what is claimed (see `jaxmark.watermark.blind.dither`).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.geometry.mesh import Mesh, compact, weld, weld_mesh
from jaxmark.geometry.pose import Pose
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.precision import matmul
from jaxmark.spectral.shapes import common_laplacian, pad_rows
from jaxmark.watermark.blind.anchors import changes, cut, make_anchors, place

_UNDONE_STEPS = (0, 10, 30, 50)  # of smoothing, by a tenth of the way to the neighbours' mean each
_BLURS = (0.0, 0.2)  # of a suspect as it is, in shares of the narrow Gaussian's variance
_DEGREE = 64  # of the polynomial that undoes smoothing
_REFINEMENTS = 8  # of the fixed point that it is
_STEP_SIZE = 0.1
#: Spread of small changes of pose that are tried: turns in radians, shifts and growth in sizes.
_SPREAD = (*(3.5e-3,) * 3, *(4e-4,) * 3, 2.5e-3)
_STARTS, _CLIMBS, _STEPS = 256, 4, 6  # random changes; how many climb, and how far
#: The ways in which a shape may look along its axes; the last four are of its mirror image.
TURNS = np.array(
    [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]], np.int64
)


VIEWS_PER_WIDTH = len(_UNDONE_STEPS) - 1 + len(_BLURS)  # ways of looking


class View(NamedTuple):
    """One way of looking at a suspect; independent of the key."""

    cells: Int64[np.ndarray, "anchors 3"]  # indices of the anchors in the lattice, as the suspect lies
    values: Float[Array, " anchors"]
    good: Bool[np.ndarray, " anchors"]  # whether an anchor counts; padding does not
    changes: Float[Array, "anchors seven"]  # of the values, by turns about the axes, shifts along them, and growth
    width: float  # of the narrow Gaussian
    pose: Pose  # from the suspect's file to where it was looked at
    undone: int  # steps of smoothing that were undone


def unsmoothed(mesh: Mesh, steps: int) -> Mesh:
    """Undo steps of smoothing as far as it goes: with one step s(λ) = 1 - λ/10, filter by (1 - (1 - s^n)^9)/s^n.

    That is what eight rounds of x ← x + (y - s^n x) give for the smoothed y. It enlarges nothing more than nine times.
    """
    if steps == 0:
        return mesh

    def gain(place: np.ndarray) -> np.ndarray:
        left = (1 - _STEP_SIZE * (place + 1)) ** steps
        return (1 - (1 - left) ** (_REFINEMENTS + 1)) / left

    places = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    series = np.polynomial.chebyshev.chebfit(places, gain(places), _DEGREE)
    operator = common_laplacian(mesh)
    middle = np.asarray(mesh.vertices).mean(axis=0)
    rows = jnp.asarray(pad_rows(np.asarray(mesh.vertices) - middle, len(operator.degree)), jnp.result_type(float))
    found = np.asarray(filter(operator, series, rows), np.float64)[: len(mesh.vertices)]
    return Mesh(found + middle, mesh.faces)


def views(suspect: Mesh, widths: Sequence[float]) -> Iterator[View]:
    """Look at a suspect in all ways, the likeliest first.

    Args:
        suspect: any mesh.
        widths: of the narrow Gaussian.

    Raises:
        JaxmarkError: see `place`.
    """
    suspect = compact(weld_mesh(suspect, weld(suspect.vertices)))
    dtype = jnp.result_type(float)
    for steps in _UNDONE_STEPS:
        placed = place(unsmoothed(suspect, steps))
        vertices = jnp.asarray(placed.mesh.vertices, dtype)
        for width in widths:
            pieces = cut(placed.mesh, width)
            surface = pieces.of(vertices)
            surface = surface._replace(normals=surface.normals * placed.outwards)
            anchors = make_anchors(surface, width)
            for blur in _BLURS if steps == 0 else _BLURS[:1]:
                found = changes(surface, anchors, jnp.asarray(width, dtype), jnp.asarray(blur, dtype))
                at = jnp.asarray(anchors.places, dtype)
                by = jnp.concatenate([jnp.cross(at, found.slope), found.slope, found.growth[:, None]], axis=1)
                good = np.asarray(found.shown.good) & (anchors.around[:, 0] >= 0)
                yield View(anchors.cells, found.shown.values, good, by, width, placed.pose, steps)


class Found(NamedTuple):
    """The best small change of pose for each turn and step, by the key's offsets."""

    change: Float[Array, "turns steps seven"]
    pilot: Float[Array, "turns steps"]  # how well the offsets fit, in standard deviations of what chance gives


@jax.jit
def search(
    values: Float[Array, " anchors"],
    changes: Float[Array, "anchors seven"],
    good: Float[Array, " anchors"],
    offsets: Float[Array, "turns anchors"],
    steps: Float[Array, " steps"],
) -> Found:
    """Find changes of pose by which values lie half a step apart as the offsets say: largest Σ cos 4π(y/step - δ).

    Random changes are tried; the best climb by steps of Gauss and Newton.

    Args:
        values: of a view.
        changes: of its values, in the order of `View`.
        good: 1 for each anchor that counts, else 0.
        offsets: δ of each anchor, for each turn.
        steps: of the lattice of values.
    """
    spread = jnp.asarray(_SPREAD, values.dtype)
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(_STARTS, 7)), values.dtype).at[0].set(0)
    scaled = changes * spread

    def fit(step: Float[Array, ""], offset: Float[Array, " anchors"]) -> tuple[Array, Array]:
        base, slope = values / step - offset, scaled / step * good[:, None]

        def pilot(change: Float[Array, "tried seven"]) -> Float[Array, " tried"]:
            return jnp.cos(4 * jnp.pi * (base + matmul(change, slope.T))) @ good

        def climb(change: Float[Array, "tried seven"], _: None) -> tuple[Float[Array, "tried seven"], None]:
            phase = base + matmul(change, slope.T)
            off = phase - jnp.round(2 * phase) / 2
            weight = good * jnp.maximum(jnp.cos(4 * jnp.pi * off), 0)
            gram = jnp.einsum("ac,ta,ad->tcd", slope, weight, slope) + jnp.eye(7, dtype=values.dtype)
            towards = jnp.einsum("ac,ta->tc", slope, weight * off)
            return change - jnp.linalg.solve(gram, towards[..., None])[..., 0], None

        best = starts[jax.lax.top_k(pilot(starts), _CLIMBS)[1]]
        best = jnp.concatenate([starts[:1], best, jax.lax.scan(climb, best, None, length=_STEPS)[0]])
        # Large changes are unlikely, and among many some fit by chance.
        worth = pilot(best) / jnp.sqrt(jnp.maximum(good.sum(), 1) / 2)
        chosen = jnp.argmax(worth - jnp.sum(best**2, axis=1) / 8)
        return best[chosen] * spread, worth[chosen]

    change, pilot = jax.lax.map(lambda step: jax.vmap(lambda offset: fit(step, offset))(offsets), steps)
    return Found(jnp.swapaxes(change, 0, 1), pilot.T)


def turned(cells: Int64[np.ndarray, "anchors 3"], turn: Int64[np.ndarray, " 3"]) -> Int64[np.ndarray, "anchors 3"]:
    """The cells that a shape covers if it looks the other way along some axes."""
    return cells * turn


def moved(view: View, change: Float64[np.ndarray, " seven"]) -> Float64[np.ndarray, " anchors"]:
    """Values of a view after a small change of pose."""
    return np.asarray(view.values, np.float64) + np.asarray(view.changes, np.float64) @ change
