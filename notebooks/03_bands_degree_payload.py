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
# # Choose bands, degree and payload
#
# A mark is written in bands of frequencies. This notebook is for readers who design filters or choose a payload. It
# measures, on one mesh, how cleanly families of filters separate bands, which degree they need, how visible each band
# is, and how many bits a mesh can carry. `docs/bands.md` compares all families on five meshes.

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
from jaxmark.evaluation import pictures
from jaxmark.geometry import asteroid
from jaxmark.spectral import centre, from_mesh, quadrature
from jaxmark.spectral.bands import bernstein, hat, nodes, report, scaling

mesh = asteroid(2800)
original = make_original(mesh)
print(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")

# %% [markdown]
# ## Families
#
# A family is a matrix of Chebyshev coefficients with one band a row. Its responses sum to 1 at every frequency λ, so
# the bands add up to the mesh. This cell makes 16 bands of degree 63 by four families. Three of them have as many bands
# as terms; to compare all at equal cost, 64 of their bands are made, and every four neighbours are summed.

# %%
BANDS, DEGREE = 16, 63


def summed(fine: np.ndarray) -> np.ndarray:
    """Sum neighbouring bands of a family, so that `BANDS` are left."""
    return fine.reshape(BANDS, -1, fine.shape[1]).sum(axis=1)


def families(degree: int) -> dict[str, np.ndarray]:
    """Make 16 bands of one degree by each family."""
    return {
        "scaling functions": summed(scaling(degree + 1)),
        "damped (Jackson)": summed(scaling(degree + 1, damping="jackson")),
        "Bernstein": summed(bernstein(degree + 1)),
        "hats": hat(nodes(BANDS), degree),
    }


shown = families(DEGREE)
for name, family in shown.items():
    print(f"{name:<18} sum to 1 up to {np.abs(family.sum(axis=0) - np.eye(1, DEGREE + 1)[0]).max():.0e}")
plot.responses(shown).save("03_1.png")

# %% [markdown]
# The undamped families ripple; this is the Gibbs oscillation of any truncated series. The next figure shows why the
# ripples matter: it has the energy of the mesh (the host), of a mark by the keyed scheme, and of three attacks in each
# of 64 bands. The host has ten thousand times more energy next to λ = 0 than elsewhere. So a ripple of 1 % there passes
# as much energy as a band should hold in total.

# %%
marker = jm.make_marker(mesh, jm.new_key(), bits=64)
marked, info = marker.embed(b"jaxmark!", jm.Budget(rms=8e-4, noise=0))
attacked = {
    "noise 0.5 %": jm.attack(marked, "noise", 0.005, seed=0),
    "50 steps of smoothing": jm.attack(marked, "smoothing", 50, seed=0),
    "8 bits": jm.attack(marked, "quantisation", 8, seed=0),
}
moves = {"mark": (mesh, marked)} | {name: (marked, suspect) for name, suspect in attacked.items()}
plot.spectra(original, moves).save("03_2.png")

# %% [markdown]
# The mark is written at low frequencies, except for the very lowest, which hold the host's shape. Noise and rounding
# have about equal energy in all bands; above 1.5 the mesh has few frequencies. Smoothing displaces the mesh far more
# than the mark does, in all bands. But nearly all of this is the effect of smoothing on the *host*, which the reader
# knows and projects off.
#
# `report` measures how cleanly bands are separated. *Leakage* is the share of a band's energy that comes from outside
# its pass band. *Coherence* is the absolute inner product of the normalised components of two bands. Both should be
# near 0. A quadrature of the mesh's spectral measure computes them exactly, without eigenvectors.

# %%
operator = from_mesh(mesh)
measure = quadrature(operator, centre(operator, np.asarray(mesh.vertices))[:, 0], 256)


def measured(name: str, family: np.ndarray):
    """Measure leakage and coherence of a family. Bernstein's bands are equally wide in λ, others in arccos(1 - λ)."""
    return report(measure, family, edges=np.linspace(0, 2, BANDS + 1) if name == "Bernstein" else None)


print("family              leakage  coherence  overshoot")
for name, family in shown.items():
    figures = measured(name, family)
    leakage = np.median(figures.leakage)
    print(f"{name:<18} {leakage:8.4f} {figures.coherence_median:10.4f} {figures.overshoot.max():10.3f}")
assert np.median(measured("damped", shown["damped (Jackson)"]).leakage) < 0.01

# %% [markdown]
# ## Degree
#
# Bands of degree n take n products with the Laplacian, which all bands share; each product visits every edge once. A
# sharper band needs a higher degree. With damping, twice as many terms as bands are enough; without damping, eight
# times as many are barely enough. Damping makes a band nearly twice as wide.

# %%
print("degree   " + "  ".join(f"{name:>18}" for name in shown))
for degree in (15, 31, 63, 127):
    row = {name: np.median(measured(name, family).leakage) for name, family in families(degree).items()}
    print(f"{degree:>6}   " + "  ".join(f"{row[name]:18.4f}" for name in shown))
plot.responses({f"degree {degree}": families(degree)["damped (Jackson)"] for degree in (15, 31, 63)}).save("03_3.png")

# %% [markdown]
# The keyed scheme has 64 damped bands of degree 63. It writes in the lowest 20 of them, and its reader weights each
# band by the part of the mark that is left in it. The overlap of neighbouring bands does no harm.
#
# ## Visibility
#
# A displacement of the same size is far more visible at high frequencies. DAME, the change of angles between
# neighbouring faces, rises by a factor of a hundred over the spectrum. This is another reason to use low frequencies.
# `04_tune_the_bands.py` balances visibility against robustness.

# %%
pictures.band_visibility(original, ["rms", "gl", "dame"]).save("03_4.png")

# %% [markdown]
# ## Payload
#
# `jm.capacity` computes how many bits survive a given noise with half of the vertices lost. Two things limit it: the
# *degrees of freedom* (dimensions of the pass band that projection leaves, shared by all bits and the tag), and the
# *energy* of the mark, shared by all bits, against that of the noise. Twice the displacement is four times the energy,
# and carries four times the bits, until the degrees of freedom are used up. Below some dozens of bits, the tag takes
# most of the capacity.

# %%
for budget in (2e-4, 4e-4, 8e-4):
    print(f"RMS {budget:.2%} of the diagonal: {jm.capacity(mesh, jm.Budget(rms=budget, noise=0.005)):4} bits")

# %% [markdown]
# A larger message is refused, and the error says how to mend it:

# %%
try:
    jm.embed(mesh, bytes(128), jm.new_key(), budget=4e-4)
except jm.JaxmarkError as refusal:
    print(refusal)

# %% [markdown]
# At the same displacement, more bits survive less noise. Each curve is the share of messages read exactly, with 95 %
# intervals, which are wide because there are few samples.

# %%
curves = {}
for size in (2, 16):
    one = jm.make_marker(mesh, jm.Key(bytes(32)), bits=8 * size)
    message = bytes(range(size))
    mesh_with, _ = one.embed(message, jm.Budget(rms=4e-4, noise=0), read_back="never")
    curves[f"{8 * size} bits"] = jm.robustness(one, mesh_with, message, "noise", [0.004, 0.012], samples=2)
    print(f"{8 * size} bits:", curves[f"{8 * size} bits"].success.mean(axis=1))
pictures.success(curves, jm.adversaries.ATTACKS["noise"].unit).save("03_5.png")

# %% [markdown]
# ## Recommendations
#
# - Use 64 bands of damped scaling functions, the default, for nearly all meshes.
# - Use as few bits as you need; 64 identify any entry of a table. The energy that is left makes the mark stronger.
# - Limit a perceptual metric, instead of using one displacement for all meshes.
# - Run `jm.capacity` before marking, and `jm.robustness` after.
