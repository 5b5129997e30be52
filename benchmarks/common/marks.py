"""Marks that several programs write, and the options for them."""

import argparse
from typing import NamedTuple

import numpy as np

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.interfaces import FreeDimensions, Scheme
from jaxmark.watermark.perception.budget import BudgetLike
from jaxmark.watermark.perception.capacity import NOISE

KEY, MESSAGE, BUDGET = jm.Key(bytes(range(32))), b"jaxmark!", 8e-4


class Case(NamedTuple):
    """Payload and strength of a mark."""

    bits: int
    budget: float
    name: str


def parse_case(text: str) -> Case:
    """The type of an argument BITS:BUDGET."""
    bits, budget = text.split(":")
    return Case(int(bits), float(budget), f"{bits} bits at {budget}")


def add_schemes(parser: argparse.ArgumentParser, noise: float | None) -> None:
    """Schemes to mark with, and the noise that the marks are to survive where the usual one is refused."""
    parser.add_argument("--schemes", nargs="+", default=["keyed"], choices=["keyed", "host", "eigen"])
    parser.add_argument("--noise", type=float, default=noise, help=f"what to declare where {NOISE:g} is refused")


class Subject(NamedTuple):
    """A marked mesh, and what is known of its mark."""

    marker: jm.watermark.NonBlindMarker  # what reads it
    marked: Mesh
    message: bytes
    noise: float  # declared at embedding


def mark(mesh: Mesh, scheme: Scheme, bits: int, budget: float, noise: float | None, seed: int = 0) -> Subject:
    """Mark for the usual noise, or where that is refused for the one given."""
    rng = np.random.default_rng([bits, seed])
    marker, message = jm.make_marker(mesh, rng.bytes(32), bits=bits, scheme=scheme), rng.bytes(bits // 8)
    try:
        return Subject(marker, marker.embed(message, jm.Budget(rms=budget, noise=NOISE))[0], message, NOISE)
    except jm.JaxmarkError:
        if noise is None:
            raise
    return Subject(marker, marker.embed(message, jm.Budget(rms=budget, noise=noise))[0], message, noise)


def write(marker: jm.watermark.NonBlindMarker, message: bytes, budget: BudgetLike) -> Mesh:
    """Embed without reading back, whether or not the mesh has capacity for the message."""
    return marker.write(marker.codeword(message), budget)[0]


def free_dimensions(marker: jm.watermark.NonBlindMarker) -> FreeDimensions | None:
    """What the marker's reader leaves of its mark; None if it knows nothing of noise."""
    return marker.reader.free_dimensions(marker.original.to_traced(marker.original.used))
