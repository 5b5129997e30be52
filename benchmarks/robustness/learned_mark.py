"""Train a learned watermark: python benchmarks/robustness/learned_mark.py [--steps STEPS] [--weights FILE].

This file is also a method of the benchmark: jaxmark bench MESH --method benchmarks/robustness/learned_mark.py

Encoder and decoder are networks that are trained together, through differentiable attacks, as Zhu, Kaplan, Johnson, and
Fei-Fei do for pictures ("HiDDeN: hiding data with deep networks", 2018). They process the distance of each vertex to
the centre of the surface, so a rotation, shift or scale changes nothing. The decoder splits the distances into bands by
learned filters, multiplies them by learned functions of the smooth distance, and averages over the surface. The encoder
is two Chebyshev convolutions, and moves vertices along the ray from the centre. It writes most into the bits that the
unmarked mesh contradicts.

Training is on meshes by formula, which random affine maps and warps change in each step. The seed is fixed.
"""

import sys
from collections.abc import Callable, Hashable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark import attacks, spectral
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import decode_margins, make_surface, scatter
from jaxmark.bench.parametric import creature
from jaxmark.errors import JaxmarkError
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.spectral.learned import ChebConv

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser, positive
from common.tables import say

WEIGHTS = Path(__file__).with_suffix(".eqx")
NAME, BITS, STEPS = "learned", 16, 1500
BANDS, TERMS, HIDDEN, WAVES = 8, 25, 32, 16  # of the networks
SMOOTH = 20.0  # time of heat flow that makes the smooth distance
SHARP = 50.0  # of what the encoder writes into bits that the unmarked mesh shows already
MESSAGES = 6  # random messages in each step of training
STRENGTHS = (5e-4, 3e-3)  # in training
RATES = {"fast": 3e-3, "slow": 2e-4}  # of learning: of the decoder's functions, and of all else

Signal = Float[Array, " vertices"]
Decisions = Float[Array, " bits"]


class Rays(NamedTuple):
    """The points of a surface as distances along rays from its centre."""

    operator: spectral.Laplacian
    weights: Signal  # of the surface's mean
    centre: Float[Array, " 3"]
    unit: Float[Array, ""]  # the mean distance
    distances: Signal  # in this unit

    def mean(self, values: Array) -> Array:
        """Average a signal, or each of several columns, over the surface."""
        return self.weights @ values

    def normalised(self, values: Array) -> Array:
        """Subtract the mean of each column, and scale it to unit variance."""
        centred = values - self.mean(values)
        return centred / jnp.sqrt(self.mean(centred**2) + 1e-12)


def rays(operator: spectral.Laplacian, mesh: Mesh) -> Rays:
    """Measure the distances of vertices to the centre of the surface; the operator is that of the mesh."""
    x = jnp.asarray(mesh.vertices, jnp.float32)
    weights = jnp.asarray(spectral.vertex_areas(x, mesh.faces))
    weights = weights / weights.sum()
    centre = weights @ x
    distances = jnp.linalg.norm(x - centre, axis=1)
    unit = weights @ distances
    return Rays(operator, weights, centre, unit, distances / unit)


def places(shape: Rays) -> Float[Array, "vertices features"]:
    """Compute waves of the smooth distance, which tell places on the surface apart."""
    smooth = spectral.heat(shape.operator, shape.distances, SMOOTH)[:, None]
    angles = jnp.pi / 2 * shape.normalised(smooth) * jnp.arange(1, WAVES + 1, dtype=jnp.float32)
    return shape.normalised(jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=1))


class Details(NamedTuple):
    """The distances in bands, limited to (-1, 1), and the derivative of that with respect to the bands."""

    values: Float[Array, "vertices bands"]
    slopes: Float[Array, "vertices bands"]


