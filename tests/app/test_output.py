"""The sentences of commands about readings."""

import numpy as np
import pytest

from jaxmark.app.output import detection_lines, survival_text
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.perception.capacity import Survival

ADVICE = "if you know the message, give it by --message"


@pytest.mark.parametrize(
    ("log10_p", "message", "claimed", "start", "advised"),
    [
        (-20.0, b"\xc0\xff", None, "detected: message c0ff; ", False),
        (-20.0, None, b"\xc0\xff", "detected: the claimed message c0ff, which could not be decoded; ", False),
        (-1.0, None, b"\xc0\xff", "nothing detected: no message could be read; ", False),
        (-1.0, None, None, "nothing detected: no message could be read; ", True),
    ],
)
def test_a_detection_says_what_was_read(
    log10_p: float, message: bytes | None, claimed: bytes | None, start: str, advised: bool
):
    """A claim that is proven is named, and one is advised where nothing was found without it."""
    found = Detection(message, Evidence(log10_p), None, np.ones(1), None, "field", claimed=claimed)
    (line,) = detection_lines(found, 1e-6, None)
    assert line.startswith(start)
    assert (ADVICE in line) == advised


@pytest.mark.parametrize(
    ("log10_p", "end"),
    [
        (-20.0, "at most 10^-20.0 if key were fixed before the suspect existed, 10^-10.0 even if they were chosen"),
        (0.0, "at most 10^0.0 (--alpha"),
    ],
)
def test_a_bound_of_one_has_no_conditions(log10_p: float, end: str):
    evidence = Evidence(log10_p, log10_p / 2)
    (line,) = detection_lines(Detection(None, evidence, None, np.ones(1), None, "field", "key"), 1e-6, None)
    assert f"false-positive probability {end}" in line


@pytest.mark.parametrize(
    ("survives", "text"),
    [
        (
            Survival(0.03, 0.02),
            "noise of 3 % of the mean distance to the centre, 2 % with half of the vertices lost",
        ),
        (Survival(0.03, 0.0), "noise of 3 % of the mean distance to the centre where no part is lost"),
        (Survival(0.0, 0.0), "hardly any noise, only attacks that do not displace vertices"),
        (Survival(np.inf, np.inf), "an unknown amount of noise, because this scheme has no noise model"),
    ],
)
def test_what_a_mark_survives(survives: Survival, text: str):
    assert survival_text(survives) == text
