import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmark.distortion.norms import percentile

pytestmark = pytest.mark.core


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.99, 1.0])
@pytest.mark.parametrize("kind", ["spread", "ties", "tiny", "one"])
def test_it_is_the_value_that_sorting_finds(kind, share, dtype):
    random = np.random.default_rng(0)
    values = {
        "spread": np.exp(random.normal(0, 9, 4001)),
        "ties": random.integers(0, 4, 400) / 3,
        "tiny": random.uniform(0, 1e-44, 50),
        "one": np.array([2.5]),
    }[kind].astype(dtype)
    weights = random.integers(0, 5, len(values)).astype(dtype) + (dtype.type(1) if kind == "one" else dtype.type(0))
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    expected = values[order][np.argmax(below >= dtype.type(share) * below[-1])]
    found, gradient = jax.value_and_grad(percentile)(jnp.asarray(values), jnp.asarray(weights), share)
    assert found == (min(values) if share == 0 else expected)
    assert gradient.sum() == 1
    assert values[np.argmax(gradient)] == found
