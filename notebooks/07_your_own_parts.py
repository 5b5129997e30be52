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
# Attacks, metrics and schemes are plain Python objects, and one of yours goes wherever a name of the library's does.
# Here we write one of each, and put them through marking, reading, robustness and limits.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.evaluation import pictures
from jaxmark.geometry import Mesh, asteroid
from jaxmark.geometry.mesh import vertex_normals
from jaxmark.spectral.precision import einsum, matmul
from jaxmark.watermark.carriers import ModulatedCarrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.coding.sequences import orthogonal_sequences
from jaxmark.watermark.interfaces import Detector, Scheme
from jaxmark.watermark.reading.detectors import decorrelate

mesh = asteroid(2800)
key = jm.Key(bytes(range(32)))  # the same each time; real ones are `jm.new_key()`
print(f"{len(mesh.vertices)} vertices")

# %% [markdown]
# ## An attack
#
# An attack is a function of a mesh, a strength and a random key, with the unit of its strength and a usual range. This
# one presses plane waves into the surface, as a worn 3D printer does. Written in JAX, it is given the mesh near the
# origin and at unit size (diagonal 1), and can be differentiated. (`host=True` marks one in NumPy, which gets the mesh
# as it is, and a NumPy generator instead of a key.)


# %%
def chatter(mesh: Mesh, strength: float, key: jax.Array) -> Mesh:
    """Waves of a twentieth of the diagonal, of a random phase, along z."""
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
# It goes where names go: into `attack`, into chains with others, into `robustness`.

# %%
marker = jm.make_marker(mesh, key, bits=16)
marked, info = marker.embed(b"ok", jm.Budget(rms=8e-4, noise=0))
both = jm.adversaries.chain(marked, [(chattering, 0.001), ("quantisation", 10)], seed=1)
print("after chatter and quantisation:", marker.detect(both).message)
curve = jm.robustness(marker, marked, b"ok", chattering, [0.02, 0.1], samples=1)
print("read at 2 % and 10 % of the diagonal:", curve.success[:, 0])

# %% [markdown]
# ## A metric
#
# A metric is a function of an original and a distorted mesh: 0 where they are the same, and rising. A print shop may
# care how much material a mark takes; an engineer, how much edges are stretched.


# %%
def stretch(original: Mesh, distorted: Mesh) -> float:
    """Root mean square of the relative change of edges' lengths."""

    def lengths(one: Mesh) -> np.ndarray:
        corners = np.asarray(one.vertices)[np.asarray(original.faces)]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)

    return float(np.sqrt(np.mean((lengths(distorted) / lengths(original) - 1) ** 2)))


for name, value in jm.distortion.measure(mesh, marked, ["rms", "dame", stretch]).items():
    print(f"{name:>8}: {value:.5f}")

# %% [markdown]
# Limits take it, too: the mark becomes as strong as no edge, in the mean, is stretched by more than 1 %. And as any
# metric, it has a visibility per band of frequencies, by which `jm.tune` would balance it against attacks. Edges are
# stretched by high frequencies, as dihedral angles are bent by them.

# %%
gentle, _ = marker.embed(b"ok", jm.Budget(limits={stretch: 0.01}, noise=0))
print(f"stretch {stretch(mesh, gentle):.4f}, RMS {jm.compare(mesh, gentle, ['rms']).rms:.3%} of the diagonal")
assert 0.0098 < stretch(mesh, gentle) <= 0.01
pictures.band_visibility(original, ["rms", "dame", stretch]).save("07_2.png")

# %% [markdown]
# ## A carrier, and the scheme that makes it
#
# A carrier is a linear map from bits to a displacement, and its adjoint. Most are *components*, fixed directions that
# do not depend on the key, modulated by keyed sequences of signs; then `ModulatedCarrier` does the rest and only the
# components are to be written. Ours are waves through space, which move each vertex along its normal:
# $w(v) = n_v \cos(k_j \cdot v + \varphi_j)$. No spectrum, no eigenvectors, no edges.
#
# Components have three methods: how they add up, what they find, and their inner products. It is a `NamedTuple` of
# arrays, so that JAX can trace it.


