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
# # Read without the original
#
# Marks of the scheme `field` are blind: they are read from the key and the suspect alone. This notebook is for readers
# who want to know how this works. It writes a mark, attacks and remeshes the mesh, and reads the mark. It then shows
# the values that carry the mark, on a lattice that depends on the shape and not on its triangles.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
import numpy as np

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.geometry import asteroid
from jaxmark.plot.figures import COLOURS, Picture, finish, panels
from jaxmark.watermark.blind.dither import make_dither
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.reading import codeword, context
from jaxmark.watermark.blind.scheme import AnchoredHost

MESSAGE = b"jaxmark!"
SCHEME = FieldScheme(widths=(0.018,))  # one of three widths, to save time; usually use "field"
mesh = asteroid(10_000)
key = jm.Key(bytes(range(32)))  # the same in each run; make real keys by `jm.new_key()`
another = jm.Key(bytes(range(1, 33)))
marked, info = jm.embed(mesh, MESSAGE, key, budget={"msdm": 0.2, "rms": 8e-4}, scheme=SCHEME)
width, step = (info.record.parameters[name] for name in ("width", "step"))
print(f"{len(mesh.vertices)} vertices moved by RMS {info.rms:.4%} of the diagonal; width {width}, step {step:.2e}")

# %% [markdown]
# The reader does not get the original. The suspects are the marked mesh, and the same with four times the triangles in
# another pose and size. Two controls follow: the unmarked mesh, and the marked mesh with another key.

# %%
random = np.random.default_rng(0)
turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
turn *= np.linalg.det(turn)
remeshed = jm.attack(marked, "loop", 1, seed=0)
suspects = {
    "marked": marked,
    "four times the triangles, turned, 3 times as large": remeshed._replace(
        vertices=3 * remeshed.vertices @ turn.T + 7
    ),
}
for name, suspect in suspects.items():
    detection = jm.detect(suspect, key=key, scheme=SCHEME)
    agreement = detection.registration.agreement
    print(f"{name:<51} {detection.message!r} log10 p {detection.log10_p:6.1f}  agreement {agreement:.2f}")
    assert detection.message == MESSAGE
known = SCHEME.fixed(width, step)  # fewer alternatives to try
for name, suspect, other in (("unmarked", mesh, key), ("marked, another key", marked, another)):
    detection = jm.detect(suspect, key=other, scheme=known)
    print(f"{name:<51} detected: {detection.detected()}")
    assert not detection.detected()

# %% [markdown]
# ## The values that carry the mark
#
# An anchor is a point of a lattice in the shape's own pose. Around each anchor the surface is averaged twice, the
# second time twice as widely, and the distance of the two averages is the anchor's value. Key and code bit allow the
# values that are whole quantisation steps away from a keyed offset. The mark moves each value most of the way to the
# nearest of these. The histograms show the difference from it, in steps. It is uniform before marking, and small after.


# %%
choices = context(key, 8 * len(MESSAGE), SCHEME.name)


def phases(host: AnchoredHost) -> np.ndarray:
    """Compute the difference of each value from the nearest one that key and message allow, in steps."""
    word = codeword(MESSAGE, choices)
    dither = make_dither(choices, SCHEME.name, host.names, len(word))
    off = (host.values / step - dither.offset - np.where(dither.sign * word[dither.slot] < 0, 0.5, 0))[host.good > 0]
    return off - np.round(off)


before, after = (phases(SCHEME.hosts(make_original(one), choices)[width]) for one in (mesh, marked))
figure, axes = panels(2, 4.5, 3.0, sharey=True)
for panel, title, off in zip(axes, ("original", "marked"), (before, after), strict=True):
    panel.hist(off, bins=np.linspace(-0.5, 0.5, 41), color=COLOURS[0])
    finish(panel, title=f"{title}: mean cosine {np.cos(2 * np.pi * off).mean():.2f}", xlabel="difference, in steps")
assert np.cos(2 * np.pi * after).mean() > 0.5 > abs(np.cos(2 * np.pi * before).mean())
Picture(figure).save("13_1.png")

# %% [markdown]
# ## Robustness
#
# The agreement is the mean cosine of these differences, as phases. Noise and smoothing lower it. While some agreement
# is left, a few hundred anchors are enough to decode the message. The record names width and step, so the reader has
# fewer alternatives to try.

# %%
STRENGTHS = {"noise": [0.001, 0.004, 0.008], "smoothing": [10, 30, 50]}
figure, axes = panels(2, 4.5, 3.0, sharey=True)
for panel, (kind, strengths) in zip(axes, STRENGTHS.items(), strict=True):
    readings = [
        jm.detect(jm.attack(marked, kind, strength, seed=0), key=key, record=info.record) for strength in strengths
    ]
    for strength, reading in zip(strengths, readings, strict=True):
        agreement = reading.registration.agreement
        print(f"{kind} {strength:g}: {reading.message!r}, log10 p {reading.log10_p:.1f}, agreement {agreement:.2f}")
    panel.plot(strengths, [reading.registration.agreement for reading in readings], color=COLOURS[0], marker="o")
    finish(panel, title=kind, xlabel="strength", ylabel="agreement", ylim=(0, 1))
Picture(figure).save("13_2.png")

# %% [markdown]
# Smoothing lowers the agreement less, because the reader undoes it. The last figure shows the displacement, which is as
# smooth as the averages that carry the mark.

# %%
original = make_original(mesh)
plot.draw([plot.View("marked", marked), plot.exaggerate(original, marked), plot.displacement(original, marked)]).save(
    "13_3.png"
)
