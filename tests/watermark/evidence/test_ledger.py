"""The ledger: its shares add up to no more than the budget, and readings are charged along its paths alone."""

import ast
import math
import re
from dataclasses import replace

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app.output import Status, detection_status
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark import RootedScheme
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import Evidence, accuse, weigh
from jaxmark.watermark.evidence.ledger import (
    MIN_LOG10_P,
    ROOTS,
    UNFLOORED,
    Alternative,
    Charge,
    Choice,
    choices,
    figure,
    is_charged_along_a_path,
)
from jaxmark.watermark.markers import CombinedMarker, make_blind_marker
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES
from tests import ROOT
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

# Choices whose alternatives have no share each, because they are counted together or have a factor of their own.
COUNTED_TOGETHER = {"proof", "catalogue"}


def every_choice() -> list[Choice]:
    return list(dict.fromkeys(choice for root in ROOTS.values() for choice in choices(root)))


@pytest.mark.parametrize("choice", every_choice(), ids=lambda choice: choice.name)
def test_shares_add_up_to_no_more_than_the_budget(choice: Choice):
    shares = [one.share for one in choice.alternatives]
    if None not in shares:
        assert math.fsum(share for share in shares if share is not None) <= 1 + 1e-12
        assert not choice.counted
    elif choice.name == "marks in one mesh":
        # Fisher's product is no alternative but one figure, which needs no share.
        assert [one.name for one in choice.alternatives] == ["product", "one mark"]
    else:
        assert set(shares) == {None}
        assert choice.counted
        assert len(shares) == 1 or choice.name in COUNTED_TOGETHER
        # The shares of n alternatives that are counted are 1/n each.
        taken = choice.alternatives[0].name
        assert 7 * 10 ** -choice.charge(taken, 7).log10 == pytest.approx(1)


def leaves(choice: Choice) -> list[float]:
    """The share that each end of the tree has, if each counted choice is among three."""
    found = []
    for one in choice.alternatives:
        share = 10 ** -choice.charge(one.name, 3).log10
        repeated = 1 if one.share is not None else 3 / len(choice.alternatives)
        below = [1.0] if one.then is None else leaves(one.then)
        found += [share * repeated * end for end in below]
    return found


@pytest.mark.parametrize("path", [path for path in ROOTS if path != "Several marks in one mesh"])
def test_the_shares_of_all_ends_of_a_path_add_up_to_no_more_than_the_budget(path: str):
    assert math.fsum(leaves(ROOTS[path])) <= 1 + 1e-9


def test_a_choice_that_spends_too_much_is_seen():
    wrong = Choice("wrong", (Alternative("a", 0.97), Alternative("b", 0.05)))
    with pytest.raises(AssertionError):
        test_shares_add_up_to_no_more_than_the_budget(wrong)
    assert math.fsum(leaves(wrong)) > 1


def test_charges_by_hand():
    score = Charge("proof", "score", math.log10(2), False)
    assert figure(-7.0, [score]) == pytest.approx(-7 + math.log10(2))
    assert figure(-0.1, [score]) == 0.0
    assert figure(-3.0, [ledger.ALIGNMENT.charge("same")]) == pytest.approx(-1.0)
    assert figure(-1.5, [ledger.ALIGNMENT.charge("same")]) == 0.0
    assert ledger.RANK.charge("each", 32).log10 == pytest.approx(math.log10(32))
    assert ledger.PAYLOAD.charge("each", bits=16).log10 == pytest.approx(16 * math.log10(2))
    assert ledger.uncommitted(-30.0) == pytest.approx(-30 + 64 * math.log10(2))
    assert ledger.uncommitted(-3.0) == 0.0


