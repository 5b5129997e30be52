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
# # Parts of your own: an attack, a metric, a carrier
#
# This notebook is for researchers who extend the library. Attacks, metrics and schemes are plain Python objects, and
# you can pass your own wherever the library accepts a name. The sections below implement one of each, and use them for
# marking, reading, robustness curves and limits.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.evaluation import pictures
from jaxmark.geometry import Mesh, asteroid
from jaxmark.geometry.mesh import vertex_normals
from jaxmark.watermark.carriers import SpreadCarrier, make_spread_carrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.interfaces import Scheme

mesh = asteroid(2800)
key = jm.Key(bytes(range(32)))  # the same in each run; make real keys by `jm.new_key()`
print(f"{len(mesh.vertices)} vertices")

# %% [markdown]
# ## An attack
#
# An attack is a function of a mesh, a strength and a random key, together with the unit of its strength and a usual
# range. This one adds plane waves to the surface, as a worn 3D printer does. An attack in JAX gets the mesh near the
# origin and with a diagonal of 1, and can be differentiated. (With `host=True`, an attack is written in NumPy. It gets
# the mesh as it is, and a NumPy generator instead of a key.)


# %%
def chatter(mesh: Mesh, strength: float, key: jax.Array) -> Mesh:
    """Displace vertices along z by waves of a twentieth of the diagonal, with a random phase."""
    phase = jax.random.uniform(key, maxval=2 * jnp.pi)
    height = strength * jnp.sin(2 * jnp.pi * 20 * mesh.vertices[:, 1] + phase)
    return Mesh(mesh.vertices + height[:, None] * jnp.array([0.0, 0.0, 1.0]), mesh.faces)


chattering = jm.attacks.Attack(chatter, "amplitude over the diagonal", (0.0005, 0.001, 0.002, 0.006))
original = make_original(mesh)
chattered = jm.attack(mesh, chattering, 0.005, seed=0)
plot.draw(
    [plot.View("original", mesh), plot.View("chattered", chattered), plot.displacement(original, chattered)]
).save("07_1.png")

# %% [markdown]
# Pass the attack to `attack`, to chains with other attacks, or to `robustness`.

# %%
marker = jm.make_marker(mesh, key, bits=16)
marked, info = marker.embed(b"ok", jm.Budget(rms=8e-4, noise=0))
both = jm.adversaries.chain(marked, [(chattering, 0.001), ("quantisation", 10)], seed=1)
print("message after chatter and quantisation:", marker.detect(both).message)
curve = jm.robustness(marker, marked, b"ok", chattering, [0.02, 0.1], samples=1)
print("message read at amplitudes of 2 % and 10 % of the diagonal:", curve.success[:, 0])

# %% [markdown]
# ## A metric
#
# A metric is a function of an original and a distorted mesh. It is 0 if they are equal, and rises with the distortion.
# This one measures how much the edges are stretched.


# %%
def stretch(original: Mesh, distorted: Mesh) -> float:
    """Compute the root mean square of the relative change of edge lengths."""

    def lengths(one: Mesh) -> np.ndarray:
        corners = np.asarray(one.vertices)[np.asarray(original.faces)]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)

    return float(np.sqrt(np.mean((lengths(distorted) / lengths(original) - 1) ** 2)))


for name, value in jm.distortion.measure(mesh, marked, ["rms", "dame", stretch]).items():
    print(f"{name:>8}: {value:.5f}")

# %% [markdown]
# The metric can be a limit: here the mark is as strong as a root mean square stretch of 1 % allows. Like any metric, it
# also has a visibility for each band of frequencies, which `jm.tune` balances against attacks. High frequencies stretch
# edges, as they change dihedral angles.

# %%
gentle, _ = marker.embed(b"ok", jm.Budget(limits={stretch: 0.01}, noise=0))
print(f"stretch {stretch(mesh, gentle):.4f}, RMS {jm.compare(mesh, gentle, ['rms']).rms:.3%} of the diagonal")
assert 0.0098 < stretch(mesh, gentle) <= 0.01
pictures.band_visibility(original, ["rms", "dame", stretch]).save("07_2.png")

