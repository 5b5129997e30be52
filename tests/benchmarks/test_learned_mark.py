"""The learned watermark, a method of the benchmark in one file."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark import spectral
from jaxmark.bench.method import Method, load_method
from jaxmark.errors import JaxmarkError
from tests import ROOT
from tests.dense import laplacian_matrix
from tests.samples import rough_sphere

PROGRAM = ROOT / "benchmarks" / "robustness" / "learned_mark.py"
STRENGTH = 0.01


@pytest.fixture(scope="module")
def method() -> Method:
    return load_method(PROGRAM, 16)


@pytest.fixture(scope="module")
def mesh() -> jm.Mesh:
    return rough_sphere(1000)


@pytest.fixture(scope="module")
def message() -> np.ndarray:
    return np.random.default_rng(0).random(16) < 0.5


@pytest.fixture(scope="module")
def marked(method, mesh, message) -> jm.Mesh:
    return method.embed(mesh, message, bytes(32), STRENGTH)


def test_a_strong_mark_is_read_with_its_key_alone(method, mesh, message, marked):
    assert method.blind
    assert np.array_equal(marked.faces, mesh.faces)
    assert np.mean(method.read(marked, bytes(32), None).message == message) >= 15 / 16
    other = method.read(marked, bytes(range(32)), None).message
    assert 3 <= np.sum(other != message) <= 13


def test_the_strength_is_the_rms_of_delta_of_the_shifts(mesh, marked):
    x, y = np.asarray(mesh.vertices), np.asarray(marked.vertices)
    weights = spectral.vertex_areas(x, mesh.faces) / np.sum(spectral.vertex_areas(x, mesh.faces))
    x, y = x - weights @ x, y - weights @ x
    before, after = np.linalg.norm(x, axis=1), np.linalg.norm(y, axis=1)
    np.testing.assert_allclose(np.sum(x * y, axis=1), before * after, rtol=1e-6)  # along rays
    bent = laplacian_matrix(spectral.from_mesh(mesh)) @ (after - before)
    assert np.sqrt(weights @ bent**2) == pytest.approx(STRENGTH * (weights @ before), rel=1e-2)


def test_pose_scale_and_order_do_not_matter(method, marked):
    before = method.read(marked, bytes(32), None)
    moved = jm.attack(jm.attack(marked, "similarity", 1, seed=1), "reordering", 1, seed=1)
    after = method.read(moved, bytes(32), None)
    assert np.array_equal(after.message, before.message)
    assert after.score == pytest.approx(before.score, rel=1e-2)


def test_missing_weights_are_named(tmp_path: Path, mesh):
    shutil.copytree(ROOT / "benchmarks" / "common", tmp_path / "common")
    (tmp_path / "robustness").mkdir()
    alone = load_method(shutil.copy(PROGRAM, tmp_path / "robustness"), 16)
    with pytest.raises(JaxmarkError, match=r"learned_mark\.eqx is missing: make it by"):
        alone.read(mesh, bytes(32), None)