class Networks(eqx.Module):
    """The networks of a mark: the decoder's filters and functions, and the encoder's convolutions."""

    filters: Float[Array, "bands terms"]
    functions: Float[Array, "features bands bits"]
    logs: Float[Array, " 2"]  # of the decoder's limiter, and of the margin that the encoder aims at, over the strength
    first: Any
    second: Any

    def __init__(self, key: PRNGKeyArray) -> None:
        """Draw the parameters; the filters begin as equal bands, and the encoder as the adjoint of the decoder."""
        keys = jax.random.split(key, 3)
        bands = spectral.bands.intervals(np.linspace(0, 2, 17), TERMS)
        self.filters = jnp.asarray(bands[1 : 1 + BANDS], jnp.float32)
        self.functions = jax.random.normal(keys[0], (2 * WAVES, BANDS, BITS)) / (2 * WAVES) ** 0.5
        self.logs = jnp.log(jnp.array([1.0, 100.0]))
        self.first = ChebConv(2 * WAVES + BANDS + BITS, HIDDEN, 2, key=keys[1])
        self.second = jax.tree.map(jnp.zeros_like, ChebConv(HIDDEN, BITS, 8, key=keys[2]))

    def decode(self, shape: Rays) -> Decisions:
        """Compute the soft decisions of the bits."""
        return self._decisions(shape, self._details(shape).values, self._functions(places(shape)))

    def encode(self, shape: Rays, signs: Decisions, strength: Float[Array, ""] | float) -> Signal:
        """Compute shifts along rays for bits of -1 or 1, in units of the mean distance.

        The strength is the RMS of Δ times the shifts, because perceptual metrics compare curvature.
        """
        where, details = places(shape), self._details(shape)
        functions = self._functions(where)
        patterns = spectral.synthesise(shape.operator, self.filters, jnp.moveaxis(functions, 1, 0))
        patterns = shape.normalised(patterns)  # one for each bit
        inputs = jnp.concatenate([where, details.values, patterns], axis=1)
        patterns += self.second(shape.operator, jnp.tanh(self.first(shape.operator, inputs)))
        margin = jnp.exp(self.logs[1]) * strength
        needed = signs * jax.nn.softplus(SHARP * (margin - signs * self._decisions(shape, details.values, functions)))
        shift = patterns @ self._amplitudes(shape, details, functions, patterns, needed)
        bent = shape.operator.apply(shift)
        return strength * shift / jnp.sqrt(shape.mean(bent**2) + 1e-12)

    def _amplitudes(
        self, shape: Rays, details: Details, functions: Array, patterns: Array, needed: Decisions
    ) -> Decisions:
        """Solve for amplitudes of the patterns that change the decisions by what is needed, up to a factor."""
        changes = spectral.band_components(shape.operator, self.filters, patterns)
        response = jnp.einsum("v,vc,cvp,vck->kp", shape.weights, details.slopes, changes, functions)
        ridge = 0.01 * jnp.mean(jnp.abs(jnp.diagonal(response)))
        return jnp.linalg.solve(response + ridge * jnp.eye(BITS), needed)

    def _details(self, shape: Rays) -> Details:
        bands = spectral.band_components(shape.operator, self.filters, shape.distances).T
        centred = bands - shape.mean(bands)
        scale = jnp.exp(self.logs[0]) / jnp.sqrt(shape.mean(centred**2) + 1e-12)
        values = jnp.tanh(scale * centred)
        return Details(values, scale * (1 - values**2))

    def _functions(self, where: Float[Array, "vertices features"]) -> Float[Array, "vertices bands bits"]:
        return jnp.einsum("vf,fbk->vbk", where, self.functions)

    def _decisions(self, shape: Rays, details: Array, functions: Array) -> Decisions:
        return jnp.einsum("v,vc,vck->k", shape.weights, details, functions)


def moved(shape: Rays, mesh: Mesh, shift: Signal) -> Mesh:
    """Move vertices along their rays."""
    x = jnp.asarray(mesh.vertices, jnp.float32)
    return Mesh(x + (shift / shape.distances)[:, None] * (x - shape.centre), mesh.faces)


def attacked(mesh: Mesh, choice: Array, key: PRNGKeyArray) -> Mesh:
    """Attack a mesh by one of the attacks that training is to survive."""
    kinds: list[Callable[[Mesh], Mesh]] = [
        lambda mesh: mesh,
        lambda mesh: attacks.uniform_noise(mesh, jax.random.uniform(key, maxval=0.003), key),
        lambda mesh: attacks.laplacian_smoothing(mesh, 10),
        lambda mesh: attacks.quantisation(mesh, 9),
    ]
    branches = [lambda x, kind=kind: kind(Mesh(x, mesh.faces)).vertices for kind in kinds]
    return Mesh(jax.lax.switch(choice, branches, mesh.vertices), mesh.faces)