# %% [markdown]
# ## A carrier, and the scheme that makes it
#
# A carrier is a linear map from bits to a displacement, together with its adjoint. `make_spread_carrier` gives every
# vertex a keyed sign times one of the bits, a *chip*, and needs only a linear function from chips to displacements. JAX
# transposes it for reading. This function smooths the chips over the surface, and moves each vertex along its normal.


# %%
def bumps(operator, normals: jax.Array, chips: jax.Array) -> jax.Array:
    """Move vertices along their normals by chips, each averaged twice with its neighbours."""
    for _ in range(2):
        chips = chips - 0.5 * operator.apply(chips)
    return normals * chips


# %% [markdown]
# A scheme is a frozen dataclass that makes the carrier for an original, a key and a payload, and inherits everything
# else from `Scheme`. Its fields are stored in the record of a mark.
#
# `choices` provides everything that depends on the key: signs, permutations and bytes, for a label of your own. They
# are bound to the scheme's name and fields, the payload and the original. Only the signs may depend on the key. If the
# function above did, the proof of a detection would not hold. The library cannot check this, so a reading with a scheme
# of your own is an estimate, and `evidence.caveats` gives the reason.


# %%
@dataclass(frozen=True)
class BumpScheme(Scheme):
    """Bumps along the normals, with a keyed sign for each vertex."""

    name: ClassVar[str] = "bumps"

    def code_length(self, original, bits: int) -> int:
        """Return the number of code bits for a payload: at most one for every 16 vertices."""
        return code_length(bits, original.count // 16, 4)

    def carrier(self, original, choices: Choices, bits: int, code_bits: int) -> SpreadCarrier:
        """Make the carrier of bumps."""
        normals = original.to_traced(vertex_normals(Mesh(original.positions, original.points.faces)))
        shape = jax.tree_util.Partial(bumps, original.operator, normals)
        return make_spread_carrier(original, choices, code_bits, shape, channels=1)


scheme = BumpScheme()
own = jm.make_marker(mesh, key, bits=16, scheme=scheme)
bumped, info = own.embed(b"ok", {stretch: 0.01})
print(f"RMS {info.rms:.3%} of the diagonal; message {own.detect(bumped).message}, parameters {info.record.parameters}")
plot.draw(
    [plot.exaggerate(original, gentle), plot.exaggerate(original, bumped), plot.displacement(original, bumped)]
).save("07_3.png")

# %% [markdown]
# The library provides everything else: alignment, tags, evidence and records. The reader needs the record and the
# scheme. A wrong key reads no message.

# %%
noisy = jm.attack(bumped, "noise", 0.002, seed=0)
detection = jm.detect(noisy, original=mesh, key=key, record=info.record, scheme=scheme)
claimed = own.detect(noisy, b"ok").log10_p
print(f"message {detection.message}, log10 p {detection.log10_p:.1f}; of a claim {claimed:.1f}")
print("an estimate, because:", *detection.evidence.caveats)
stranger = jm.make_marker(mesh, jm.Key(bytes(32)), bits=16, scheme=scheme)
assert detection.message == b"ok"
assert detection.evidence.caveats
assert stranger.detect(bumped).message is None

# %% [markdown]
# ## Compare both schemes
#
# Both schemes mark the mesh up to the same limit of the new metric, and read after the new attack. The keyed scheme
# weights bands by the noise in them; the bumps are read by plain correlation.

# %%
curves = {
    "keyed": jm.robustness(marker, gentle, b"ok", chattering, samples=3),
    "bumps": jm.robustness(own, bumped, b"ok", chattering, samples=3),
}
for name, curve in curves.items():
    print(name, curve.success.mean(axis=1), curve.log10_p.max(axis=1).round(1))
pictures.success(curves, chattering.unit).save("07_4.png")
