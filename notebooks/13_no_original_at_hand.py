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
# # No original at hand
#
# Marks of the scheme `field` are read by the key and the suspect alone. Here one is written, attacked, remeshed and
# read, and what it is made of is looked at: values on a lattice that belongs to the shape, not to its triangles.

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
SCHEME = FieldScheme(widths=(0.018,))  # one of three widths, so that this takes a minute; usually "field" will do
mesh = asteroid(10_000)
key = jm.new_key()
marked, info = jm.embed(mesh, MESSAGE, key, budget={"msdm": 0.2, "rms": 8e-4}, scheme=SCHEME)
width, step = (info.record.parameters[name] for name in ("width", "step"))
print(f"{len(mesh.vertices)} vertices moved by RMS {info.rms:.4%} of the diagonal; width {width}, step {step:.2e}")

# %% [markdown]
# Now forget the mesh. The suspects are another meshing of the marked one, in another pose, order and size; a smoothed
# one; and for control the unmarked mesh, and another key.

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
    found = jm.detect(suspect, key=key, scheme=SCHEME)
    print(f"{name:<51} {found.message!r} log10 p {found.log10_p:6.1f}  agreement {found.registration.agreement:.2f}")
    assert found.message == MESSAGE
known = SCHEME.fixed(width, step)  # less to try
for name, suspect, tried in (("unmarked", mesh, key), ("marked, another key", marked, jm.new_key())):
    found = jm.detect(suspect, key=tried, scheme=known)
    print(f"{name:<51} detected: {found.detected()}")
    assert not found.detected()

# %% [markdown]
# ## What was written
#
# Around each anchor, a point of a lattice in the shape's own pose, the surface is averaged twice, once twice as widely.
# How far apart the averages are is the anchor's value. A mark moves it most of the way to the nearest number of those
# that the key allows for its code bit: whole steps from its keyed offset. Before, values are anywhere between them.


# %%
choices = context(key, 8 * len(MESSAGE), SCHEME.name)


def phases(host: AnchoredHost) -> np.ndarray:
    """How far each value is from what key and message allow, in steps."""
    word = codeword(MESSAGE, choices)
    dither = make_dither(choices, SCHEME.name, host.names, len(word))
    off = (host.values / step - dither.offset - np.where(dither.sign * word[dither.slot] < 0, 0.5, 0))[host.good > 0]
    return off - np.round(off)


before, after = (phases(SCHEME.hosts(make_original(one), choices)[width]) for one in (mesh, marked))
figure, axes = panels(2, 4.5, 3.0, sharey=True)
for panel, title, off in zip(axes, ("original", "marked"), (before, after), strict=True):
    panel.hist(off, bins=np.linspace(-0.5, 0.5, 41), color=COLOURS[0])
    finish(panel, title=f"{title}: mean cosine {np.cos(2 * np.pi * off).mean():.2f}", xlabel="off, in steps")
assert np.cos(2 * np.pi * after).mean() > 0.5 > abs(np.cos(2 * np.pi * before).mean())
Picture(figure).save("13_1.png")

# %% [markdown]
# ## What is left of it
#
# The agreement is the mean cosine of what values are off. Noise and smoothing lower it; while some of it is left, a
# few hundred anchors still say the message. With its record, which names width and step, there is less to try.

# %%
STRENGTHS = {"noise": [0.001, 0.004, 0.008], "smoothing": [10, 30, 50]}
figure, axes = panels(2, 4.5, 3.0, sharey=True)
for panel, (kind, strengths) in zip(axes, STRENGTHS.items(), strict=True):
    readings = [
        jm.detect(jm.attack(marked, kind, strength, seed=0), key=key, record=info.record) for strength in strengths
    ]
    for strength, found in zip(strengths, readings, strict=True):
        agreement = found.registration.agreement
        print(f"{kind} {strength:g}: {found.message!r}, log10 p {found.log10_p:.1f}, agreement {agreement:.2f}")
    panel.plot(strengths, [found.registration.agreement for found in readings], color=COLOURS[0], marker="o")
    finish(panel, title=kind, xlabel="strength", ylabel="agreement", ylim=(0, 1))
Picture(figure).save("13_2.png")

# %% [markdown]
# Smoothing lowers it less, as the reader undoes it. In the picture of what moved, the mark is as smooth as the averages
# that carry it.

# %%
original = make_original(mesh)
plot.draw([plot.View("marked", marked), plot.exaggerate(original, marked), plot.displacement(original, marked)]).save(
    "13_3.png"
)
