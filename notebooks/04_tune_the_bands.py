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
import numpy as np

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.geometry import asteroid
from jaxmark.spectral.bands import scaling
from jaxmark.watermark.perception.visibility import band_visibility

mesh = asteroid(1500)  # small, so that this takes a minute or two
original = make_original(mesh)
visible = band_visibility(original, scaling(64, damping="jackson"), ["dame", "gl"])
for band in (0, 1, 3, 7, 15, 31):
    print(
        f"band {band:2}: DAME {visible[0, band]:8.3f} rad, GL {visible[1, band]:6.3f}, for a unit of RMS displacement"
    )

# %% [markdown]
# One limit and two attacks: noise that looks like a mark, and a filter that leaves only the lowest tenth of the
# spectrum. `tune` writes, attacks and reads marks of several strengths; `tried` is the evidence that the detector has
# after each attack, in nats. Only the worst attack counts, so what another leaves may shrink down to it. No strengths
# whatever could exceed `bound`, by a model of the attacks.
#
# The default strengths are good against many attacks, and kept where nothing does better by a fifth: try noise and
# smoothing instead.

# %%
LIMITS = {"dame": 0.008}
ATTACKS = [("jamming", 0.002), ("low-pass", 0.9)]
tuned = jm.tune(mesh, ATTACKS, LIMITS, seed=0, bits=16, margin="evidence")
report = tuned.report
print("kept: the default is as good" if report.default_kept else "found: better strengths than the default's")
for (kind, strength), left, before in zip(ATTACKS, report.trials, report.default_trials, strict=True):
    print(f"after {kind} {strength:g}: {left:.0f} nats, by default {before:.0f}")
print(f"worst {report.trials.min():.0f}, by default {report.default_trials.min():.0f}, bound {report.bound:.0f}")

# %% [markdown]
# Beside a mark of the default strengths, at the same limit. The claims are of another key than those that were tried.

# %%
key, message = jm.new_key(), b"ok"
shown, betas, worst = {}, {}, {}
for name, scheme in (("default", "keyed"), ("tuned", tuned.scheme)):
    marker = jm.make_marker(mesh, key, bits=16, scheme=scheme)
    marked, info = marker.embed(message, jm.Budget(limits=LIMITS, noise=0))
    print(f"{name}: RMS {info.rms:.4%} of the diagonal, DAME {jm.compare(mesh, marked, ['dame']).dame:.4f}")
    claims = [marker.detect(jm.attack(marked, *one, seed=1), message) for one in ATTACKS]
    for (kind, strength), found in zip(ATTACKS, claims, strict=True):
        print(f"  after {kind} {strength:g}: log10 p of the claim {found.evidence.log10_p_unfloored:.1f}")
    worst[name] = max(found.evidence.log10_p_unfloored for found in claims)
    betas[name] = info.record.beta * np.asarray(marker.reader.carrier.profile)
    shown[name] = marked
assert worst["tuned"] < -6
assert report.default_kept or worst["tuned"] < worst["default"]

# %% [markdown]
# The strengths over frequency: β is what is written in a band, in diagonals of the bounding box.

# %%
plot.strengths({name: np.pad(beta, (0, 64 - len(beta))) for name, beta in betas.items()}).save("04_1.png")

# %% [markdown]
# The mark, ten times the mark, and where it shows: displacement over what the roughness around it hides.

# %%
plot.draw(
    [
        plot.View("original", mesh),
        plot.exaggerate(original, shown["tuned"]),
        plot.displacement(original, shown["tuned"]),
        plot.visibility(original, shown["tuned"]),
    ]
).save("04_2.png")
