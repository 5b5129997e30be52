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
# # Mark a mesh and read it again
#
# A key, a message, a budget: the marked mesh looks the same, and the owner, who keeps the original, reads the message
# from an attacked copy.

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
# What was done to the mesh: nothing to be seen, but ten times as much shows where it is. The viewer turns it with the
# mouse, and switches between them.

# %%
original = marker.original
shown = plot.displacement(original, marked)
plot.draw([plot.View("marked", marked), plot.exaggerate(original, marked), shown]).save("01_1.png")

# %%
views = [plot.View("original", mesh), plot.View("marked", marked), plot.exaggerate(original, marked), shown]
plot.show(*views).save("01_viewer.html")

# %% [markdown]
# The marker has prepared the original, and reads as many suspects as you like. The unmarked mesh, and the right suspect
# under a wrong key, must give nothing. `log10_p` bounds the probability of such a reading where there is no mark: -6 is
# one in a million, and detected.

# %%
suspects = {
    "marked": marked,
    "noise 0.1 %": jm.attack(marked, "noise", 0.001, seed=0),
    "quantised to 9 bits": jm.attack(marked, "quantisation", 9, seed=0),
    "smoothed 50 times": jm.attack(marked, "smoothing", 50, seed=0),
    "unmarked": mesh,
}
for name, suspect in suspects.items():
    found = marker.detect(suspect)
    print(f"{name:<20} {found.message!r:<14} log10 p {found.log10_p:6.1f}  detected: {found.detected()}")

stranger = jm.make_marker(mesh, jm.new_key(), bits=64)
assert marker.detect(marked).message == b"jaxmark!"
assert stranger.detect(marked).message is None
assert marker.detect(mesh).message is None

# %% [markdown]
# The attacked copies look worse than the marked one, and the message is still there.

# %%
shown = {name: suspect for name, suspect in suspects.items() if name != "unmarked"}
plot.draw([plot.View(name, suspect) for name, suspect in shown.items()]).save("01_2.png")