def test_the_floor_of_the_key_holds_before_charges_outside_of_a_bound():
    payload, score = ledger.PAYLOAD.charge("each", bits=64), ledger.PROOF.charge("score", 2)
    below = -800 / math.log(10)
    assert figure(-1e9, []) == MIN_LOG10_P == -77.0
    assert figure(below, [payload, score]) == pytest.approx(MIN_LOG10_P + math.log10(2))
    assert figure(-90.0, [payload, score]) == pytest.approx(-90 + 64 * math.log10(2) + math.log10(2))
    unfloored = figure(below, [payload, score], UNFLOORED)
    assert unfloored == pytest.approx(64 * math.log10(2) + math.log10(2) + below)
    assert figure(0.0, [payload], UNFLOORED) == 0.0


@pytest.mark.slow
def test_paths_are_told_from_what_is_none():
    score, alignment = ledger.PROOF.charge("score", 2), ledger.ALIGNMENT.charge("auto")
    assert is_charged_along_a_path(())
    assert is_charged_along_a_path((alignment, score))
    assert is_charged_along_a_path((ledger.PASS_BAND.charge("low"), alignment, score, ledger.PAYLOAD.charge("each", 4)))
    assert not is_charged_along_a_path((score, alignment)), "against the tree's order"
    assert not is_charged_along_a_path((alignment, alignment)), "twice"
    assert not is_charged_along_a_path((score, ledger.RANK.charge("each", 1))), "the score has no rank"
    assert not is_charged_along_a_path((Charge("a choice", "of nobody", 1.0, False),))


def test_evidence_of_both_ways_of_proof():
    """The best of two scores and a tag, by hand, after what each of them is charged."""
    ways = [(8.0, 1.0), (7.0, 1.0)]
    read = weigh(ways, bits=16, fixed=False)
    assert read.log10_p == pytest.approx(-32 / math.log(10) + 16 * math.log10(2) + math.log10(2))
    assert read.charges == (ledger.PROOF.charge("score", 2), ledger.PAYLOAD.charge("each", bits=16))
    claimed = weigh(ways, bits=16, fixed=True)
    assert claimed.log10_p == pytest.approx(-32 / math.log(10) + math.log10(2))
    late = -32 / math.log(10) + math.log10(2) + (16 + 64) * math.log10(2)
    assert read.log10_p_uncommitted == claimed.log10_p_uncommitted == min(0.0, late)
    assert weigh([(2.0, 1.0)], bits=16, fixed=False).log10_p == 0.0
    assert accuse_one(3) - accuse_one(1) == pytest.approx(math.log10(3))


def accuse_one(tried: int) -> float:
    biases, values = np.full(200, 0.5), np.ones(200)
    return float(accuse(np.array([100.0]), values, biases, tried)[0])


def test_united_evidence_keeps_every_caveat():
    one, other = Evidence(-20.0, -3.0, caveats=("a",)), Evidence(-30.0, -1.0, caveats=("b", "a"))
    least = Evidence.least(one, other)
    assert (least.log10_p, least.log10_p_uncommitted, set(least.caveats)) == (-30.0, -3.0, {"a", "b"})
    product = Evidence.product(one, other)
    assert set(product.caveats) == {"a", "b"}
    assert -50 < product.log10_p < -47
    assert product.log10_p_uncommitted == pytest.approx(-3 + math.log10(2))


@pytest.fixture(scope="module")
def original() -> Mesh:
    return bumpy_sphere(4)


@pytest.fixture(scope="module")
def marked(original: Mesh, key: jm.Key) -> tuple[Mesh, jm.watermark.EmbedInfo]:
    return jm.embed(original, b"original", key)


@pytest.mark.parametrize("record", [True, False], ids=["record", "none"])
@pytest.mark.parametrize("message", [None, b"original", b"another!"])
@pytest.mark.parametrize("align", ["auto", "affine"])
def test_every_detection_is_charged_along_a_path(original: Mesh, marked, key: jm.Key, record, message, align):
    suspect, info = marked
    if record and message == b"another!":
        pytest.skip("the record refuses that claim")
    kept = info.record if record else None
    found = jm.detect(suspect, original=original, key=key, record=kept, message=message, align=align)
    assert found.message == b"original"
    assert found.evidence.charges
    assert is_charged_along_a_path(found.evidence.charges), found.evidence.charges
    assert found.detected(1e-6 if align == "auto" or record else 1e-3)
    assert all(charge.log10 >= 0 for charge in found.evidence.charges)


