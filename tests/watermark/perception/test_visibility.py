"""Visibility per band and per vertex, and marks that are written by them."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.plot.meshes import roughness_masking
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import filter
from jaxmark.watermark.carriers import KeyedCarrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.perception.visibility import band_visibility
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.registry import make_scheme, parameters_of
from tests.samples import rough_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def half_rough() -> Mesh:
    """A smooth sphere with one rough half."""
    mesh = rough_sphere(2000)
    directions = np.asarray(mesh.vertices) / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    bumps = 0.02 * np.random.default_rng(0).normal(size=2000) * (directions[:, 0] > 0)
    return make_mesh(directions * (1 + bumps)[:, None], mesh.faces)


def test_the_eye_sees_high_frequencies_first(half_rough: Mesh):
    """RMS sees all alike; bending grows with the frequency, as GL, whose slope is the Laplacian's, does."""
    family = scaling(32, damping="jackson")
    original = make_original(half_rough)
    rms, dame, gl = band_visibility(original, family, ["rms", "dame", "gl"])
    np.testing.assert_allclose(rms, 1, rtol=1e-3)
    assert (np.diff(np.log(dame[2:20])) > -0.05).all()
    assert dame[20] > 10 * dame[2]
    # A displacement of frequency λ changes position by 1 and the geometric Laplacian by about λ, half of each.
    edges = 1 - np.cos(np.pi * np.array([4, 5]) / 32)
    assert 0.9 * (1 + edges[0]) / 2 < gl[4] < 1.2 * (1 + edges[1]) / 2


def test_rough_regions_mask_more(half_rough: Mesh):
    original = make_original(half_rough)
    masked = original.to_host(roughness_masking(original))[original.weld.point]
    assert np.sqrt(np.mean(masked**2)) == pytest.approx(1, rel=1e-5)
    x = np.asarray(half_rough.vertices)[:, 0]
    assert masked[x > 0.3].mean() > 1.2 * masked[x < -0.3].mean()


def test_masking_by_roughness_is_no_longer_read():
    fields = parameters_of(KeyedScheme())
    assert fields["masking"] is False
    assert make_scheme("keyed", fields) == KeyedScheme()
    with pytest.raises(jm.JaxmarkError, match="no longer read"):
        make_scheme("keyed", {**fields, "masking": True})


def test_a_profile_is_what_is_written(half_rough: Mesh, key: jm.Key, dtype):
    scheme = KeyedScheme(bands=32, profile=(0.0, 1.0, 0.5, 0.0, 0.25), hiding=False)
    original = make_original(half_rough)
    carrier = scheme.carrier(original, Choices(key, b""), 16, 88)
    assert isinstance(carrier, KeyedCarrier)
    assert len(carrier.host.coefficients) == 5
    bits = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], 88), dtype)
    chips = np.asarray(carrier.chips.signs) * np.asarray(bits)[np.asarray(carrier.chips.slots)]
    expected = filter(
        original.operator,
        (scaling(32, damping="jackson")[:5].T @ np.array(scheme.profile)).astype(dtype),
        jnp.asarray(chips, dtype),
    )
    np.testing.assert_allclose(carrier.displacement(bits), expected, atol=1e-5 if dtype == np.float32 else 1e-12)
    # And what is read: the adjoint.
    residual = jnp.asarray(np.random.default_rng(1).normal(size=original.signal.shape), dtype)
    mass = np.asarray(original.operator.degree)[:, None]
    assert float(jnp.sum(mass * carrier.displacement(bits) * residual)) == pytest.approx(
        float(bits @ carrier.adjoint(residual)), rel=1e-3
    )


@pytest.mark.slow
def test_profiles_pass_through_records(half_rough: Mesh, key: jm.Key, tmp_path):
    profile = (0.2, 0.7, 1.0, 1.0, 1.0, 0.5, 0.25, 0.125, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1)
    scheme = KeyedScheme(profile=profile)
    marked, info = jm.embed(half_rough, b"\x5a", key, budget=jm.Budget(noise=0), scheme=scheme)
    file = tmp_path / "record.json"
    file.write_text(info.record.to_json())
    record = jm.Record.load(file)
    assert make_scheme(record.scheme, record.parameters) == scheme
    assert jm.detect(marked, original=half_rough, key=key, record=record).message == b"\x5a"
    with pytest.raises(jm.JaxmarkError, match="takes the parameters"):
        make_scheme("keyed", parameters_of(scheme) | {"profile": ["1"]})
