"""Collusion: an adversary holds several copies of one mesh, each with a mark of its own, but not the original."""

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64

from jaxmark.adversaries.by_name import attack
from jaxmark.attacks.attack import Attack
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, host_mesh, same_connectivity, weld, weld_mesh
from jaxmark.seeds import Randomness, generator

Rule = Literal["mean", "median", "minimum", "maximum", "mixing", "circumcentre"]
Positions = Float64[np.ndarray, "copies vertices 3"]
_STRENGTHS = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)


def collude(others: Sequence[Mesh], rule: Rule) -> Attack:
    """Combine a mesh with other copies of it, and jam the result; the strength is that of `jamming`.

    Raises:
        JaxmarkError: if there is no such rule; when applied, if the mesh is of another connectivity than the others.
    """
    _check(rule)
    points = [weld_mesh(one, weld(one.vertices)) for one in map(host_mesh, others)]

    def apply(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
        random = generator(seed)
        together = combine([mesh, *points], rule, random)
        return attack(together, "jamming", strength, seed=int(random.integers(2**31)))

    return Attack(apply, "RMS of jamming over the diagonal", _STRENGTHS, host=True)


def combine(copies: Sequence[Mesh], rule: Rule, seed: Randomness) -> Mesh:
    """Combine several copies of a mesh, which share their connectivity, into one that looks like them.

    Args:
        copies: meshes of one connectivity.
        rule: the mean, median, minimum or maximum of each coordinate; `"mixing"`, each point from a copy drawn at
            random; or `"circumcentre"`, the point of the copies' affine hull that is equally far from all of them.
            Marks of one budget are equally far from the original, so this is the original's projection onto the hull:
            of all affine combinations of the copies, the one with the least of the marks in it.
        seed: a whole number, a JAX random key or a NumPy generator, for mixing.

    Raises:
        JaxmarkError: if there is no such rule or no copy, or their connectivity differs.
    """
    _check(rule)
    if not copies or not all(same_connectivity(one, copies[0]) for one in copies):
        raise JaxmarkError(f"Only copies of one connectivity can be combined; these {len(copies)} copies differ in it.")
    stack = np.stack([np.asarray(one.vertices, np.float64) for one in copies])
    return Mesh(_RULES[rule](stack, generator(seed)), np.asarray(copies[0].faces))


def _check(rule: str) -> None:
    if rule not in get_args(Rule):
        raise JaxmarkError(f"There is no rule {rule!r} for combining copies; there are {', '.join(get_args(Rule))}.")


def _mix(copies: Positions, random: np.random.Generator) -> np.ndarray:
    point = weld(copies[0]).point  # all vertices at one point come from the same copy
    chosen = random.integers(len(copies), size=point.max() + 1)[point]
    return copies[chosen, np.arange(len(chosen))]


def _circumcentre(copies: Positions, random: np.random.Generator) -> np.ndarray:
    sides = (copies[1:] - copies[0]).reshape(len(copies) - 1, -1)
    # The point has the same distance to all copies if ⟨e_i, Σ b_j e_j⟩ = ‖e_i‖²/2 for the differences e_i to the first.
    products = sides @ sides.T
    shares = np.linalg.lstsq(products, np.diagonal(products) / 2, rcond=1e-9)[0]
    return copies[0] + (shares @ sides).reshape(copies[0].shape)


_RULES: dict[Rule, Callable[[Positions, np.random.Generator], np.ndarray]] = {
    "mean": lambda copies, random: copies.mean(axis=0),
    "median": lambda copies, random: np.median(copies, axis=0),
    "minimum": lambda copies, random: copies.min(axis=0),
    "maximum": lambda copies, random: copies.max(axis=0),
    "mixing": _mix,
    "circumcentre": _circumcentre,
}
