# %% [markdown]
# # Mark a mesh and read it again
#
# A key, a message, a budget: the marked mesh looks the same, and the owner reads the message from an attacked copy.

# %%
import jaxmark as jm
from jaxmark.demo import sample_mesh

mesh = jm.load_mesh(sample_mesh())
key = jm.new_key()
marked, info = jm.embed(mesh, b"jaxmark!", key, budget=8e-4)
print(f"{len(mesh.vertices)} vertices moved by RMS {info.rms:.4%} of the diagonal, at most {info.max:.4%}")

# %% [markdown]
# A reader prepares the original once, and reads as many suspects as you like. The unmarked mesh, and the right suspect
# under a wrong key, must give nothing.

# %%
read = jm.reader(original=mesh, key=key)
suspects = {
    "marked": marked,
    "noise 0.1 %": jm.attack(marked, "noise", 0.001, seed=0),
    "quantised to 9 bits": jm.attack(marked, "quantisation", 9, seed=0),
    "smoothed 10 times": jm.attack(marked, "smoothing", 10, seed=0),
    "unmarked": mesh,
}
for name, suspect in suspects.items():
    found = read(suspect)
    print(f"{name:<20} {found.message!r:<14} log10 p {found.log10_p:6.1f}  detected: {found.detected()}")

stranger = jm.reader(original=mesh, key=jm.new_key())
assert read(marked).message == b"jaxmark!"
assert stranger(marked).message is None
assert read(mesh).message is None
