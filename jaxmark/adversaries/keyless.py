"""Attacks by an adversary who has the marked mesh and the program, but neither key nor original.

In closed form, the attacker estimates the mark and subtracts it, or writes another mark. By optimisation, the attacker
searches for the displacement that lowers the *expected* score of the detector most: among all displacements, among band
filters with band-limited noise, or among smooth warps; by gradients, or by evolution, which uninformative gradients
cannot mislead.

Strengths are sizes of the displacement: its RMS relative to the diagonal; or, with another metric, the value that the
metric would have if it grew in proportion to the displacement, each band weighted by how visible it is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypedDict, Unpack, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.example_libraries import optimizers
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PRNGKeyArray

from jaxmark.adversaries.expected import (
    Surrogate,
    band_filter,
    energies,
    evidence,
    make_surrogate,
    random_mark,
    rescale,
)
from jaxmark.alignment.original import displace
from jaxmark.attacks.attack import Attack
from jaxmark.attacks.support import Strength
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Randomness, Seed, random_key
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.interfaces import Displacement
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, Scheme

Parameters = Any  # a pytree of arrays
Loss = Callable[[Parameters, PRNGKeyArray], Array]
# Parameters to start from, and the function that makes a displacement of parameters.
Start = tuple[Parameters, Callable[[Parameters], Displacement]]
Family = Literal["vertices", "bands", "warps"]
MARK = 8e-4  # RMS displacement, in diagonals, that the attacker assumes of marks by default

_STRENGTHS = (2e-4, 5e-4, 2e-3, 5e-3, 2e-2, 5e-2)
_LEARNING_RATE = 0.3  # of Adam, for parameters that usually change by about 1
_POPULATION_SIZE, _PARENT_COUNT = 16, 4  # candidates in a generation, and the best of them, which make the next
_WAVE_COUNT, _MIN_WAVELENGTH = 24, 0.2  # of a warp; wavelengths in diagonals


class _Assumptions(TypedDict, total=False):
    """The attacker's assumptions about the mark; defaults are those of `make_attack`."""

    scheme: str | Scheme  # the scheme that the mesh was marked with
    bits: int  # size of the payload in bits
    mark: float  # RMS displacement of the mark, relative to the diagonal
    metric: str  # the metric of `distortion.METRICS` in which strengths are measured


def subtraction(**assumptions: Unpack[_Assumptions]) -> Attack:
    """Subtract the best linear estimate of the mark: each band of the mesh times the mark's share of its energy.

    This is the Wiener filter for a mark and a host that are independent (Su, Girod, "Power-spectrum condition for
    energy-efficient watermarking", IEEE Transactions on Multimedia 4(4), 2002).
    """

    def way(surrogate: Surrogate, strength: Array, seed: PRNGKeyArray) -> Displacement:
        written, whole = energies(surrogate, random_mark(surrogate, seed)[1]), energies(surrogate, surrogate.signal)
        share = jnp.clip(written / jnp.maximum(whole, jnp.finfo(whole.dtype).tiny), 0, 1)
        return -band_filter(surrogate, share, surrogate.signal)

    return make_attack(way, **assumptions)


def rewatermarking(**assumptions: Unpack[_Assumptions]) -> Attack:
    """Write another mark over the first, with a key of the attacker's own."""
    return make_attack(lambda surrogate, strength, seed: random_mark(surrogate, seed)[1], **assumptions)


def descent(family: Family = "vertices", *, steps: int = 30, **assumptions: Unpack[_Assumptions]) -> Attack:
    """Lower the expected evidence by its gradient, with new random keys at each step (Adam; Kingma, Ba, ICLR 2015).

    Args:
        family: the displacements to search: `"vertices"`, all of them; `"bands"`, lower gains of the mesh's own bands,
            and another mark with any strength in each band; `"warps"`, smooth fields of wavelengths from 0.2 to 2
            diagonals.
        steps: number of gradient steps.
        assumptions: see `_Assumptions`.

    Raises:
        JaxmarkError: if there is no such family, or `steps` is below 1.
    """
    _check(family, steps)
    return make_attack(jax.jit(partial(descend, family=family, steps=steps)), **assumptions)


def evolution(family: Family = "bands", *, generations: int = 10, **assumptions: Unpack[_Assumptions]) -> Attack:
    """Lower the expected evidence without gradients, by the cross-entropy method (Rubinstein 1999).

    Each generation draws the parameters 16 times from a normal distribution; the best four draws give the mean and the
    spread of the next generation.

    Args:
        family: see `descent`; `"vertices"` has too many parameters.
        generations: number of generations.
        assumptions: see `_Assumptions`.

    Raises:
        JaxmarkError: if there is no such family, it is `"vertices"`, or `generations` is below 1.
    """
    if family == "vertices":
        raise JaxmarkError("All vertices are too many parameters for an evolution; choose 'bands' or 'warps'.")
    _check(family, generations)
    return make_attack(jax.jit(partial(evolve, family=family, generations=generations)), **assumptions)


def descend(surrogate: Surrogate, strength: Strength, seed: Seed, *, family: Family, steps: int) -> Displacement:
    """Find the displacement of `descent`, in diagonals; a pure function, so that `vmap` over seeds gives restarts.

    The surrogate is the marked mesh, from `expected.make_surrogate`; the strength is the size of the displacement.
    """
    return _search(surrogate, strength, seed, family, partial(_descend, steps=steps))


def evolve(surrogate: Surrogate, strength: Strength, seed: Seed, *, family: Family, generations: int) -> Displacement:
    """Find the displacement of `evolution`, as `descend` does."""
    return _search(surrogate, strength, seed, family, partial(_evolve, generations=generations))


