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
# # Choosing bands, degree and payload
#
# A mark is written in bands of frequencies. How the bands are cut out decides how cleanly they are told apart; their
# degree, what they cost; the mesh, its budget and the noise to survive, how many bits they carry. This notebook
# measures each on one mesh. `docs/bands.md` has all families on five meshes.

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
# A family is a matrix of Chebyshev coefficients, one band a row, whose responses sum to 1 at every frequency λ:
# together the bands hold all of the mesh. Here are 16 bands of degree 63, four ways. To compare them at equal cost,
# families that come with as many bands as terms are made with 64, of which four neighbours are summed.

# %%
BANDS, DEGREE = 16, 63


def summed(fine: np.ndarray) -> np.ndarray:
    """Neighbours of a family of many bands as one each."""
    return fine.reshape(BANDS, -1, fine.shape[1]).sum(axis=1)


def families(degree: int) -> dict[str, np.ndarray]:
    """16 bands of one degree."""
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
# The undamped ones ripple: the Gibbs oscillation of any cut-off series. That looks harmless, until one sees where a
# mesh has its energy. Below is what each of 64 bands holds of the mesh, of a mark by the keyed scheme, and of three
# attacks. The host has ten thousand times more next to λ = 0 than elsewhere, so that a ripple of 1 % there is as much
# as all that a band should hold.

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
# The mark is written at low frequencies, but the very lowest, which belong to the host's shape. Noise and rounding are
# about equal everywhere; above 1.5 the mesh has few frequencies. Smoothing moves the mesh far more than the mark did,
# in all bands, but nearly all of it is what it does to the *host*: known, and projected off before reading.
#
# `report` puts numbers to "cleanly": *leakage* is the share of a band's energy that comes from outside its place, and
# *coherence* how nearly parallel the components of two bands are. Both should be near 0. They are exact for the mesh,
# by a quadrature of its spectral measure, without eigenvectors.

# %%
operator = from_mesh(mesh)
measure = quadrature(operator, centre(operator, np.asarray(mesh.vertices))[:, 0], 256)


def measured(name: str, family: np.ndarray):
    """Leakage and coherence of a family; Bernstein's bands are equally wide in λ, not in its angle."""
    return report(measure, family, edges=np.linspace(0, 2, BANDS + 1) if name == "Bernstein" else None)


print("family              leakage  coherence  overshoot")
for name, family in shown.items():
    found = measured(name, family)
    leakage = np.median(found.leakage)
    print(f"{name:<18} {leakage:8.4f} {found.coherence_median:10.4f} {found.overshoot.max():10.3f}")
assert np.median(measured("damped", shown["damped (Jackson)"]).leakage) < 0.01

# %% [markdown]
# ## Degree
#
# A band of degree n takes n products with the Laplacian, each as long as one look at every edge, and all bands share
# them. A sharper band takes a higher degree. With damping, twice as many terms as bands are plenty; without, eight
# times as many only just do. The price of damping is a band that is nearly twice as wide.

# %%
print("degree   " + "  ".join(f"{name:>18}" for name in shown))
for degree in (15, 31, 63, 127):
    row = {name: np.median(measured(name, family).leakage) for name, family in families(degree).items()}
    print(f"{degree:>6}   " + "  ".join(f"{row[name]:18.4f}" for name in shown))
plot.responses({f"degree {degree}": families(degree)["damped (Jackson)"] for degree in (15, 31, 63)}).save("03_3.png")

# %% [markdown]
# The keyed scheme has 64 damped bands of degree 63. Neighbours overlap, which does no harm: it writes in the lowest 20
# of them, and weighs each by what is left in it.
#
# ## Where the eye looks
#
# Displacement of the same size is seen far more at high frequencies. DAME, the change of angles between neighbouring
# faces, rises a hundredfold over the spectrum: another reason to stay low. `04_tune_the_bands.py` weighs it against
# what attacks leave.

# %%
pictures.band_visibility(original, ["rms", "gl", "dame"]).save("03_4.png")

# %% [markdown]
# ## Payload
#
# `jm.capacity` says how many bits survive the noise you name with half of the vertices lost. It comes from two things:
# *room* (dimensions of the pass band, less what is projected off: every bit and the tag take some) and *energy* (each
# bit takes its part of the mark's, against the noise's). Twice the displacement is four times the energy, and so many
# times the bits, until the room is full. Below some dozens of bits, the tag takes most.

# %%
for budget in (2e-4, 4e-4, 8e-4):
    print(f"RMS {budget:.2%} of the diagonal: {jm.capacity(mesh, jm.Budget(rms=budget, noise=0.005)):4} bits")

# %% [markdown]
# More is refused, with the mend:

# %%
try:
    jm.embed(mesh, bytes(128), jm.new_key(), budget=4e-4)
except jm.JaxmarkError as refusal:
    print(refusal)

# %% [markdown]
# And what is the price of more bits, at the same displacement? Strength against noise. Each curve is the share of
# messages read exactly, with 95 % intervals for the few samples that were taken.

# %%
curves = {}
for size in (2, 16):
    one = jm.make_marker(mesh, jm.Key(bytes(32)), bits=8 * size)
    message = bytes(range(size))
    mesh_with, _ = one.embed(message, jm.Budget(rms=4e-4, noise=0), read_back=False)
    curves[f"{8 * size} bits"] = jm.robustness(one, mesh_with, message, "noise", [0.004, 0.012], samples=2)
    print(f"{8 * size} bits:", curves[f"{8 * size} bits"].success.mean(axis=1))
pictures.success(curves, jm.adversaries.ATTACKS["noise"].unit).save("03_5.png")

# %% [markdown]
# ## In short
#
# - Damped scaling functions, 64 bands: the default, for nearly all meshes.
# - As few bits as serve: 64 name anything in a table. The rest of the energy makes the mark stronger.
# - As strong as the limits of a budget on a perceptual metric allow, not with one displacement for all meshes.
# - `jm.capacity` before, and `jm.robustness` after.
