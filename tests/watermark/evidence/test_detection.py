"""Detections: what they say about themselves."""

import re

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.everyday import detect_scene, embed_scene
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.markers import NonBlindMarker
from tests.samples import bumpy_sphere


def test_the_statement_of_a_detection_has_its_figures_conditions_and_choices():
    """Figures are rounded up, so that each is a bound as well."""
    charges = (ledger.REFLECTION.charge("better fit"),)
    evidence = Evidence(-20.38, -1.04, charges=charges)
    proof = Detection(b"jm", evidence, None, np.zeros(3), 1.0, "keyed", premises="key and mesh")
    said = proof.statement()
    assert said.startswith("The message 6a6d of the scheme 'keyed' was decoded without a claim. For a mesh")
    assert re.findall(r"10\^(-?[\d.]+)", said) == ["-20.3", "-1.0"]
    assert "is at most 10^-20.3 if key and mesh were fixed before the mesh existed" in said
    assert f"{charges[0].choice} ({charges[0].taken}) {charges[0].log10:.2f}" in said
    assert "estimate" not in said
    estimate = proof._replace(message=None, evidence=evidence._replace(caveats=("it is a test", "of mine")))
    said = estimate.statement()
    assert "No message was claimed, and none of the scheme 'keyed' was decoded, so there is no evidence" in said
    assert "is estimated as 10^-20.3" in said
    assert "They are estimates, because it is a test; of mine." in said


CLAIM = "Before the mesh was read, the message 6a6d of the scheme 'keyed' was claimed"
PRESENCE = "Before the mesh was read, the presence of a mark of the scheme 'keyed' was claimed"
READ = "The message 6a6d of the scheme 'keyed' was decoded without a claim."


@pytest.mark.parametrize(
    ("message", "claimed", "recorded", "log10_p", "said"),
    [
        (b"jm", b"jm", None, -20.0, f"{CLAIM}, and it was decoded."),
        (
            None,
            b"jm",
            None,
            -20.0,
            f"{CLAIM}. The mesh supports the claim, although it could not be decoded, at a level of 10^-6.",
        ),
        (None, b"jm", None, -5.9, f"{CLAIM}. The mesh does not support the claim at a level of 10^-6."),
        (
            b"mj",
            b"jm",
            None,
            -20.0,
            f"{CLAIM}. The mesh does not support the claim: the message 6d6a was decoded instead, and the figures are"
            " those of the decoded message.",
        ),
        (None, b"", None, -20.0, f"{PRESENCE}. The mesh supports the claim at a level of 10^-6."),
        (None, b"", None, 0.0, f"{PRESENCE}. The mesh does not support the claim at a level of 10^-6."),
        (b"jm", None, None, -20.0, READ),
        (b"jm", None, True, -20.0, f"{READ} It is the message that the record commits to."),
        (b"jm", None, False, -20.0, f"{READ} It is another message than the one that the record commits to."),
        (None, None, None, 0.0, "No message was claimed, and none of the scheme 'keyed' was decoded, so"),
    ],
)
def test_the_statement_says_what_was_claimed_or_read(message, claimed, recorded, log10_p, said):
    evidence = Evidence(log10_p, log10_p / 2)
    found = Detection(message, evidence, None, np.zeros(3), 1.0, "keyed", claimed=claimed, recorded=recorded)
    assert found.statement().startswith(said)


@pytest.fixture(scope="module")
def marker(sphere: Mesh) -> NonBlindMarker:
    return jm.make_marker(sphere, bytes(range(32)), bits=16)


@pytest.fixture(scope="module")
def copy(marker: NonBlindMarker) -> tuple[Mesh, NonBlindMarker]:
    """A marked copy, and a marker with its record."""
    marked, info = marker.embed(b"jm", 2e-3)
    return marked, marker.with_record(info.record)


@pytest.mark.parametrize(
    ("claim", "with_record", "fields"),
    [
        (b"jm", False, (b"jm", b"jm", None)),
        (b"mj", False, (b"jm", b"mj", None)),
        (None, False, (b"jm", None, None)),
        (None, True, (b"jm", None, True)),
        (b"jm", True, (b"jm", b"jm", True)),
    ],
)
def test_a_detection_has_its_claim(marker, copy, claim, with_record, fields):
    marked, recorded = copy
    found = (recorded if with_record else marker).detect(marked, claim)
    assert (found.message, found.claimed, found.recorded) == fields


def test_a_detection_of_another_message_than_the_recorded_one(marker, copy):
    other = marker.embed(b"mj", 2e-3)[0]
    found = copy[1].detect(other)
    assert (found.message, found.claimed, found.recorded) == (b"mj", None, False)
    assert "another message than the one that the record commits to" in found.statement()


@pytest.mark.parametrize("claim", [b"jm", None])
def test_an_unmarked_mesh_supports_no_claim(marker, sphere, claim):
    found = marker.detect(jm.attack(sphere, "noise", 0.01, seed=0), claim)
    assert (found.message, found.claimed, found.recorded) == (None, claim, None)
    said = "does not support the claim" if claim else "No message was claimed, and none"
    assert said in found.statement()


def test_a_claim_of_presence(sphere: Mesh):
    marker = jm.make_marker(sphere, bytes(range(32)), bits=0)
    found = marker.detect(marker.embed(b"", 2e-3)[0])
    assert (found.message, found.claimed) == (None, b"")
    assert found.statement().startswith(f"{PRESENCE}. The mesh supports the claim")


def test_scenes_have_the_claim_of_their_meshes(sphere: Mesh):
    meshes = {"a": sphere, "b": bumpy_sphere(3, seed=1)}
    key = jm.Key(bytes(range(32)))
    marked, info = embed_scene(meshes, b"jm", key, budget=2e-3)
    for claim, record, fields in ((b"jm", None, (b"jm", b"jm", None)), (None, info.record, (b"jm", None, True))):
        found = detect_scene(marked, originals=meshes, key=key, record=record, bits=16, message=claim)
        assert (found.message, found.claimed, found.recorded) == fields
