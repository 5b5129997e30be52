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
# # A robustness study of your own mesh
#
# A study measures how often messages are read after attacks, with controls and confidence intervals. It is declared as
# a grid, and run by one line. To study a mesh of your own, change the line `MESH = …`.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot,study]"], check=True)

# %%
from pathlib import Path

import jaxmark as jm
from jaxmark.geometry import asteroid

MESH = asteroid(5000)  # or: MESH = "my_model.obj"
FOLDER = Path("demo-output/study")
FOLDER.mkdir(parents=True, exist_ok=True)

study = jm.Study(
    meshes={"model": MESH},
    schemes=["keyed"],
    budgets=[4e-4],  # RMS displacement over the diagonal; weak, so that some readings fail
    attacks={"noise": [0.002, 0.005, 0.02], "quantisation": [9, 7]},
    samples=3,
)
results = study.run(FOLDER / "results.jsonl", log=print)

# %% [markdown]
# Each line of `results.jsonl` is a finished cell of the grid. If you run the code again, it ends at once, because no
# cell is missing. If you add a strength, only the new cells are computed. `workers=2` uses two processes; a script
# (unlike Jupyter) must then start them below `if __name__ == "__main__":`.
#
# Every sample has its own seed, and so its own key, message and random choices of the attack. The trials are therefore
# independent, and the rate of reading has an exact interval (Clopper and Pearson, 1934) that covers the true rate with
# a probability of at least 95 %. If all of three trials succeed, the interval begins at 29 %, so take more samples.

# %%
print(results.markdown())
for rate in results.rates(["attack", "strength", "control"]):
    if rate["control"] == "marked":
        print(
            f"{rate['attack']} {rate['strength']:g}: {rate['read']} of {rate['trials']} read,"
            f" {rate['read_low']:.0%} to {rate['read_high']:.0%}; median log10 p {rate['log10_p']:.1f}"
        )

# %% [markdown]
# A reading proves something only if unmarked meshes are not detected. Two controls go through the same pipeline: the
# unmarked mesh after the same attacks, read with the right key, and the marked mesh, read with another key. The next
# cell pools them over all attacks.

# %%
for rate in results.rates(["control"]):
    if rate["control"] != "marked":
        print(f"{rate['control']}: {rate['detected']} of {rate['trials']}, rate at most {rate['detected_high']:.0%}")
        assert rate["detected"] == 0

# %% [markdown]
# The first figure shows the share of messages read over the strength of each attack, with the controls in grey. The
# second shows the evidence, with the level from which a mark is detected, and the floor beyond which nothing is proven.
# With pandas (extra `study`), `results.frame()` returns a table of all readings.

# %%
results.plot().save("05_1.png")

# %%
results.plot("log10_p_unfloored").save("05_2.png")

# %%
frame = results.frame()
print(frame.groupby(["attack", "strength", "control"])[["read", "detected", "log10_p", "seconds"]].mean().round(2))
