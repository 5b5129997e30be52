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
# # Strengths trained against a learned attack
#
# This notebook, for researchers who train marks against attacks, lets a network and the strengths of the bands play
# against each other. `log_evidence` computes the evidence for a message in nats, as a pure function of the suspect and,
# through the carrier, of the strengths. Signs and codeword are computed once, and gradients treat them as constants. In
# each step the attacking network of two Chebyshev convolutions descends on the evidence, and the strengths ascend.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]", "optax"], check=True)

# %%
import jax
import jax.numpy as jnp
import optax

import jaxmark as jm
from jaxmark import spectral
from jaxmark.geometry import asteroid
from jaxmark.plot.figures import Picture, finish, panels
from jaxmark.watermark import log_evidence

mesh = asteroid(2800)  # small, so that this takes a minute
owner = jm.Key(bytes(range(32)))  # the same in each run; make real keys by `jm.new_key()`
marker, size = jm.make_marker(mesh, owner, bits=16), 8e-4
carrier, x = marker.reader.carrier, marker.original.signal
word, bands = jnp.asarray(marker.codeword(b"ok"), x.dtype), len(carrier.host.coefficients)
moving = jnp.asarray(marker.original.to_traced(marker.original.used))[:, None]


def scaled(displacement):
    """Scale a displacement to an RMS of 1."""
    return displacement / jnp.sqrt(jnp.sum((moving * displacement) ** 2) / moving.sum())


@jax.jit
def evidence(strengths, layers, key):
    mine = carrier.with_bands(jnp.exp(strengths))
    marked = x + size * scaled(mine.displacement(word))
    noise = jax.random.normal(key, x[:, :1].shape)
    inputs = jnp.concatenate([100 * carrier.host.operator.apply(marked), noise], axis=1)
    hidden = jnp.tanh(spectral.cheb_conv(carrier.host.operator, layers[0], inputs))
    shift = moving * spectral.cheb_conv(carrier.host.operator, layers[1], hidden)
    return log_evidence(marked + 3 * size * scaled(shift), x, mine, word)


both = jax.jit(jax.value_and_grad(evidence, (0, 1)))
draws = jax.random.split(jax.random.key(0), 3)
start = [spectral.init_cheb_conv(key, *shape, degree=8) for key, shape in zip(draws, ((4, 8), (8, 3)), strict=False)]


def play(strengths, layers, rate):
    """Train the network, and the strengths at a learning rate; return the evidence of each step, and the strengths."""
    attack, defence = optax.adam(0.01), optax.chain(optax.scale(-1), optax.adam(rate))  # which descend, and ascend
    states, history = (attack.init(layers), defence.init(strengths)), []
    for key in jax.random.split(draws[2], 40):
        nats, (up, down) = both(strengths, layers, key)
        (down, attacking), (up, defending) = attack.update(down, states[0]), defence.update(up, states[1])
        layers, strengths = optax.apply_updates(layers, down), optax.apply_updates(strengths, up)
        states = attacking, defending
        history.append(float(nats))
    return history, strengths


fixed = jnp.log(jnp.ones(bands) if carrier.profile is None else jnp.asarray(carrier.profile))
figure, (axes,) = panels(1, 6.5, 3.6)
for name, rate in {"fixed": 0.0, "trained": 0.05}.items():
    history, strengths = play(fixed, start, rate)
    print(f"strengths {name:<8} evidence in nats:", *(f"{nats:.0f}" for nats in history[::8]), f"{history[-1]:.0f}")
    axes.plot(history, label=f"strengths {name}")
finish(axes, xlabel="step of network and strengths", ylabel="evidence after the attack, in nats")
Picture(figure).save("11_1.png")

# %% [markdown]
# The strengths of the last play are the profile of a scheme, which embeds and detects like any other. At equal RMS
# displacement, both schemes are attacked by jamming, random noise in the bands of the default strengths. So this
# attacker does not know the trained ones.

# %%
profile = jnp.exp(strengths - strengths.max())
schemes = {"default": marker.scheme, "trained": marker.scheme.with_profile(tuple(map(float, profile)))}
for name, scheme in schemes.items():
    marked, info = jm.embed(mesh, b"ok", owner, budget=jm.Budget(rms=size, noise=0), scheme=scheme)
    jammed = jm.attack(marked, "jamming", 4 * size, seed=1)
    found = jm.detect(jammed, original=mesh, key=owner, record=info.record)
    print(f"strengths {name}: message {found.message}, log10 p {found.log10_p:.1f}")
