"""Functions that are linear in one argument, with transposes and derivatives given by hand.

JAX's own rules differentiate a recurrence step by step and keep every step for reverse mode. `jax.custom_vjp` avoids
this, but has no forward mode, and `jax.custom_derivatives.linear_call` cannot be mapped. A `Linear` is one primitive
that any transformation may meet, in any order: its transposes and derivatives are made of such functions again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

Rule = Callable[..., Any]


@dataclass(frozen=True)
class Linear:
    """An array as a function `apply(*fixed, x)` of pytrees that is linear in the last of them, x.

    Make each once, at the level of a module or in a cached function: what is compiled is kept by the functions'
    identities.
    """

    apply: Rule
    transposed: Rule  # transposed(*fixed, y): the x' with ⟨y, apply(*fixed, x)⟩ = ⟨x', x⟩ for all x
    # One for each of `fixed`, derivative(*fixed, x, tangent), for tangents in the structure of that argument with None
    # in place of leaves that are not floating. Without them, `apply` is differentiated by JAX, with its memory.
    derivatives: tuple[Rule, ...] | None = None
    # The derivative in directions of the last of `fixed` and of x at once, jointly(*fixed, x, (tangent, tangent)), if
    # its transpose takes less time than theirs.
    jointly: Rule | None = None
    on_processors: Rule | None = None  # what computes `apply` where a program is compiled for processors

    def __call__(self, *arguments: PyTree) -> Array:
        """Apply the function to `(*fixed, x)`."""
        leaves, structure = jax.tree.flatten(arguments)
        return _primitive.bind(*map(jnp.asarray, leaves), rule=self, structure=structure)

    def derivative(self, index: int, arguments: tuple[PyTree, ...], tangent: PyTree) -> Array:
        """Return the derivative in the direction of a tangent of one argument."""
        if index == len(arguments) - 1:
            return self(*arguments[:-1], tangent)
        if self.derivatives is not None:
            return self.derivatives[index](*arguments, tangent)

        def of_one(changed: PyTree) -> Array:
            return self.apply(*arguments[:index], changed, *arguments[index + 1 :])

        return along(of_one, arguments[index], tangent)


def along(function: Callable[[Any], Array], tree: PyTree, change: PyTree) -> Array:
    """Return the derivative of a function in the direction of a change of a pytree's floating leaves."""
    return jax.jvp(lambda part: function(combine(part, tree)), (floats(tree),), (change,))[1]


def floats(tree: PyTree) -> PyTree:
    """Return the pytree with None in place of leaves that have no derivatives."""
    return jax.tree.map(lambda leaf: leaf if jnp.issubdtype(leaf.dtype, jnp.inexact) else None, tree)


def combine(part: PyTree, whole: PyTree) -> PyTree:
    """Return the pytree `whole` with its floating leaves taken from `part`, of which `floats` gives the structure."""
    leaves = iter(jax.tree.leaves(part))
    return jax.tree.map(lambda leaf: next(leaves) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf, whole)


@dataclass(frozen=True)
class _Mapped:
    """A rule under `vmap`: each argument's structure, and which of its leaves have a mapped axis, as 0 or None."""

    rule: Rule
    parts: tuple[tuple[Any, tuple[int | None, ...]], ...]
    summed: tuple[int | None, ...] | None = None  # leaves of the result that all members share, and that collect all

    def __call__(self, *arguments: PyTree) -> Any:
        axes = tuple(jax.tree.unflatten(tree, part) for tree, part in self.parts)
        found = jax.vmap(self.rule, axes)(*arguments)
        if self.summed is None:
            return found
        leaves, structure = jax.tree.flatten(found)
        leaves = [leaf.sum(axis=0) if axis is None else leaf for leaf, axis in zip(leaves, self.summed, strict=True)]
        return jax.tree.unflatten(structure, leaves)


@partial(jax.jit, static_argnames=("rule", "structure"))
def _run(*leaves: Array, rule: Linear, structure: Any) -> Array:
    return _primitive.bind(*leaves, rule=rule, structure=structure)


def _apply(*leaves: Array, rule: Linear, structure: Any) -> Array:
    return rule.apply(*jax.tree.unflatten(structure, leaves))


