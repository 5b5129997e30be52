"""Denoising, which removes small detail as noise: shrinkage of wavelets, and averages over similar places."""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxmark.attacks.support import Strength, centred, diagonal, displace, on_host, surface
from jaxmark.distortion.norms import root
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices, vertex_normals
from jaxmark.seeds import Randomness, Seed
from jaxmark.spectral.bands import heat, meyer
from jaxmark.spectral.chebyshev import band_components, synthesise
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.padding import common_laplacian, pad_rows

_OCTAVES = 7  # of wavelets, and a low-pass below λ = 0.03, which is the shape and stays
_COARSER = 4  # times of diffusion, each twice the one before, by which places are compared
_ALIKE = 64  # places that are averaged
_frame = lru_cache(maxsize=1)(meyer)


def shrinkage(mesh: Mesh, strength: Strength, seed: Seed | None = None) -> Mesh:
    """Shrink the coefficients of spectral wavelets towards zero, each vector of three by the same length at most.

    Donoho, "De-noising by soft-thresholding", IEEE Transactions on Information Theory 41(3), 1995, with the tight
    frame of Meyer wavelets of the graph Laplacian, `jaxmark.spectral.bands.meyer`: what is small at its place and in
    its octave is removed, what is large keeps its direction. All vertices that faces use move, those on a boundary too.
    The strength is the length that is taken from each coefficient, relative to the diagonal of the bounding box.
    Differentiable with respect to vertices and strength, in reverse mode.
    """
    start, operator = centred(mesh), from_mesh(mesh)
    frame = _frame(_OCTAVES + 1).astype(start.dtype)
    parts = band_components(operator, frame, start)
    length = root(jnp.sum(parts**2, axis=-1, keepdims=True))
    most = jnp.asarray(strength).astype(start.dtype) * diagonal(surface(mesh))
    removed = parts * jnp.where(length > most, most / jnp.where(length > most, length, 1), 1)
    return displace(mesh, -synthesise(operator, frame, removed.at[0].set(0)))


@on_host
def nonlocal_means(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Replace the detail at each place by the mean detail of similar places on the whole surface; on the host.

    Non-local means (Buades, Coll, Morel, "A non-local algorithm for image denoising", CVPR 2005; on meshes Yoshizawa,
    Belyaev, Seidel, "Smoothing by example", SMI 2006). Detail is the offset along the normal between a vertex and the
    surface after diffusion of a time t. Places are similar if the differences of the diffusions t, 2t, … 16t along
    their normals are similar. The 64 most similar places are averaged with the weights exp(-d²/h²), where h is the
    median of the largest distances. The strength is the time t, at most 1,000, in units of the graph Laplacian:
    exp(-tΔ) is about t steps of smoothing.
    """
    if strength > 1000:
        raise JaxmarkError(f"The time of diffusion of non-local means is 1,000 at most, got {strength:g}.")
    used = used_vertices(mesh)
    vertices, normals = np.asarray(mesh.vertices, np.float64), vertex_normals(mesh)
    operator = common_laplacian(mesh)
    rows = jnp.asarray(pad_rows(vertices - vertices[used].mean(axis=0), len(operator.degree)), jnp.result_type(float))
    times = strength * 2.0 ** np.arange(_COARSER + 1)
    diffused = np.asarray(band_components(operator, heat(times), rows), np.float64)[:, : len(vertices)]
    steps = np.diff(np.concatenate([np.asarray(rows, np.float64)[None, : len(vertices)], diffused]), axis=0)
    offsets = -np.einsum("svc,vc->vs", steps, normals)[used]
    detail, coarser = offsets[:, 0], offsets[:, 1:]
    spread = np.sqrt(np.mean(coarser**2, axis=0))
    places = coarser / np.where(spread > 0, spread, 1)
    apart, alike = KDTree(places).query(places, min(_ALIKE, len(places)))
    apart, alike = apart.reshape(len(places), -1), alike.reshape(len(places), -1)
    width = np.median(apart[:, -1]) or 1.0
    weights = np.exp(-((apart / width) ** 2))
    mean = (weights * detail[alike]).sum(axis=1) / weights.sum(axis=1)
    moved = vertices.copy()
    moved[used] += (mean - detail)[:, None] * normals[used]
    return Mesh(moved, mesh.faces)
