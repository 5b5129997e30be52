"""Attacks by somebody who holds several copies of one mesh, each with a mark of its own, and none without."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64, PRNGKeyArray

from jaxmark.attacks.random import generator
from jaxmark.attacks.registry import Attack, attack
from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, host_mesh, same_connectivity, weld, welded_mesh

Rule = Literal["mean", "median", "minimum", "maximum", "mixing", "circumcentre"]

_STRENGTHS = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)


def colluded(others: Sequence[Mesh], rule: Rule) -> Attack:
    """What a mesh and others make together, jammed.

    Args:
        others: copies of the mesh that is attacked, of its connectivity.
        rule: see `combined`.

    Returns:
        An attack; its strength is that of `jamming` after the copies were put together.

    Raises:
        JaxmarkError: if there is no such rule; when applied, if the mesh is of another connectivity.
    """
    _check(rule)
    points = [welded_mesh(one, weld(one.vertices)) for one in map(host_mesh, others)]

    def apply(mesh: Mesh, strength: float, key: PRNGKeyArray) -> Mesh:
        random = generator(key)
        together = combined([mesh, *points], rule, random)
        return attack(together, "jamming", strength, seed=int(random.integers(2**31)))

    return Attack(apply, "RMS of jamming over the diagonal", _STRENGTHS, host=True)


def combined(copies: Sequence[Mesh], rule: Rule, random: np.random.Generator) -> Mesh:
    """One mesh of several copies, which all look like it.

    Args:
        copies: of one connectivity.
        rule: of each coordinate the mean, median, minimum or maximum; `"mixing"`, each point from a copy drawn at
            random; `"circumcentre"`, the point of the copies' affine hull that is as far from one as from all others.
            Marks of one budget are all as far from the original, so it is the original's projection on the hull: of all
            combinations of the copies, the one with the least of marks in it.
        random: for mixing.

    Raises:
        JaxmarkError: if there is no such rule or no copy, or their connectivity differs.
    """
    _check(rule)
    if not copies or not all(same_connectivity(one, copies[0]) for one in copies):
        raise JaxmarkError(f"Copies are put together if they share their connectivity; these {len(copies)} do not.")
    stack = np.stack([np.asarray(one.vertices, np.float64) for one in copies])
    return Mesh(_combined(stack, rule, random), np.asarray(copies[0].faces))


def _combined(
    copies: Float64[np.ndarray, "copies vertices 3"], rule: Rule, random: np.random.Generator
) -> Float64[np.ndarray, "vertices 3"]:
    match rule:
        case "mean":
            return copies.mean(axis=0)
        case "median":
            return np.median(copies, axis=0)
        case "minimum":
            return copies.min(axis=0)
        case "maximum":
            return copies.max(axis=0)
        case "mixing":
            point = weld(copies[0]).point  # copies of a point go the same way
            who = random.integers(len(copies), size=point.max() + 1)[point]
            return copies[who, np.arange(len(who))]
        case "circumcentre":
            sides = (copies[1:] - copies[0]).reshape(len(copies) - 1, -1)
            # As far from each copy as from the first: ⟨e_i, Σ b_j e_j⟩ = ‖e_i‖²/2 for the sides e_i from the first.
            products = sides @ sides.T
            shares = np.linalg.lstsq(products, np.diagonal(products) / 2, rcond=1e-9)[0]
            return copies[0] + (shares @ sides).reshape(copies[0].shape)


def _check(rule: str) -> None:
    if rule not in get_args(Rule):
        raise JaxmarkError(f"Copies are put together by {', '.join(get_args(Rule))}, not {rule!r}.")