def make_step(mesh: Mesh, optimiser: optax.GradientTransformation) -> Callable[..., tuple[Networks, Any, Array]]:
    """Make the step of training on one mesh."""
    operator = spectral.from_mesh(mesh)

    def loss(networks: Networks, key: PRNGKeyArray) -> Array:
        keys = jax.random.split(key, 4)
        host = attacks.warp(attacks.affine(mesh, 0.3, keys[0]), 0.02, keys[1])
        shape, choice = rays(operator, host), jax.random.randint(keys[3], (), 0, 4)

        def of_one(key: PRNGKeyArray) -> Array:
            parts = jax.random.split(key, 3)
            signs = jax.random.rademacher(parts[0], (BITS,), jnp.float32)
            low, high = np.log(STRENGTHS)
            strength = jnp.exp(jax.random.uniform(parts[1], minval=low, maxval=high))
            marked = moved(shape, host, networks.encode(shape, signs, strength))
            decisions = networks.decode(rays(operator, attacked(marked, choice, parts[2])))
            return 1 - jnp.mean(signs * decisions) / jnp.sqrt(jnp.mean(decisions**2))  # does not depend on a gain

        return jnp.mean(jax.vmap(of_one)(jax.random.split(keys[2], MESSAGES)))

    @eqx.filter_jit
    def step(networks: Networks, state: Any, key: PRNGKeyArray) -> tuple[Networks, Any, Array]:
        value, slope = eqx.filter_value_and_grad(loss)(networks, key)
        change, state = optimiser.update(slope, state)
        return eqx.apply_updates(networks, change), state, value

    return step


def train(steps: int, sizes: tuple[int, ...] = (1000, 1500, 2000)) -> Networks:
    """Train on an asteroid and a creature of each size, by turns."""
    networks = Networks(jax.random.key(0))
    rates: dict[Hashable, optax.GradientTransformation] = {
        name: optax.adam(optax.cosine_decay_schedule(rate, steps)) for name, rate in RATES.items()
    }
    slow = jax.tree.map(lambda leaf: "slow", eqx.filter(networks, eqx.is_array))
    optimiser = optax.multi_transform(rates, eqx.tree_at(lambda tree: tree.functions, slow, "fast"))
    meshes = [make(size, seed=1000 + size) for size in sizes for make in (asteroid, creature)]
    every = [make_step(mesh, optimiser) for mesh in meshes]
    state, losses = optimiser.init(eqx.filter(networks, eqx.is_array)), []
    for turn in range(steps):
        networks, state, value = every[turn % len(every)](networks, state, jax.random.key(turn))
        losses.append(float(value))
        if not (turn + 1) % 60:
            say(f"step {turn + 1}: mean loss {np.mean(losses[-60:]):.3f}")
    return networks


@cache
def trained() -> Networks:
    """Load the trained networks."""
    if not WEIGHTS.is_file():
        raise JaxmarkError(f"{WEIGHTS.name} is missing: make it by python benchmarks/robustness/learned_mark.py.")
    return eqx.tree_deserialise_leaves(WEIGHTS, Networks(jax.random.key(0)))


_encode, _decode = eqx.filter_jit(Networks.encode), eqx.filter_jit(Networks.decode)


def centred(surface: Mesh) -> tuple[Rays, Mesh, float]:
    """Shift and scale a surface before its positions lose digits; returns its rays, itself, and its former diagonal."""
    vertices = np.asarray(surface.vertices, np.float64)
    size = diagonal(surface)
    mesh = Mesh((vertices - vertices.mean(axis=0)) / size, surface.faces)
    return rays(spectral.from_mesh(mesh), mesh), mesh, size


def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    """Embed a message; for the strength, see `Networks.encode`."""
    surface = make_surface(mesh)
    shape, small, size = centred(surface.mesh)
    signs = jnp.asarray(2.0 * scatter(message, key, NAME) - 1, jnp.float32)
    shift = _encode(trained(), shape, signs, jnp.asarray(strength, jnp.float32))
    change = np.asarray(moved(shape, small, shift).vertices, np.float64) - small.vertices
    return surface.moved(np.asarray(surface.mesh.vertices) + size * change)


def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    """Read 16 bits blind; the score is the decision that three bits in four exceed."""
    shape, _, _ = centred(make_surface(suspect).mesh)
    return decode_margins(np.asarray(_decode(trained(), shape), np.float64), key, NAME)


METHOD = Method(NAME, embed, read, blind=True, bits=BITS, strengths=(1e-6, 3e-2), source="benchmarks, trained here")


def main() -> None:
    """Train, and write the weights."""
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=positive, default=STEPS, help="steps of training (default: %(default)s)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="file to write (default: beside this program)")
    given = parser.parse_args()
    eqx.tree_serialise_leaves(given.weights, train(given.steps))
    say(f"{given.weights.name}: {given.weights.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