def _apply_on_processors(*leaves: Array, rule: Linear, structure: Any) -> Array:
    return (rule.on_processors or rule.apply)(*jax.tree.unflatten(structure, leaves))


def _evaluate_abstractly(*avals: Any, rule: Linear, structure: Any) -> Any:
    # This is mostly the function that is traced anyway, and it takes less time to trace than `apply`.
    jaxpr = jax.make_jaxpr(partial(_apply_on_processors, rule=rule, structure=structure))(*avals)
    (result,) = jaxpr.out_avals
    return result


def _differentiate(primals: Any, tangents: Any, *, rule: Linear, structure: Any) -> tuple[Array, Any]:
    arguments = jax.tree.unflatten(structure, primals)
    value = _primitive.bind(*primals, rule=rule, structure=structure)
    changes: dict[int, PyTree] = {}  # one or more, for JAX asks only where something is differentiated
    for index, (tree, part) in enumerate(_split(structure, tangents)):
        if all(isinstance(leaf, ad.Zero) for leaf in part):
            continue
        leaves = [
            ad.instantiate_zeros(leaf) if jnp.issubdtype(jnp.result_type(old), jnp.inexact) else None
            for leaf, old in zip(part, jax.tree.leaves(arguments[index]), strict=True)
        ]
        changes[index] = jax.tree.unflatten(tree, leaves)
    last, terms = len(arguments) - 1, []
    if rule.jointly is not None and {last - 1, last} <= changes.keys():
        terms.append(rule.jointly(*arguments, (changes.pop(last - 1), changes.pop(last))))
    terms += [rule.derivative(index, arguments, change) for index, change in changes.items()]
    return value, sum(terms[1:], terms[0])


def _transpose(cotangent: Any, *operands: Any, rule: Linear, structure: Any) -> list[Any]:
    *fixed, (_, last) = _split(structure, operands)
    nothing: list[Any] = [None] * (len(operands) - len(last))
    if isinstance(cotangent, ad.Zero):
        return nothing + [ad.Zero(leaf.aval) if ad.is_undefined_primal(leaf) else None for leaf in last]
    found = rule.transposed(*(jax.tree.unflatten(tree, part) for tree, part in fixed), cotangent)
    leaves = jax.tree.leaves(found)
    return nothing + [new if ad.is_undefined_primal(old) else None for new, old in zip(leaves, last, strict=True)]


def _map(operands: Any, axes: Any, *, rule: Linear, structure: Any) -> tuple[Array, int]:
    """Move mapped axes to the front, and bind the primitive with mapped rules."""
    moved = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes, strict=True)]
    parts = tuple(_split(structure, [None if axis is None else 0 for axis in axes]))
    one = (jax.tree.structure(0), (0,))
    derivatives = rule.derivatives and tuple(
        _Mapped(function, (*parts, part)) for function, part in zip(rule.derivatives, parts, strict=False)
    )
    jointly = None
    if rule.jointly is not None:
        (before, before_axes), (last, last_axes) = parts[-2:]
        jointly = _Mapped(rule.jointly, (*parts, (jax.tree.structure((before, last)), (*before_axes, *last_axes))))
    over = Linear(
        _Mapped(rule.apply, parts),
        _Mapped(rule.transposed, (*parts[:-1], one), parts[-1][1]),
        derivatives,
        jointly,
        rule.on_processors and _Mapped(rule.on_processors, parts),
    )
    return _primitive.bind(*moved, rule=over, structure=structure), 0


def _split(structure: Any, leaves: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """Return the structure and the leaves of each argument."""
    parts, start = [], 0
    for tree in structure.children():
        parts.append((tree, tuple(leaves[start : start + tree.num_leaves])))
        start += tree.num_leaves
    return parts


_primitive = Primitive("linear")
_primitive.def_impl(_run)
_primitive.def_abstract_eval(_evaluate_abstractly)
ad.primitive_jvps[_primitive] = _differentiate
ad.primitive_transposes[_primitive] = _transpose
batching.primitive_batchers[_primitive] = _map
mlir.register_lowering(_primitive, mlir.lower_fun(_apply, multiple_results=False))
mlir.register_lowering(_primitive, mlir.lower_fun(_apply_on_processors, multiple_results=False), platform="cpu")
