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
# # The gradient of the evidence with respect to the bands
#
# This notebook is for researchers who design filters for marks. The evidence of a suspect is a smooth function of the
# Chebyshev coefficients of the bands in which the mark is written and read. Its gradient takes O(N) memory. Forward
# mode confirms the gradient, and a step along it increases the evidence.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
import jax
import jax.numpy as jnp

import jaxmark as jm
from jaxmark.geometry import asteroid
from jaxmark.plot.figures import BOUND, Picture, finish, panels
from jaxmark.watermark import log_evidence

mesh = asteroid(2800)  # small, so that this takes a minute
owner = jm.Key(bytes(range(32)))  # the same in each run; make real keys by `jm.new_key()`
marker, size = jm.make_marker(mesh, owner, bits=16), 8e-4
carrier, x = marker.reader.carrier, marker.original.signal
word, bands = jnp.asarray(marker.codeword(b"ok"), x.dtype), jnp.asarray(carrier.host.coefficients, x.dtype)
strengths = jnp.ones(len(bands)) if carrier.profile is None else jnp.asarray(carrier.profile)
noise = 4 * size * jax.random.normal(jax.random.key(0), x.shape) / jnp.sqrt(3.0)


@jax.jit
def evidence(bands):
    mine = carrier.with_bands(strengths, bands)
    mark = mine.displacement(word)
    marked = x + size * mark / jnp.sqrt(jnp.mean(jnp.sum(mark**2, axis=1)))
    return log_evidence(marked + noise, x, mine, word)


slope = jax.jit(jax.grad(evidence))(bands)
length = jnp.linalg.norm(slope)
value, rate = jax.jvp(evidence, (bands,), (slope / length,))
print(f"{slope.shape} coefficients, evidence {float(value):.1f} nats")
print(f"norm of the gradient {float(length):.1f}, by forward mode {float(rate):.1f}")
assert jnp.allclose(rate, length, rtol=1e-2)
lengths = (0.0, 0.01, 0.02, 0.05, 0.1)
steps = [float(evidence(bands + t * slope / length)) for t in lengths]
print("evidence in nats after steps along the gradient:", *(f"{nats:.1f}" for nats in steps))
assert max(steps) > steps[0]
figure, (axes,) = panels(1, 6.5, 3.6)
axes.plot(lengths, steps, marker="o", label="evidence")
axes.plot(lengths, [steps[0] + t * float(length) for t in lengths], label="its slope at 0", **BOUND)
finish(axes, xlabel="step along the gradient, in coefficients", ylabel="evidence, in nats", ylim=(steps[0], None))
Picture(figure).save("12_1.png")
