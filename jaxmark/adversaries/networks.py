"""Neural networks that learn to remove marks, from meshes of the attacker that are marked with random keys.

A network decomposes a mesh into parts in eight bands of the graph Laplacian. From the energies of the parts, Chebyshev
convolutions compute for each vertex and band which share of the part is subtracted, and the strength of noise that is
added. The displacement therefore rotates with the mesh. Before training, the network subtracts the Wiener estimate of
the mark.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Unpack, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.example_libraries import optimizers
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.adversaries.expected import Surrogate, evidence, make_surrogate, random_mark, rescale, rms
from jaxmark.adversaries.keyless import MARK, _Assumptions, make_attack
from jaxmark.attacks.attack import Attack
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.bands import intervals
from jaxmark.spectral.chebyshev import band_components
from jaxmark.spectral.learned import cheb_conv, init_cheb_conv
from jaxmark.watermark.interfaces import Displacement
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, Scheme

Goal = Literal["estimate", "removal"]
Network = tuple[dict[str, Float[Array, "..."]], ...]  # parameters of convolutions, one after the other
Parts = Float[Array, "bands rows 3"]
Weights = Float[Array, "bands rows 1"]

_EDGES = (0.0, 0.02, 0.05, 0.1, 0.17, 0.26, 0.36, 0.46, 2.0)  # of the bands in λ; marks are below 0.46
_TERMS = 129
_HIDDEN, _DEGREE = 16, 6  # columns between convolutions, and how many edges each looks
_FLOOR = 1e-3  # of energies, in that of the mark
_RATE = 3e-3  # of Adam
_SIZE = 4.0  # of displacements in training for removal, in that of the mark
_CHECKS = 4  # random keys for each mesh by which a network is judged


class Learned(NamedTuple):
    """A trained network, with its losses, which are those of the goal, see `learn`."""

    network: Network
    goal: Goal
    losses: Float64[np.ndarray, " steps"]  # training losses, one per step
    before: float  # loss of the Wiener estimate on the held-out meshes
    after: float  # loss of the trained network on the held-out meshes


def init_network(seed: Seed) -> Network:
    """Draw the parameters of a network whose last layer is zero, so that it gives the Wiener estimate."""
    bands = len(_EDGES) - 1
    sizes = ((2 * bands, _HIDDEN), (_HIDDEN, _HIDDEN), (_HIDDEN, 2 * bands))
    keys = jax.random.split(random_key(seed), len(sizes))
    *layers, last = (init_cheb_conv(one, *size, degree=_DEGREE) for one, size in zip(keys, sizes, strict=True))
    return (*layers, jax.tree.map(jnp.zeros_like, last))


def estimate(network: Network, surrogate: Surrogate, signal: Displacement) -> Displacement:
    """Estimate the mark in a signal: Σ_j share_j f_j(Δ)x, with a share of each band at each vertex.

    The signal is the coordinates of the marked mesh of `expected.make_surrogate`, `[rows, 3]`, in diagonals.
    """
    parts = _parts(surrogate, signal)
    return surrogate.moving * jnp.sum(_decide(network, surrogate, parts)[0] * parts, axis=0)


def removal(network: Network, surrogate: Surrogate, signal: Displacement, seed: Seed) -> Displacement:
    """Compute the displacement that removes a mark from a signal: minus the estimate of the mark, plus random noise."""
    parts = _parts(surrogate, signal)
    shares, strengths = _decide(network, surrogate, parts)
    noise = _parts(surrogate, jax.random.normal(random_key(seed), signal.shape, signal.dtype))
    return surrogate.moving * jnp.sum(surrogate.mark * strengths * noise - shares * parts, axis=0)


def learn(
    meshes: Sequence[Mesh],
    held_out: Sequence[Mesh],
    *,
    seed: Seed,
    goal: Goal = "estimate",
    scheme: str | Scheme = DEFAULT_SCHEME,
    bits: int = 64,
    mark: float = MARK,
    steps: int = 400,
    log: Callable[[str], None] = lambda line: None,
) -> Learned:
    """Train a network on meshes, each marked with another random key in every step (Adam).

    Args:
        meshes: training meshes; they should not include the meshes that are attacked later.
        held_out: meshes on which the trained network is evaluated.
        seed: a whole number or a JAX random key.
        goal: for `"estimate"`, the loss is the energy of the estimation error, over that of the mark; for `"removal"`,
            it is the expected evidence S/‖a‖ after a displacement four times as large as the mark.
        scheme: the scheme that meshes are marked with, see `make_marker`.
        bits: size of the payload in bits.
        mark: RMS displacement of marks, relative to the diagonal.
        steps: number of gradient steps, each on one mesh, in turn.
        log: callback, called with a line after every hundredth step.

    Raises:
        JaxmarkError: if there is no such goal, no mesh, no mark or no step, or a mesh cannot be marked.
    """
    _check_goal(goal)
    if not mark > 0:
        raise JaxmarkError(f"The RMS displacement of a mark must be positive, got {mark:g}.")
    if not meshes or not held_out or steps < 1:
        raise JaxmarkError(
            f"Learning needs meshes, held-out meshes and steps; got {len(meshes)}, {len(held_out)} and {steps}."
        )
    surrogates = [make_surrogate(mesh, scheme, bits, mark)[0] for mesh in meshes]
    others = [make_surrogate(mesh, scheme, bits, mark)[0] for mesh in held_out]
    loss, begin, drawn, judged = _LOSSES[goal], *jax.random.split(random_key(seed), 3)
    init, update, get = optimizers.adam(_RATE)

    @jax.jit
    def step(count: Any, state: Any, surrogate: Surrogate, seed: PRNGKeyArray) -> tuple[Any, Array]:
        found, slope = jax.value_and_grad(loss)(get(state), surrogate, seed)
        return update(count, slope, state), found

    def judge(network: Network) -> float:
        seeds = jax.random.split(judged, _CHECKS)
        return float(np.mean([[one(network, surrogate, seed) for seed in seeds] for surrogate in others]))

    one = jax.jit(loss)
    network = init_network(begin)
    state, losses, before = init(network), [], judge(network)
    for count in range(steps):
        # The count takes the parameters' own dtype, because dtypes must not be mixed.
        number = jnp.asarray(count, jax.tree.leaves(network)[0].dtype)
        state, found = step(number, state, surrogates[count % len(surrogates)], jax.random.fold_in(drawn, count))
        losses.append(float(found))
        if (count + 1) % 100 == 0:
            log(f"{count + 1} of {steps} steps, loss {np.mean(losses[-100:]):.4g}")
    return Learned(get(state), goal, np.array(losses), before, judge(get(state)))


def learned_attack(network: Network, goal: Goal, **assumptions: Unpack[_Assumptions]) -> Attack:
    """Make an attack with the `network` of a `Learned`.

    For the goal `"estimate"`, the attack subtracts the network's estimate of the mark; for `"removal"`, it applies the
    network's displacement.

    Raises:
        JaxmarkError: if there is no such goal, or a `Learned` is passed instead of its network.
    """
    _check_goal(goal)
    if isinstance(network, Learned):
        raise JaxmarkError("This is a `Learned`, not a network; pass its attributes `network` and `goal`.")

    def way(surrogate: Surrogate, strength: Array, seed: PRNGKeyArray) -> Displacement:
        if goal == "estimate":
            return -estimate(network, surrogate, surrogate.signal)
        return removal(network, surrogate, surrogate.signal, seed)

    return make_attack(way, **assumptions)


def _check_goal(goal: Goal) -> None:
    if goal not in get_args(Goal):
        raise JaxmarkError(f"There is no goal {goal!r}; there are {', '.join(get_args(Goal))}.")


def _parts(surrogate: Surrogate, signal: Displacement) -> Parts:
    """Return the parts of a signal in the network's bands, which sum to it."""
    return band_components(surrogate.operator, intervals(np.array(_EDGES), _TERMS), signal)


