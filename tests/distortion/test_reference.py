"""What a `Reference` keeps of its original, and what it begins to compute in other threads."""

import copy
import pickle
from contextlib import suppress
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from jaxmark.distortion import Reference
from jaxmark.geometry.mesh import Mesh

METRICS = ("dame", "stretch", "shading")


@pytest.fixture(scope="module")
def moved(sphere: Mesh) -> Mesh:
    noise = np.random.default_rng(0).normal(size=sphere.vertices.shape)
    return sphere._replace(vertices=sphere.vertices + 1e-3 * noise)


@pytest.fixture(scope="module")
def expected(sphere: Mesh, moved: Mesh) -> dict:
    return Reference(sphere).measure(moved, METRICS)


@pytest.mark.parametrize("metric", METRICS)
def test_what_is_kept_belongs_to_no_trace(metric, sphere, moved, expected):
    reference = Reference(sphere)

    @jax.jit
    def traced(x):
        with suppress(jax.errors.JAXTypeError):  # a measurement is a number of the host
            reference.measure(moved, [metric])
        return x

    traced(1.0)
    assert reference.measure(moved, [metric])[metric] == expected[metric]


def test_what_was_begun_is_the_same_and_does_not_hinder_copies(sphere, moved, expected):
    reference = Reference(sphere)
    reference.begin(METRICS)
    copies = copy.deepcopy(reference), pickle.loads(pickle.dumps(reference))
    for one in (*copies, reference):
        assert one.measure(moved, METRICS) == expected


def test_an_error_in_a_thread_is_raised_and_forgotten(sphere, moved, expected, monkeypatch):
    reference = Reference(sphere)
    with monkeypatch.context() as failing:
        failing.setattr(Reference, "_make_masking", Mock(side_effect=MemoryError))
        reference.begin(METRICS)
        with pytest.raises(MemoryError):
            reference.measure(moved, METRICS)
    assert reference.measure(moved, METRICS) == expected
