"""Chains of attacks, written as text."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.random import Generator

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh

Own = Mapping[str, Callable[[Mesh, float, Generator], Mesh]]


def parse(steps: str) -> list[tuple[str, float]]:
    """Kinds and strengths of attacks such as "noise 0.005 + smoothing 10"; without a strength it is 0."""
    return [(kind, float(*strength)) for kind, *strength in (step.split() for step in steps.split(" + "))]


def attacked(mesh: Mesh, steps: str, seed: int, own: Own | None = None) -> Mesh:
    """A mesh after attacks one by one: those of the caller, "none", and those of `jaxmark.attack`."""
    for place, (kind, strength) in enumerate(parse(steps)):
        if own and kind in own:
            mesh = own[kind](mesh, strength, np.random.default_rng([seed, place]))
        elif kind != "none":
            mesh = jm.attack(mesh, kind, strength, seed=seed)
    return mesh
