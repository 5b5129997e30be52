"""The sentences of commands about readings."""

import numpy as np
import pytest

from jaxmark.app.output import detection_lines
from jaxmark.watermark.evidence.detection import Detection, Evidence

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
    found = Detection(message, Evidence(log10_p), None, np.zeros(1), None, "field", claimed=claimed)
    (line,) = detection_lines(found, 1e-6, None)
    assert line.startswith(start)
    assert (ADVICE in line) == advised