def _search(
    surrogate: Surrogate, strength: Strength, seed: Seed, family: Family, seek: Callable[..., Parameters]
) -> Displacement:
    """Search a family for the displacement of a given size that lowers the expected evidence most."""
    key, wanted = random_key(seed), jnp.asarray(strength, surrogate.signal.dtype)
    start, make = _FAMILIES[family](surrogate, jax.random.fold_in(key, 0))

    def loss(parameters: Parameters, seed: PRNGKeyArray) -> Array:
        return evidence(surrogate, rescale(surrogate, make(parameters), wanted), seed)

    return rescale(surrogate, make(seek(loss, start, jax.random.fold_in(key, 1))), wanted)


def _check(family: Family, steps: int) -> None:
    if family not in get_args(Family):
        raise JaxmarkError(f"There is no family of displacements {family!r}; there are {', '.join(get_args(Family))}.")
    if steps < 1:
        raise JaxmarkError(f"An attack by optimisation needs at least one step, got {steps}.")


def make_attack(
    way: Callable[[Surrogate, Array, PRNGKeyArray], Displacement],
    *,
    scheme: str | Scheme = DEFAULT_SCHEME,
    bits: int = 64,
    mark: float = MARK,
    metric: str = "rms",
) -> Attack:
    """Attack by a displacement in the direction of `way(surrogate, size, seed)`; for the rest see `_Assumptions`."""

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        surrogate, original = make_surrogate(mesh, scheme, bits, mark, metric)
        wanted = jnp.asarray(strength, surrogate.signal.dtype)
        moved = rescale(surrogate, way(surrogate, wanted, random_key(seed)), wanted)
        return displace(original, original.to_host(moved))

    unit = "RMS over the diagonal" if metric == "rms" else f"{metric}, extrapolated from small displacements"
    return Attack(apply, unit, _STRENGTHS, host=True)


def _descend(loss: Loss, start: Parameters, seed: PRNGKeyArray, *, steps: int) -> Parameters:
    """Minimise a loss by Adam, with a step proportional to 1/√iteration."""
    init, update, get = optimizers.adam(lambda step: _LEARNING_RATE / jnp.sqrt(step + 1.0))

    def step(state: Any, count: Array) -> tuple[Any, None]:
        slope = jax.grad(loss)(get(state), jax.random.fold_in(seed, count))
        # The count takes the parameters' own dtype, because dtypes must not be mixed.
        return update(count.astype(jax.tree.leaves(slope)[0].dtype), slope, state), None  # pyright: ignore

    return get(jax.lax.scan(step, init(start), jnp.arange(steps))[0])


def _evolve(loss: Loss, start: Parameters, seed: PRNGKeyArray, *, generations: int) -> Parameters:
    """Minimise a loss by the cross-entropy method; return the mean of the last generation."""
    mean, unravel = ravel_pytree(start)

    def generation(state: tuple[Array, Array], seed: PRNGKeyArray) -> tuple[tuple[Array, Array], None]:
        mean, spread = state
        draw, same = jax.random.split(seed)
        drawn = mean + spread * jax.random.normal(draw, (_POPULATION_SIZE, len(mean)), mean.dtype)
        # All candidates meet the same random key; one after the other, to save memory.
        worth = jax.lax.map(lambda one: loss(unravel(one), same), drawn)
        best = drawn[jnp.argsort(worth)[:_PARENT_COUNT]]
        # Few parents make the spread too small by chance, so half of the old one is kept.
        return (best.mean(axis=0), 0.5 * spread + 0.5 * best.std(axis=0)), None

    seeds = jax.random.split(seed, generations)
    return unravel(jax.lax.scan(generation, (mean, jnp.ones_like(mean)), seeds)[0][0])


def _vertices(surrogate: Surrogate, seed: PRNGKeyArray) -> Start:
    """Search all displacements, with larger steps in bands that are harder to see; the start is a random mark."""
    hidden = surrogate.visibility.min() / surrogate.visibility
    return random_mark(surrogate, seed)[1] / surrogate.mark, lambda z: band_filter(surrogate, hidden, z)


def _bands(surrogate: Surrogate, seed: PRNGKeyArray) -> Start:
    """Search losses from 0 to 1 in each of the mesh's own bands, and another mark with any strength in each band."""
    other = random_mark(surrogate, seed)[1]
    start = jnp.full_like(surrogate.visibility, -4), jnp.zeros_like(surrogate.visibility)

    def make(parameters: tuple[Array, Array]) -> Displacement:
        lost, strengths = jax.nn.sigmoid(parameters[0]), jnp.exp(parameters[1])
        return band_filter(surrogate, strengths, other) - band_filter(surrogate, lost, surrogate.signal)

    return start, make


def _warps(surrogate: Surrogate, seed: PRNGKeyArray) -> Start:
    """Search sums of plane waves in random directions; the parameters are their amplitudes."""
    direct, length, begin = jax.random.split(seed, 3)
    dtype = surrogate.signal.dtype
    waves = jax.random.normal(direct, (_WAVE_COUNT, 3), dtype)
    per_diagonal = jax.random.uniform(length, (_WAVE_COUNT, 1), dtype, 0.5, 1 / _MIN_WAVELENGTH)
    waves *= 2 * np.pi * per_diagonal / jnp.linalg.norm(waves, axis=1, keepdims=True)
    turns = matmul(surrogate.signal, waves.T)
    fields = jnp.concatenate([jnp.sin(turns), jnp.cos(turns)], axis=1)
    return jax.random.normal(begin, (2 * _WAVE_COUNT, 3), dtype), lambda amplitudes: matmul(fields, amplitudes)


_FAMILIES = {"vertices": _vertices, "bands": _bands, "warps": _warps}
