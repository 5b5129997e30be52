import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import jaxmark as jm
from jaxmark.tuning import Channels, rate, tune


def random_channels(attacks: int, bands: int, seed: int = 0) -> tuple[Channels, np.ndarray]:
    random = np.random.default_rng(seed)
    gain = random.uniform(0.1, 1, (attacks, bands))
    noise = random.uniform(0.5, 2, (attacks, bands))
    return Channels(*map(jnp.asarray, (gain, noise, random.uniform(1, 20, bands)))), random.uniform(0.5, 2, bands)


def test_one_attack_is_water_filling(x64):
    """The closed form: n_j/(2 ln 2)/(level + q) with one water level, by root finding."""
    channels, cost = random_channels(1, 12)
    floor = np.asarray(channels.noise[0] / channels.gain[0] ** 2) * cost  # in units of the budget spent
    n = np.asarray(channels.dimensions)

    def spent(level: float) -> np.ndarray:
        return np.maximum(n * level - floor, 0)

    budget = 3.0
    level = optimize.brentq(lambda mu: spent(mu).sum() - budget**2, 0, 1e3)
    beta = tune(channels, jnp.asarray(cost), budget, steps=5000)
    np.testing.assert_allclose(cost * np.asarray(beta) ** 2, spent(level), atol=1e-3 * budget**2)


def test_several_attacks_against_another_solver(x64):
    channels, cost = random_channels(4, 8, seed=1)
    beta = tune(channels, jnp.asarray(cost), 2.0, steps=5000)
    assert float(np.sum(cost * np.asarray(beta) ** 2)) == pytest.approx(4.0, rel=1e-9)

    def bits(q: np.ndarray) -> np.ndarray:
        snr = np.asarray(channels.gain) ** 2 * q / np.asarray(channels.noise)
        return (np.asarray(channels.dimensions) / 2 * np.log2(1 + snr)).sum(axis=1)

    start = np.append(np.full(8, 0.5) / cost, 0.0)
    best = optimize.minimize(
        lambda z: -z[-1],
        start,
        method="SLSQP",
        bounds=[(0, None)] * 8 + [(None, None)],
        constraints=[
            {"type": "ineq", "fun": lambda z: bits(z[:-1]) - z[-1]},
            {"type": "ineq", "fun": lambda z: 4.0 - cost @ z[:-1]},
        ],
        options={"maxiter": 500},
    )
    assert float(rate(channels, beta).min()) == pytest.approx(best.x[-1], rel=0.02)
    assert float(rate(channels, beta).min()) > 1.01 * bits(4.0 / 8 / cost).min()


@pytest.mark.parametrize("seed", range(12))
def test_channels_of_all_sizes(seed):
    """The budget is spent, and never worse than equally, however far the channels lie apart; in float32."""
    random = np.random.default_rng(seed)
    gain, noise = random.uniform(0, 1, (4, 12)) ** 3, 10 ** random.uniform(-4, 0, (4, 12))
    channels = Channels(*(jnp.asarray(a, jnp.float32) for a in (gain, noise, random.integers(1, 200, 12))))
    cost = jnp.asarray(10 ** random.uniform(-2, 0, 12), jnp.float32)
    beta = tune(channels, cost, 0.1)
    assert float(jnp.sum(cost * beta**2)) == pytest.approx(0.01, rel=1e-4)
    assert float(rate(channels, beta).min()) > float(rate(channels, 0.1 / jnp.sqrt(12 * cost)).min())


def test_differentiable_with_respect_to_the_budget(x64):
    """Implicitly, through the solution: at the optimum, more budget buys the rate that finite differences say."""
    channels, cost = random_channels(3, 6, seed=2)

    def worst(budget):
        return rate(channels, tune(channels, jnp.asarray(cost), budget, sharpness=20.0, steps=20000)).mean()

    with jax.numpy_dtype_promotion("standard"):  # jaxopt's own derivative mixes integers into floats
        slope = jax.grad(worst)(2.0)
    assert float(slope) == pytest.approx(float(worst(2.01) - worst(1.99)) / 0.02, rel=0.02)


def test_jaxopt_is_imported_late_and_without_its_warning():
    code = (
        "import warnings; warnings.simplefilter('error'); import sys, jaxmark, jax.numpy as jnp;"
        "from jaxmark.tuning import Channels, tune; assert 'jaxopt' not in sys.modules;"
        "one = jnp.ones((1, 3)); print(tune(Channels(one, one, jnp.ones(3)), jnp.ones(3), 1.0))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(np.fromstring(done.stdout.strip("[]\n"), sep=" "), 3**-0.5, rtol=1e-5)


def test_refusals(x64, unchecked):
    channels, cost = random_channels(2, 4)
    with pytest.raises(jm.JaxmarkError, match="positive budget"):
        tune(channels, jnp.asarray(cost), 0.0)
    with pytest.raises(jm.JaxmarkError, match="needs gain"):
        tune(channels, jnp.ones(3), 1.0)
