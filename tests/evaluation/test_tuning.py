"""Strengths against closed forms, SciPy's HiGHS and SLSQP, a cone solver, and marks that were made and attacked."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import jaxmark as jm
from jaxmark.alignment.observation import observe
from jaxmark.alignment.original import make_original
from jaxmark.evaluation.allocation import allocate, upper_bound
from jaxmark.evaluation.channels import Channels, margins, measure, rate
from jaxmark.evaluation.tuning import tune
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import filter
from jaxmark.watermark.reading.reception import make_host, make_receiver
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import rough_sphere


def random_channels(attacks: int, bands: int, seed: int = 0) -> tuple[Channels, np.ndarray]:
    random = np.random.default_rng(seed)
    gain = random.uniform(0.1, 1, (attacks, bands))
    noise = random.uniform(0.5, 2, (attacks, bands))
    dimensions = random.uniform(1, 20, (attacks, bands))
    return Channels(*map(jnp.asarray, (gain, noise, dimensions))), random.uniform(0.5, 2, bands)


def test_margins_by_their_formulas(x64):
    channels, _ = random_channels(3, 5)
    power = np.random.default_rng(1).uniform(0, 4, 5)
    gain, noise, n = map(np.asarray, channels)
    snr = gain**2 * power / noise
    for margin, worth in (("rate", np.log2(1 + snr)), ("evidence", snr / (1 + snr)), ("snr", snr)):
        np.testing.assert_allclose(margins(channels, jnp.asarray(power), margin), (n / 2 * worth).sum(axis=1))
    np.testing.assert_allclose(rate(channels, jnp.sqrt(power)), margins(channels, jnp.asarray(power)))


def test_one_attack_is_water_filling(x64):
    """The closed form: n_j/(2 ln 2)/(level + q) with one water level, by root finding."""
    channels, cost = random_channels(1, 12)
    floor = np.asarray(channels.noise[0] / channels.gain[0] ** 2) * cost  # in units of the budget spent
    n = np.asarray(channels.dimensions[0])

    def spent(level: float) -> np.ndarray:
        return np.maximum(n * level - floor, 0)

    budget = 3.0
    level = optimize.brentq(lambda mu: spent(mu).sum() - budget**2, 0, 1e3)
    beta = allocate(channels, jnp.asarray(cost), budget, steps=5000)
    np.testing.assert_allclose(cost * np.asarray(beta) ** 2, spent(level), atol=1e-3 * budget**2)


@pytest.mark.parametrize("cap", [1.0, 0.2])
def test_the_linear_programme_of_weak_marks(cap, x64):
    """By HiGHS, which knows nothing of softness: within 1 %, and below the bound."""
    channels, cost = random_channels(4, 16, seed=3)
    slope = np.asarray(channels.dimensions / 2 * channels.gain**2 / channels.noise) / cost
    # max t with slope s ≥ t, Σ s = 1, s ≤ cap
    found = optimize.linprog(
        np.append(np.zeros(16), -1),
        A_ub=np.hstack([-slope, np.ones((4, 1))]),
        b_ub=np.zeros(4),
        A_eq=np.append(np.ones(16), 0)[None],
        b_eq=[1],
        bounds=[(0, cap)] * 16 + [(None, None)],
        method="highs",
    )
    beta = allocate(channels, jnp.asarray(cost), margin="snr", cap=cap, sharpness=1000.0, steps=5000)
    worst = float(margins(channels, beta**2, "snr").min())
    assert (cost * np.asarray(beta) ** 2).max() <= cap * (1 + 1e-9)
    assert worst == pytest.approx(-found.fun, rel=0.01)
    assert -found.fun * (1 - 1e-9) <= upper_bound(channels, cost, cap=cap, margin="snr") <= -found.fun * 1.01


@pytest.mark.parametrize("margin", ["rate", "evidence"])
@pytest.mark.parametrize("cap", [1.0, 0.1])
def test_the_concave_programme_by_a_cone_solver(margin, cap, x64):
    cvxpy = pytest.importorskip("cvxpy")
    channels, cost = random_channels(6, 24, seed=4)
    channels = channels._replace(noise=channels.noise * 1e-2)
    slope, n = np.asarray(channels.gain**2 / channels.noise) / cost, np.asarray(channels.dimensions)
    shares, worst = cvxpy.Variable(24, nonneg=True), cvxpy.Variable()
    snr = [cvxpy.multiply(row, shares) for row in slope]
    worth = [cvxpy.log1p(one) / np.log(2) if margin == "rate" else 1 - cvxpy.inv_pos(1 + one) for one in snr]
    attacked = [cvxpy.sum(cvxpy.multiply(row / 2, one)) for row, one in zip(n, worth, strict=True)]
    problem = cvxpy.Problem(
        cvxpy.Maximize(worst), [*(one >= worst for one in attacked), cvxpy.sum(shares) <= 1, shares <= cap]
    )
    problem.solve(solver=cvxpy.CLARABEL)
    beta = allocate(channels, jnp.asarray(cost), margin=margin, cap=cap, sharpness=1000.0, steps=5000)
    assert float(np.sum(cost * np.asarray(beta) ** 2)) == pytest.approx(1, rel=1e-9)
    assert float(margins(channels, beta**2, margin).min()) == pytest.approx(problem.value, rel=0.01)
    bound = upper_bound(channels, cost, cap=cap, margin=margin)
    assert problem.value * (1 - 1e-6) <= bound <= problem.value * 1.01


@pytest.mark.parametrize("seed", range(12))
def test_channels_of_all_sizes(seed):
    """The budget is spent, never worse than equally, never above the bound, however far the channels lie apart."""
    random = np.random.default_rng(seed)
    gain, noise = random.uniform(0, 1, (4, 12)) ** 3, 10 ** random.uniform(-4, 0, (4, 12))
    channels = Channels(*(jnp.asarray(a, jnp.float32) for a in (gain, noise, random.integers(1, 200, (4, 12)))))
    cost = jnp.asarray(10 ** random.uniform(-2, 0, 12), jnp.float32)
    beta = allocate(channels, cost, 0.1)
    assert beta.dtype == jnp.float32
    assert float(jnp.sum(cost * beta**2)) == pytest.approx(0.01, rel=1e-4)
    worst = float(rate(channels, beta).min())
    assert worst > float(rate(channels, 0.1 / jnp.sqrt(12 * cost)).min())
    assert worst <= upper_bound(channels, cost / 0.01) * (1 + 1e-5)


def test_channels_of_very_different_noise_keep_the_cap(x64):
    channels, cost = random_channels(4, 8, seed=1)
    channels = channels._replace(noise=channels.noise * 10.0 ** -np.arange(8))
    share = cost * np.asarray(allocate(channels, jnp.asarray(cost), 2.0, cap=0.3, steps=5000)) ** 2 / 4
    assert share.sum() == pytest.approx(1, rel=1e-9)
    assert share.max() <= 0.3 * (1 + 1e-9)


@pytest.mark.slow
def test_differentiable_with_respect_to_budget_and_strength(x64):
    """Implicitly, through the solution: what finite differences say, of one strength and of a margin."""
    channels, cost = random_channels(3, 6, seed=2)

    def tuned(budget, noise):
        harder = channels._replace(noise=channels.noise * jnp.array([1.0, 1, noise])[:, None] ** 2)
        beta = allocate(harder, jnp.asarray(cost), budget, sharpness=20.0, steps=20000)
        return jnp.stack([rate(harder, beta).mean(), jnp.arange(6.0) @ beta**2, beta.max()])

    with jax.numpy_dtype_promotion("standard"):  # jaxopt's own derivative mixes integers into floats
        slopes = jax.jacrev(tuned, argnums=(0, 1))(2.0, 1.5)
    step = 1e-3
    for slope, ahead, behind in (
        (slopes[0], tuned(2.0 + step, 1.5), tuned(2.0 - step, 1.5)),
        (slopes[1], tuned(2.0, 1.5 + step), tuned(2.0, 1.5 - step)),
    ):
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=0.02, atol=2e-3)
    assert abs(float(slopes[1][1])) > 1e-3


@pytest.mark.slow
def test_jaxopt_is_imported_late_and_without_its_warning():
    code = (
        "import warnings; warnings.simplefilter('error'); import sys, jaxmark, jax.numpy as jnp;"
        "from jaxmark.evaluation.allocation import Channels, allocate; assert 'jaxopt' not in sys.modules;"
        "one = jnp.ones((1, 3)); print(allocate(Channels(one, one, one), jnp.ones(3), 1.0))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(np.fromstring(done.stdout.strip("[]\n"), sep=" "), 3**-0.5, rtol=1e-5)


def test_a_channel_is_what_was_done_to_the_bands():
    """A mark weakened by a known filter, in noise of known strength."""
    original, family = make_original(rough_sphere(2000)), scaling(16, damping="jackson")
    host = make_host(
        *(original.operator, original.signal, original.to_traced(original.positions), family),
        scales=2,
        degree=2,
    )
    receiver = make_receiver(host)
    random = np.random.default_rng(0)
    signs = original.to_traced(random.choice([-1.0, 1.0], (2000, 3)))
    response = np.linspace(1, 0.2, 16)
    noise = original.to_traced(random.normal(size=(2000, 3)))
    residual = 1e-3 * filter(original.operator, family.T @ response, signs) + 3e-4 * noise
    found = measure(receiver, observe(residual, original.to_traced(original.used)), 1e-3 * signs)
    counted = np.asarray(found.dimensions[0])
    assert counted.sum() == pytest.approx(3 * (2000 - receiver.nuisance.shape[1]), rel=0.02)
    # The response of a band is its own, averaged with its neighbours'.
    some = (counted > 100) & (np.arange(16) > 0)
    assert some.sum() > 6
    np.testing.assert_allclose(np.asarray(found.gain[0])[some], response[some], atol=0.1)
    np.testing.assert_allclose(np.sqrt(found.noise[0])[some], 3e-4, rtol=0.25)


ATTACKS = [("noise", 0.004), ("smoothing", 10), ("quantisation", 8)]


@pytest.fixture(scope="module")
def tuned():
    mesh = rough_sphere(2500)
    return mesh, tune(mesh, ATTACKS, {"dame": 0.02}, seed=jax.random.key(0), margin="evidence", bits=16)


@pytest.mark.long
def test_what_was_predicted_is_measured(tuned, key: jm.Key):
    """Marks of the tuned profile, attacked anew, have the evidence that the channels say."""
    mesh, found = tuned
    marker = jm.make_marker(mesh, key, bits=16, scheme=found.scheme)
    marked, info = marker.embed(b"ok", jm.Budget(limits={"dame": 0.02}, noise=0))
    assert 0.98 * 0.02 <= (jm.compare(mesh, marked, ["dame"]).dame or 0) <= 0.02
    assert info.beta * max(found.scheme.profile) == pytest.approx(found.beta.max(), rel=0.05)
    word = jnp.asarray(marker.codeword(b"ok"), jnp.float32)
    predicted = margins(found.channels, jnp.asarray(found.beta**2, jnp.float32), "evidence")
    for one, expected in zip(ATTACKS, predicted, strict=True):
        score, norm = marker.reader.claim(marker.receive(marker.register(jm.attack(marked, *one, seed=11))), word)
        # What smoothing leaves of the host is no white noise within a band.
        least = 0.6 if one[0] == "smoothing" else 0.8
        assert least < float(score**2 / (2 * norm**2)) / float(expected) < 1.25
        assert marker.detect(jm.attack(marked, *one, seed=12)).message == b"ok"


@pytest.mark.long
def test_tuning_beats_equal_strengths_and_says_how_far_it_is_from_the_best(tuned):
    _, found = tuned
    assert len(found.report.margins) == len(ATTACKS)
    assert found.report.bound >= found.report.margins.min() > 0
    assert found.report.gap < 0.02
    flat = found.cost[0].sum() ** -0.5 * np.ones(64)
    assert found.report.margins.min() > 1.5 * float(margins(found.channels, jnp.asarray(flat**2), "evidence").min())
    assert found.detector_weights.shape == (len(ATTACKS), 64)


@pytest.mark.long
def test_several_limits_at_once(tuned):
    mesh = tuned[0]
    limits = {"dame": 0.02, "gl": 1e-4}
    found = tune(mesh, ATTACKS[:2], jm.Budget(rms=5e-4, limits=limits), seed=jax.random.key(0), bits=16)
    assert list(found.report.binding) == ["dame", "gl", "budget"]
    assert sum(found.report.binding.values()) == pytest.approx(1)
    assert (found.cost @ found.beta**2 < 1.6).all()
    assert 0 <= found.report.gap < 0.05
    marked, info = jm.embed(
        mesh, b"ok", jm.new_key(), budget=jm.Budget(rms=5e-4, limits=limits, noise=0), scheme=found.scheme
    )
    compared = jm.compare(mesh, marked, limits)._asdict()
    used = [*(compared[name] / limit for name, limit in limits.items()), info.rms / 5e-4]
    assert 0.98 <= max(used) <= 1 + 1e-6


@pytest.mark.long
def test_any_function_is_an_attack_and_a_start_is_warm(tuned):
    mesh, before = tuned

    def shrink(mesh, seed):
        return mesh._replace(vertices=0.5 * np.asarray(mesh.vertices))

    named = (jm.adversaries.ATTACKS["smoothing"], 5)
    found = tune(mesh, [shrink, named], 5e-4, seed=jax.random.key(0), bits=16, start=before.beta)
    assert 0 <= found.report.gap < 0.02
    assert found.report.trials[0] > found.report.trials[1]  # a change of size takes nothing of a mark


def test_refusals(x64, unchecked):
    channels, cost = random_channels(2, 4)
    with pytest.raises(jm.JaxmarkError, match="positive budget"):
        allocate(channels, jnp.asarray(cost), 0.0)
    with pytest.raises(jm.JaxmarkError, match="needs gain"):
        allocate(channels, jnp.ones(3), 1.0)
    with pytest.raises(jm.JaxmarkError, match="raise the cap"):
        allocate(channels, jnp.asarray(cost), cap=0.2)
    with pytest.raises(jm.JaxmarkError, match="at least one attack"):
        tune(rough_sphere(300), [], seed=jax.random.key(0))
    for wrong in (0.5, jm.new_key()):
        with pytest.raises(jm.JaxmarkError, match="A seed must be a whole number, such as 0, or a random key of JAX"):
            tune(rough_sphere(300), ATTACKS, seed=wrong)  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match=r"pair such as \('noise', 0.005\), got 'noise'"):
        tune(rough_sphere(300), ["noise"], seed=jax.random.key(0))  # type: ignore[list-item]
    with pytest.raises(jm.JaxmarkError, match="one of rate, evidence, snr, got 'x'"):
        tune(rough_sphere(300), ATTACKS, seed=jax.random.key(0), margin="x")  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="use tune_blind"):
        tune(rough_sphere(300), ATTACKS, seed=jax.random.key(0), scheme="field")
    with pytest.raises(jm.JaxmarkError, match="name of ATTACKS or an Attack"):
        jm.attack(rough_sphere(300), lambda mesh: mesh, 0.1, seed=0)  # type: ignore[arg-type]
    with pytest.raises(jm.JaxmarkError, match="not along normals"):
        tune(rough_sphere(300), ATTACKS, seed=jax.random.key(0), scheme=KeyedScheme(direction="normals"))
    with pytest.raises(jm.JaxmarkError, match="profile is up to 64 finite"):
        KeyedScheme(profile=(1.0,) * 65)
