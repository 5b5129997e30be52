"""Methods that take part in the benchmark: their interface, and those that are loaded by name."""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh

Bits = Bool[np.ndarray, " bits"]

#: The factory of each method, from the size of its message: a module of `jaxmark.bench.methods`, and a function in it.
METHODS: Mapping[str, str] = {
    "keyed": "builtin_schemes:keyed",
    "eigen": "builtin_schemes:eigen",
    "host": "builtin_schemes:host",
    "paper": "builtin_schemes:paper",
    "field": "builtin_schemes:field",
    "local": "builtin_schemes:local",
    "harmonics": "builtin_schemes:harmonics",
    "cho": "vertex_norms:cho",
    "cho-variance": "vertex_norms:cho_variance",
    "radial": "radial:radial",
    "wang": "moments:moments",
    "praun": "influence:influence",
}


class Reading(NamedTuple):
    """The result of one reading of a suspect."""

    message: Bits | None  # the best guess; None where the reader makes none
    score: float  # rises with the evidence that a mark of this key is there; calibrated by counting
    log10_p: float | None = None  # log10 of the false-positive probability, where the method proves one


@dataclass(frozen=True)
class Method:
    """A watermarking method, as the benchmark calls it.

    `embed(mesh, message, key, strength)` returns the marked mesh; `read(suspect, key, original)` a `Reading`, where
    `original` is None for a blind method. Keys are 32 bytes, and strengths are in the method's own unit: the benchmark
    finds, between the two of `strengths`, the largest one that its limits of distortion allow.
    """

    name: str
    embed: Callable[[Mesh, Bits, bytes, float], Mesh]
    read: Callable[[Mesh, bytes, Mesh | None], Reading]
    blind: bool
    bits: int  # size of a message; 0 for a method that shows presence only
    strengths: tuple[float, float]  # the weakest and the strongest, both above 0
    source: str = ""  # the publication
    anchor: str = ""  # the published figure that this code was validated against and meets; empty for 'not validated'
    threshold: float | None = None  # the score from which the method itself reports a mark
    rate: float = 1e-6  # the false-positive rate that the method states for its threshold


def get_method(name: str, bits: int) -> Method:
    """Make a method by its name in `METHODS`, for messages of a number of bits.

    Raises:
        JaxmarkError: if there is none of that name.
    """
    if name not in METHODS:
        raise JaxmarkError(f"There is no method {name!r}; there are {', '.join(METHODS)}, and files of your own.")
    module, _, function = METHODS[name].partition(":")
    made = getattr(importlib.import_module(f"jaxmark.bench.methods.{module}"), function)(bits)
    return replace(made, name=name)
