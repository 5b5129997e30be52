"""What takes part in the benchmark: a writer, a reader, and what is declared about them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxmark.geometry.mesh import Mesh

Bits = Bool[np.ndarray, " bits"]


class Reading(NamedTuple):
    """What a reader says of a suspect."""

    message: Bits | None  # the best guess, or None where the reader has no guess
    score: float  # the larger, the surer is the reader that a mark of this key is there; calibrated by counting
    log10_p: float | None = None  # log10 of the false-positive probability that the method proves, where it proves one


@dataclass(frozen=True)
class Method:
    """A watermarking method, as the benchmark sees it.

    `embed(mesh, message, key, strength)` returns the marked mesh; `read(suspect, key, original)` a `Reading`, where
    `original` is None for a blind method. Keys are 32 bytes, and strengths are the method's own: the benchmark looks,
    by bisection between the two of `strengths`, for the largest one that its limits of distortion allow.
    """

    name: str
    embed: Callable[[Mesh, Bits, bytes, float], Mesh]
    read: Callable[[Mesh, bytes, Mesh | None], Reading]
    blind: bool
    bits: int  # that a message has; 0 for a method that shows presence only
    strengths: tuple[float, float]  # the weakest and the strongest, both above 0
    source: str = ""  # the publication
    anchor: str = ""  # the published figure that this code was held against and meets; empty for 'not validated'
    threshold: float | None = None  # of the score, from which on the method itself says that a mark is there
    rate: float = 1e-6  # of false positives, which the method states for its threshold
