"""Operators on a device: no call after the first sends anything there, and a batch is made there, too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark import spectral
from jaxmark.spectral import chebyshev, recurrence
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core


@pytest.fixture(scope="module", params=[{}, {"weights": "cotangent", "mass": "areas"}], ids=["valence", "areas"])
def operator(request) -> spectral.Laplacian:
    return jax.device_put(spectral.from_mesh(bumpy_sphere(2), **request.param))


def test_an_operator_on_a_device_stays_there(operator: spectral.Laplacian):
    """Calls with an operator of NumPy arrays send it each time, which JAX's guard refuses."""
    put = jax.device_put
    x, bank = put(np.asarray(bumpy_sphere(2).vertices, np.float32)), put(spectral.bands.scaling(8).astype(np.float32))
    layer, time, frozen = spectral.init_cheb_conv(0, 3, 3, 4), put(np.float32(2)), spectral.freeze(operator)
    batch, pair = put(spectral.stack([operator, operator])), jnp.stack([x, x])
    first, parts = bank[0], spectral.band_components(operator, bank, x)
    slope = jax.jit(jax.grad(lambda operator, c: jnp.sum(spectral.filter(operator, c, x) ** 2), 1))
    calls = {
        "apply": lambda: operator.apply(x),
        "inner": lambda: operator.inner(x, x),
        "filter": lambda: spectral.filter(operator, first, x),
        "transpose": lambda: spectral.transpose(operator, first, x),
        "band_components": lambda: spectral.band_components(operator, bank, x),
        "synthesise": lambda: spectral.synthesise(operator, bank, parts),
        "heat": lambda: spectral.heat(operator, x, time, degree=8),
        "gram": lambda: spectral.gram(operator, bank, x),
        "cheb_conv": lambda: spectral.cheb_conv(operator, layer, x),
        "gradient": lambda: slope(operator, first),
        "batch": lambda: jax.vmap(spectral.filter, (0, None, 0))(batch, first, pair),
        "frozen": lambda: spectral.filter(frozen.operator, first, x),
    }
    for name, call in calls.items():
        call()
        with jax.transfer_guard("disallow"):
            found = call()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found)), name
    on_host = jax.tree.map(np.asarray, operator)
    with jax.transfer_guard("disallow"), pytest.raises(Exception, match="Disallowed host-to-device transfer"):
        spectral.filter(on_host, first, x)


def test_a_fourth_column_changes_nothing(operator: spectral.Laplacian, monkeypatch):
    """It is added on GPUs for the alignment of rows; here it is said to be one."""
    x, c = jnp.asarray(bumpy_sphere(2).vertices, jnp.float32), jnp.asarray(np.random.default_rng(0).normal(size=(3, 9)))

    def value_and_slopes(c, x):
        return jax.value_and_grad(lambda c, x: jnp.sum(jnp.sin(spectral.filter(operator, c, x))), (0, 1))(c, x)

    expected = value_and_slopes(c, x)
    jax.clear_caches()
    monkeypatch.setattr(chebyshev, "_MIN_ALIGNED", 1)
    monkeypatch.setattr(recurrence, "_UNROLLED_ON_GPU", 1)  # a processor's compiler would take gigabytes for more
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "f32[162,4]" in str(jax.make_jaxpr(spectral.filter)(operator, c, x))
    for found, one in zip(jax.tree.leaves(value_and_slopes(c, x)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(found, one, rtol=1e-5, atol=1e-5)
    jax.clear_caches()
