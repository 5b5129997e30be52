"""The distortion that brings a mark below detection, with its message claimed."""

import math
from typing import NamedTuple

import jaxmark as jm
from common.marks import BUDGET, KEY, MESSAGE
from common.tables import Row
from jaxmark import adversaries as enemies
from jaxmark.evaluation._robustness import Breaking
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.interfaces import Scheme

BITS, ALPHA = 8 * len(MESSAGE), 1e-6
METRICS = ("rms", "dame", "msdm2")
TOLERANCE = 0.1


class Target(NamedTuple):
    """A marked mesh that enemies go against."""

    marker: jm.watermark.NonBlindMarker  # what reads it
    marked: Mesh
    theory: float  # the least noise by theory over the mark


def make_target(mesh: Mesh, scheme: str | Scheme, budget: float | None = BUDGET) -> Target:
    """Mark a mesh at a budget, or without one as strongly as is hidden."""
    marker = jm.make_marker(mesh, KEY, bits=BITS, scheme=scheme)
    marked, _ = marker.embed(MESSAGE, jm.Budget(rms=budget, noise=0))
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


def paid(target: Target, attack: jm.attacks.Attack, seed: int) -> Row:
    """What an attack must pay, as a row: distortions over the mark's in each metric, or what it reaches at most."""
    found = least_distortion(target, attack, seed)
    if (weakest := found.weakest) is None:
        strongest = found.curve[-1]
        return {"not below": strongest.strength, "log10_p": strongest.log10_p}
    cost = {metric: found.cost(metric) for metric in METRICS}
    return {"cost": cost, "strength": weakest.strength, "log10_p": weakest.log10_p}


def cell(row: Row) -> str:
    """A row of `paid`, or of a refusal, as a cell of a table."""
    if "cost" in row:
        return costs(row["cost"])
    return f"refused: {row['refused']}" if "refused" in row else f"detected up to {row['not below']:g}"


def costs(cost: dict[str, float]) -> str:
    """Distortions by all metrics, as a cell of a table."""
    values = [cost.get(metric, math.nan) for metric in METRICS]
    return " / ".join("-" if math.isnan(value) else f"{value:.3g}" for value in values)
