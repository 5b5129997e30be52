# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A learned attack
#
# This notebook, for readers who assess security, trains an attack. A network of two Chebyshev convolutions learns to
# displace a marked mesh so that little evidence for the mark is left. The attacker has this library, but no key: each
# step draws a new key, so the network reduces the expected evidence S/‖a‖, a score over its norm.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]", "optax"], check=True)

# %%
import math

import jax
import jax.numpy as jnp
import optax

import jaxmark as jm
from jaxmark import adversaries, plot, spectral
from jaxmark.geometry import asteroid
from jaxmark.plot.figures import BOUND, COLOURS, Picture, finish, panels

mesh = asteroid(2800)  # small, so that this takes a minute
owner = jm.Key(bytes(range(32)))  # the same in each run; make real keys by `jm.new_key()`
marker = jm.make_marker(mesh, owner, bits=16)
marked, _ = marker.embed(b"ok", 8e-4)
surrogate, original = adversaries.make_surrogate(marked, "keyed", 16, 8e-4)
sizes, draws = ((4, 8), (8, 3)), jax.random.split(jax.random.key(0), 3)
layers = [spectral.init_cheb_conv(key, *size, degree=8) for key, size in zip(draws, sizes, strict=False)]


def displaced(layers, noise):
    inputs = jnp.concatenate([100 * surrogate.operator.apply(surrogate.signal), noise], axis=1)
    hidden = jnp.tanh(spectral.cheb_conv(surrogate.operator, layers[0], inputs))
    return adversaries.rescale(surrogate, spectral.cheb_conv(surrogate.operator, layers[1], hidden), 4 * 8e-4)


optimiser = optax.adam(0.02)


@jax.jit
def step(layers, state, key):
    noise, mark = jax.random.normal(key, surrogate.signal[:, :1].shape), jax.random.fold_in(key, 1)
    left, slope = jax.value_and_grad(lambda layers: adversaries.evidence(surrogate, displaced(layers, noise), mark))(
        layers
    )
    change, state = optimiser.update(slope, state)
    return optax.apply_updates(layers, change), state, left


history, state = [], optimiser.init(layers)
for key in jax.random.split(draws[2], 40):
    layers, state, left = step(layers, state, key)
    history.append(float(left))
print("expected evidence S/‖a‖, step by step:", *(f"{left:.1f}" for left in history[::8]), f"{history[-1]:.1f}")
assert sum(history[-5:]) < sum(history[:5])
figure, (axes,) = panels(1, 6.5, 3.6)
axes.plot(history, color=COLOURS[0], label="expected evidence")
axes.axhline(math.sqrt(2 * 6 * math.log(10)), label="one in a million", **BOUND)
finish(axes, xlabel="step", ylabel="S/‖a‖")
Picture(figure).save("10_1.png")

# %% [markdown]
# The owner claims the message after the learned attack, and after random noise of the same size in the bands that carry
# marks (`jamming`).

# %%
shift = original.to_host(displaced(layers, jax.random.normal(draws[0], surrogate.signal[:, :1].shape)))
attacked = marked._replace(vertices=marked.vertices + original.diagonal * shift[original.weld.point])
noisy = jm.attack(marked, "jamming", 4 * 8e-4, seed=1)
for name, suspect in {"learned": attacked, "jamming": noisy}.items():
    print(f"{name:<12} log10 p {marker.detect(suspect, b'ok').log10_p:6.1f}")
plot.draw(
    [
        plot.View("marked", marked),
        plot.displacement(original, attacked, "learned"),
        plot.displacement(original, noisy, "jamming"),
    ]
).save("10_2.png")
