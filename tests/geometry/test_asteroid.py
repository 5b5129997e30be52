"""The mesh to try things on."""

import numpy as np
import pytest
import trimesh

import jaxmark as jm
from jaxmark.geometry import asteroid

pytestmark = pytest.mark.core


@pytest.mark.parametrize("count", [100, 3000])
def test_it_is_closed_and_of_the_size_asked_for(count: int):
    mesh = asteroid(count)
    solid = trimesh.Trimesh(*mesh, process=False)
    assert len(mesh.vertices) == count
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.euler_number == 2
    assert 1 < np.ptp(mesh.vertices, axis=0).max() < 4


def test_it_is_the_same_each_time_and_another_by_seed():
    np.testing.assert_array_equal(asteroid(200).vertices, asteroid(200).vertices)
    assert (asteroid(200, seed=0).vertices != asteroid(200, seed=1).vertices).any()


def test_it_carries_a_mark(key: jm.Key):
    mesh = asteroid(3000)
    marked, _ = jm.embed(mesh, b"hi", key)
    assert jm.detect(jm.attack(marked, "noise", 0.002, seed=0), original=mesh, key=key, bits=16).message == b"hi"