def _decide(network: Network, surrogate: Surrogate, parts: Parts) -> tuple[Weights, Weights]:
    """Compute the share of each part that is subtracted at each vertex, and the strength of noise in its band.

    The inputs of the network are the energies of the parts, relative to that of the mark, and their correlations with
    the next band. Neither changes if the mesh is rotated.
    """
    mark, bands = surrogate.mark**2, len(parts)
    square = jnp.sum(parts**2, axis=-1)
    common = jnp.sum(parts * jnp.roll(parts, -1, axis=0), axis=-1)
    either = jnp.sqrt((square + _FLOOR * mark) * (jnp.roll(square, -1, axis=0) + _FLOOR * mark))
    features = jnp.concatenate([jnp.log(square / mark + _FLOOR) / 4, common / either]).T
    *hidden, last = network
    for layer in hidden:
        features = jnp.tanh(cheb_conv(surrogate.operator, layer, features))
    more, strengths = jnp.split(cheb_conv(surrogate.operator, last, features).T[..., None], [bands])
    energy = jnp.sum(surrogate.moving.T * square, axis=1) / surrogate.moving.sum()
    wiener = jnp.clip(mark * _profile(surrogate) / jnp.maximum(energy, jnp.finfo(energy.dtype).tiny), 1e-6, 0.5)
    start = jnp.log(wiener / (1 - wiener))[:, None, None]
    return jax.nn.sigmoid(start + more), jax.nn.softplus(strengths)


def _profile(surrogate: Surrogate) -> Float[Array, " bands"]:
    """Return the share of a mark's energy in each band, the same for every key."""
    written = random_mark(surrogate, jax.random.key(0))[1]
    square = jnp.sum(jnp.sum(_parts(surrogate, written) ** 2, axis=-1), axis=1)
    return square / jnp.maximum(jnp.sum(written**2), jnp.finfo(square.dtype).tiny)


def _distance(network: Network, surrogate: Surrogate, seed: PRNGKeyArray) -> Float[Array, ""]:
    """Compute the energy of a mark less its estimate, over its own; averaged as in `evidence`."""
    written = random_mark(surrogate, seed)[1]
    both = [rms(surrogate, one - estimate(network, surrogate, surrogate.signal + one)) for one in (written, -written)]
    return jnp.mean(jnp.stack(both) ** 2) / rms(surrogate, written) ** 2


def _evidence(network: Network, surrogate: Surrogate, seed: PRNGKeyArray) -> Float[Array, ""]:
    """Compute the expected evidence of a mark after removal by a displacement of a fixed size."""
    noise, mark = jax.random.split(seed)
    moved = removal(network, surrogate, surrogate.signal, noise)
    return evidence(surrogate, rescale(surrogate, moved, _SIZE * surrogate.mark), mark)


_LOSSES: dict[Goal, Callable[[Network, Surrogate, PRNGKeyArray], Array]] = {
    "estimate": _distance,
    "removal": _evidence,
}
