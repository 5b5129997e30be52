"""Attackers with the key: against finite differences, and against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries.key_holder import _slope, erasure, erasure_by_descent
from jaxmark.geometry.mesh import Mesh
from tests.samples import bumpy_sphere

MESSAGE = b"ok"


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(3), key, bits=16)
    return marker, marker.embed(MESSAGE, jm.Budget(rms=2e-3, noise=0))[0]


def evidence(marker: jm.watermark.NonBlindMarker, suspect: Mesh) -> float:
    """S/‖a‖ of a claim of the message."""
    code = marker.codeword(MESSAGE)
    seen = marker.observe(marker.register(suspect))
    score, norm = marker.carrier.claim(seen, jnp.asarray(code, seen.residual.dtype))
    return float(score / norm)


@pytest.mark.slow
def test_the_size_is_met_and_evidence_falls(marked):
    marker, mesh = marked
    before = evidence(marker, mesh)
    for size in (1e-4, 5e-4):
        once, many = (
            jm.attack(mesh, kind, size, seed=0)
            for kind in (erasure(marker, MESSAGE), erasure_by_descent(marker, MESSAGE, steps=6))
        )
        random = jm.attack(mesh, "jamming", size, seed=0)
        for suspect in (once, many):
            assert jm.distortion.displacement_size(mesh, suspect).rms == pytest.approx(size, rel=5e-3)
        # What knows the key does more than what looks like a mark, and what knows the receiver does most.
        assert evidence(marker, many) < evidence(marker, once) < min(evidence(marker, random), before)
    np.testing.assert_array_equal(jm.attack(mesh, erasure(marker, MESSAGE), 0, seed=0).vertices, mesh.vertices)


@pytest.mark.slow
def test_slopes_agree_with_finite_differences(key: jm.Key, x64):
    marker = jm.make_marker(bumpy_sphere(2), key, bits=8)
    mesh = marker.embed(b"k", jm.Budget(rms=5e-3, noise=0), read_back="never")[0]
    seen = marker.observe(marker.register(jm.attack(mesh, "noise", 1e-3, seed=0)))
    code = jnp.asarray(marker.codeword(b"k"))
    value, slope = _slope(marker.reader, seen, code)
    way = jnp.asarray(np.random.default_rng(0).normal(size=seen.residual.shape) * marker.original.moving[:, None])
    step = 1e-7

    def along(length: float) -> jax.Array:
        return _slope(marker.reader, seen._replace(residual=seen.residual + length * way), code)[0]

    found, wanted = jnp.sum(slope * way), (along(step) - along(-step)) / (2 * step)
    assert float(value) > 0
    assert float(found) == pytest.approx(float(wanted), rel=1e-5)


def test_copies_of_a_point_move_together(key: jm.Key):
    points = bumpy_sphere(2)
    copied = Mesh(
        np.asarray(points.vertices)[np.asarray(points.faces).ravel()], np.arange(points.faces.size).reshape(-1, 3)
    )
    marker = jm.make_marker(copied, key, bits=8)
    mesh = marker.embed(b"k", jm.Budget(rms=5e-3, noise=0), read_back="never")[0]
    suspect = jm.attack(mesh, erasure(marker, b"k"), 1e-3, seed=0)
    assert jm.distortion.displacement_size(mesh, suspect).rms == pytest.approx(1e-3, rel=5e-3)


def test_refusals(marked):
    marker, _ = marked
    with pytest.raises(jm.JaxmarkError, match="24 bits, but the payload is 16"):
        erasure(marker, b"too")
    with pytest.raises(jm.JaxmarkError, match="at least one step"):
        erasure_by_descent(marker, MESSAGE, steps=0)
