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
# # A robustness study with your own mesh
#
# A study is declared as a grid and run by one line. To use a mesh of your own, change the one line below.

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
    budgets=[4e-4],  # RMS of the mark over the diagonal: weak, so that there is something to lose
    attacks={"noise": [0.002, 0.005, 0.02], "quantisation": [9, 7]},
    samples=3,
)
results = study.run(FOLDER / "results.jsonl", say=print)

# %% [markdown]
# Each line of `results.jsonl` is a finished cell. Run the cell above again: nothing is left to do, and it ends at once.
# Add a strength, and only that is done. With `workers=2` there are two processes; a script (not Jupyter) then has to
# start them below `if __name__ == "__main__":`.
#
# Every sample has a seed of its own: another key, another message, another attack. So the trials are independent,
# and the share that was read has an exact interval (Clopper and Pearson, 1934), which covers the true rate with at
# least 95 % probability whatever it is. From three trials that all read, it begins at 29 %: few trials prove little.

# %%
print(results.markdown())
for rate in results.rates(["attack", "strength", "control"]):
    if rate["control"] == "marked":
        print(
            f"{rate['attack']} {rate['strength']:g}: {rate['read']} of {rate['trials']} read,"
            f" {rate['read_low']:.0%} to {rate['read_high']:.0%}; median log10 p {rate['log10_p']:.1f}"
        )

# %% [markdown]
# A reading proves something only if what is not marked is not read. Two controls went through the same pipeline: the
# unmarked mesh after the same attacks, read with the right key, and the marked one read with another key. Here they are
# pooled over all attacks.

# %%
for rate in results.rates(["control"]):
    if rate["control"] != "marked":
        print(f"{rate['control']}: {rate['detected']} of {rate['trials']}, rate at most {rate['detected_high']:.0%}")
        assert rate["detected"] == 0

# %% [markdown]
# The curves: the share of messages read over the strength of each attack, the controls in grey; and the evidence, with
# the level at which a mark counts as detected and the floor below which nothing is proven. With pandas (extra `study`),
# `results.frame()` is a table of all readings.

# %%
results.plot().save("05_1.png")

# %%
results.plot("log10_p_unfloored").save("05_2.png")

# %%
frame = results.frame()
print(frame.groupby(["attack", "strength", "control"])[["read", "detected", "log10_p", "seconds"]].mean().round(2))
