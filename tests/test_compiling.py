"""Eager calls of numerical functions compile once: no more for other arguments, or fresh operators, of equal shape."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark import spectral
from jaxmark.alignment.original import make_original
from jaxmark.evaluation.allocation import allocate
from jaxmark.evaluation.channels import Channels
from jaxmark.spectral.chebyshev import band_energies, over_bands
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import rough_sphere

pytestmark = pytest.mark.core

BANDS = np.asarray(spectral.bands.scaling(8, damping="jackson"), np.float32)
SECTIONS = np.array([[1, 0, 0, 1, 0.5, 0.0]])


def square(x: jax.Array) -> jax.Array:
    return jnp.sum(x**2)


def factors() -> spectral.Factors:
    first = spectral.lagrange_factors(np.array([0.1, 0.5, 1.1, 1.7]))
    return spectral.Factors(*(part[0] for part in first))


def carrier(seed: int) -> Any:
    original = make_original(rough_sphere(67))
    return KeyedScheme().carrier(original, Choices(jm.Key(bytes([seed] * 32)), b""), 8, 64)


def dimensions(seed: int) -> Any:
    """Of pass bands of different widths."""
    one, bands = carrier(seed), np.concatenate([BANDS] * (1 + seed))
    strengths, moving = np.ones(len(bands), np.float32), np.ones(len(one.host.signal), np.float32)
    return one.with_bands(*map(jax.device_put, (strengths, bands))).reader().free_dimensions(jax.device_put(moving))


def layer(seed: int) -> dict[str, jax.Array]:
    return spectral.init_cheb_conv(seed, 3, 2, 4)


def miss(parameters: dict[str, jax.Array], operator: Any, x: jax.Array) -> jax.Array:
    return jnp.sum(spectral.cheb_conv(operator, parameters, x, form="symmetric") ** 2)


CALLS: dict[str, Callable[[Any, Any, int], Any]] = {
    "apply": lambda operator, x, seed: operator.apply(x),
    "inner": lambda operator, x, seed: operator.inner(x, x),
    "filter": lambda operator, x, seed: spectral.filter(operator, BANDS[0], x),
    "transpose": lambda operator, x, seed: spectral.transpose(operator, BANDS[0], x),
    "band_components": lambda operator, x, seed: spectral.band_components(operator, BANDS, x),
    "over_bands": lambda operator, x, seed: over_bands(square, operator, BANDS, x),
    "band_energies": lambda operator, x, seed: band_energies(operator, jnp.asarray(BANDS), x, x),
    "heat": lambda operator, x, seed: spectral.heat(operator, x, 5.0),
    "synthesise": lambda operator, x, seed: spectral.synthesise(operator, BANDS, jnp.stack([x] * 8)),
    "inverse": lambda operator, x, seed: spectral.inverse(operator, BANDS, jnp.stack([x] * 8)),
    "moments": lambda operator, x, seed: spectral.moments(operator, x, degree=5),
    "cross_moments": lambda operator, x, seed: spectral.cross_moments(operator, x, x, degree=5),
    "gram": lambda operator, x, seed: spectral.gram(operator, BANDS, x),
    "trace": lambda operator, x, seed: spectral.trace(operator, jnp.exp, x, steps=5),
    "lowest_eigenpairs": lambda operator, x, seed: spectral.lowest_eigenpairs(operator, 5, seed).values,
    "filter_rational": lambda operator, x, seed: spectral.filter_rational(operator, SECTIONS, x),
    "filter_by_factors": lambda operator, x, seed: spectral.filter_by_factors(operator, factors(), x),
    "cheb_conv": lambda operator, x, seed: spectral.cheb_conv(operator, layer(seed), x),
    "cheb_conv, gradient": lambda operator, x, seed: jax.grad(miss)(layer(seed), operator, x),
    "allocate": lambda _, x, seed: allocate(Channels(*(jnp.full((2, 8), 1.0 + seed),) * 3), jnp.ones(8)),
    "carrier": lambda _, x, seed: carrier(seed).displacement(jnp.ones(64)),
    "free dimensions": lambda _, x, seed: dimensions(seed),
    "carrier gram": lambda _, x, seed: carrier(seed).gram(),
}


@pytest.mark.parametrize("name", CALLS)
def test_the_second_call_compiles_nothing(name: str, caplog: pytest.LogCaptureFixture):
    compiled = []
    for seed in (0, 1):
        mesh = rough_sphere(67, seed)
        operator = spectral.from_mesh(mesh, "inverse-length", lowering="segments")
        x = jnp.asarray(mesh.vertices, jnp.float32)
        caplog.clear()
        with jax.log_compiles(True):
            jax.block_until_ready(CALLS[name](operator, x, seed))
        compiled.append([record.message for record in caplog.records if "ompil" in record.message])
    first, second = compiled
    assert first
    assert second == []


def test_few_programs_are_compiled(key: jm.Key, caplog: pytest.LogCaptureFixture):
    """The numbers of programs of first calls; unlike seconds, they are the same in each run."""
    mesh = rough_sphere(500)

    def compiled(call: Callable[[], Any]) -> tuple[Any, list[str]]:
        caplog.clear()
        jax.config.update("jax_log_compiles", True)  # of all threads
        try:
            found = call()
        finally:
            jax.config.update("jax_log_compiles", False)
        messages = [record.message.split() for record in caplog.records]
        return found, [words[4] for words in messages if words[:3] == ["Finished", "XLA", "compilation"]]

    jax.clear_caches()
    (marked, info), embedding = compiled(lambda: jm.embed(mesh, b"8 bytes!", key))
    assert 0 < len(embedding) <= 15, embedding
    found, detecting = compiled(lambda: jm.detect(marked, original=mesh, key=key, record=info.record))
    assert found.detected()
    assert 0 < len(detecting) <= 5, detecting
    suspect = jm.attack(marked, "simplification", 0.3, seed=0)
    found, remeshed = compiled(lambda: jm.detect(suspect, original=mesh, key=key, record=info.record))
    assert found.detected()
    assert 0 < len(remeshed) <= 6, remeshed  # one of them joins what simplification smoothed to the other nuisance