@pytest.mark.slow
def test_detections_of_all_other_kinds_are_charged_along_a_path(original: Mesh, key: jm.Key, monkeypatch):
    # Few steps are sooner written; rooted marks, which are sought last, take long to find.
    usual = BLIND_SCHEMES["field"]
    quick = replace(usual, widths=usual.widths[-1:], steps=usual.steps[4:8], with_hint=False)
    monkeypatch.setattr(RootedScheme, "views", lambda *_: iter(()))
    field = make_blind_marker(original, key, bits=40, scheme=quick).embed(b"blind", read_back="never")[0]
    combined = CombinedMarker(jm.make_marker(original, key, bits=32), (quick,))
    both = combined.embed(b"both", read_back="never")[0]
    scene = {"a": original, "b": bumpy_sphere(4, seed=3)}
    written, info = jm.watermark.embed_scene(scene, b"scene", key)
    remeshed = jm.attack(jm.embed(original, b"original", key)[0], "simplification", 0.3, seed=0)
    found = {
        "blind": jm.detect(field, key=key, bits=40),
        "blind, claimed": jm.detect(field, key=key, message=b"blind"),
        "together": jm.detect(both, original=original, key=key, message=b"both", scheme=("keyed", "field")),
        "scene": jm.watermark.detect_scene(written, originals=scene, key=key, record=info.record),
        "surface": jm.detect(remeshed, original=original, key=key),
    }
    for kind, one in found.items():
        assert one.detected(), kind
        assert is_charged_along_a_path(one.evidence.charges), (kind, one.evidence.charges)
        for part in one.parts.values():
            assert is_charged_along_a_path(part.evidence.charges), (kind, part.evidence.charges)


def test_only_evidence_knows_the_formulas():
    """Nothing else in the package turns a score into a probability, so that nothing escapes the ledger."""
    importing = {
        str(path.relative_to(ROOT / "jaxmark"))
        for path in (ROOT / "jaxmark").rglob("*.py")
        if "evidence" not in path.parts and re.search(r"import .*\bbounds\b|evidence\.bounds import", path.read_text())
    }
    assert not importing
    assert "evidence.bounds" in (ROOT / "tests" / "watermark" / "evidence" / "test_bounds.py").read_text()


def test_only_the_ledger_spends_shares():
    """Choices are made in the ledger, and charges are made by them."""
    made = [
        f"{path}: {node.func.id}"
        for path in (ROOT / "jaxmark").rglob("*.py")
        if path.name != "ledger.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in {"Charge", "Choice"}
    ]
    assert not made


def test_the_documentation_has_the_ledger():
    assert ledger.table() in (ROOT / "docs" / "proof.md").read_text(), "print it again, as that page says"


def test_what_has_caveats_is_no_proof(original: Mesh, marked, key: jm.Key):
    suspect, info = marked
    found = jm.detect(suspect, original=original, key=key, record=info.record)
    estimate = found._replace(evidence=found.evidence._replace(caveats=("the original was edited",)))
    assert found.detected()
    assert found.detected(allow_estimate=True)
    assert not estimate.detected()
    assert estimate.detected(allow_estimate=True)
    assert [detection_status(one, 1e-6) for one in (found, estimate)] == [Status.DONE, Status.ESTIMATE]
    assert [detection_status(one, 1e-99) for one in (found, estimate)] == [Status.NOTHING] * 2
    for alpha in (0.0, 1.0, -1.0):
        with pytest.raises(jm.JaxmarkError, match="alpha is a probability"):
            found.detected(alpha)
