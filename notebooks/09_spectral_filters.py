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
# # Spectral filters
#
# This notebook is for researchers who want spectral filters in JAX, and no watermark. `jaxmark.spectral` filters
# signals on any graph by pure functions, without eigenvectors. Derivatives are available with respect to every input.

# %% tags=["remove-cell"]
import importlib.util
import subprocess
import sys

if importlib.util.find_spec("jaxmark") is None:  # in the folder of notebooks of a clone
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "..[plot]"], check=True)

# %%
import jax
import jax.numpy as jnp
import numpy as np

from jaxmark import Mesh, plot, spectral
from jaxmark.geometry import asteroid

mesh = asteroid(28_000)  # or a file of your own: jm.load_mesh("model.obj")
operator = spectral.from_mesh(mesh)
x = jnp.asarray(spectral.centre(operator, mesh.vertices), jnp.float32)
size = float(jnp.linalg.norm(jnp.ptp(x, axis=0)))  # the diagonal


def error(y):
    """Compute the RMS distance to the original, relative to the diagonal."""
    return float(jnp.sqrt(jnp.mean(jnp.sum((y - x) ** 2, axis=1))) / size)


# %% [markdown]
# ## Denoise a scan by one filter
#
# The filter 1/(1 + τλ²) keeps low frequencies λ and damps noise. Gradient descent finds τ, by differentiating through
# conjugate gradients. The example compares with the true surface; in practice, compare with a second scan.

# %%
scan = x + 0.002 * size * jax.random.normal(jax.random.key(0), x.shape)


@jax.jit
@jax.value_and_grad
def miss(log_tau):
    section = jnp.stack([*map(jnp.float32, (1, 0, 0, 1, 0)), jnp.exp(log_tau)])
    return jnp.mean((spectral.filter_rational(operator, section[None], scan) - x) ** 2) / size**2 * 1e6


log_tau = jnp.float32(0)
for _ in range(20):
    loss, slope = miss(log_tau)
    log_tau -= 0.5 * jnp.sign(slope) * jnp.minimum(jnp.abs(slope), 1)
section = jnp.array([[1, 0, 0, 1, 0, jnp.exp(log_tau)]])
smooth = spectral.filter_rational(operator, section, scan)
print(f"error {error(scan):.2e} before, {error(smooth):.2e} after, with τ = {float(jnp.exp(log_tau)):.1f}")
assert error(smooth) < error(scan)


def view(title, y):
    return plot.View(title, mesh._replace(vertices=np.asarray(y, np.float64)))


plot.draw([view("original", x), view("scan", scan), view("filtered", smooth)]).save("09_1.png")

# %% [markdown]
# ## Heat on a point cloud
#
# Filters work on any graph, such as that of points and their nearest neighbours. Here heat flows from one point, for up
# to 10⁴ units of time.

# %%
cloud = spectral.from_points(mesh.vertices, 8, "gaussian")
spark = jnp.zeros(len(mesh.vertices)).at[jnp.argmax(mesh.vertices[:, 2])].set(1)
views = []
for time in (1.0, 100.0, 1e4):
    warm = spectral.heat(cloud, spark, time)
    reached, whole = np.mean(np.asarray(warm) > 1e-6), float(cloud.inner(warm, jnp.ones_like(warm)))
    print(f"t = {time:g}: {reached:.1%} of the points are warm, total heat {whole:.3f}")
    views.append(plot.View(f"t = {time:g}", mesh, np.asarray(warm / warm.max(), np.float64), "of the warmest"))
plot.draw(views).save("09_2.png")

# %% [markdown]
# ## Wavelets and their inverse
#
# Meyer wavelets are a frame: the parts of a signal determine the signal. Small coefficients are mostly noise, so they
# are set to 0 before the inverse.

# %%
bank = spectral.bands.meyer(6)
lower, upper = spectral.frame_bounds(bank)
details = spectral.band_components(operator, bank, scan)
clean = spectral.inverse(operator, bank, jnp.where(jnp.abs(details) > 0.003 * size, details, 0))
back = spectral.inverse(operator, bank, details)
print(f"frame bounds {lower:.4f}, {upper:.4f}; error {error(clean):.2e}; unchanged parts reproduce the scan")
assert jnp.allclose(back, scan, atol=1e-4 * size)
assert error(clean) < error(scan)

# %% [markdown]
# ## A learned filter
#
# Two layers of Chebyshev convolution learn to estimate the noise. Each step draws a new noisy scan.

# %%
keys = jax.random.split(jax.random.key(1), 2)
layers = [spectral.init_cheb_conv(key, *shape, degree=6) for key, shape in zip(keys, ((3, 8), (8, 3)), strict=True)]
layers[1] = jax.tree.map(jnp.zeros_like, layers[1])  # so that the network starts as the identity


def denoise(layers, noisy):
    differences = 100 * operator.apply(noisy)  # of each vertex from the mean of its neighbours
    hidden = jax.nn.tanh(spectral.cheb_conv(operator, layers[0], differences))
    return noisy - 0.01 * spectral.cheb_conv(operator, layers[1], hidden)


@jax.jit
def step(layers, momentum, key, rate):
    noisy = (x + 0.002 * size * jax.random.normal(key, x.shape)) / size
    slope = jax.grad(lambda layers: 1e5 * jnp.mean((denoise(layers, noisy) - x / size) ** 2))(layers)
    momentum = jax.tree.map(lambda old, new: 0.9 * old + new, momentum, slope)
    norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(momentum)))
    return jax.tree.map(lambda value, change: value - rate * change / norm, layers, momentum), momentum


momentum = jax.tree.map(jnp.zeros_like, layers)
rates = 0.02 * np.cos(np.linspace(0, np.pi / 2, 150)) ** 2
for key, rate in zip(jax.random.split(jax.random.key(2), 150), rates, strict=True):
    layers, momentum = step(layers, momentum, key, rate)
learned = size * denoise(layers, scan / size)
print(f"error of the learned filter {error(learned):.2e}")
assert error(learned) < error(scan)
plot.draw([view("scan", scan), view("wavelets", clean), view("learned", learned)]).save("09_3.png")

# %% [markdown]
# ## Differentiate through the operator
#
# Cotangent weights are functions of the positions, so a filter with these weights is, too. Here the vertices descend
# along the gradient of the energy of the surface's details. Memory is O(N) at any degree.


# %%
@jax.jit
@jax.value_and_grad
def roughness(vertices):
    moving = spectral.from_mesh(Mesh(vertices, mesh.faces), "cotangent")
    fine = vertices - spectral.filter(moving, spectral.bands.heat([2.0])[0], vertices)
    return jnp.sum(moving.inner(fine, fine)) / size**2


vertices = scan
for _ in range(20):
    value, slope = roughness(vertices)
    vertices -= 2e-4 * size * slope / jnp.sqrt(jnp.mean(jnp.sum(slope**2, axis=1)))
print(f"roughness {float(roughness(scan)[0]):.2e} → {float(value):.2e}; error {error(vertices):.2e}")
assert value < 0.9 * roughness(scan)[0]
