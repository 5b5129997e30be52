"""Chains of tools: what evolution finds, and what a chain costs."""

import math

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries import chain_attack, projected_cost, search_chain
from jaxmark.adversaries.by_name import ATTACKS
from jaxmark.adversaries.chains import Gene, decode, run_chain
from jaxmark.geometry.mesh import Mesh

TOOLS = {"noise": (1e-3, 1e-1), "smoothing": (1, 100), "quantisation": (12, 4)}


def test_the_best_chain_of_a_known_landscape_is_found():
    """Least costs a smoothing of ten steps before noise of 0.02; every wrong or missing step costs more."""
    asked = []

    def judge(steps):
        asked.append(steps)
        cost = abs(len(steps) - 2.0)
        for step, (kind, strength) in zip(steps, [("smoothing", 10), ("noise", 0.02)], strict=False):
            cost += abs(math.log(step[1] / strength)) if step[0] == kind else 5
        return cost

    found = search_chain(judge, tools=TOOLS, population=30, generations=30, seed=3)
    assert [gene.kind for gene in found.genes] == ["smoothing", "noise"]
    assert found.cost < 0.1
    assert found.cost == judge(decode(found.genes, TOOLS))
    assert max(map(len, asked)) <= 4
    assert len(asked) - 1 == len(set(asked[:-1]))  # no chain is tried twice
    again = search_chain(judge, tools=TOOLS, population=30, generations=30, seed=3)
    assert again == found


def test_refused_chains_cost_most():
    def judge(steps):
        if steps[0][0] != "noise":
            raise jm.JaxmarkError("refused")
        return 1.0

    assert search_chain(judge, tools=TOOLS, generations=2).genes[0].kind == "noise"


def test_strengths_go_from_the_weakest_to_the_strongest():
    chain = [Gene("noise", 0.5), Gene("smoothing", 0.5), Gene("quantisation", 1), Gene("quantisation", -3)]
    assert decode(chain, TOOLS) == (("noise", 0.01), ("smoothing", 10), ("quantisation", 4), ("quantisation", 12))


def test_a_chain_as_an_attack_grows_in_all_its_steps(sphere: Mesh):
    attack = chain_attack([Gene("noise", 0.5), Gene("smoothing", 0.25)], TOOLS)
    weak, strong = (jm.attack(sphere, attack, strength, seed=0) for strength in (0.25, 4.0))
    near, far = (np.sqrt(np.mean((one.vertices - sphere.vertices) ** 2)) for one in (weak, strong))
    assert near < far / 3
    np.testing.assert_array_equal(weak.vertices, jm.attack(sphere, attack, 0.25, seed=0).vertices)


@pytest.mark.slow
def test_costs_are_distortions_over_the_mark_and_more_where_it_is_still_proven(sphere: Mesh, key):
    marker = jm.make_marker(sphere, key, bits=8)
    marked, _ = marker.embed(b"m", jm.Budget(rms=2e-3, noise=0), read_back="never")
    judge = projected_cost([(marker, marked, b"m")], "rms")
    steps = [("noise", 0.002)]
    suspect = run_chain(marked, steps, seed=0)
    paid = jm.compare(marked, suspect, ["rms"]).rms / jm.compare(sphere, marked, ["rms"]).rms
    log10_p = marker.detect(suspect, b"m").evidence.log10_p_unfloored
    assert log10_p < -6
    first = marker.detect(marked, b"m").evidence.log10_p_unfloored
    assert judge(steps) == pytest.approx(paid * math.sqrt((first / -6 - 1) / (first / log10_p - 1)))
    dear = [("noise", 0.3)]
    far = run_chain(marked, dear, seed=0)
    assert judge(dear) == pytest.approx(jm.compare(marked, far, ["rms"]).rms / jm.compare(sphere, marked, ["rms"]).rms)
    assert judge([("loop", 1)]) > 1e8  # has other vertices, which RMS cannot compare


def test_refusals(sphere: Mesh):
    with pytest.raises(jm.JaxmarkError, match="There is no attack 'nothing'; there are noise"):
        search_chain(lambda steps: 1.0, tools={"nothing": (1, 2)})
    with pytest.raises(jm.JaxmarkError, match=r"must be positive, got \(0, 1\) for 'noise'"):
        search_chain(lambda steps: 1.0, tools={"noise": (0, 1)})
    with pytest.raises(jm.JaxmarkError, match="returned NaN"):
        search_chain(lambda steps: float("nan"), generations=1)
    with pytest.raises(jm.JaxmarkError, match="There is no metric 'x'; there are rms"):
        projected_cost([], "x")
    with pytest.raises(jm.JaxmarkError, match="got 0 tools, 4, 12 and 8"):
        search_chain(lambda steps: 1.0, tools={})
    with pytest.raises(jm.JaxmarkError, match="at least one mark of the attacker"):
        projected_cost([])
    marker = jm.make_marker(sphere, jm.Key(bytes(32)), bits=8)
    with pytest.raises(jm.JaxmarkError, match="not proven before any attack"):
        projected_cost([(marker, sphere, b"m")])
    with pytest.raises(jm.JaxmarkError, match="more than 4 times as many vertices"):
        run_chain(sphere, [("loop", 1), ("loop", 1)], seed=0)
    assert set(ATTACKS) >= {"loop", *TOOLS}
