"""Marks as arrays: the same marks and evidence as by meshes, and many keys at once as one by one."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.markers import NonBlindMarker
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module", params=["keyed", "eigen"])
def marker(request, key: jm.Key) -> NonBlindMarker:
    return jm.make_marker(bumpy_sphere(3), key, bits=16, scheme=request.param)


def test_arrays_embed_and_prove_what_meshes_do(marker: NonBlindMarker):
    arrays = marker.arrays(b"ok")
    marked, _ = marker.embed(b"ok", jm.Budget(rms=8e-4, noise=0), read_back="never")
    by_arrays = jax.jit(lambda arrays: arrays.embed(8e-4))(arrays)
    np.testing.assert_allclose(marker.to_mesh(by_arrays).vertices, marked.vertices, atol=2e-6)
    noise = 1e-3 * jax.random.normal(jax.random.key(0), arrays.x.shape)
    suspect = by_arrays + noise
    nats = jax.jit(lambda arrays, suspect: arrays.evidence(suspect))(arrays, suspect)
    said = marker.read(marker.register(marker.to_mesh(suspect), "same"), b"ok").evidence
    earlier = sum(charge.log10 for charge in said.charges if charge.choice in ("alignment", "message"))
    # Registration takes a part of the lowest frequencies away, which eigenvectors have most of.
    close = 0.1 if marker.scheme.name == "eigen" else 2e-3
    assert float(nats) == pytest.approx(math.log(10) * (earlier - said.log10_p_unfloored), rel=close)
    slope = jax.grad(lambda suspect: arrays.evidence(suspect))(suspect)
    assert jnp.isfinite(slope).all()
    with pytest.raises(jm.JaxmarkError, match="16 bits"):
        marker.arrays(b"longer")


def test_many_keys_at_once_are_each_of_them(marker: NonBlindMarker):
    """The own key among others, which have no evidence; what no key decides is not there once per key."""
    keys = [jm.Key(bytes([seed] * 32)) for seed in range(1, 6)] + [marker.key]
    batch = marker.arrays_of_keys(b"ok", keys)
    suspect = batch.map(lambda one: one.embed(8e-4))[-1]
    one_by_one = [
        NonBlindMarker.make(marker.original, key, marker.scheme, 16).arrays(b"ok").evidence(suspect) for key in keys
    ]

    @jax.jit
    def all_at_once(batch, suspect):
        received = batch.first().receive(suspect)
        return batch.map(lambda one: one.claim(received), chunk=4)

    found = all_at_once(batch, suspect)
    np.testing.assert_allclose(found, jnp.stack(one_by_one), rtol=1e-4, atol=1e-4)
    assert float(found[-1]) > 20
    assert float(found[:-1].max()) < 10
    rows = len(marker.original.signal)
    assert not any(leaf.ndim > 1 and leaf.shape[1:3] == (rows, 4) for leaf in batch.keyed)
    assert sum(leaf.size for leaf in batch.keyed) < 10 * len(keys) * 3 * rows
    with pytest.raises(jm.JaxmarkError, match="at least one key"):
        marker.arrays_of_keys(b"ok", [])


def test_the_own_key_alone_is_a_batch(marker: NonBlindMarker):
    suspect, own = marker.original.signal, marker.arrays(b"ok")
    for count in (1, 3):
        found = marker.arrays_of_keys(b"ok", [marker.key] * count).map(lambda one: one.evidence(suspect))
        np.testing.assert_allclose(found, [own.evidence(suspect)] * count)


def test_one_key_and_many_suspects(marker: NonBlindMarker):
    arrays = marker.arrays(b"ok")
    noise = jax.random.normal(jax.random.key(0), (3, *arrays.x.shape))
    suspects = arrays.embed(8e-4) + jnp.array([0, 1e-3, 1e-2])[:, None, None] * noise
    together = jax.jit(lambda arrays, x: jax.lax.map(arrays.evidence, x, batch_size=2))(arrays, suspects)
    alone = jnp.stack([arrays.evidence(suspect) for suspect in suspects])
    np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-2)
    assert (np.diff(together) < 0).all()


def test_meshes_of_arrays_are_in_the_units_of_the_file(marker: NonBlindMarker, key: jm.Key):
    large = Mesh(1e3 * np.asarray(bumpy_sphere(2).vertices) + 5e3, bumpy_sphere(2).faces)
    other = NonBlindMarker.make(make_original(large), key, marker.scheme, 16)
    np.testing.assert_allclose(other.to_mesh(other.arrays(b"ok").x).vertices, large.vertices, rtol=1e-12)


def test_an_original_and_broken_numbers_prove_nothing(sphere: Mesh, key: jm.Key):
    arrays = jm.make_marker(sphere, key, bits=16).arrays(b"ok")
    for suspect in (arrays.x, jnp.nan * arrays.x, arrays.x.at[0, 0].set(jnp.inf)):
        assert arrays.evidence(suspect) <= 0
    assert jnp.isfinite(jax.grad(arrays.evidence)(arrays.x)).all()
