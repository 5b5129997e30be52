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
# # Mark a mesh and read the mark
#
# This notebook shows the whole workflow to new users. Embed a message with a key and a distortion budget, attack the
# marked mesh, and read the message from the attacked copies. The owner needs the original and the key for that.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
import jaxmark as jm
from jaxmark import plot
from jaxmark.geometry import asteroid

mesh = asteroid(20_000)  # or a file of your own: jm.load_mesh("model.obj")
key = jm.new_key()
marker = jm.make_marker(mesh, key, bits=64)
marked, info = marker.embed(b"jaxmark!", budget=8e-4)
print(f"{len(mesh.vertices)} vertices moved by RMS {info.rms:.4%} of the diagonal, at most {info.max:.4%}")

# %% [markdown]
# The mark is not visible. Ten times its displacement shows where the vertices moved. The interactive viewer rotates the
# meshes with the mouse, and switches between them.

# %%
original = marker.original
shown = plot.displacement(original, marked)
plot.draw([plot.View("marked", marked), plot.exaggerate(original, marked), shown]).save("01_1.png")

# %%
views = [plot.View("original", mesh), plot.View("marked", marked), plot.exaggerate(original, marked), shown]
plot.show(*views).save("01_viewer.html")

# %% [markdown]
# The marker prepares the original once, and reads any number of suspects. `log10_p` is the base-10 logarithm of a bound
# on the false-positive probability: that a mesh which is independent of the key reads as well. A mark is detected from
# -6 on, one in a million. The unmarked mesh, and the marked mesh under another key, must not be detected.

# %%
suspects = {
    "marked": marked,
    "noise 0.1 %": jm.attack(marked, "noise", 0.001, seed=0),
    "quantised to 9 bits": jm.attack(marked, "quantisation", 9, seed=0),
    "smoothed 50 times": jm.attack(marked, "smoothing", 50, seed=0),
    "unmarked": mesh,
}
for name, suspect in suspects.items():
    detection = marker.detect(suspect)
    print(f"{name:<20} {detection.message!r:<14} log10 p {detection.log10_p:6.1f}  detected: {detection.detected()}")

stranger = jm.make_marker(mesh, jm.new_key(), bits=64)
assert marker.detect(marked).message == b"jaxmark!"
assert stranger.detect(marked).message is None
assert marker.detect(mesh).message is None

# %% [markdown]
# The attacked copies look worse than the marked mesh, but the message can still be read from each of them.

# %%
shown = {name: suspect for name, suspect in suspects.items() if name != "unmarked"}
plot.draw([plot.View(name, suspect) for name, suspect in shown.items()]).save("01_2.png")
