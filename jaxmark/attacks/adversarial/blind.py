"""Attacks by somebody who has the marked mesh and the program, but neither key nor original.

In closed form: estimate the mark and subtract it, write another. By optimisation: the displacement that brings the
*expected* detector down furthest, sought among all of them, among band filters and band-limited noise, or among smooth
warps; by gradients, and by evolution, which gradients that say nothing cannot mislead.

Strengths are sizes of the displacement: its RMS relative to the diagonal, or with another metric what that would be if
it grew in proportion, each band weighed by how visible it is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.example_libraries import optimizers
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.attacks.adversarial.expected import (
    Surrogate,
    band_filter,
    energies,
    evidence,
    make_surrogate,
    random_mark,
    sized,
)
from jaxmark.attacks.registry import Attack
from jaxmark.carriers.carrier import Displacement
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh
from jaxmark.original import displaced
from jaxmark.precision import matmul
from jaxmark.schemes import DEFAULT_SCHEME, Scheme

Parameters = Any  # a pytree of arrays
Family = Literal["vertices", "bands", "warps"]
MARK = 8e-4  # RMS that the attacker takes marks to have, unless told

_STRENGTHS = (2e-4, 5e-4, 2e-3, 5e-3, 2e-2, 5e-2)
_RATE = 0.3  # of Adam, for parameters of which 1 is a usual change
_POPULATION, _PARENTS = 16, 4
_WAVES, _SHORTEST = 24, 0.2  # of a warp: how many, and their least wavelength, in diagonals


def subtraction(*, scheme: str | Scheme = DEFAULT_SCHEME, bits: int = 64, mark: float = MARK) -> Attack:
    """Subtract the best linear estimate of the mark: each band of the mesh by the share that a mark has of its energy.

    The Wiener filter, for a mark and a host that are independent (Su, Girod, "Power-spectrum condition for
    energy-efficient watermarking", IEEE Transactions on Multimedia 4(4), 2002).

    Args:
        scheme: what the mesh was marked with.
        bits: of the payload.
        mark: RMS displacement that the mark is taken to have, relative to the diagonal.
    """

    def way(surrogate: Surrogate, strength: Array, key: PRNGKeyArray) -> Displacement:
        written, whole = energies(surrogate, random_mark(surrogate, key)[1]), energies(surrogate, surrogate.signal)
        share = jnp.clip(written / jnp.maximum(whole, jnp.finfo(whole.dtype).tiny), 0, 1)
        return -band_filter(surrogate, share, surrogate.signal)

    return _attack(way, scheme, bits, mark, "rms")


def remarking(*, scheme: str | Scheme = DEFAULT_SCHEME, bits: int = 64) -> Attack:
    """Write another mark over it, by a key of the attacker's own.

    Args:
        scheme: see `subtraction`.
        bits: see `subtraction`.
    """
    return _attack(lambda surrogate, strength, key: random_mark(surrogate, key)[1], scheme, bits, MARK, "rms")


def descent(
    family: Family = "vertices",
    *,
    scheme: str | Scheme = DEFAULT_SCHEME,
    bits: int = 64,
    mark: float = MARK,
    metric: str = "rms",
    steps: int = 30,
) -> Attack:
    """Lower the expected evidence by its gradient, with new random keys at each step (Adam; Kingma, Ba, ICLR 2015).

    Args:
        family: which displacements: all of the `"vertices"`; `"bands"`, of the mesh with lower gains, and of another
            mark with any strength in each; `"warps"`, smooth fields of wavelengths from 0.2 diagonals on.
        scheme: see `subtraction`.
        bits: see `subtraction`.
        mark: see `subtraction`.
        metric: of `distortion.METRICS`, in which strengths are measured.
        steps: how many gradients are taken.

    Raises:
        JaxmarkError: if there is no such family, or not one step is asked for.
    """
    _check(family, steps)
    return _attack(jax.jit(partial(descended, family=family, steps=steps)), scheme, bits, mark, metric)


def evolution(
    family: Family = "bands",
    *,
    scheme: str | Scheme = DEFAULT_SCHEME,
    bits: int = 64,
    mark: float = MARK,
    metric: str = "rms",
    generations: int = 10,
) -> Attack:
    """Lower the expected evidence without gradients, by the cross-entropy method (Rubinstein 1999).

    Of 16 normal draws of the parameters the best four give the mean and the spread of the next generation.

    Args:
        family: see `descent`; few parameters are needed, so not `"vertices"`.
        scheme: see `subtraction`.
        bits: see `subtraction`.
        mark: see `subtraction`.
        metric: see `descent`.
        generations: how many times the parents are chosen.

    Raises:
        JaxmarkError: if there is no such family, or not one generation is asked for.
    """
    if family == "vertices":
        raise JaxmarkError("All vertices are too many parameters for an evolution; choose 'bands' or 'warps'.")
    _check(family, generations)
    return _attack(jax.jit(partial(evolved, family=family, generations=generations)), scheme, bits, mark, metric)


def descended(
    surrogate: Surrogate, strength: Float[Array, ""], key: PRNGKeyArray, *, family: Family, steps: int
) -> Displacement:
    """The displacement that `descent` finds, in diagonals; pure, also under `vmap` over keys (restarts).

    Args:
        surrogate: from `expected.make_surrogate`.
        strength: its size.
        key: a JAX random key.
        family: see `descent`.
        steps: see `descent`.
    """
    return _sought(surrogate, strength, key, family, partial(_descend, steps=steps))


def evolved(
    surrogate: Surrogate, strength: Float[Array, ""], key: PRNGKeyArray, *, family: Family, generations: int
) -> Displacement:
    """The displacement that `evolution` finds; see `descended`."""
    return _sought(surrogate, strength, key, family, partial(_evolve, generations=generations))


def _sought(
    surrogate: Surrogate, strength: Array, key: PRNGKeyArray, family: Family, seek: Callable[..., Parameters]
) -> Displacement:
    start, make = _FAMILIES[family](surrogate, jax.random.fold_in(key, 0))

    def loss(parameters: Parameters, key: PRNGKeyArray) -> Array:
        return evidence(surrogate, sized(surrogate, make(parameters), strength), key)

    return sized(surrogate, make(seek(loss, start, jax.random.fold_in(key, 1))), strength)


def _check(family: Family, steps: int) -> None:
    if family not in get_args(Family):
        raise JaxmarkError(f"There is no family of displacements {family!r}; there are {', '.join(get_args(Family))}.")
    if steps < 1:
        raise JaxmarkError(f"An attack by optimisation needs at least one step, got {steps}.")


def _attack(
    way: Callable[[Surrogate, Array, PRNGKeyArray], Displacement],
    scheme: str | Scheme,
    bits: int,
    mark: float,
    metric: str,
) -> Attack:
    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        surrogate, original = make_surrogate(mesh, scheme, bits, mark, metric)
        wanted = jnp.asarray(strength, surrogate.signal.dtype)
        return displaced(original, original.on_host(sized(surrogate, way(surrogate, wanted, key), wanted)))

    unit = "RMS over the diagonal" if metric == "rms" else f"{metric}, as small displacements make it"
    return Attack(apply, unit, _STRENGTHS, host=True)


def _descend(
    loss: Callable[[Parameters, PRNGKeyArray], Array], start: Parameters, key: PRNGKeyArray, *, steps: int
) -> Parameters:
    """By Adam, whose step falls with the root of their number."""
    init, update, get = optimizers.adam(lambda step: _RATE / jnp.sqrt(step + 1.0))

    def step(state: Any, count: Array) -> tuple[Any, None]:
        slope = jax.grad(loss)(get(state), jax.random.fold_in(key, count))
        # A number of the parameters' own type, for they are not mixed.
        return update(count.astype(jax.tree.leaves(slope)[0].dtype), slope, state), None  # pyright: ignore

    return get(jax.lax.scan(step, init(start), jnp.arange(steps))[0])


def _evolve(
    loss: Callable[[Parameters, PRNGKeyArray], Array], start: Parameters, key: PRNGKeyArray, *, generations: int
) -> Parameters:
    mean, unravel = ravel_pytree(start)

    def generation(state: tuple[Array, Array], key: PRNGKeyArray) -> tuple[tuple[Array, Array], None]:
        mean, spread = state
        draw, same = jax.random.split(key)
        drawn = mean + spread * jax.random.normal(draw, (_POPULATION, len(mean)), mean.dtype)
        # All against the same random key; one after the other, for memory.
        worth = jax.lax.map(lambda one: loss(unravel(one), same), drawn)
        best = drawn[jnp.argsort(worth)[:_PARENTS]]
        # Few parents make the spread too small by chance.
        return (best.mean(axis=0), 0.5 * spread + 0.5 * best.std(axis=0)), None

    keys = jax.random.split(key, generations)
    return unravel(jax.lax.scan(generation, (mean, jnp.ones_like(mean)), keys)[0][0])


def _vertices(surrogate: Surrogate, key: PRNGKeyArray) -> tuple[Parameters, Callable[[Parameters], Displacement]]:
    """All displacements, with steps as large in each band as it is hard to see; a random mark to start from."""
    hidden = surrogate.seen.min() / surrogate.seen
    return (
        random_mark(surrogate, key)[1] / surrogate.mark,
        lambda z: band_filter(surrogate, hidden, z),
    )


def _bands(surrogate: Surrogate, key: PRNGKeyArray) -> tuple[Parameters, Callable[[Parameters], Displacement]]:
    """The mesh's own bands, less what gains from 0 to 1 leave of them, and another mark's, each of any strength."""
    other = random_mark(surrogate, key)[1]
    start = jnp.full_like(surrogate.seen, -4), jnp.zeros_like(surrogate.seen)

    def make(parameters: tuple[Array, Array]) -> Displacement:
        lost, strengths = jax.nn.sigmoid(parameters[0]), jnp.exp(parameters[1])
        return band_filter(surrogate, strengths, other) - band_filter(surrogate, lost, surrogate.signal)

    return start, make


def _warps(surrogate: Surrogate, key: PRNGKeyArray) -> tuple[Parameters, Callable[[Parameters], Displacement]]:
    """Sums of plane waves in random directions, whose amplitudes are free."""
    direct, length, begin = jax.random.split(key, 3)
    dtype = surrogate.signal.dtype
    waves = jax.random.normal(direct, (_WAVES, 3), dtype)
    per_diagonal = jax.random.uniform(length, (_WAVES, 1), dtype, 0.5, 1 / _SHORTEST)
    waves *= 2 * np.pi * per_diagonal / jnp.linalg.norm(waves, axis=1, keepdims=True)
    turns = matmul(surrogate.signal, waves.T)
    fields = jnp.concatenate([jnp.sin(turns), jnp.cos(turns)], axis=1)
    return jax.random.normal(begin, (2 * _WAVES, 3), dtype), lambda amplitudes: matmul(fields, amplitudes)


_FAMILIES = {"vertices": _vertices, "bands": _bands, "warps": _warps}
