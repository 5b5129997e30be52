"""What it costs to bring a mark below detection, with its message claimed."""

import math
from typing import NamedTuple

import jaxmark as jm
from common.marks import BUDGET, KEY, MESSAGE
from jaxmark import adversaries as enemies
from jaxmark.evaluation._robustness import Breaking
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.schemes import Scheme

BITS, ALPHA = 8 * len(MESSAGE), 1e-6
METRICS = ("rms", "dame", "msdm2")
TOLERANCE = 0.1


class Target(NamedTuple):
    """A marked mesh that enemies go against."""

    marker: jm.watermark.Marker  # what reads it
    marked: Mesh
    theory: float  # the least noise by theory over the mark


def make_target(mesh: Mesh, scheme: str | Scheme) -> Target:
    """Mark a mesh at the budget."""
    marker = jm.make_marker(mesh, KEY, bits=BITS, scheme=scheme)
    marked, _ = marker.embed(MESSAGE, BUDGET, noise=0)
    evidence, needed = enemies.score_oracle(marker, MESSAGE)(marked) ** 2 / 2, -math.log(ALPHA)
    return Target(marker, marked, math.sqrt(max(evidence / needed - 1, 0.0)))


def around(attack: jm.attacks.Attack, theory: float, unit: float = BUDGET) -> jm.attacks.Attack:
    """Strengths about that of noise by theory: a search among all would take long."""
    return attack._replace(strengths=(unit * max(theory, 1) / 8, 2 * unit * max(theory, 1)))


def least_distortion(target: Target, attack: jm.attacks.Attack, seed: int) -> Breaking:
    """The least distortion at which an attack succeeds."""
    return jm.evaluation.minimum_distortion(
        target.marker, target.marked, MESSAGE, attack, alpha=ALPHA, metrics=METRICS, tolerance=TOLERANCE, seed=seed
    )


def costs(cost: dict[str, float]) -> str:
    """Distortions by all metrics, as a cell of a table."""
    return " / ".join(f"{cost[metric]:.3g}" if metric in cost else "-" for metric in METRICS)