# %%
class Waves(NamedTuple):
    """Cosines of the position, along normals."""

    heights: jax.Array  # vertices, waves
    normals: jax.Array  # vertices, 3

    @property
    def gram(self) -> jax.Array:
        """Inner products of the waves for each coordinate."""
        return einsum("vj,vc,vk->cjk", self.heights, self.normals**2, self.heights)

    def synthesise(self, amplitudes: jax.Array) -> jax.Array:
        """From an amplitude for each wave and coordinate to a displacement."""
        return self.normals * matmul(self.heights, amplitudes)

    def analyse(self, residual: jax.Array) -> jax.Array:
        """Back: the adjoint."""
        return matmul(self.heights.T, self.normals * residual)


# %% [markdown]
# A scheme is a frozen dataclass that makes the carrier for an original, a key and a payload, and inherits from `Scheme`
# what it does not say. Its fields go into the record of a mark. It says which detector reads it: `decorrelate` solves
# for all bits at once, as the waves are not orthogonal on the surface.
#
# `choices` has all that depends on the key: signs, permutations and bytes, by a label of our own. They are bound to
# the scheme's name and fields, to payload and original: with another wavelength, all signs are others. Only the signs
# may depend on the key; the waves must not, or the proof of a detection would not hold. Nobody but you can know that,
# so that a reading with a scheme of your own is an estimate, and `evidence.caveats` says why.


# %%
@dataclass(frozen=True)
class WaveScheme(Scheme):
    """Plane waves, each with a keyed sign for each code bit."""

    name: ClassVar[str] = "waves"
    waves: int = 256
    wavelength: float = 0.1  # the shortest, in diagonals

    @property
    def detector(self) -> Detector:
        """What reads it."""
        return decorrelate

    def code_length(self, original, bits: int) -> int:
        """How many code bits carry a payload: at most one for two waves."""
        return code_length(bits, self.waves // 2, 4)

    def carrier(self, original, choices: Choices, bits: int, code_bits: int) -> ModulatedCarrier:
        """The waves, and a keyed sequence of signs for each code bit."""
        random = np.random.default_rng(0)  # no secret: the same for every key
        vectors = random.normal(size=(3, self.waves))
        vectors *= 2 * np.pi / self.wavelength * random.uniform(0.3, 1, self.waves) / np.linalg.norm(vectors, axis=0)
        heights = np.cos(original.positions @ vectors + random.uniform(0, 2 * np.pi, self.waves))
        heights /= np.linalg.norm(heights, axis=0)
        normals = vertex_normals(Mesh(original.positions, original.points.faces))
        signs = orthogonal_sequences(choices, code_bits, self.waves, label=self.name)
        used = original.used[:, None]
        waves = Waves(original.to_traced(used * heights), original.to_traced(used * normals))
        return ModulatedCarrier(waves, signs[:, :, None])


scheme = WaveScheme()
waves = jm.make_marker(mesh, key, bits=16, scheme=scheme)
waved, record = waves.embed(b"ok", {stretch: 0.01})
print(f"RMS {record.rms:.3%} of the diagonal; read: {waves.detect(waved).message}, {record.record.parameters}")
plot.draw(
    [plot.exaggerate(original, gentle), plot.exaggerate(original, waved), plot.displacement(original, waved)]
).save("07_3.png")

# %% [markdown]
# Everything else is the library's: alignment, tags, evidence, records. A wrong key reads nothing, and the reader asks
# for no more than the record and the scheme.

# %%
noisy = jm.attack(waved, "noise", 0.002, seed=0)
found = jm.detect(noisy, original=mesh, key=key, record=record.record, scheme=scheme)
print(f"read {found.message}, log10 p {found.log10_p:.1f}; claimed {waves.detect(noisy, b'ok').log10_p:.1f}")
print("an estimate, for", *found.evidence.caveats)
stranger = jm.make_marker(mesh, jm.Key(bytes(32)), bits=16, scheme=scheme)
assert found.message == b"ok"
assert found.evidence.caveats
assert stranger.detect(waved).message is None

# %% [markdown]
# ## All together
#
# Both schemes under our attack, marked up to the same limit of our metric. Waves through space are what chatter is made
# of, so that the reader of the waves hears it; the keyed scheme weighs bands by what is left in them, and loses little.

# %%
curves = {
    "keyed": jm.robustness(marker, gentle, b"ok", chattering, samples=3),
    "waves": jm.robustness(waves, waved, b"ok", chattering, samples=3),
}
for name, curve in curves.items():
    print(name, curve.success.mean(axis=1), curve.log10_p.max(axis=1).round(1))
pictures.success(curves, chattering.unit).save("07_4.png")
