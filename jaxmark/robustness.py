"""What a mark survives: attacks of rising strength, and what is still read after each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from jaxmark.alignment import Alignment
from jaxmark.attacks import Kind, attack, get_attack
from jaxmark.errors import JaxmarkError
from jaxmark.marking import Marker
from jaxmark.mesh import Mesh
from jaxmark.message import guess


class Reading(NamedTuple):
    """What is read from one suspect, beside what was written."""

    read: bool  # the exact message, and its tag fits
    wrong: bool  # another message, whose tag fits
    bit_errors: float  # share of the message's bits that are wrong in the best guess; 1/2 where there is none
    log10_p: float  # bound on the false-positive probability, the message unknown


class Robustness(NamedTuple):
    """What is read at each strength in each sample; a suspect that is refused is not read."""

    strengths: Float64[np.ndarray, " epsilons"]
    success: Bool[np.ndarray, "epsilons samples"]  # of the reader: the exact message
    bit_errors: Float64[np.ndarray, "epsilons samples"]  # see `Reading`
    log10_p: Float64[np.ndarray, "epsilons samples"]
    refusals: tuple[tuple[str, ...], ...]  # epsilons, samples: the sentence, empty where there is an answer


NOTHING = Reading(False, False, 0.5, 0.0)  # read from a suspect that is refused


def read(marker: Marker, suspect: Mesh | Alignment, message: bytes) -> Reading:
    """Read a suspect, and compare with what was written.

    Raises:
        JaxmarkError: if the suspect cannot be aligned.
    """
    found = marker.detect(suspect)
    said = found.message or guess(found.scores, marker.bits)
    wrong = 0.5 if said is None else float(np.mean(_bits(said) != _bits(message)))
    return Reading(found.message == message, found.message not in (None, message), wrong, found.log10_p)


def robustness(
    marker: Marker,
    marked: Mesh,
    message: bytes,
    kind: Kind,
    epsilons: Sequence[float] | None = None,
    *,
    samples: int = 5,
) -> Robustness:
    """Attack a marked mesh at several strengths, and read each suspect.

    Args:
        marker: what reads: original, key, payload and scheme.
        marked: the mesh with the message in it.
        message: what was written.
        kind: a name in `ATTACKS`, or an `Attack` of your own.
        epsilons: strengths, in the attack's unit; by default its usual ones.
        samples: seeds 0, 1, … for each strength.

    Raises:
        JaxmarkError: if there is no such attack, or not one strength and sample.
    """
    strengths = get_attack(kind).strengths if epsilons is None else tuple(epsilons)
    if samples < 1 or not strengths:
        raise JaxmarkError(f"robustness needs a strength and a sample, got {len(strengths)} and {samples}.")

    def tried(strength: float, seed: int) -> tuple[Reading, str]:
        try:
            return read(marker, attack(marked, kind, strength, seed=seed), message), ""
        except JaxmarkError as error:
            return NOTHING, str(error)

    rows = [[tried(strength, seed) for seed in range(samples)] for strength in strengths]

    def column(name: str) -> np.ndarray:
        return np.array([[getattr(reading, name) for reading, _ in row] for row in rows])

    refusals = tuple(tuple(sentence for _, sentence in row) for row in rows)
    return Robustness(np.array(strengths, float), column("read"), column("bit_errors"), column("log10_p"), refusals)


def _bits(message: bytes) -> np.ndarray:
    return np.unpackbits(np.frombuffer(message, np.uint8))
