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
# # Tune the bands under a perceptual budget
#
# People tolerate far more displacement at low spatial frequencies than at high ones, and attacks leave more of some
# bands than of others. `tune` measures both on the mesh, and gives the bands the strengths at which the worst attack is
# least bad.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
import jax

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.geometry import asteroid
from jaxmark.spectral.bands import scaling
from jaxmark.watermark import KeyedScheme
from jaxmark.watermark.visibility import band_visibility

mesh = asteroid(10_000)  # or a file of your own: jm.load_mesh("model.obj")
original = make_original(mesh)
visible = band_visibility(original, scaling(64, damping="jackson"), ["dame", "gl"])
for band in (0, 1, 3, 7, 15, 31):
    print(
        f"band {band:2}: DAME {visible[0, band]:8.3f} rad, GL {visible[1, band]:6.3f}, for a unit of RMS displacement"
    )

# %% [markdown]
# Two attacks and one limit. The report says what each attack leaves of the best strengths found, and what no strengths
# whatever could exceed on the channels that were measured.

# %%
LIMITS = {"dame": 0.008}
ATTACKS = [("noise", 0.005), ("smoothing", 50)]
tuned = jm.tune(mesh, ATTACKS, limits=LIMITS, key=jax.random.key(0), margin="evidence")
print("profile", tuned.scheme.profile)
print("margins", tuned.report.margins.round(), "nats; bound", round(tuned.report.bound))

# %% [markdown]
# The strengths over frequency. β is what is written in a band, in diagonals of the bounding box: most lies where
# neither the eye nor the attacks look.

# %%
plot.strengths({"tuned": tuned.beta}).save("04_1.png")

# %% [markdown]
# Beside a mark that is equally strong in all bands, at the same distortion.

# %%
key, message = jm.new_key(), b"jaxmark!"
claims = {}
for name, scheme in (("tuned", tuned.scheme), ("flat", KeyedScheme(profile=(1.0,) * 64))):
    marker = jm.make_marker(mesh, key, scheme=scheme)
    marked, info = marker.embed(message, limits=LIMITS, noise=0)
    print(f"{name}: RMS {info.rms:.4%} of the diagonal, DAME {jm.compare(mesh, marked, ['dame']).dame:.4f}")
    for kind, strength in ATTACKS:
        found = marker.detect(jm.attack(marked, kind, strength, seed=1))
        claims[name, kind] = found.message == message
        print(f"  {kind} {strength:g}: read {found.message == message}, log10 p {found.log10_p:.1f}")
    if name == "tuned":
        shown = marked
assert claims["tuned", "noise"]
assert claims["tuned", "smoothing"]

# %% [markdown]
# The mark, ten times the mark, and where it shows: displacement over what the roughness around it hides.

# %%
plot.draw(
    [
        plot.View("original", mesh),
        plot.exaggerate(original, shown),
        plot.displacement(original, shown),
        plot.visibility(original, shown),
    ]
).save("04_2.png")
