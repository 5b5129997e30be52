"""Plots over frequency: responses of bands, their strengths, and energy of host, mark and attacks in each band."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64
from numpy.polynomial import chebyshev

from jaxmark.alignment.original import Original, shift_of
from jaxmark.geometry.mesh import Mesh
from jaxmark.plot.figures import FIELD, Picture, finish, panels, styles
from jaxmark.spectral.bands import nodes, scaling
from jaxmark.spectral.chebyshev import band_energies

FREQUENCY = "frequency λ, from 0, smooth, to 2"


def responses(families: Mapping[str, Float[np.ndarray, "bands terms"]], mark: Sequence[float] = ()) -> Picture:
    """Plot the responses of families of bands over λ, one panel each; the lowest bands are dark, the highest bright.

    Families are Chebyshev coefficients (see `jaxmark.spectral.bands`) by the title of the panel; `mark` has values of λ
    for vertical lines, such as the edges between bands.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    figure, axes = panels(len(families), 4.5, 3.5, sharey=True)
    from matplotlib import colormaps

    for panel, (name, family) in zip(axes, families.items(), strict=True):
        # Dense at the ends, where bands are narrow; 8 points per term.
        grid = 1 - np.cos(np.linspace(0, np.pi, 8 * max(64, family.shape[1]) + 1))
        for place, response in enumerate(chebyshev.chebval(grid - 1, np.asarray(family, np.float64).T)):
            panel.plot(grid, response, color=colormaps[FIELD](place / max(1, len(family) - 1)), linewidth=1)
        for place in mark:
            panel.axvline(place, color="grey", linewidth=0.5)
        finish(panel, title=name, xlabel=FREQUENCY, ylabel="response f(λ)")
    return Picture(figure)


def strengths(betas: Mapping[str, Float[np.ndarray, " bands"]]) -> Picture:
    """Plot strengths β of bands, in diagonals, over λ, such as `Tuned.beta`, by the name of the line.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    figure, (axes,) = panels()
    for (name, beta), style in zip(betas.items(), styles(64), strict=False):
        axes.plot(nodes(len(beta)), beta, label=name, **style)
    finish(axes, xlabel=FREQUENCY, ylabel="strength β of a band / diagonal", ylim=(0, None))
    return Picture(figure)


def spectra(original: Original, moves: Mapping[str, tuple[Mesh, Mesh]], bands: int = 64) -> Picture:
    """Plot the energy of the host, and of displacements of it, in each of several Jackson-damped scaling functions.

    A point is the mean square displacement of the vertices in a band; for the host, their displacement from its centre.

    Args:
        original: the original.
        moves: pairs of meshes before and after a change, by the name of the change: original and marked mesh, marked
            and attacked mesh. All have the original's connectivity and pose.
        bands: number of bands.

    Raises:
        JaxmarkError: if matplotlib is missing, or a connectivity differs.
    """
    signals = {"host": original.to_host(original.signal)}
    for name, (before, after) in moves.items():
        signals[name] = shift_of(original, after) - shift_of(original, before)
    figure, (axes,) = panels()
    for (name, signal), style in zip(signals.items(), styles(bands), strict=False):
        axes.plot(nodes(bands), mean_squares(original, signal, bands), label=name, **style)
    finish(axes, xlabel=FREQUENCY, ylabel="mean square in the band / diagonal²", yscale="log")
    return Picture(figure)


def mean_squares(
    original: Original, signal: Float64[np.ndarray, "points 3"], bands: int
) -> Float64[np.ndarray, " bands"]:
    """Compute the mean square of a displacement (in diagonals) in each band, over the vertices that faces use.

    Vertices are weighted by valence, as in the inner product of the bands. Values at the level of rounding are NaN.
    """
    family, x = jnp.asarray(scaling(bands, damping="jackson"), original.signal.dtype), original.to_traced(signal)
    energies = np.asarray(band_energies(original.operator, family, x, x), np.float64)
    floor = 10 * float(np.finfo(original.signal.dtype).eps) * energies.sum() / bands
    return np.where(energies > floor, energies, np.nan) / original.used.sum()
