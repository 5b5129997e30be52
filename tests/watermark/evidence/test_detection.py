"""Detections: what they say about themselves."""

import re

import numpy as np

from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence


def test_the_statement_of_a_detection_has_its_figures_conditions_and_choices():
    """Figures are rounded up, so that each is a bound as well."""
    charges = (ledger.REFLECTION.charge("better fit"),)
    evidence = Evidence(-20.38, -1.04, charges=charges)
    proof = Detection(b"jm", evidence, None, np.zeros(3), 1.0, "keyed", premises="key and mesh")
    said = proof.statement()
    assert "The message 6a6d of the scheme 'keyed' was decoded." in said
    assert re.findall(r"10\^(-?[\d.]+)", said) == ["-20.3", "-1.0"]
    assert "is at most 10^-20.3 if key and mesh were fixed before the mesh existed" in said
    assert f"{charges[0].choice} ({charges[0].taken}) {charges[0].log10:.2f}" in said
    assert "estimate" not in said
    estimate = proof._replace(message=None, evidence=evidence._replace(caveats=("it is a test", "of mine")))
    said = estimate.statement()
    assert "No message of the scheme 'keyed' was decoded; if one was claimed, " in said
    assert "is estimated as 10^-20.3" in said
    assert "They are estimates, because it is a test; of mine." in said
