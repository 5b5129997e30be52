# %% [markdown]
# # Tune the bands under a perceptual budget
#
# People tolerate far more displacement at low spatial frequencies than at high ones, and attacks leave more of some
# bands than of others. `tune` measures both on the mesh, and gives the bands the strengths at which the worst attack is
# least bad.

# %%
import jax

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment import make_original
from jaxmark.app.demo import sample_mesh
from jaxmark.spectral.bands import scaling
from jaxmark.watermark import KeyedScheme
from jaxmark.watermark.visibility import band_visibility

mesh = jm.load_mesh(sample_mesh())
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
)
